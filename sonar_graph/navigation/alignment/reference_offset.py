"""Time offset and start heading of a reference trajectory, from the rotations that it shares with the gyros.

Between two poses of the reference, at their stamps plus the offset tau, the gyros turn by ``C_k^T C_{k+1}``. In the
axes of the reference's earlier pose the difference is, to first order, that of a constant gyro bias b and of a
rotation e that is constant in the world, such as the Earth's::

    Log((R_k^T R_{k+1})^T C_k^T C_{k+1}) = b T + R_k^T e T + noise

Both are fitted anew every few minutes and of no interest. Once the offset is known, the difference of the two headings
over the run is a constant and a drift. Where the first part of the run stands out from that line, the reference began
with a wrong heading (or jumped), since gyros do not jump.
In a hole of their samples nobody knows how the vehicle turned: poses about holes are left out, no difference goes over
one, and the beginning is compared with what comes before the first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Imu, Ints
from sonar_graph.navigation.alignment.dvl_imu import InertialPath
from sonar_graph.navigation.alignment.time_offset import RANGE_S, Estimate1D, SampleSeries, search_offset
from sonar_graph.states import Trajectory

LEAST_INTERVAL_S = 0.5
"""Poses closer than this are thinned: their differences would be noise."""
STRETCH_ROWS = 60
LEAST_ROWS = 30
FEWEST_DIFFERENCES = 12
"""Between two holes of the gyros' samples."""
NO_PARAMETERS = np.empty(0)
OFFSET_LIMIT_S = 0.1
START_SHARE = 0.05
"""Part of the run whose heading is asked for at its beginning."""
LEAST_PART_SHARE = 0.2
"""Part of the run before the first hole of the gyros' samples, with which the beginning is compared."""
LEAST_SPREAD_RAD = 1e-4


@dataclass(frozen=True)
class ReferenceMatch:
    """What the gyros say about a reference trajectory."""

    offset: Estimate1D
    """To be added to its stamps, s."""
    start_heading: Estimate1D
    """Heading of its first pose less what the rest of it and the gyros say, rad."""


def match_reference_to_imu(imu: Imu, reference: Trajectory, calibration: Calibration) -> ReferenceMatch:
    """Compare a reference's rotations with those of the gyros.

    Parameters
    ----------
    imu
        Any gyros whose drift is small against the motion.
    reference
        Of the body.
    calibration
        Mounting of the IMU.
    """
    path = InertialPath.of(imu)
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    seconds = path.since_origin(reference.stamps_ns)
    rows = np.flatnonzero(path.covers(seconds, RANGE_S))
    rows = rows[_thinned(seconds[rows])]
    if sum(map(len, _stretches_of(path.parts_at(seconds[rows])))) < LEAST_ROWS - 1:
        short = Estimate1D(np.nan, np.inf, f"less than {LEAST_ROWS} poses while the IMU runs without a hole")
        return ReferenceMatch(short, short)
    seconds, world_R_imu = seconds[rows], reference.rotations()[rows] * Rotation.from_matrix(body_R_imu)
    with threadpool_limits(1, user_api="blas"):
        found = search_offset(lambda tau: _line_up(path, seconds, tau, world_R_imu), NO_PARAMETERS)
    offset = found.offset().limited(OFFSET_LIMIT_S, "too little turning")
    if not offset.is_known:
        return ReferenceMatch(offset, Estimate1D(np.nan, np.inf, "the time offset cannot be told"))
    return ReferenceMatch(offset, _start_heading(path, reference, body_R_imu, offset.value))


def _thinned(seconds: Floats) -> np.ndarray:
    """Rows at least some time apart."""
    if len(seconds) < 2:
        return np.arange(len(seconds))
    step = max(1, int(np.ceil(LEAST_INTERVAL_S / max(float(np.median(np.diff(seconds))), 1e-9) - 1e-6)))
    return np.arange(0, len(seconds), step)


def _line_up(path: InertialPath, seconds: Floats, offset_s: float, world_R_imu: Rotation) -> list[SampleSeries]:
    C = Rotation.from_matrix(path.rotations_at(seconds + offset_s))
    turn_by_gyro, turn_of_reference = C[:-1].inv() * C[1:], world_R_imu[:-1].inv() * world_R_imu[1:]
    y = (turn_of_reference.inv() * turn_by_gyro).as_rotvec()
    duration = np.diff(seconds)
    steady = duration[:, None, None] * np.eye(3)
    from_world = duration[:, None, None] * world_R_imu[:-1].inv().as_matrix()
    B = np.concatenate([steady, from_world], axis=2)
    nothing = np.empty((len(y), 3, 0))
    return [
        SampleSeries(y[rows], nothing[rows], B[rows], duration[rows]) for rows in _stretches_of(path.parts_at(seconds))
    ]


def _stretches_of(parts: Ints) -> list[Ints]:
    """Differences between poses of one part of the path; of short parts none."""
    within = np.split(np.arange(len(parts) - 1), np.flatnonzero(np.diff(parts)) + 1)
    within = [rows[:-1] if k + 1 < len(within) else rows for k, rows in enumerate(within)]
    return [
        stretch
        for rows in within
        if len(rows) >= FEWEST_DIFFERENCES
        for stretch in np.array_split(rows, max(1, len(rows) // STRETCH_ROWS))
    ]


def _start_heading(path: InertialPath, reference: Trajectory, body_R_imu: Floats, offset_s: float) -> Estimate1D:
    """How far the beginning stands out from a line through the rest, which is found by medians."""
    seconds = path.since_origin(reference.stamps_ns) + offset_s
    inside = path.covers(seconds)
    run_s = float(np.ptp(seconds[inside]))
    inside &= path.parts_at(seconds) == path.parts_at(seconds[inside][:1])
    if np.ptp(seconds[inside]) < LEAST_PART_SHARE * run_s:
        return Estimate1D(np.nan, np.inf, "a hole of the IMU comes too soon after the start")
    C = Rotation.from_matrix(path.rotations_at(seconds[inside]))
    world_R_imu = reference.rotations()[np.flatnonzero(inside)] * Rotation.from_matrix(body_R_imu)
    turned = world_R_imu * C.inv()  # world_R_g: constant but for drift
    heading = (turned * turned[len(turned) // 2].inv()).as_rotvec()[:, 2]
    t = seconds[inside]
    beginning = t <= t[0] + START_SHARE * run_s
    level, slope, spread = _line_by_medians(t[~beginning], heading[~beginning])
    stands_out = float(np.median(heading[beginning] - level - slope * t[beginning]))
    return Estimate1D(stands_out, max(spread, LEAST_SPREAD_RAD))


def _line_by_medians(t: Floats, values: Floats) -> tuple[float, float, float]:
    """Level, slope and spread: the slope from the medians of the first and last third, blind to a few jumps."""
    third = max(1, len(t) // 3)
    slope = float((np.median(values[-third:]) - np.median(values[:third])) / (t[-third:].mean() - t[:third].mean()))
    left = values - slope * t
    level = float(np.median(left))
    return level, slope, 1.4826 * float(np.median(np.abs(left - level)))
