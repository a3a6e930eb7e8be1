"""The invariant filter over a window of measurements, in one compiled call.

The order of events is that of `baselines.ekf_window`: nodes first, then depth, then frames.
"""

from __future__ import annotations

import numpy as np

from baselines.ekf_landmarks import DetectionColumns, SonarModel, SonarValues
from baselines.ekf_prediction import (
    DEPTHS,
    LOST,
    NODE,
    OPENED,
    SIGHTINGS,
    GravityInterval,
    GravityValues,
    VehicleModel,
    VehicleValues,
    extend_interval,
    measured_up,
    next_node,
    open_interval,
)
from baselines.ekf_window import DEPTH, FRAME, DepthColumns, DetectionOutcomes, PoseArrays, next_event
from baselines.invariant_motion import motion_since_node, motion_to_node, told_again_with_bias
from baselines.invariant_state import InvariantState, pose_after, predict
from baselines.invariant_updates import correct_depth, correct_plane, correct_up, observe_rows
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.steps import Columns
from sonar_graph.navigation.triples import vector

StateValues = tuple[Floats, Floats, Floats, Floats]
"""Fields of an `InvariantState`."""


@compiled
def process_window(
    columns: Columns,
    vehicle_values: VehicleValues,
    walk_density: float,
    sonar_values: SonarValues,
    state_values: StateValues,
    clock: Ints,
    interval_values: GravityValues,
    depth: DepthColumns,
    depth_variance: float,
    frame_ns: Ints,
    detections: DetectionColumns,
    until_ns: int,
) -> tuple[StateValues, DetectionOutcomes, PoseArrays]:
    """Bring the state to the newest node reached at an instant, with all that was measured on the way.

    Parameters
    ----------
    columns
        Rows of `Odometry.columns`.
    vehicle_values, sonar_values, state_values, interval_values
        Fields of a `VehicleModel`, a `SonarModel`, an `InvariantState`, a `GravityInterval`; plain tuples enter
        compiled code faster.
    walk_density
        Of the gyro bias, rad/s²/√Hz.
    clock
        Changed, as are state and gravity interval.
    depth, frame_ns, detections
        Samples and detections from the state's stamp up to ``until_ns``, in order; a stamp for each detection.
    depth_variance
        Of samples whose log does not say, m².

    Returns
    -------
    The state, what became of the detections, and the pose at ``until_ns``.
    """
    vehicle, sonar = VehicleModel(*vehicle_values), SonarModel(*sonar_values)
    interval, state = GravityInterval(*interval_values), InvariantState(*state_values)
    rows = len(frame_ns)
    outcomes, innovations, covs = np.empty(rows, np.int64), np.full((rows, 2), np.nan), np.full((rows, 2, 2), np.nan)
    sample, row = 0, 0
    while True:
        kind, event_ns = next_event(depth[0], sample, frame_ns, row, until_ns)
        node_ns = next_node(columns, clock[NODE], event_ns)
        clock[LOST] |= int((node_ns if node_ns >= 0 else event_ns) - clock[NODE] > vehicle.gap[0])
        if node_ns >= 0:
            _advance_to_node(columns, vehicle, walk_density, state, clock, interval, node_ns)
            continue
        motion = motion_since_node(columns, vehicle, state.R, state.bias, clock[NODE], event_ns)
        is_gap = event_ns - clock[NODE] > vehicle.gap[0]
        if kind == DEPTH:
            if is_gap:
                clock[DEPTHS] += 1
                motion = told_again_with_bias(motion, clock[DEPTHS])
            variance = depth_variance if np.isnan(depth[2][sample]) else depth[2][sample]
            correct_depth(state, motion, vehicle.body_p_port, depth[1][sample], variance)
            sample += 1
        elif kind == FRAME:
            first = row
            while row < rows and frame_ns[row] == event_ns:
                row += 1
            if is_gap:
                clock[SIGHTINGS] += row - first
                motion = told_again_with_bias(motion, clock[SIGHTINGS])
            was_lost = clock[LOST] > 0
            state = observe_rows(state, motion, sonar, detections, first, row, outcomes, innovations, covs, was_lost)
        else:
            arrays = state.R, state.points, state.bias, state.P
            return arrays, (outcomes, innovations, covs), pose_after(state, motion)


@compiled
def _advance_to_node(
    columns: Columns,
    vehicle: VehicleModel,
    walk_density: float,
    state: InvariantState,
    clock: Ints,
    interval: GravityInterval,
    node_ns: int,
) -> None:
    """Predict to a node and apply what holds there."""
    motion = motion_to_node(columns, vehicle, state.R, state.bias, clock[NODE], node_ns)
    predict(state, motion, walk_density**2 * (node_ns - clock[NODE]) * 1e-9)
    clock[NODE] = node_ns
    clock[DEPTHS:LOST] = 0
    if vehicle.gravity_interval_ns > 0:
        extend_interval(interval, motion.integral)
        if clock[NODE] - clock[OPENED] >= vehicle.gravity_interval_ns:
            up, sigma = measured_up(columns, vehicle, clock, interval)
            if not np.isnan(sigma):
                correct_up(state, vector(up), sigma**2)
            open_interval(columns, vehicle.dvl_p_imu, interval, clock)
    if vehicle.is_planar:
        correct_plane(state, vehicle.plane_z_m, vehicle.plane_z_variance, vehicle.plane_tilt_variance)
