"""Faults of sensors, as they stand in the messages of a log.

Each function changes the columns of one sensor's rows and returns the `Effect`: which rows are faulty, and by how much
an estimator that cannot repair them may err. What a vehicle of another fault would have shown is not invented: unless
a function says more, an estimator is expected to do as well as without the faulty rows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Flags = NDArray[np.bool_]
Generator = np.random.Generator
NS = 1_000_000_000


class Effect(NamedTuple):
    """Size of a fault."""

    rows: Flags | None = None
    """Faulty rows, which an estimator may leave out; None: all, or none, and the sound log is the measure."""
    shift_m: float = 0.0
    """Displacement that the fault implies."""
    turn_rad: float = 0.0
    """Turn that it implies: times the vehicle's distance from its start, a displacement."""


NOBODY_CAN = Effect(shift_m=inf)
"""Effect of rows that are wrong throughout: only the name counts."""
Change = Callable[[SimpleNamespace, Generator], Effect]


@dataclass(frozen=True)
class Fault:
    """A fault of one sensor, and the words by which the terminal must name it."""

    sensor: str
    named: str
    """Regular expression."""
    change: Change
    bases: tuple[str, ...]
    """Logs for which it has a meaning."""

    @property
    def name(self) -> str:
        return self.change.__name__.removeprefix(f"{self.sensor}_").replace("_", " ")


FAULTS: list[Fault] = []
SEA, VEHICLES, ALL = ("mission",), ("mission", "akit"), ("mission", "akit", "mrclam")


def fault(
    sensor: str, named: str, bases: tuple[str, ...] = VEHICLES
) -> Callable[[Change], Change]:
    """Decorator: list a fault."""

    def add(change: Change) -> Change:
        FAULTS.append(Fault(sensor, named, change, bases))
        return change

    return add


def some(rows: SimpleNamespace, rng: Generator, share: float) -> Flags:
    """A share of the rows, at random, the first ten aside."""
    chosen = rng.random(len(rows.stamps_ns)) < share
    chosen[:10] = False
    return chosen


def one(rows: SimpleNamespace, part: float = 0.4) -> Flags:
    """A single row."""
    return np.arange(len(rows.stamps_ns)) == int(part * len(rows.stamps_ns))


def stretch(rows: SimpleNamespace, seconds: float, part: float = 0.4) -> Flags:
    """All rows of some seconds."""
    t = (rows.stamps_ns - rows.stamps_ns[0]) / NS
    return (t >= part * t[-1]) & (t < part * t[-1] + seconds)


def kept(rows: SimpleNamespace, is_kept: Flags) -> None:
    """Take the other rows out."""
    for name, column in vars(rows).items():
        setattr(rows, name, column[is_kept])


def twice(rows: SimpleNamespace, again: Flags) -> None:
    """Send rows once more."""
    order = np.sort(np.r_[np.arange(len(again)), np.flatnonzero(again)])
    for name, column in vars(rows).items():
        setattr(rows, name, column[order])


def held(rows: SimpleNamespace, column: str, at: Flags) -> None:
    values = getattr(rows, column)
    values[at] = values[np.flatnonzero(at)[0] - 1]


def interval_s(rows: SimpleNamespace) -> float:
    return float(np.median(np.diff(np.unique(rows.stamps_ns)))) / NS


def turned(rows: SimpleNamespace, before: NDArray[np.float64]) -> float:
    """Turn by which the rates differ from what they were, at most, rad."""
    return float(
        np.linalg.norm(rows.angular_velocity - before, axis=1).sum()
    ) * interval_s(rows)


# --------------------------------------------------------------------------------------------------------- IMU
@fault("imu", "imu.*no gyro or accelerometer measures", ALL)
def imu_one_rate_of_1e9(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.angular_velocity[one(rows)] = 1e9
    return Effect(one(rows))


@fault("imu", "imu.*no gyro or accelerometer measures", ALL)
def imu_one_percent_of_rates_beyond_scale(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.01)
    rows.angular_velocity[chosen] = (
        100.0 * rng.standard_normal((chosen.sum(), 3)) + 200.0
    )
    return Effect(chosen)


@fault("imu", "imu.*no gyro or accelerometer measures")
def imu_one_force_of_1e6(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.specific_force[one(rows)] = -1e6
    return Effect(one(rows))


@fault("imu", "imu.*stand.? out")
def imu_one_rate_of_30_rad_s(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.angular_velocity[one(rows), 2] = 30.0
    return Effect(one(rows), turn_rad=30.0 * interval_s(rows))


@fault("imu", "imu.*stand.? out")
def imu_five_spikes_of_20_rad_s(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = np.flatnonzero(some(rows, rng, 0.1))[::20][:5]
    rows.angular_velocity[chosen] += 20.0 * rng.choice([-1.0, 1.0], (len(chosen), 3))
    return Effect(turn_rad=5 * 20.0 * np.sqrt(3) * interval_s(rows))


@fault("imu", "imu.*force.*stand.? out")
def imu_one_force_of_500(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.specific_force[one(rows)] = 500.0
    return Effect(one(rows))


@fault("imu", "imu.*rate.*same to the last bit")
def imu_rate_stuck_for_5_s(rows: SimpleNamespace, _: Generator) -> Effect:
    before = rows.angular_velocity.copy()
    held(rows, "angular_velocity", stretch(rows, 5.0))
    return Effect(turn_rad=turned(rows, before))


@fault("imu", "imu.*rate.*exactly zero")
def imu_rate_zero_for_10_s(rows: SimpleNamespace, _: Generator) -> Effect:
    before = rows.angular_velocity.copy()
    rows.angular_velocity[stretch(rows, 10.0)] = 0.0
    return Effect(turn_rad=turned(rows, before))


@fault("imu", "imu.*force.*same to the last bit")
def imu_force_stuck_for_10_s(rows: SimpleNamespace, _: Generator) -> Effect:
    held(rows, "specific_force", stretch(rows, 10.0))
    return Effect()


@fault("imu", "imu.*force.*exactly zero")
def imu_force_zero_for_10_s(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.specific_force[stretch(rows, 10.0)] = 0.0
    return Effect(stretch(rows, 10.0))


@fault("imu", "gyro.*degrees")
def imu_rates_in_degrees(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.angular_velocity[:] = np.degrees(rows.angular_velocity)
    return NOBODY_CAN


@fault("imu", "(specific force|accelerometer).*(scale|g)")
def imu_forces_in_g(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.specific_force /= 9.80665
    return NOBODY_CAN


@fault("imu", "(specific force|accelerometer).*(scale|mg)")
def imu_forces_in_mg(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.specific_force /= 9.80665e-3
    return NOBODY_CAN


@fault("imu", "gravity is felt")
def imu_axes_rotated(rows: SimpleNamespace, _: Generator) -> Effect:
    for values in (rows.angular_velocity, rows.specific_force):
        values[:] = values[:, [2, 0, 1]]
    return NOBODY_CAN


@fault("imu", "gravity is felt along -z")
def imu_forward_right_down(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.angular_velocity *= [1, -1, -1]
    rows.specific_force *= [1, -1, -1]
    return NOBODY_CAN


@fault("imu", "gravity is felt along -z")
def imu_force_negated(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.specific_force *= -1
    return NOBODY_CAN


@fault("imu", "gyro.*(negated|sign|axes)")
def imu_rate_negated(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.angular_velocity *= -1
    return NOBODY_CAN


@fault("imu", "gyro.*(negated|sign|axes)")
def imu_yaw_rate_negated(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.angular_velocity[:, 2] *= -1
    return NOBODY_CAN


@fault("imu", "imu.*(NaN|not finite|number)", ALL)
def imu_rate_nan_in_5_percent(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.05)
    rows.angular_velocity[chosen, 1] = np.nan
    return Effect(chosen)


@fault("imu", "imu.*(NaN|infinite|not finite|number)")
def imu_force_infinite_in_5_percent(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.05)
    rows.specific_force[chosen] = np.inf
    return Effect(chosen)


@fault("imu", "imu: no sample")
def imu_gap_of_3_s(rows: SimpleNamespace, _: Generator) -> Effect:
    gone = stretch(rows, 3.0)
    turn = float(
        np.linalg.norm(rows.angular_velocity[gone], axis=1).sum()
    ) * interval_s(rows)
    kept(rows, ~gone)
    return Effect(turn_rad=turn)


@fault("imu", "imu: no sample")
def imu_gap_of_20_s(rows: SimpleNamespace, _: Generator) -> Effect:
    gone = stretch(rows, 20.0)
    turn = float(
        np.linalg.norm(rows.angular_velocity[gone], axis=1).sum()
    ) * interval_s(rows)
    kept(rows, ~gone)
    return Effect(turn_rad=turn)


@fault("imu", "imu.*stamp of another", ALL)
def imu_rows_sent_twice(rows: SimpleNamespace, rng: Generator) -> Effect:
    twice(rows, some(rows, rng, 0.1))
    return Effect()


@fault("imu", "imu.*backwards")
def imu_rows_out_of_order(rows: SimpleNamespace, _: Generator) -> Effect:
    chosen = np.flatnonzero(stretch(rows, 10.0))
    for name in ("stamps_ns", "angular_velocity", "specific_force"):
        values = getattr(rows, name)
        values[chosen] = values[chosen[::-1]]
    return Effect()


@fault("imu", "imu.*without a stamp", ALL)
def imu_first_50_stamps_unset(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns[:50] = 0
    return Effect()


@fault("imu", "imu.*without a stamp")
def imu_stamps_unset(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns[:] = 0
    return Effect()


@fault("imu", "imu.*was the clock set")
def imu_first_second_in_1970(rows: SimpleNamespace, _: Generator) -> Effect:
    first = stretch(rows, 1.0, 0.0)
    rows.stamps_ns[first] -= rows.stamps_ns[0] - NS
    return Effect(first)


@fault("imu", "imu.*(drift apart|clock)")
def imu_clock_jumps_an_hour(rows: SimpleNamespace, _: Generator) -> Effect:
    half = np.arange(len(rows.stamps_ns)) > len(rows.stamps_ns) // 2
    rows.stamps_ns[half] += 3600 * NS
    return Effect(
        turn_rad=float(np.linalg.norm(rows.angular_velocity[half], axis=1).sum())
        * interval_s(rows)
    )


@fault("imu", "imu.*(backwards|drift apart|clock)")
def imu_clock_jumps_back_2_s(rows: SimpleNamespace, _: Generator) -> Effect:
    half = np.arange(len(rows.stamps_ns)) > len(rows.stamps_ns) // 2
    rows.stamps_ns[half] -= 2 * NS
    return late_by(rows, 2.0)


def late_by(rows: SimpleNamespace, seconds: float) -> Effect:
    """Turn and way of those seconds: what a sensor is taken for that was somewhere else."""
    if hasattr(rows, "angular_velocity"):
        return Effect(
            turn_rad=float(np.linalg.norm(rows.angular_velocity, axis=1).max())
            * seconds
        )
    return Effect(
        shift_m=float(np.linalg.norm(rows.velocity, axis=1).max()) * seconds,
        turn_rad=1.0 * seconds,
    )


@fault("imu", "imu.*drift apart|DVL against IMU")
def imu_clock_drifts_1_percent(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns += ((rows.stamps_ns - rows.stamps_ns[0]) * 0.01).astype(np.int64)
    return late_by(rows, 0.01 * float(rows.stamps_ns[-1] - rows.stamps_ns[0]) / NS)


@fault("imu", "imu.*before recording")
def imu_clock_3_s_late(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns -= 3 * NS
    return late_by(rows, 3.0)


@fault("imu", "IMU begins")
def imu_first_10_s_missing(rows: SimpleNamespace, _: Generator) -> Effect:
    kept(rows, ~stretch(rows, 10.0, 0.0))
    return NOBODY_CAN  # the start pose is that of another instant


# --------------------------------------------------------------------------------------------------------- DVL
@fault("dvl", "dvl.*no vehicle")
def dvl_one_velocity_of_1e9(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.velocity[one(rows)] = 1e9
    return Effect(one(rows))


@fault("dvl", "dvl.*no vehicle")
def dvl_5_percent_at_5_m_s(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.05)
    return moved_by(rows, lambda: rows.velocity.__setitem__(chosen, 5.0))


@fault("dvl", "dvl.*no vehicle")
def dvl_20_percent_outliers(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.2)
    rows.velocity[chosen] += rng.uniform(4.0, 8.0, (chosen.sum(), 3)) * rng.choice(
        [-1.0, 1.0], (chosen.sum(), 3)
    )
    return Effect(chosen)


@fault("dvl", "dvl.*no vehicle")
def dvl_invalid_marked_by_minus_32768(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.velocity[chosen] = -32.768
    return Effect(chosen)


@fault("dvl", "dvl.*no vehicle")
def dvl_first_three_rows_wrong(rows: SimpleNamespace, _: Generator) -> Effect:
    wrong = np.array([[5.0, 0.0, 0.0], [-3.0, 4.0, 0.0], [0.0, -6.0, 2.0]])
    return moved_by(rows, lambda: rows.velocity.__setitem__(slice(3), wrong))


@fault("dvl", "dvl.*same to the last bit")
def dvl_stuck_for_20_s(rows: SimpleNamespace, _: Generator) -> Effect:
    return moved_by(rows, lambda: held(rows, "velocity", stretch(rows, 20.0)))


@fault("dvl", "dvl.*exactly zero")
def dvl_zero_for_20_s(rows: SimpleNamespace, _: Generator) -> Effect:
    return moved_by(rows, lambda: rows.velocity.__setitem__(stretch(rows, 20.0), 0.0))


def moved_by(rows: SimpleNamespace, change: Callable[[], None]) -> Effect:
    """Apply a change; way by which the velocities differ from what they were, at most."""
    before = rows.velocity.copy()
    change()
    return Effect(
        shift_m=float(np.linalg.norm(rows.velocity - before, axis=1).sum())
        * interval_s(rows)
    )


@fault("dvl", "DVL.*mm/s", ALL)
def dvl_in_mm_s(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.velocity *= 1000.0
    return NOBODY_CAN


@fault("dvl", "DVL.*(cm/s|scale)", ALL)
def dvl_in_cm_s(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.velocity *= 100.0
    return NOBODY_CAN


@fault("dvl", "DVL mounting yaw")
def dvl_axes_swapped(rows: SimpleNamespace, _: Generator) -> Effect:
    return moved_by(
        rows,
        lambda: rows.velocity.__setitem__(slice(None), rows.velocity[:, [1, 0, 2]]),
    )


@fault("dvl", "DVL mounting yaw")
def dvl_looks_astern(rows: SimpleNamespace, _: Generator) -> Effect:
    return moved_by(rows, lambda: rows.velocity.__imul__([-1, -1, 1]))


@fault("dvl", "DVL mounting yaw|gyro.*(negated|sign|axes)")
def dvl_forward_right_down(rows: SimpleNamespace, _: Generator) -> Effect:
    return moved_by(rows, lambda: rows.velocity.__imul__([1, -1, -1]))


@fault("dvl", "dvl.*covariance", ALL)
def dvl_10_percent_indefinite_covariances(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.velocity_cov[chosen] = 1e-4 * np.array(
        [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    )
    return Effect(chosen)


@fault("dvl", "dvl.*covariance", SEA)
def dvl_10_percent_negative_variances(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.velocity_cov[chosen] = -1e-2 * np.eye(3)
    return Effect(chosen)


@fault("dvl", "dvl.*no covariance", SEA)
def dvl_10_percent_zero_covariances(rows: SimpleNamespace, rng: Generator) -> Effect:
    rows.velocity_cov[some(rows, rng, 0.1)] = 0.0
    return Effect()


@fault("dvl", "dvl.*covariance", SEA)
def dvl_one_covariance_infinite(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.velocity_cov[one(rows)] = np.inf
    return Effect(one(rows))


@fault("dvl", "dvl.*(NaN|not finite|number)", ALL)
def dvl_nan_in_10_percent(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.velocity[chosen, 0] = np.nan
    return Effect(chosen)


@fault("dvl", "dvl.*(NaN|infinite|not finite|number)")
def dvl_infinite_in_10_percent(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.velocity[chosen] = -np.inf
    return Effect(chosen)


@fault("dvl", "dvl: no velocity")
def dvl_gap_of_10_s(rows: SimpleNamespace, _: Generator) -> Effect:
    return lost(rows, stretch(rows, 10.0))


@fault("dvl", "dvl: no velocity")
def dvl_gap_of_30_s(rows: SimpleNamespace, _: Generator) -> Effect:
    return lost(rows, stretch(rows, 30.0, 0.3))


def lost(rows: SimpleNamespace, gone: Flags) -> Effect:
    """Take rows out; the way of the vehicle meanwhile."""
    way_m = float(np.linalg.norm(rows.velocity[gone], axis=1).sum()) * interval_s(rows)
    kept(rows, ~gone)
    return Effect(shift_m=way_m)


@fault("dvl", "Doppler log ends", ALL)
def dvl_ends_half_way(rows: SimpleNamespace, _: Generator) -> Effect:
    kept(rows, np.arange(len(rows.stamps_ns)) < len(rows.stamps_ns) // 2)
    return Effect()


@fault("dvl", "dvl.*stamp of another", ALL)
def dvl_rows_sent_twice(rows: SimpleNamespace, rng: Generator) -> Effect:
    twice(rows, some(rows, rng, 0.2))
    return Effect()


@fault("dvl", "dvl.*backwards")
def dvl_rows_out_of_order(rows: SimpleNamespace, _: Generator) -> Effect:
    chosen = np.flatnonzero(stretch(rows, 10.0))
    for name in ("stamps_ns", "velocity", "velocity_cov"):
        values = getattr(rows, name)
        values[chosen] = values[chosen[::-1]]
    return Effect()


@fault("dvl", "dvl.*without a stamp")
def dvl_first_10_stamps_unset(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns[:10] = 0
    return Effect()


@fault("dvl", "dvl.*was the clock set", ALL)
def dvl_first_rows_in_1970(rows: SimpleNamespace, _: Generator) -> Effect:
    first = np.arange(len(rows.stamps_ns)) < 10
    rows.stamps_ns[first] -= rows.stamps_ns[0] - NS
    return Effect(first)


@fault("dvl", "dvl.*(backwards|drift apart|clock)|DVL against IMU")
def dvl_clock_jumps_back_1_s(rows: SimpleNamespace, _: Generator) -> Effect:
    half = np.arange(len(rows.stamps_ns)) > len(rows.stamps_ns) // 2
    rows.stamps_ns[half] -= NS
    return late_by(rows, 1.0)


@fault("dvl", "dvl.*(after|before) recording|DVL against IMU")
def dvl_clock_half_a_second_late(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns += NS // 2
    return late_by(rows, 0.5)


# ------------------------------------------------------------------------------------------------------- depth
@fault("depth", "depth.*no vehicle reaches", SEA)
def depth_5_percent_at_1000_m(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.05)
    rows.z_m[chosen] = -1000.0
    return Effect(chosen)


@fault("depth", "depth.*no vehicle reaches", SEA)
def depth_one_row_100_m_off(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.z_m[one(rows)] += 100.0
    return Effect(one(rows))


@fault("depth", "depth.*no vehicle reaches", SEA)
def depth_first_ten_rows_zero(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.z_m[:10] = 50.0
    return Effect(np.arange(len(rows.z_m)) < 10)


@fault("depth", "depth.*(NaN|not finite|number)", SEA)
def depth_nan_in_10_percent(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.z_m[chosen] = np.nan
    return Effect(chosen)


@fault("depth", "depth.*same to the last bit", SEA)
def depth_stuck_for_20_s(rows: SimpleNamespace, _: Generator) -> Effect:
    before = rows.z_m.copy()
    held(rows, "z_m", stretch(rows, 20.0))
    return Effect(shift_m=float(np.abs(rows.z_m - before).max()))


@fault("depth", "depth.*(no vehicle reaches|unit|start)", SEA)
def depth_in_mm(rows: SimpleNamespace, _: Generator) -> Effect:
    before = rows.z_m.copy()
    rows.z_m *= 1000.0
    return Effect(shift_m=float(np.abs(rows.z_m - before).max()))


@fault("depth", "depth.*(no vehicle reaches|sign|start)", SEA)
def depth_positive_downwards(rows: SimpleNamespace, _: Generator) -> Effect:
    before = rows.z_m.copy()
    rows.z_m *= -1.0
    return Effect(shift_m=float(np.abs(rows.z_m - before).max()))


@fault("depth", "depth.*(no vehicle reaches|start)", SEA)
def depth_with_the_air_s_pressure(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.z_m -= 10.33
    return Effect(shift_m=10.33)


@fault("depth", "depth.*covariance", SEA)
def depth_10_percent_negative_variances(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.variance_m2[chosen] = -1e-4
    return Effect(chosen)


@fault("depth", "depth.*(positive definite|covariance|variance)", SEA)
def depth_one_variance_infinite(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.variance_m2[one(rows)] = np.inf
    return Effect(one(rows))


@fault("depth", "depth.*(without a stamp|clock)", SEA)
def depth_first_10_stamps_unset(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns[:10] = 0
    return Effect()


@fault("depth", "depth.*before recording", SEA)
def depth_clock_5_s_late(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns -= 5 * NS
    return Effect(shift_m=5.0 * 3.0)  # no vehicle changes its depth by more than 3 m/s


# -------------------------------------------------------------------------------------------------- detections
@fault("detections", "detections.*positive definite", ALL)
def detections_one_indefinite_covariance(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.range_azimuth_cov[one(rows)] = [[1e-4, 1.0], [1.0, 1e-4]]
    return Effect(one(rows))


@fault("detections", "detections.*positive definite", ALL)
def detections_10_percent_zero_covariances(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.range_azimuth_cov[chosen] = 0.0
    return Effect(chosen)


@fault("detections", "detections.*(range|number)", ALL)
def detections_5_percent_negative_ranges(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.05)
    rows.range_m[chosen] *= -1.0
    return Effect(chosen)


@fault("detections", "detections.*(NaN|not finite|number)", ALL)
def detections_nan_in_5_percent(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.05)
    rows.azimuth_rad[chosen] = np.nan
    return Effect(chosen)


@fault("detections", "detections.*azimuth", ALL)
def detections_azimuth_in_degrees(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.azimuth_rad[:] = np.degrees(rows.azimuth_rad)
    return NOBODY_CAN


@fault("detections", "(contradict|far outside|lost its way|azimuth)", ALL)
def detections_azimuth_negated(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.azimuth_rad *= -1.0
    return NOBODY_CAN


@fault("detections", "(contradict|far outside|lost its way|range)", ALL)
def detections_range_in_mm(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.range_m *= 1000.0
    return NOBODY_CAN


@fault("detections", "(contradict|far outside|lost its way|outlier|innovation)", ALL)
def detections_10_percent_wrong_ranges(rows: SimpleNamespace, rng: Generator) -> Effect:
    chosen = some(rows, rng, 0.1)
    rows.range_m[chosen] *= rng.uniform(1.5, 2.5, chosen.sum())
    return NOBODY_CAN


@fault("detections", "(contradict|far outside|lost its way|identit)", ALL)
def detections_20_percent_wrong_identities(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.2)
    best = rows.id_probability.argmax(axis=1)
    known = np.unique(rows.candidate_ids[rows.candidate_ids >= 0])
    rows.candidate_ids[chosen, best[chosen]] = rng.choice(known, chosen.sum())
    return NOBODY_CAN


@fault("detections", "(contradict|far outside|lost its way|identit)", ALL)
def detections_all_of_one_identity(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.candidate_ids[:] = np.where(
        rows.candidate_ids >= 0, rows.candidate_ids.max(), -1
    )
    rows.id_probability[:, 1:] = 0.0
    return NOBODY_CAN


@fault("detections", "(detections|landmarks).*(after|before) recording", ALL)
def detections_clock_2_s_late(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns -= 2 * NS
    return NOBODY_CAN


@fault(
    "detections",
    "(detections|landmarks).*(without a stamp|clock|before the first)",
    ALL,
)
def detections_first_10_stamps_unset(rows: SimpleNamespace, _: Generator) -> Effect:
    rows.stamps_ns[:10] = 0
    return Effect()


@fault("detections", "detections.*(probabilit|posterior)", ALL)
def detections_5_percent_probabilities_of_97(
    rows: SimpleNamespace, rng: Generator
) -> Effect:
    chosen = some(rows, rng, 0.05)
    rows.id_probability[chosen] = 97.0
    return Effect(chosen)
