"""EKF-SLAM over a window of measurements, in one compiled call.

Events happen in the order of their stamps: first all nodes that are reached by then, then the depth sample or the
detections of a sonar frame, at a provisional motion from the newest node. At equal stamps depth comes first.
"""

from __future__ import annotations

import numpy as np

from baselines.ekf_landmarks import DetectionColumns, SonarModel, SonarValues, observe_rows
from baselines.ekf_motion import motion_since_node, motion_to_node, nothing_running, told_again
from baselines.ekf_prediction import (
    DEPTHS,
    LOST,
    NODE,
    SIGHTINGS,
    GravityInterval,
    GravityValues,
    VehicleModel,
    VehicleValues,
    advance_to_node,
    correct_depth,
    next_node,
)
from baselines.ekf_state import pose_after
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.steps import Columns

DepthColumns = tuple[Ints, Floats, Floats]
"""Stamps in ns, heights of the port in m, variances in m² (NaN where the log does not say), each (m,)."""
DetectionOutcomes = tuple[Ints, Floats, Floats]
"""USED, NEW, GATED or PASSED_OVER (m,); innovations (m, 2), their covariances (m, 2, 2): NaN without prediction."""
PoseArrays = tuple[Floats, Floats, Floats]
"""world_R_body (3, 3), position (3,), covariance of [theta, rho] (6, 6)."""

END, DEPTH, FRAME = 0, 1, 2


@compiled
def process_window(
    columns: Columns,
    vehicle_values: VehicleValues,
    sonar_values: SonarValues,
    x: Floats,
    P: Floats,
    n: int,
    clock: Ints,
    interval_values: GravityValues,
    depth: DepthColumns,
    depth_variance: float,
    frame_ns: Ints,
    detections: DetectionColumns,
    until_ns: int,
) -> tuple[int, DetectionOutcomes, PoseArrays]:
    """Bring the state to the newest node reached at an instant, with all that was measured on the way.

    Parameters
    ----------
    columns
        Rows of `Odometry.columns`.
    vehicle_values, sonar_values, interval_values
        Fields of a `VehicleModel`, a `SonarModel`, a `GravityInterval`; plain tuples enter compiled code faster.
    x, P, n, clock
        Filter state; changed, as is the gravity interval.
    depth, frame_ns, detections
        Samples and detections from the state's stamp up to ``until_ns``, in order; a stamp for each detection.
    depth_variance
        Of samples whose log does not say, m².

    Returns
    -------
    Length of the state, what became of the detections, and the pose at ``until_ns``.
    """
    vehicle, sonar = VehicleModel(*vehicle_values), SonarModel(*sonar_values)
    interval = GravityInterval(*interval_values)
    rows = len(frame_ns)
    outcomes, innovations, covs = np.empty(rows, np.int64), np.full((rows, 2), np.nan), np.full((rows, 2, 2), np.nan)
    sample, row, running = 0, 0, nothing_running()
    while True:
        kind, event_ns = next_event(depth[0], sample, frame_ns, row, until_ns)
        node_ns = next_node(columns, clock[NODE], event_ns)
        clock[LOST] |= int((node_ns if node_ns >= 0 else event_ns) - clock[NODE] > vehicle.gap[0])
        if node_ns >= 0:
            motion = motion_to_node(columns, vehicle, x, clock[NODE], node_ns)
            advance_to_node(columns, vehicle, x, P, n, clock, interval, node_ns, motion)
            continue
        running, motion = motion_since_node(columns, vehicle, x, running, clock[NODE], event_ns)
        is_gap = event_ns - clock[NODE] > vehicle.gap[0]
        if kind == DEPTH:
            if is_gap:
                clock[DEPTHS] += 1
                motion = told_again(motion, clock[DEPTHS])
            variance = depth_variance if np.isnan(depth[2][sample]) else depth[2][sample]
            correct_depth(x, P, n, motion, vehicle.body_p_port, depth[1][sample], variance)
            sample += 1
        elif kind == FRAME:
            first = row
            while row < rows and frame_ns[row] == event_ns:
                row += 1
            if is_gap:
                clock[SIGHTINGS] += row - first
                motion = told_again(motion, clock[SIGHTINGS])
            was_lost = clock[LOST] > 0
            n = observe_rows(x, P, n, motion, sonar, detections, first, row, outcomes, innovations, covs, was_lost)
        else:
            return n, (outcomes, innovations, covs), pose_after(x, P, motion)


@inlined
def next_event(depth_ns: Ints, sample: int, frame_ns: Ints, row: int, until_ns: int) -> tuple[int, int]:
    """Kind and stamp of the event that comes next."""
    kind, event_ns = END, until_ns
    if row < len(frame_ns):
        kind, event_ns = FRAME, frame_ns[row]
    if sample < len(depth_ns) and depth_ns[sample] <= event_ns:
        kind, event_ns = DEPTH, depth_ns[sample]
    return kind, event_ns
