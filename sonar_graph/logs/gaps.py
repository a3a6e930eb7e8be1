"""Times without measurements in a log: of what is then assumed, and for how long, a user wants to know."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import HOLE_INTERVALS, SHORTEST_HOLE_S, Calibration
from sonar_graph.doppler_beams import UNMEASURED_M_S
from sonar_graph.measurements import Dvl, Imu, Ints

MOST_NAMED = 3
"""Gaps of one kind that are named one by one; of more the longest."""

Gaps = list[tuple[int, int]]
"""Stamps of the samples before and after, ns."""


def gap_warnings(imu: Imu, dvl: Dvl, calibration: Calibration) -> Iterator[str]:
    """What is assumed while nothing was measured, with times in seconds after the first instant with both.

    A Doppler log has a gap where estimators no longer take its velocity as linear (``dvl.gap_s``), an IMU where
    `HOLE_INTERVALS` typical intervals pass without a sample. Samples that hold for the time before them leave none.
    """
    if calibration.odometry_interpolation == "hold-past":
        return
    start_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    holes = _holes(imu.stamps_ns[imu.stamps_ns >= start_ns])
    if holes:
        yield (
            f"imu: no sample {_times(holes, start_ns)}: the turn in between is guessed from the rates before and "
            f"after, with an error of imu.turn_sigma_rad_s; heading is as unsure from there on"
        )
    yield from _doppler(imu, dvl, round(calibration.dvl.gap_s * 1e9), start_ns)


def is_partial(dvl: Dvl) -> NDArray[np.bool_]:
    """Rows that leave a direction of the velocity unmeasured, shape (n,)."""
    variances = np.trace(dvl.velocity_cov, axis1=1, axis2=2)
    return np.asarray(variances > 0.5 * UNMEASURED_M_S**2)


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


def _holes(stamps_ns: Ints) -> Gaps:
    if len(stamps_ns) < 3:
        return []
    typical_ns = float(np.median(np.diff(stamps_ns)))
    return _longer_than(int(max(HOLE_INTERVALS * typical_ns, SHORTEST_HOLE_S * 1e9)), stamps_ns)


def _longer_than(longest_ns: int, stamps_ns: Ints) -> Gaps:
    before = np.flatnonzero(np.diff(stamps_ns) > longest_ns)
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
