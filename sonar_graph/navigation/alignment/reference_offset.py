"""Time offset and start heading of a reference trajectory, from the rotations that it shares with the gyros.

Between two poses of the reference, at their stamps plus the offset tau, the gyros turn by ``C_k^T C_{k+1}``. In the
axes of the reference's earlier pose the difference is, to first order, that of a constant gyro bias b and of a
rotation e that is constant in the world, such as the Earth's, both fitted again every few minutes::

    Log((R_k^T R_{k+1})^T C_k^T C_{k+1}) = b T + R_k^T e T + noise

With the offset known, the difference of the two headings over the run is a constant and a drift. Where the first part
of the run stands out from that line, the reference began with a wrong heading. No difference goes over a hole of the
IMU, and the beginning is compared with what comes before the first. docs/theory/sensor_check.md.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Imu, Ints
from sonar_graph.navigation.alignment.dvl_imu import InertialPath
from sonar_graph.navigation.alignment.time_offset import (
    RANGE_S,
    Estimate1D,
    SampleSeries,
    search_offset,
)
from sonar_graph.states import Trajectory

LEAST_INTERVAL_S = 0.5
"""Poses closer than this are thinned, since their differences would be noise."""
STRETCH_ROWS = 60
LEAST_ROWS = 30
FEWEST_DIFFERENCES = 12
"""Fewest differences of poses between two holes of the IMU."""
NO_PARAMETERS = np.empty(0)
OFFSET_LIMIT_S = 0.1
START_SHARE = 0.05
"""Share of the run that counts as its beginning."""
LEAST_PART_SHARE = 0.2
"""Least share of the run before the first hole of the IMU, with which the beginning is compared."""
LEAST_SPREAD_RAD = 1e-4


@dataclass(frozen=True)
class ReferenceMatch:
    """Errors of a reference trajectory's stamps and first heading."""

    offset: Estimate1D
    """To be added to its stamps, s."""
    start_heading: Estimate1D
    """Heading of its first pose less that by its other poses and the gyros, rad."""


def match_reference_to_imu(
    imu: Imu, reference: Trajectory, calibration: Calibration
) -> ReferenceMatch:
    """Compare a reference's rotations with those of the gyros.

    Parameters
    ----------
    imu
        Rows of gyros whose drift is small against the motion.
    reference
        Poses of the body.
    calibration
        Mounting of the IMU.
    """
    path = InertialPath.of(imu)
    body_R_imu = calibration.imu.mounting.pose().rotation().matrix()
    seconds = path.since_origin(reference.stamps_ns)
    rows = np.flatnonzero(path.covers(seconds, RANGE_S))
    if len(rows) > 1:
        interval_s = max(np.median(np.diff(seconds[rows])), 1e-9)
        rows = rows[:: max(1, int(np.ceil(LEAST_INTERVAL_S / interval_s - 1e-6)))]
    if sum(map(len, _stretches_of(path.parts_at(seconds[rows])))) < LEAST_ROWS - 1:
        short = Estimate1D.unknown(
            f"less than {LEAST_ROWS} poses, {LEAST_INTERVAL_S:g} s apart, while the IMU runs without a hole"
        )
        return ReferenceMatch(short, short)
    seconds = seconds[rows]
    world_R_imu = reference.rotations()[rows] * Rotation.from_matrix(body_R_imu)

    def line_up(tau: float) -> list[SampleSeries]:
        C = Rotation.from_matrix(path.rotations_at(seconds + tau))
        turn_by_gyro = C[:-1].inv() * C[1:]
        turn_of_reference = world_R_imu[:-1].inv() * world_R_imu[1:]
        y = (turn_of_reference.inv() * turn_by_gyro).as_rotvec()
        duration = np.diff(seconds)
        steady = duration[:, None, None] * np.eye(3)
        from_world = duration[:, None, None] * world_R_imu[:-1].inv().as_matrix()
        B = np.concatenate([steady, from_world], axis=2)  # (m, 3, 6)
        nothing = np.empty((len(y), 3, 0))  # no parameters are common to all stretches
        stretches = _stretches_of(path.parts_at(seconds))
        return [
            SampleSeries(y[rows], nothing[rows], B[rows], duration[rows])
            for rows in stretches
        ]

    with threadpool_limits(1, user_api="blas"):
        found = search_offset(line_up, NO_PARAMETERS)
    offset = found.offset().limited(OFFSET_LIMIT_S, "too little turning")
    if not offset.is_known:
        return ReferenceMatch(
            offset, Estimate1D.unknown("the time offset is not known")
        )
    return ReferenceMatch(
        offset, start_heading(path, reference, body_R_imu, offset.value)
    )


def _stretches_of(parts: Ints) -> list[Ints]:
    """Rows of differences between poses of one part of the path; none of short parts."""
    changes = np.flatnonzero(np.diff(parts)) + 1
    within = np.split(np.arange(len(parts) - 1), changes)
    # the last difference before a hole goes over it
    within = [
        rows[:-1] if k + 1 < len(within) else rows for k, rows in enumerate(within)
    ]
    return [
        stretch
        for rows in within
        if len(rows) >= FEWEST_DIFFERENCES
        for stretch in np.array_split(rows, max(1, len(rows) // STRETCH_ROWS))
    ]


def start_heading(
    path: InertialPath, reference: Trajectory, body_R_imu: Floats, offset_s: float
) -> Estimate1D:
    """Heading of the beginning, less a line through the rest.

    The line's slope is from the medians of the first and last third, so that a few jumps do not matter.
    """
    seconds = path.since_origin(reference.stamps_ns) + offset_s
    inside = path.covers(seconds)
    run_s = np.ptp(seconds[inside])
    inside &= path.parts_at(seconds) == path.parts_at(seconds[inside][:1])
    if np.ptp(seconds[inside]) < LEAST_PART_SHARE * run_s:
        return Estimate1D.unknown("a hole of the IMU comes too soon after the start")
    C = Rotation.from_matrix(path.rotations_at(seconds[inside]))
    world_R_imu = reference.rotations()[np.flatnonzero(inside)] * Rotation.from_matrix(
        body_R_imu
    )
    turned = world_R_imu * C.inv()  # world_R_g: constant but for drift
    middle = turned[len(turned) // 2]
    heading = (turned * middle.inv()).as_rotvec()[:, 2]
    t = seconds[inside]
    beginning = t <= t[0] + START_SHARE * run_s
    rest_t = t[~beginning]
    rest = heading[~beginning]
    third = max(1, len(rest_t) // 3)
    rise = np.median(rest[-third:]) - np.median(rest[:third])
    run = rest_t[-third:].mean() - rest_t[:third].mean()
    slope = rise / run
    left = rest - slope * rest_t
    level = np.median(left)
    # standard deviation of a normal distribution with this median of absolute deviations
    spread = 1.4826 * float(np.median(np.abs(left - level)))
    stands_out = float(np.median(heading[beginning] - level - slope * t[beginning]))
    return Estimate1D(stands_out, max(spread, LEAST_SPREAD_RAD))
