"""Checks of a log's numbers: stamps, gaps, axes, units, stuck sensors and single wild angular rates.

Nothing is corrected here. Each check returns sentences for the notes of a sequence and for `inspect_log`
(docs/design/0004-logs.md).
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import (
    HOLE_INTERVALS,
    ROWS_BEFORE,
    SHORTEST_HOLE_S,
    UNTYPICAL_S,
    Calibration,
    Mounting,
)
from sonar_graph.devices import is_partial
from sonar_graph.logs.adapters import Z_DOWN_TYPES, Adapter
from sonar_graph.measurements import NS_PER_S, Depth, Dvl, Floats, Imu, Ints
from sonar_graph.states import counted

Mask = NDArray[np.bool_]
MOST_NAMED = 3
"""Gaps or stretches of one kind that are named one by one; of more, the longest."""
LEAST_PART_UPWARDS = 0.7
"""Part of the typical specific force that must point up in the body."""
FELT_ALONG = "gravity is felt along"
OTHER_WAYS = "specific forces point another way from row to row"
SAME_DIRECTION = 0.5
"""Length of the typical force over the typical length, below which rows contradict each other."""
MOST_OFF_GRAVITY = 0.2
"""Relative difference between specific force and gravity above which units are in doubt."""
SPIKES = {
    "angular rate": (1.0, "rad/s", "heading is wrong from there on"),
    "specific force": (
        30.0,
        "m/s2",
        "gravity and gaps of the Doppler log are wrong there",
    ),
}
"""Least spike of a quantity, its unit, and what it does; 3 g of a single sample, without a trace in the next, is no
blow."""
SPIKE_RATIO = 20.0
"""A spike exceeds the 99 % quantile of all differences by this factor."""
LARGEST_LAG_S = 1.0
"""Median time between stamp and recording that is still usual."""
LONG_GAP_S = 1.5
"""Time without a Doppler sample, or between the first or last samples of both sensors, that a user should know of."""
LARGEST_LAG_CHANGE_S = 0.5
LEAST_MOVED = {"positions": 1.0, "heading": 0.2, "depth": 0.5, "detections": 0.5}
"""Motion, m or rad, from which on a sensor that repeats its value is stuck, by role."""
RESOLUTIONS = 3.0
FASTEST_RESTING_M_S = 0.05
"""Mean speed that the noise of a Doppler log makes at rest."""
STUCK_S = 1.0
STUCK_ROWS = 5
"""Equal rows are named when they last longer than `STUCK_S` and are at least this many."""
SURELY_STUCK_S = 3.0
SURELY_STUCK_ROWS = 10
"""The same of a sensor that is called stuck because others change meanwhile."""
LEAST_CHANGING = 0.9
"""Share of rows that differ from the row before, from which on a sensor changes."""
_ROTATIONS = {
    (0, False): "[0, -90, 0]",
    (0, True): "[0, 90, 0]",
    (1, False): "[90, 0, 0]",
    (1, True): "[-90, 0, 0]",
}
"""Rotation to give, by the axis along which gravity is felt, and whether against it."""


DAY_S = 86_400.0
DRIFTING = "stamps and recording drift apart"


def stamp_faults(stamps_ns: Ints, log_times_ns: Ints) -> Iterator[str]:
    """Faults of header stamps, shape (n,): missing, backwards, repeated, far from times of recording, or drifting."""
    # data sets begin at 0: recorded at 0, a stamp of 0 is right
    unset = (stamps_ns == 0) & (log_times_ns != 0)
    if unset.any():
        yield f"{counted(int(unset.sum()), 'message')} without a stamp: the time of recording is used"
    stamps_ns = stamps_ns[~unset]
    log_times_ns = log_times_ns[~unset]
    if len(stamps_ns) < 2:
        return
    steps_ns = np.diff(stamps_ns)
    if (steps_ns < 0).any():
        times = np.count_nonzero(steps_ns < 0)
        often = "once" if times == 1 else f"{times} times"
        yield f"{often} backwards, by {-steps_ns.min() / 1e9:.3g} s at most: rows are sorted"
    repeated = len(stamps_ns) - len(np.unique(stamps_ns))
    if repeated:
        yield f"{counted(repeated, 'message')} with the stamp of another"
    # the recorder's clock is the only other one that a log has
    lag_ns = log_times_ns - stamps_ns
    typical_s = float(np.median(lag_ns)) / 1e9
    side = "before" if typical_s > 0 else "after"
    if abs(typical_s) > DAY_S:
        yield f"stamped {abs(typical_s) / DAY_S:.0f} days {side} recording: a log was played, or a clock was not set"
    elif abs(typical_s) > LARGEST_LAG_S:
        yield f"stamped {abs(typical_s):.4g} s {side} recording: another clock, or a delay"
    # medians of some messages: a single late one is no drift
    drift_s = abs(np.median(lag_ns[-20:]) / 1e9 - np.median(lag_ns[:20]) / 1e9)
    if drift_s > LARGEST_LAG_CHANGE_S:
        yield f"{DRIFTING} by {drift_s:.3g} s: a clock jumped or runs wrong"


def gap_warnings(imu: Imu, dvl: Dvl, calibration: Calibration) -> Iterator[str]:
    """Times without measurements and the assumption that estimators make there, in seconds after the common start.

    A Doppler log has a gap worth a warning where it misses a sample for `LONG_GAP_S`. An IMU has a hole where
    estimators count with turns that were not measured (`sonar_graph.navigation.imu_gaps`). Samples that hold for the
    time before them leave no gap. A sensor that begins or ends more than `LONG_GAP_S` apart from the other is named
    first.
    """
    begin_s, end_s = (
        (int(imu.stamps_ns[row]) - int(dvl.stamps_ns[row])) * 1e-9 for row in (0, -1)
    )
    if abs(begin_s) > LONG_GAP_S:
        late, early = ("IMU", "Doppler log") if begin_s > 0 else ("Doppler log", "IMU")
        yield f"{late} begins {abs(begin_s):.1f} s after the {early}; not estimated until then"
    if abs(end_s) > LONG_GAP_S:
        early, late = ("IMU", "Doppler log") if end_s < 0 else ("Doppler log", "IMU")
        yield f"{early} ends {abs(end_s):.1f} s before the {late}; not estimated from there"
    if calibration.odometry_interpolation == "hold-past":
        return
    # estimators begin where both sensors are
    start_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    holes = imu_holes(imu.stamps_ns)
    holes = holes[
        (holes[:, 0] < min(imu.stamps_ns[-1], dvl.stamps_ns[-1]))
        & (holes[:, 1] > start_ns)
    ]
    if len(holes):
        holes[:, 0] = np.maximum(holes[:, 0], start_ns)
        turns = (
            "with an error of imu.turn_sigma_rad_s; heading is as unsure from there on"
            if any(calibration.imu.turn_sigma_rad_s)
            else "and counts as measured, since imu.turn_sigma_rad_s is zero; heading may be wrong from there on"
        )
        guess = "the turn in between is guessed from the rates before and after"
        yield f"imu: no sample {_gap_times(holes, start_ns)}: {guess}, {turns}"
    yield from _dvl_gap_warnings(imu, dvl, start_ns)


BY_BEAMS = "too few beams for a whole velocity {}: left out, and bridged as a gap"
BY_FORCE = "no velocity {}: bridged by the IMU, with an error that grows fast"
BY_WALK = "no velocity {}, and no accelerometer: bridged by a random walk (dvl.velocity_walk_density)"
"""Warnings about gaps of the Doppler log, by what bridges them; with the times of the gaps."""


def _dvl_gap_warnings(imu: Imu, dvl: Dvl, start_ns: int) -> Iterator[str]:
    """Gaps of the Doppler log, grouped by how estimators bridge them."""
    partial = is_partial(dvl.velocity_cov)
    whole_ns = dvl.stamps_ns[~partial]
    partial_ns = dvl.stamps_ns[partial]
    if len(whole_ns) and whole_ns[0] > start_ns:
        yield f"dvl: no whole velocity until {(whole_ns[0] - start_ns) * 1e-9:.3f} s after the start: too few beams"
    found: dict[str, list[list[int]]] = {BY_BEAMS: [], BY_FORCE: [], BY_WALK: []}
    is_long = np.diff(whole_ns) > LONG_GAP_S * 1e9
    for gap in _gaps_where(is_long, whole_ns).tolist():
        # rows of one or two beams inside the gap shorten it
        first, last = np.searchsorted(partial_ns, gap, side="right")
        samples = imu.between(*gap)
        bridge = BY_WALK
        if last > first:
            bridge = BY_BEAMS
        elif samples is not None and np.isfinite(samples.specific_force).all():
            bridge = BY_FORCE
        found[bridge].append(gap)
    for bridge, gaps in found.items():
        if gaps:
            yield f"dvl: {bridge.format(_gap_times(gaps, start_ns))}"


def imu_holes(stamps_ns: Ints) -> Ints:
    """Stamps before and after each hole, shape (m, 2), by the rule of `sonar_graph.navigation.imu_gaps.hole_ns`.

    An interval is a hole when it is longer than the median of the intervals before it by a factor.
    """
    intervals = np.diff(stamps_ns)
    shorter = np.zeros(len(intervals))
    before = np.minimum(np.arange(len(intervals)), ROWS_BEFORE)
    # counting shorter intervals finds the median without sorting each window
    for lag in range(1, min(ROWS_BEFORE + 1, len(intervals))):
        shorter[lag:] += HOLE_INTERVALS * intervals[:-lag] < intervals[lag:]
    is_hole = (intervals > SHORTEST_HOLE_S * 1e9) & (2 * shorter >= before)
    # the first interval has none before it to be compared with
    is_hole[:1] &= intervals[:1] > UNTYPICAL_S * 1e9
    return _gaps_where(is_hole, stamps_ns)


def _gaps_where(chosen: Mask, stamps_ns: Ints) -> Ints:
    before = np.flatnonzero(chosen)
    return np.column_stack((stamps_ns[before], stamps_ns[before + 1]))


def _gap_times(gaps: Ints | list[list[int]], start_ns: int) -> str:
    first, last = np.array(gaps).T
    named = f"{_longest(first, last, last - first, start_ns)} s after the start"
    if len(first) <= MOST_NAMED:
        return named
    return f"in {len(first)} gaps of {int(np.sum(last - first)) * 1e-9:.1f} s together, the longest {named}"


def _longest(first_ns: Ints, last_ns: Ints, size: Ints, origin_ns: int) -> str:
    """Times of the `MOST_NAMED` largest spans in their order: ``1.000 to 2.500, 4.000 to 4.200``."""
    # the largest ones, in the order of the log
    named = np.sort(np.argsort(-size, kind="stable")[:MOST_NAMED])
    return ", ".join(
        f"{(first_ns[k] - origin_ns) * 1e-9:.3f} to {(last_ns[k] - origin_ns) * 1e-9:.3f}"
        for k in named
    )


def is_without_gravity(specific_force: Floats, gravity_m_s2: float) -> bool:
    """True where specific forces, shape (n, 3), are typically so small that gravity was taken out of them."""
    sizes = np.linalg.norm(specific_force, axis=1)
    sizes = sizes[np.isfinite(sizes)]
    return bool(len(sizes) and np.median(sizes) < MOST_OFF_GRAVITY * gravity_m_s2)


def gravity_warning(
    specific_force: Floats, mounting: Mounting, gravity_m_s2: float
) -> str | None:
    """Warning when the median specific force, shape (n, 3), is not gravity upwards in the body; None: nothing is wrong.

    Vehicles that can be navigated at all are near level most of the time. A force that differs from gravity by more
    than a fifth is a wrong unit, not a wrong axis.
    """
    measured = specific_force[np.isfinite(specific_force).all(axis=1)]
    if not len(measured):
        return None
    # the median forgets manoeuvres, which the mean keeps
    typical = mounting.rotation_matrix() @ np.median(measured, axis=0)
    length = float(np.linalg.norm(typical))
    size = float(np.median(np.linalg.norm(measured, axis=1)))
    is_gravity = abs(size - gravity_m_s2) < MOST_OFF_GRAVITY * gravity_m_s2
    if is_gravity and length < SAME_DIRECTION * size:
        return (
            f"{OTHER_WAYS}: two IMUs, or two drivers, on one topic; name another "
            "`topic` under [imu] in the log configuration (--log-config FILE)"
        )
    if abs(length - gravity_m_s2) > MOST_OFF_GRAVITY * gravity_m_s2:
        return (
            f"the typical specific force is {length:.3g} m/s2 instead of {gravity_m_s2:.3g}: give its scale (9.80665 "
            "where it is in g), or `use_gravity = false` in the calibration (--calibration FILE) where gravity was "
            "taken out"
        )
    if typical[2] >= LEAST_PART_UPWARDS * length:
        return None
    axis = int(np.argmax(np.abs(typical)))
    sign = "-" if typical[axis] < 0 else "+"
    rotation = _ROTATIONS.get((axis, bool(typical[axis] < 0)))
    advice = 'give rotation = "frd", or linear_acceleration_scale = -1 where only the sign is wrong'
    if rotation is not None:
        advice = f"give rotation = {rotation} or the IMU's mounting"
    return f"{FELT_ALONG} {sign}{'xyz'[axis]} ({typical[axis]:.2f} m/s2) instead of the body's +z: {advice}"


def row_doubts(
    imu: Imu, dvl: Dvl | None, depth: Depth | None, calibration: Calibration
) -> Iterator[str]:
    """Sentences about IMU and Doppler log with which no result is to be relied on, each after its role.

    Axes of the accelerometers that gravity contradicts, quantities that are stuck, and axes of gyros and Doppler log
    that are dead or clipped.
    """
    gravity_m_s2 = calibration.gravity_m_s2
    mounting = calibration.imu.mounting
    # its owner has stated that gravity was taken out
    is_said = not calibration.use_gravity
    is_said &= is_without_gravity(imu.specific_force, gravity_m_s2)
    gravity = gravity_warning(imu.specific_force, mounting, gravity_m_s2)
    if gravity and not is_said:
        yield f"imu: {gravity}"
    # wheels turn evenly, and their rates jump
    if dvl is None or calibration.odometry_interpolation != "linear":
        return
    for quantity, stuck in stuck_quantities(imu, dvl).items():
        role = "dvl" if quantity == "velocity" else "imu"
        stamps_ns = dvl.stamps_ns if role == "dvl" else imu.stamps_ns
        if doubt := stuck_doubt(stamps_ns, stuck, quantity):
            yield f"{role}: {doubt}"
    yield from axis_doubts(imu, dvl, depth, calibration)


def axis_doubts(
    imu: Imu, dvl: Dvl, depth: Depth | None, calibration: Calibration
) -> Iterator[str]:
    """Sentences about dead and clipped axes of gyros and Doppler log, each after its role."""
    if calibration.odometry_interpolation != "linear":
        return
    rate = fresh_rows(imu.angular_velocity)
    for check in (two_sensors, dead_axes, clipped_axes):
        for fault in check(rate, "angular rate"):
            yield f"imu: {fault}: headings and positions are wrong from the first turn on"
    velocity = fresh_rows(dvl.velocity)
    faults = [
        *two_sensors(velocity, "velocity"),
        *clipped_axes(velocity, "velocity"),
        *magnitudes(velocity, "velocity"),
    ]
    if is_measured_in_full(depth, calibration):
        faults += dead_axes(velocity, "velocity", most=2)
    yield from (f"dvl: {fault}: positions are wrong" for fault in faults)


def is_measured_in_full(depth: Depth | None, calibration: Calibration) -> bool:
    """True for velocities that should change along all axes: of a vehicle that dives, and not stated to be unsure."""
    is_sure = max(calibration.dvl.velocity_sigma_m_s) < UNSURE_M_S
    return depth is not None and calibration.planar is None and is_sure


def row_oddities(
    imu: Imu | None, dvl: Dvl | None, depth: Depth | None, calibration: Calibration
) -> Iterator[tuple[str, str | None]]:
    """Results of the checks of numbers by role; None: nothing is wrong."""
    # of wheels rates jump, and values stay the same
    is_linear = calibration.odometry_interpolation == "linear"
    # quantities that are stuck beside others have a doubt of their own
    stuck = stuck_quantities(imu, dvl) if imu is not None and dvl is not None else {}
    named = {quantity for quantity, rows in stuck.items() if rows.any()}
    if imu is not None and is_linear:
        quantities = {
            "angular rate": imu.angular_velocity,
            "specific force": imu.specific_force,
        }
        for quantity, values in quantities.items():
            yield "imu", spike_warning(imu.stamps_ns, values, quantity)
            if quantity not in named:
                yield "imu", stuck_warning(imu.stamps_ns, values, quantity)
    if dvl is not None and is_linear:
        if "velocity" not in named:
            yield "dvl", stuck_warning(dvl.stamps_ns, dvl.velocity, "velocity")
        if not is_measured_in_full(depth, calibration):
            for fault in dead_axes(fresh_rows(dvl.velocity), "velocity"):
                yield "dvl", fault
    if imu is not None and dvl is not None and depth is not None:
        way_m = way_by("positions", imu, dvl, calibration, depth.stamps_ns)
        heights = depth.z_m[:, None]
        yield "depth", stuck_warning(depth.stamps_ns, heights, "height", way_m)


NEAR_ZERO = 0.1
"""Of the spread: so near 0 the least magnitude of a signal comes that changes its sign."""
UNSURE_M_S = 0.5
"""Sigma of a velocity from which on an axis is stated not to be measured."""
UNMEASURED_AXIS = "; if it is not measured: `covariance = false` under [dvl], and 1.0 for it in `dvl.velocity_sigma_m_s`"
STEPPED_BACK = "the clock of its stamps stepped back"
BURST_SHARE = 0.1
LONGEST_BURST_S = 0.2
"""Stamps are off by half of it on average, more than a sensor's own delay."""
FEWEST_FRESH = 100
ALTERNATING = 1.6
"""Mean change over one row over that over two, from which on rows alternate; of recordings up to 1.0, of noise 1."""
FEWEST_VALUES = 50
"""Number of different values below which a sensor is too coarse to show where it is clipped."""
FEWEST_CLIPPED = 5
CLIPPED_SHARE = 0.002
CLIPPED_RATIO = 5


def fresh_rows(values: Floats) -> Floats:
    """Rows that differ from the row before, shape (m, 3); none where they are too few to show anything.

    Rows of a sensor that is frozen are all alike, and have a finding of their own.
    """
    fresh = values[1:][differing(values)]
    return fresh if len(fresh) >= FEWEST_FRESH else fresh[:0]


def two_sensors(fresh: Floats, quantity: str) -> Iterator[str]:
    """A quantity, shape (n, 3), whose rows are of two sensors that take turns.

    Differences over one row are as large as those over two where all is noise, and smaller where the signal is smooth.
    """
    if not len(fresh):
        return
    over_one = np.abs(fresh[1:] - fresh[:-1]).mean(axis=0)
    over_two = np.abs(fresh[2:] - fresh[:-2]).mean(axis=0)
    axis = int(np.argmax(over_one - ALTERNATING * over_two))
    role = "dvl" if quantity == "velocity" else "imu"
    if over_one[axis] > ALTERNATING * over_two[axis]:
        yield (
            f"{quantity} along {'xyz'[axis]} changes by {over_one[axis]:.2g} from row to row, and by {over_two[axis]:.2g} "
            f"over two rows: two sensors take turns on one topic; name another `topic` under [{role}], or record them apart"
        )


def dead_axes(fresh: Floats, quantity: str, most: int = 1) -> Iterator[str]:
    """Axes of a quantity, shape (n, 3), that never change; nothing where they are more than ``most``.

    A robot on wheels has two axes that never change.
    """
    if not len(fresh):
        return
    dead = np.flatnonzero(np.ptp(fresh, axis=0) == 0)
    if 1 <= len(dead) <= most:
        names = " and ".join("xyz"[axis] for axis in dead)
        text = (
            f"{quantity} along {names} is {fresh[0, dead[0]] + 0.0:g} in every row, while the other axes change: not"
            " filled by the driver, or dead"
        )
        if quantity == "velocity":
            text += UNMEASURED_AXIS
        yield text


def clipped_axes(fresh: Floats, quantity: str) -> Iterator[str]:
    """Axes of a quantity, shape (n, 3), that are clipped.

    Noise makes every value its own, so that the largest one comes once. Where it comes `FEWEST_CLIPPED` times, in
    `CLIPPED_SHARE` of the rows, and `CLIPPED_RATIO` times as often as the next, the sensor or its driver cuts there.
    """
    for axis, values in enumerate(fresh.T):
        found, counts = np.unique(values, return_counts=True)
        if len(found) < FEWEST_VALUES:
            continue
        for limit, often, beside in (
            (found[0], counts[0], counts[1]),
            (found[-1], counts[-1], counts[-2]),
        ):
            fewest = max(FEWEST_CLIPPED, CLIPPED_SHARE * len(fresh))
            if often >= fewest and often >= CLIPPED_RATIO * beside:
                yield (
                    f"{quantity} along {'xyz'[axis]} is never beyond {limit:g}, its value in {often} rows: clipped by the"
                    " sensor's range or the driver"
                )


def magnitudes(fresh: Floats, quantity: str) -> Iterator[str]:
    """A quantity, shape (n, 3), without a sign: no axis is ever negative, and those that come near 0 turn there."""
    if not len(fresh) or (fresh < 0).any():
        return
    # a vehicle that only goes ahead has one such axis; to the side and up it goes both ways
    is_near = fresh.min(axis=0) < NEAR_ZERO * fresh.std(axis=0)
    if np.count_nonzero(is_near) >= 2:
        yield f"{quantity} is never negative along any axis: magnitudes without a sign"


def stamp_doubts(stamps_ns: Ints, log_times_ns: Ints) -> Iterator[str]:
    """Faults of stamps, shape (n,), with which no result is to be relied on: a clock that steps back, and bursts.

    A driver that stamps all samples of a read at once makes bursts: most intervals are far below the mean one.
    """
    if len(stamps_ns) < FEWEST_FRESH:
        return
    back_s = -float(np.diff(stamps_ns).min()) * 1e-9
    if back_s > LARGEST_LAG_CHANGE_S and (np.diff(log_times_ns) >= 0).all():
        yield f'{STEPPED_BACK} by {back_s:.3g} s: `stamp = "log"` uses the times of recording'
    if (period_s := burst_period_s(stamps_ns)) > LONGEST_BURST_S:
        way_out = (
            '`stamp = "log"` uses the times of recording'
            if burst_period_s(log_times_ns) <= LONGEST_BURST_S
            else "let the driver stamp each sample"
        )
        yield f"stamps come in bursts every {period_s:.2g} s, as if all samples of a read had one time: {way_out}"


def burst_period_s(stamps_ns: Ints) -> float:
    """Time from burst to burst of stamps, shape (n,), s; 0 where they come one by one."""
    intervals_s = np.diff(np.sort(stamps_ns)) * 1e-9
    is_within = intervals_s < BURST_SHARE * intervals_s.mean()
    if np.count_nonzero(is_within) < len(intervals_s) / 2:
        return 0.0
    # a hole is no usual pause
    return float(np.median(intervals_s[~is_within]))


def axes_warning(adapter: Adapter) -> str | None:
    """Warning for a type whose definition has z down, read as z up; for a DVL without a known mounting."""
    if adapter.type not in Z_DOWN_TYPES or adapter.rotation != "flu":
        return None
    return (
        f"by its definition {adapter.type} has z downwards, and no mounting says how the instrument sits; it is read "
        f'as x forward, y left, z up: give rotation = "frd" where the driver keeps to the definition'
    )


def spike_warning(stamps_ns: Ints, values: Floats, quantity: str) -> str | None:
    """Warning about single samples, shape (n, 3), that differ from both neighbours, which agree; None without one.

    ``e_k = |w_k - (w_k-1 + w_k+1) / 2|`` is a spike above the least of `SPIKES` and `SPIKE_RATIO` times its 99 %
    quantile, where ``|w_k+1 - w_k-1| < e_k / 2``.
    """
    if len(values) < 3:
        return None
    least, unit, effect = SPIKES[quantity]
    # a step has one neighbour on either side, a spike none
    off = np.linalg.norm(values[1:-1] - (values[:-2] + values[2:]) / 2, axis=1)
    # a row without accelerometers is no spike
    off[np.isnan(off)] = 0.0
    agree = np.linalg.norm(values[2:] - values[:-2], axis=1) < off / 2
    # the first row has no neighbour before it
    off[~agree | (off <= max(least, SPIKE_RATIO * float(np.quantile(off, 0.99))))] = 0.0
    count = int(np.count_nonzero(off))
    if not count:
        return None
    largest = int(np.argmax(off))
    at_s = (stamps_ns[largest + 1] - stamps_ns[0]) * 1e-9
    return (
        f"{counted(count, quantity)} {'stands' if count == 1 else 'stand'} out from both neighbours, by "
        f"{off[largest]:.3g} {unit} at most, {at_s:.3f} s after the first: {effect}, leave such messages out"
    )


def stuck_warning(
    stamps_ns: Ints, values: Floats, quantity: str, way_m: Floats | None = None
) -> str | None:
    """Warning about stretches of rows, shape (n, k), that are equal to the bit, zeros or not; None without any.

    Such rows are used as they are. A coarse sensor may look the same. With ``way_m``, the way of the vehicle until each
    row, shape (n,), a stretch counts only where the vehicle is not at rest, and where its m of n rows, with a share p that
    repeats the row before, come by chance less than once in a thousand such logs, ``n p^(m - 1) < 0.001``.
    """
    runs = Runs.of(differing(values))
    is_long = runs.are_long(stamps_ns, STUCK_S, STUCK_ROWS)
    if way_m is not None:
        # resolution alone makes short stretches of equal rows
        is_long &= ~runs.may_be_chance()
        duration_s = np.maximum(runs.span(stamps_ns) / 1e9, 1e-9)
        is_long &= runs.span(way_m) / duration_s > FASTEST_RESTING_M_S
    is_zero = ~np.any(values[runs.first], axis=1)
    texts = []
    for what, chosen in {
        "exactly zero": is_long & is_zero,
        "the same to the last bit": is_long & ~is_zero,
    }.items():
        if count := np.count_nonzero(chosen):
            rows, times = runs.text(chosen, stamps_ns)
            more = f" of {count} stretches, the longest" if count > MOST_NAMED else ","
            texts.append(f"{what} in {rows} rows{more} {times} s after the first")
    if not texts:
        return None
    why = "sending without lock" if quantity == "velocity" else "repeating old values"
    return f"{quantity} {' and '.join(texts)}: used as measured; unless at rest, a driver may be {why}"


def differing(values: NDArray[Any]) -> Mask:
    """True for each row but the first, shape (n - 1,), that differs from the row before."""
    return np.any(values[1:] != values[:-1], axis=1)


class Runs(NamedTuple):
    """Runs of successive rows that are equal."""

    first: Ints
    """First row of each, shape (k,)."""
    last: Ints

    @classmethod
    def of(cls, differs: Mask) -> "Runs":
        """Runs by whether each row but the first differs from the row before."""
        first = np.concatenate([[0], np.flatnonzero(differs) + 1])
        return cls(first, np.concatenate([first[1:] - 1, [len(differs)]]))

    @property
    def rows(self) -> Ints:
        """Number of rows of each, shape (k,)."""
        return self.last - self.first + 1

    def span(self, values: NDArray[Any]) -> NDArray[Any]:
        """Change of values, shape (n,), from the first row of each run to its last, shape (k,)."""
        return values[self.last] - values[self.first]

    def are_long(self, stamps_ns: Ints, seconds: float, fewest: int) -> Mask:
        """Runs that last longer and have at least so many rows, shape (k,)."""
        return (self.span(stamps_ns) > seconds * 1e9) & (self.rows >= fewest)

    def may_be_chance(self) -> Mask:
        """Runs whose number of repeated rows comes by chance once in a thousand logs of a coarse sensor, shape (k,)."""
        changes = len(self.first) - 1
        if not changes:
            return np.zeros(1, bool)
        n = int(self.last[-1]) + 1
        share = 1.0 - changes / (n - 1)
        return n * share ** (self.rows - 1) >= 1e-3

    def mask(self, chosen: Mask) -> Mask:
        """Rows of the chosen runs, shape (n,)."""
        return np.repeat(chosen, self.rows)

    def repeats(self, chosen: Mask) -> Mask:
        """Rows of the chosen runs but for the first of each, which was measured, shape (n,)."""
        found = self.mask(chosen)
        found[self.first] = False
        return found

    def text(self, chosen: Mask, stamps_ns: Ints) -> tuple[int, str]:
        """Number of rows of the chosen runs, and the times of the longest, in seconds after the first stamp."""
        rows = self.rows[chosen]
        begin_ns = stamps_ns[self.first[chosen]]
        end_ns = stamps_ns[self.last[chosen]]
        return int(rows.sum()), _longest(begin_ns, end_ns, rows, int(stamps_ns[0]))


def stuck_rows(quantity: str, rows: Mapping[str, tuple[Ints, Floats]]) -> Mask:
    """Mask of rows of a quantity, shape (n,), that repeat to the bit while all others change.

    A vehicle at rest in a simulator repeats all sensors. Noise never repeats, so that one sensor that repeats alone is
    stuck; a velocity of zeros is a value at rest.

    ``rows``: stamps and values, shape (n, k), of all quantities, by name.
    """
    stamps_ns, values = rows[quantity]
    runs = Runs.of(differing(values))
    chosen = runs.are_long(stamps_ns, SURELY_STUCK_S, SURELY_STUCK_ROWS)
    chosen &= ~runs.may_be_chance()
    if quantity == "velocity":
        chosen &= values[runs.first].any(axis=1)
    for run in np.flatnonzero(chosen).tolist():
        begin_ns = stamps_ns[runs.first[run]]
        end_ns = stamps_ns[runs.last[run]]
        chosen[run] = all(
            _changes(*others, begin_ns, end_ns)
            for name, others in rows.items()
            if name != quantity
        )
    return runs.mask(chosen)


def stuck_quantities(imu: Imu, dvl: Dvl) -> dict[str, Mask]:
    """Masks of rows of IMU and Doppler log that are stuck, by quantity, as of `stuck_rows`."""
    rows = {
        "angular rate": (imu.stamps_ns, imu.angular_velocity),
        "specific force": (imu.stamps_ns, imu.specific_force),
        "velocity": (dvl.stamps_ns, dvl.velocity),
    }
    return {name: stuck_rows(name, rows) for name in rows}


def stuck_doubt(stamps_ns: Ints, stuck: Mask, quantity: str) -> str | None:
    """Doubt about a quantity with stuck rows, shape (n,); None without any."""
    if not stuck.any():
        return None
    runs = Runs.of(stuck[1:] != stuck[:-1])
    rows, times = runs.text(stuck[runs.first], stamps_ns)
    return (
        f"{quantity} the same to the last bit in {rows} rows, {times} s after the first, while the other sensors "
        "change: stuck; results are wrong from there on, and the part before is read by --end"
    )


ROWS_BESIDE = 8
FEWEST_BESIDE = 5
LONGEST_BESIDE_S = 12.0
"""Beyond it the bias of a gyro bends the line."""
UNFELT_SIGMAS = 6.0
LEAST_STEP_M_S = 0.05
"""At such speeds a row of zeros does little harm."""
LEAST_SHARE = 0.5
"""Of the speed of the row beside the zeros: a vehicle that brakes is off by less where stamps are late."""
UNFELT = "with a velocity of 0 that the accelerometers contradict"
UNLIKELY_ZEROS = "of exactly 0, far from the rows beside them"


def unfelt_zeros(imu: Imu, dvl: Dvl, calibration: Calibration) -> Mask:
    """Mask of rows of zeros, shape (n,), in stretches that the vehicle reaches or leaves by a step it does not feel.

    With C the turn by the gyros and F = int C f dt, the differences x = C v - F are a straight line in time, whose slope is
    gravity. A line through the rows on one side of the zeros predicts -F at the first of them. At rest the prediction
    holds; without bottom lock it is off by the velocity.
    """
    is_zero = np.asarray(~dvl.velocity.any(axis=1))
    runs = Runs.of(is_zero[1:] != is_zero[:-1])
    chosen = is_zero[runs.first]
    for run in np.flatnonzero(chosen).tolist():
        first = int(runs.first[run])
        last = int(runs.last[run])
        before = np.arange(max(first - ROWS_BESIDE, 0), first + 1)
        after = np.arange(last, min(last + 1 + ROWS_BESIDE, len(dvl)))
        chosen[run] = any(
            is_unfelt(imu, dvl, calibration, rows, zero)
            for rows, zero in ((before, first), (after, last))
        )
    return runs.mask(chosen)


def is_unfelt(
    imu: Imu, dvl: Dvl, calibration: Calibration, rows: Ints, zero: int
) -> bool:
    """True where the row ``zero`` leaves the line of the others by far more than they scatter about it."""
    is_beside = (rows == zero) | dvl.velocity[rows].any(axis=1)
    stamps_ns = dvl.stamps_ns[rows]
    is_beside &= np.abs(stamps_ns - dvl.stamps_ns[zero]) <= LONGEST_BESIDE_S * NS_PER_S
    chosen = dvl.rows(rows[is_beside])
    begin_ns = int(chosen.stamps_ns[0])
    samples = imu.between(begin_ns - NS_PER_S, int(chosen.stamps_ns[-1]) + NS_PER_S)
    if samples is None or len(chosen) <= FEWEST_BESIDE:
        return False
    from sonar_graph.logs.measured_start import FirstPath  # compiles

    path = FirstPath.of(samples, chosen, calibration, begin_ns)
    x = path.velocity - path.impulse  # (m, 3)
    # a hole of the IMU ends the path
    if len(x) < len(chosen) or not np.isfinite(x).all():
        return False
    at = int(np.flatnonzero(rows[is_beside] == zero)[0])
    A = np.vander(path.seconds - path.seconds[at], 2)  # (m, 2)
    others = np.arange(len(x)) != at
    slope_and_level, *_ = np.linalg.lstsq(A[others], x[others])
    residuals = x[others] - A[others] @ slope_and_level
    freedom = 3 * (len(residuals) - 2)
    variance = float(np.sum(residuals**2)) / freedom
    of_line = np.linalg.inv(A[others].T @ A[others])[1, 1]
    sigma_m_s = float(np.sqrt(variance * (1 + of_line)))
    off_m_s = float(np.linalg.norm(x[at] - slope_and_level[1]))
    beside = 1 if at == 0 else at - 1
    step_m_s = LEAST_SHARE * float(np.linalg.norm(chosen.velocity[beside]))
    return off_m_s > max(LEAST_STEP_M_S, step_m_s, UNFELT_SIGMAS * sigma_m_s)


def _changes(stamps_ns: Ints, values: Floats, begin_ns: int, end_ns: int) -> bool:
    """True where most rows between two instants differ from the row before."""
    inside = values[(stamps_ns >= begin_ns) & (stamps_ns <= end_ns)]
    return len(inside) > 1 and bool(differing(inside).mean() >= LEAST_CHANGING)


def unlikely_zeros(values: Floats, moved: Floats, least: float) -> Mask:
    """Mask of rows of zeros, shape (n,), that are farther from the rows beside them than the vehicle moves.

    ``values``, shape (n, k), ``moved`` and ``least`` as of `repeats`. Drivers send zeros where they have no value.
    """
    is_zero = ~values.any(axis=1)
    others = np.flatnonzero(~is_zero)
    rows = np.flatnonzero(is_zero)
    mask = np.zeros(len(values), bool)
    if not len(others) or not len(rows):
        return mask
    after = np.searchsorted(others, rows)
    mask[rows] = True
    for beside in (after - 1, after):
        has_one = (beside >= 0) & (beside < len(others))
        row = others[np.clip(beside, 0, len(others) - 1)]
        distance = np.linalg.norm(values[row], axis=1)
        way = np.abs(moved[row] - moved[rows])
        mask[rows] &= ~has_one | (distance > least + way)
    return mask


def repeats(values: Floats, moved: Floats, least: float) -> Mask:
    """Mask of rows, shape (n,), that repeat the row before while the vehicle moves: a stuck sensor.

    To a billionth: a yaw that stands still in an orientation that tilts is the same but for rounding.

    ``values``, shape (n, k), and ``moved``, what the vehicle has moved until each row by other sensors, have one unit.
    A stretch counts where the vehicle moves in it by more than ``least`` and three steps of the sensor's resolution.
    """
    values = np.round(values, 9)
    # the smallest difference of any two values of a sensor is its resolution
    gaps = [np.diff(np.unique(np.round(column, 6))) for column in values.T]
    resolution = float(np.min(np.concatenate(gaps), initial=np.inf))
    if np.isfinite(resolution):
        least = max(least, RESOLUTIONS * resolution)
    return _repeated_while_moving(differing(values), moved, least)


def repeated_sightings(
    frame: Ints, sightings: Floats, moved: Floats, least: float
) -> Mask:
    """Mask of sightings, shape (n,), that repeat what came before to the bit while the vehicle moves.

    Either a whole frame repeats the frame before, or one coordinate has one value for all landmarks of several frames.

    ``frame``: number of each sighting's frame, in order, shape (n,). ``sightings``: range and azimuth, shape (n, 2).
    ``moved``: the way until each sighting, m.
    """
    mask = repeated_frames(frame, sightings, moved, least)
    has_company = np.zeros(len(frame), bool)
    has_company[1:] = frame[1:] == frame[:-1]
    for column in sightings.T:
        differs = column[1:] != column[:-1]
        is_held = _repeated_while_moving(differs, moved, least)
        # a single landmark straight ahead keeps the azimuth of a beam; two landmarks do not share it
        run = np.concatenate([[0], np.cumsum(differs)])
        shares = np.bincount(run, weights=is_held & has_company)
        mask |= is_held & (shares[run] > 0)
    return mask


def repeated_frames(
    frame: Ints, sightings: Floats, moved: Floats, least: float
) -> Mask:
    """Mask of sightings, shape (n,), whose whole frame repeats the frame before, as of `repeated_sightings`."""
    begins = np.flatnonzero(np.diff(frame, prepend=frame[0] - 1))
    parts = np.split(sightings, begins[1:])
    differs = np.array([not np.array_equal(*two) for two in pairwise(parts)], bool)
    if not differs.any():  # one picture all the time, as in a demonstration
        return np.zeros(len(frame), bool)
    is_stuck = _repeated_while_moving(differs, moved[begins], least)
    return np.repeat(is_stuck, [len(part) for part in parts])


def _repeated_while_moving(differs: Mask, moved: Floats, least: float) -> Mask:
    """Rows, shape (n,), that do not differ from the row before in a stretch over which the vehicle moves by a length."""
    runs = Runs.of(differs)
    return runs.repeats(np.abs(runs.span(moved)) > least)


def way_by(
    role: str, imu: Imu, dvl: Dvl, calibration: Calibration, at_ns: Ints
) -> Floats:
    """What the vehicle has moved until each instant, for `repeats`: metres, or rad for a heading, shape (n,).

    For depth the way up and down, for fixes and sightings the way, both by velocities averaged over a second.
    """
    if role == "heading":
        stamps_ns = imu.stamps_ns
        # yaw rate: the world's vertical is the body's z while it is near level
        rate = imu.angular_velocity @ calibration.imu.mounting.rotation_matrix()[2]
    else:
        whole = ~is_partial(dvl.velocity_cov)
        if not whole.any():
            return np.zeros(len(at_ns))
        rows = dvl.rows(whole)
        stamps_ns = rows.stamps_ns
        velocity = rows.velocity @ calibration.dvl.mounting.rotation_matrix().T
        step_ns = float(np.median(np.diff(stamps_ns))) if len(rows) > 1 else np.inf
        width = min(max(1, round(1e9 / step_ns)), len(rows))
        # without averaging, noise adds up to a distance that was not moved
        mean = np.ones(width) / width
        columns = [np.convolve(column, mean, "same") for column in velocity.T]
        smooth = np.column_stack(columns)
        rate = smooth[:, 2] if role == "depth" else np.linalg.norm(smooth, axis=1)
    steps = (rate[1:] + rate[:-1]) / 2 * np.diff(stamps_ns) * 1e-9
    return np.interp(at_ns, stamps_ns, np.concatenate([[0.0], np.cumsum(steps)]))
