"""Times without measurements in a log: of what is then assumed, and for how long, a user wants to know.

What a log's numbers say against the axes that are assumed for its sensors.

Angular rates of single samples that no vehicle turns with.

What is wrong with the stamps of a topic.

Measurements that stay the same to the last bit, as of a driver that goes on sending when its sensor does not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import HOLE_INTERVALS, ROWS_BEFORE, SHORTEST_HOLE_S, UNTYPICAL_S, Calibration, Mounting
from sonar_graph.devices import UNMEASURED_M_S
from sonar_graph.logs.adapters import Z_DOWN_TYPES, Adapter
from sonar_graph.measurements import Dvl, Floats, Imu, Ints

MOST_NAMED = 3
"""Gaps of one kind that are named one by one; of more the longest."""
_GUESSED = "the turn in between is guessed from the rates before and after"
Gaps = list[tuple[int, int]]
"""Stamps of the samples before and after, ns."""


def gap_warnings(imu: Imu, dvl: Dvl, calibration: Calibration) -> Iterator[str]:
    """What is assumed while nothing was measured, with times in seconds after the first instant with both.

    A Doppler log has a gap where estimators no longer take its velocity as linear (``dvl.gap_s``), an IMU has a
    hole where they count with turns that were not measured (`sonar_graph.navigation.imu_gaps`). Samples that
    hold for the time before them leave none. First, where one sensor begins or ends more than ``dvl.gap_s`` apart from
    the other.
    """
    yield from _apart(imu, dvl, calibration.dvl.gap_s)
    if calibration.odometry_interpolation == "hold-past":
        return
    start_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    end_ns = int(min(imu.stamps_ns[-1], dvl.stamps_ns[-1]))
    holes = [
        (max(first, start_ns), last) for first, last in _holes(imu.stamps_ns) if first < end_ns and last > start_ns
    ]
    if holes:
        yield f"imu: no sample {_times(holes, start_ns)}: {_GUESSED}, {_error_of_turns(calibration)}"
    yield from _doppler(imu, dvl, round(calibration.dvl.gap_s * 1e9), start_ns)


def is_partial(dvl: Dvl) -> NDArray[np.bool_]:
    """Rows that leave a direction of the velocity unmeasured, shape (n,)."""
    variances = np.trace(dvl.velocity_cov, axis1=1, axis2=2)
    return np.asarray(variances > 0.5 * UNMEASURED_M_S**2)


def _apart(imu: Imu, dvl: Dvl, gap_s: float) -> Iterator[str]:
    begin_s, end_s = ((int(imu.stamps_ns[row]) - int(dvl.stamps_ns[row])) * 1e-9 for row in (0, -1))
    if abs(begin_s) > gap_s:
        late, early = ("IMU", "Doppler log") if begin_s > 0 else ("Doppler log", "IMU")
        yield f"{late} begins {abs(begin_s):.1f} s after the {early}; not estimated until then"
    if abs(end_s) > gap_s:
        early, late = ("IMU", "Doppler log") if end_s < 0 else ("Doppler log", "IMU")
        yield f"{early} ends {abs(end_s):.1f} s before the {late}; not estimated from there"


def _doppler(imu: Imu, dvl: Dvl, longest_ns: int, start_ns: int) -> Iterator[str]:
    whole_ns, partial_ns = dvl.stamps_ns[~is_partial(dvl)], dvl.stamps_ns[is_partial(dvl)]
    if len(whole_ns) and whole_ns[0] > start_ns:
        yield f"dvl: no whole velocity until {(whole_ns[0] - start_ns) * 1e-9:.3f} s after the start: too few beams"
    by_beams, by_force, by_walk = [], [], []
    for gap in _longer_than(longest_ns, whole_ns):
        if _any_within(gap, partial_ns):
            by_beams.append(gap)
        elif _is_force_measured(imu, gap):
            by_force.append(gap)
        else:
            by_walk.append(gap)
    if by_beams:
        yield f"dvl: too few beams for a whole velocity {_times(by_beams, start_ns)}: completed by the IMU"
    if by_force:
        yield f"dvl: no velocity {_times(by_force, start_ns)}: bridged by the IMU, with an error that grows fast"
    if by_walk:
        yield (
            f"dvl: no velocity {_times(by_walk, start_ns)}, and no accelerometer: bridged by a random walk "
            f"(dvl.velocity_walk_density)"
        )


def _error_of_turns(calibration: Calibration) -> str:
    if any(calibration.imu.turn_sigma_rad_s):
        return "with an error of imu.turn_sigma_rad_s; heading is as unsure from there on"
    return "and counts as measured, since imu.turn_sigma_rad_s is zero; heading may be wrong from there on"


def _holes(stamps_ns: Ints) -> Gaps:
    """By the rule of `sonar_graph.navigation.imu_gaps.hole_ns`: the median of the intervals before each."""
    intervals = np.diff(stamps_ns)
    shorter, before = np.zeros(len(intervals)), np.minimum(np.arange(len(intervals)), ROWS_BEFORE)
    for lag in range(1, min(ROWS_BEFORE + 1, len(intervals))):
        shorter[lag:] += HOLE_INTERVALS * intervals[:-lag] < intervals[lag:]
    is_hole = (intervals > SHORTEST_HOLE_S * 1e9) & (2 * shorter >= before)
    is_hole[:1] &= intervals[:1] > UNTYPICAL_S * 1e9
    return _intervals_where(is_hole, stamps_ns)


def _longer_than(longest_ns: int, stamps_ns: Ints) -> Gaps:
    return _intervals_where(np.diff(stamps_ns) > longest_ns, stamps_ns)


def _intervals_where(chosen: NDArray[np.bool_], stamps_ns: Ints) -> Gaps:
    before = np.flatnonzero(chosen)
    return list(zip(stamps_ns[before].tolist(), stamps_ns[before + 1].tolist(), strict=True))


def _any_within(gap: tuple[int, int], stamps_ns: Ints) -> bool:
    first, last = np.searchsorted(stamps_ns, gap, side="right")
    return bool(last > first)


def _is_force_measured(imu: Imu, gap: tuple[int, int]) -> bool:
    within = imu.between(*gap)
    return within is not None and bool(np.isfinite(within.specific_force).all())


def _times(gaps: Gaps, start_ns: int) -> str:
    """From when to when, and how much more there is."""
    longest = sorted(sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MOST_NAMED])
    spans = [f"{(first - start_ns) * 1e-9:.3f} to {(last - start_ns) * 1e-9:.3f}" for first, last in longest]
    named = f"{', '.join(spans)} s after the start"
    if len(gaps) > len(longest):
        total_s = sum(last - first for first, last in gaps) * 1e-9
        return f"in {len(gaps)} gaps of {total_s:.1f} s together, the longest {named}"
    return named


_LEAST_PART_UPWARDS = 0.7
_MOST_OF_GRAVITY = 0.2


def gravity_warning(specific_force: Floats, mounting: Mounting, gravity_m_s2: float) -> str | None:
    """What is wrong when the typical specific force, shape (n, 3), does not point up in the body; None: nothing.

    Vehicles that can be navigated at all are near level for most of the time. A force that differs from gravity by
    more than a fifth says nothing about axes, but something about units.
    """
    measured = specific_force[np.isfinite(specific_force).all(axis=1)]
    if not len(measured):
        return None
    typical = mounting.pose().rotation().matrix() @ np.median(measured, axis=0)
    length = float(np.linalg.norm(typical))
    if abs(length - gravity_m_s2) > _MOST_OF_GRAVITY * gravity_m_s2:
        return (
            f"the typical specific force is {length:.3g} m/s2 instead of {gravity_m_s2:.3g}: give its scale (9.80665 "
            f"where it is in g), or turn off use_gravity in the calibration where gravity was taken out"
        )
    if typical[2] >= _LEAST_PART_UPWARDS * length:
        return None
    axis = int(np.argmax(np.abs(typical)))
    sign, advice = ("-" if typical[axis] < 0 else "+"), _ROTATIONS[axis, bool(typical[axis] < 0)]
    return f"gravity is felt along {sign}{'xyz'[axis]} ({typical[axis]:.2f} m/s2) instead of the body's +z: {advice}"


_ROTATIONS = {
    (0, False): "give rotation = [0, -90, 0] or the IMU's mounting",
    (0, True): "give rotation = [0, 90, 0] or the IMU's mounting",
    (1, False): "give rotation = [90, 0, 0] or the IMU's mounting",
    (1, True): "give rotation = [-90, 0, 0] or the IMU's mounting",
    (2, True): 'give rotation = "frd", or linear_acceleration_scale = -1 where only the sign is wrong',
}
"""By axis and whether gravity is felt against it."""


def axes_warning(adapter: Adapter) -> str | None:
    """That a driver may keep to its message's definition, where that has z down and nothing else is known."""
    if adapter.type not in Z_DOWN_TYPES or adapter.rotation != "flu":
        return None
    return (
        f"by its definition {adapter.type} has z downwards, and no mounting says how the instrument sits; it is read "
        f'as x forward, y left, z up: give rotation = "frd" where the driver keeps to the definition'
    )


LEAST_RAD_S = 1.0
LEAST_RATIO = 20.0
"""A spike stands out by more than this times what is exceeded by one sample in a hundred."""


def spike_warning(imu: Imu) -> str | None:
    """Samples that differ from both their neighbours, which agree; None: there is none.

    ``e_k = |w_k - (w_k-1 + w_k+1) / 2|`` is a spike above `LEAST_RAD_S` and `LEAST_RATIO` times its 99 % quantile,
    where ``|w_k+1 - w_k-1| < e_k / 2``.
    """
    rate = imu.angular_velocity
    if len(rate) < 3:
        return None
    off = np.linalg.norm(rate[1:-1] - (rate[:-2] + rate[2:]) / 2, axis=1)
    agree = np.linalg.norm(rate[2:] - rate[:-2], axis=1) < off / 2
    spikes = np.flatnonzero(agree & (off > max(LEAST_RAD_S, LEAST_RATIO * float(np.quantile(off, 0.99))))) + 1
    if not spikes.size:
        return None
    largest = int(spikes[np.argmax(off[spikes - 1])])
    at_s = (imu.stamps_ns[largest] - imu.stamps_ns[0]) * 1e-9
    count = "1 angular rate stands" if len(spikes) == 1 else f"{len(spikes)} angular rates stand"
    return (
        f"{count} out from both neighbours, by {off[largest - 1]:.3g} rad/s at most, {at_s:.3f} s after the first: "
        f"heading is wrong from there on, leave such messages out"
    )


_NS_PER_S = 1e9
_LARGEST_LAG_S = 1.0
_LARGEST_LAG_CHANGE_S = 0.5


def stamp_faults(stamps_ns: Ints, log_times_ns: Ints) -> Iterator[str]:
    """In words, what a reader of the numbers would want to know.

    Parameters
    ----------
    stamps_ns
        Of the headers, in the order of the file, shape (n,).
    log_times_ns
        When each message was recorded, shape (n,).
    """
    unset = (stamps_ns == 0) & (log_times_ns != 0)  # recorded at 0, 0 is the time: data sets begin there
    if unset.any():
        yield f"{_messages(int(unset.sum()))} without a stamp: the time of recording is used"
    stamps_ns, log_times_ns = stamps_ns[~unset], log_times_ns[~unset]
    if len(stamps_ns) < 2:
        return
    steps_ns = np.diff(stamps_ns)
    if (steps_ns < 0).any():
        yield f"{_occasions(steps_ns < 0)} backwards, by {-steps_ns.min() / _NS_PER_S:.3g} s at most: rows are sorted"
    again = len(stamps_ns) - len(np.unique(stamps_ns))
    if again:
        yield f"{_messages(again)} with the stamp of another"
    yield from _lag(log_times_ns - stamps_ns)


def _lag(lag_ns: Ints) -> Iterator[str]:
    """How recording follows stamps: another clock, or one that jumps or drifts."""
    typical_s = float(np.median(lag_ns)) / _NS_PER_S
    if abs(typical_s) > _LARGEST_LAG_S:
        side = "before" if typical_s > 0 else "after"
        yield f"stamped {abs(typical_s):.4g} s {side} recording: another clock, or a delay"
    first_s, last_s = (float(np.median(part)) / _NS_PER_S for part in (lag_ns[:20], lag_ns[-20:]))
    if abs(last_s - first_s) > _LARGEST_LAG_CHANGE_S:
        yield f"stamps and recording drift apart by {abs(last_s - first_s):.3g} s: a clock jumped or runs wrong"


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count} messages"


def _occasions(which: np.ndarray) -> str:
    count = int(np.count_nonzero(which))
    return "once" if count == 1 else f"{count} times"


LEAST_S = 1.0
LEAST_ROWS = 5
"""A stretch of equal rows is named from more than this time and at least this many rows on."""
MOST_STUCK_NAMED = 3
"""Stretches that are named one by one; of more the longest."""


def stuck_warning(stamps_ns: Ints, values: Floats, quantity: str) -> str | None:
    """Stretches of rows that are equal to the bit, zeros or not; None: there are none.

    They are used as they are: a vehicle at rest in a simulator, or coarse steps of a sensor, may look so as well.

    Parameters
    ----------
    values
        Shape (n, 3).
    quantity
        What they are, for the text.
    """
    texts = []
    first, last = _stretches(stamps_ns, values)
    is_zero = ~np.any(values[first], axis=1)
    for chosen, what in ((is_zero, "exactly zero"), (~is_zero, "the same to the last bit")):
        if chosen.any():
            texts.append(f"{what} {_spans(stamps_ns, first[chosen], last[chosen])}")
    if not texts:
        return None
    return f"{quantity} {' and '.join(texts)}: used as measured; unless at rest, a driver may be sending without lock"


def _stretches(stamps_ns: Ints, values: Floats) -> tuple[Ints, Ints]:
    """First and last row of each."""
    differs = np.any(values[1:] != values[:-1], axis=1)
    first = np.concatenate([[0], np.flatnonzero(differs) + 1])
    last = np.concatenate([first[1:] - 1, [len(values) - 1]])
    is_long = (stamps_ns[last] - stamps_ns[first] > LEAST_S * 1e9) & (last - first + 1 >= LEAST_ROWS)
    return first[is_long], last[is_long]


def _spans(stamps_ns: Ints, first: Ints, last: Ints) -> str:
    """From when to when, and how many rows."""
    named = np.sort(np.argsort(first - last, kind="stable")[:MOST_STUCK_NAMED])
    spans = [
        f"{(stamps_ns[first[k]] - stamps_ns[0]) * 1e-9:.3f} to {(stamps_ns[last[k]] - stamps_ns[0]) * 1e-9:.3f}"
        for k in named
    ]
    text, rows = f"{', '.join(spans)} s after the first", int(np.sum(last - first + 1))
    if len(first) > len(named):
        return f"in {rows} rows of {len(first)} stretches, the longest {text}"
    return f"in {rows} rows, {text}"
