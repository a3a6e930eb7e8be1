"""The invariant filter over a window of measurements, in one compiled call: what each event of `filter_events` does."""

from __future__ import annotations

import math

from baselines.filter_clock import NODE, reach_node
from baselines.filter_detections import DetectionOutcomes, nothing_told
from baselines.filter_events import (
    BEFORE_ALL,
    DEPTH,
    FRAME,
    NODE_REACHED,
    PoseArrays,
    Window,
    WindowValues,
    depth_sample,
    frame_at,
    next_event,
    stamps_of,
)
from baselines.filter_models import SonarModel, VehicleModel
from baselines.gravity_interval import GravityInterval, up_at_node
from baselines.invariant_motion import motion_since_node, motion_to_node, told_again_with_bias
from baselines.invariant_state import InvariantState, pose_after, predict
from baselines.invariant_updates import correct_depth, correct_plane, correct_up, observe_rows
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.steps import Columns

StateValues = tuple[Floats, Floats, Floats, Floats]
"""Fields of an `InvariantState`."""


@compiled
def process_window(
    state_values: StateValues, walk_density: float, values: WindowValues
) -> tuple[StateValues, DetectionOutcomes, PoseArrays]:
    """Bring the state to the newest node reached at the window's end, with all that was measured on the way.

    Parameters
    ----------
    state_values
        Fields of an `InvariantState`; changed.
    walk_density
        Of the gyro bias, rad/s²/√Hz.
    values
        Fields of a `Window`.

    Returns
    -------
    The state, what became of the detections, and the pose at the window's end.
    """
    window, state = Window(*values), InvariantState(*state_values)
    columns, clock, interval = window.columns, window.clock, GravityInterval(*window.interval)
    vehicle, sonar = VehicleModel(*window.vehicle), SonarModel(*window.sonar)
    stamps, told, event = stamps_of(window), nothing_told(len(window.frame_ns)), BEFORE_ALL
    while True:
        event = next_event(stamps, clock, vehicle.gap[0], event)
        if event.kind == NODE_REACHED:
            _advance_to_node(columns, vehicle, walk_density, state, clock, interval, event.stamp_ns)
            continue
        motion = motion_since_node(columns, vehicle, state.R, state.bias, clock[NODE], event.stamp_ns)
        if event.times_told > 0:
            motion = told_again_with_bias(motion, event.times_told)
        if event.kind == DEPTH:
            z_m, variance_m2 = depth_sample(window.depth, event, vehicle)
            correct_depth(state, motion, vehicle.body_p_port, z_m, variance_m2)
        elif event.kind == FRAME:
            state = observe_rows(state, motion, sonar, frame_at(window.detections, event, told, clock))
        else:
            return (state.R, state.points, state.bias, state.P), told, pose_after(state, motion)


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
    reach_node(clock, node_ns)
    up, sigma = up_at_node(columns, vehicle, motion.integral, clock, interval)
    if not math.isnan(sigma):
        correct_up(state, up, sigma**2)
    if vehicle.is_planar:
        correct_plane(state, vehicle.plane_z_m, vehicle.plane_z_variance, vehicle.plane_tilt_variance)
