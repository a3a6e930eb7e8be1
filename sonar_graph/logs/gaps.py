"""Times without measurements in a log: of what is then assumed, and for how long, a user wants to know."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import HOLE_INTERVALS, ROWS_BEFORE, SHORTEST_HOLE_S, UNTYPICAL_S, Calibration
from sonar_graph.doppler_beams import UNMEASURED_M_S
from sonar_graph.measurements import Dvl, Imu, Ints

MOST_NAMED = 3
"""Gaps of one kind that are named one by one; of more the longest."""

_GUESSED = "the turn in between is guessed from the rates before and after"
Gaps = list[tuple[int, int]]
"""Stamps of the samples before and after, ns."""


def gap_warnings(imu: Imu, dvl: Dvl, calibration: Calibration) -> Iterator[str]:
    """What is assumed while nothing was measured, with times in seconds after the first instant with both.

    A Doppler log has a gap where estimators no longer take its velocity as linear (``dvl.gap_s``), an IMU has a
    hole where they count with turns that were not measured (`sonar_graph.navigation.unmeasured_turns`). Samples that
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
    """By the rule of `sonar_graph.navigation.unmeasured_turns.hole_ns`: the median of the intervals before each."""
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
