"""EKF-SLAM over a window of measurements, in one compiled call: what each event of `baselines.filter_events` does."""

from __future__ import annotations

from baselines.ekf_landmarks import observe_rows
from baselines.ekf_motion import motion_since_node, motion_to_node, nothing_running, told_again
from baselines.ekf_prediction import advance_to_node, correct_depth
from baselines.ekf_state import pose_after
from baselines.filter_clock import NODE
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
from baselines.gravity_interval import GravityInterval
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled


@compiled
def process_window(x: Floats, P: Floats, n: int, values: WindowValues) -> tuple[int, DetectionOutcomes, PoseArrays]:
    """Bring the state to the newest node reached at the window's end, with all that was measured on the way.

    Parameters
    ----------
    x, P, n
        Filter state; changed. With room for all landmarks of the window.
    values
        Fields of a `Window`.

    Returns
    -------
    Length of the state, what became of the detections, and the pose at the window's end.
    """
    window = Window(*values)
    columns, clock, interval = window.columns, window.clock, GravityInterval(*window.interval)
    vehicle, sonar = VehicleModel(*window.vehicle), SonarModel(*window.sonar)
    stamps, told, event, running = stamps_of(window), nothing_told(len(window.frame_ns)), BEFORE_ALL, nothing_running()
    while True:
        event = next_event(stamps, clock, vehicle.gap[0], event)
        if event.kind == NODE_REACHED:
            motion = motion_to_node(columns, vehicle, x, clock[NODE], event.stamp_ns)
            advance_to_node(columns, vehicle, x, P, n, clock, interval, event.stamp_ns, motion)
            continue
        running, motion = motion_since_node(columns, vehicle, x, running, clock[NODE], event.stamp_ns)
        if event.times_told > 0:
            motion = told_again(motion, event.times_told)
        if event.kind == DEPTH:
            z_m, variance_m2 = depth_sample(window.depth, event, vehicle)
            correct_depth(x, P, n, motion, vehicle.body_p_port, z_m, variance_m2)
        elif event.kind == FRAME:
            n = observe_rows(x, P, n, motion, sonar, frame_at(window.detections, event, told, clock))
        else:
            return n, told, pose_after(x, P, motion)
