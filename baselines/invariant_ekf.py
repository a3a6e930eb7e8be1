"""Right-invariant EKF-SLAM with the gyro bias in its state, the strongest filter here to compare with.

Equations: `baselines.invariant_equations`; docs/theory/invariant_ekf.md.
"""

import math
from typing import ClassVar

import numpy as np

from baselines.filter_motion import (
    inflate_shared_motion_with_bias,
    motion_since_node_with_bias,
    motion_to_node_with_bias,
    up_at_node,
)
from baselines.filter_window import (
    BEFORE_ALL,
    DEPTH,
    FRAME,
    NODE,
    NODE_REACHED,
    FilterParams,
    GravityInterval,
    MeasurementWindow,
    PoseArrays,
    VehicleModel,
    WindowValues,
    depth_sample,
    frame_at,
    next_event,
    reach_node,
    stamps_of,
)
from baselines.invariant_equations import (
    BARE,
    BIAS,
    BODY,
    InvariantState,
    correct_depth,
    correct_plane,
    correct_up,
    landmark_covariance,
    observe_rows,
    pose_after,
    predict,
)
from baselines.old_shell import FilterShell
from baselines.sonar_update import DetectionOutcomes, SonarModel, no_outcomes
from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.motion import MotionSource
from sonar_graph.numerics import compiled, skew

StateValues = tuple[Floats, Floats, Floats, Floats]
"""Fields of an `InvariantState`."""


@compiled
def process_window(
    state_values: StateValues, walk_density: float, values: WindowValues
) -> tuple[StateValues, DetectionOutcomes, PoseArrays]:
    """Carry the state to the newest epoch reached at the window's end, with all measurements on the way.

    Returns the state, the outcomes of the detections, and the pose at the window's end. ``state_values`` (changed) and
    ``values`` are the fields of an `InvariantState` and a `MeasurementWindow`; the bias walks by ``walk_density``,
    rad/s²/√Hz.
    """
    window, state = MeasurementWindow(*values), InvariantState(*state_values)
    columns, clock, interval = window.columns, window.clock, GravityInterval(*window.interval)
    vehicle, sonar = VehicleModel(*window.vehicle), SonarModel(*window.sonar)
    stamps, outcomes, event = stamps_of(window), no_outcomes(len(window.frame_ns)), BEFORE_ALL
    while True:
        event = next_event(stamps, clock, vehicle.gap[0], event)
        if event.kind == NODE_REACHED:
            motion = motion_to_node_with_bias(columns, vehicle, state.R, state.bias, clock[NODE], event.stamp_ns)
            predict(state, motion, walk_density**2 * (event.stamp_ns - clock[NODE]) * 1e-9)
            reach_node(clock, event.stamp_ns)
            up, sigma = up_at_node(columns, vehicle, motion.integral, clock, interval)
            if not math.isnan(sigma):
                correct_up(state, up, sigma**2)
            if vehicle.is_planar:
                correct_plane(state, vehicle.plane_z_m, vehicle.plane_z_variance, vehicle.plane_tilt_variance)
            continue
        motion = motion_since_node_with_bias(columns, vehicle, state.R, state.bias, clock[NODE], event.stamp_ns)
        if event.count_in_gap > 0:
            motion = inflate_shared_motion_with_bias(motion, event.count_in_gap)
        if event.kind == DEPTH:
            z_m, variance_m2 = depth_sample(window.depth, event, vehicle)
            correct_depth(state, motion, vehicle.body_p_port, z_m, variance_m2)
        elif event.kind == FRAME:
            state = observe_rows(state, motion, sonar, frame_at(window.detections, event, outcomes, clock))
        else:
            return (state.R, state.points, state.bias, state.P), outcomes, pose_after(state, motion)


class InvariantEkfParams(FilterParams):
    """Settings of the invariant filter: the same as those of EKF-SLAM, with the same defaults."""


class InvariantEkf(FilterShell):
    """Right-invariant extended Kalman filter over pose, gyro bias and landmarks.

    Same measurements, gates, floor and gaps as `baselines.ekf_slam.EkfSlam`, with three differences:

    - The error is right-invariant, in the world's frame. The unobservable directions, position and heading of the
      world, are then the same at every estimate, and no linearisation gains information along them (Barrau and
      Bonnabel, 2015; Zhang, Wu, Song, Huang and Dissanayake, RA-L 2(2), 2017).
    - The gyro bias is a state that walks; every motion has its derivative by the bias, also over gaps.
    - Attitude is a rotation matrix and has no singular pitch.

    It linearises once, cannot revise an association, and has no accelerometer bias: the sigma of gravity's direction is
    widened instead. Derivation: docs/theory/invariant_ekf.md.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor. ``imu.gyro_bias_sigma = 0`` means that there is no bias, and none that walks.
    odometry
        Source of motion, its own.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = InvariantEkfParams

    def __init__(
        self, calibration: Calibration, odometry: MotionSource, params: InvariantEkfParams | None = None
    ) -> None:
        super().__init__(calibration, odometry, params or InvariantEkfParams())
        has_bias = calibration.imu.gyro_bias_sigma > 0
        self._walk_density = calibration.imu.gyro_bias_walk_density if has_bias else 0.0
        self._state = start_state(calibration)

    def state(self) -> tuple[int, InvariantState]:
        """Stamp (ns) and a copy of the state at the newest epoch."""
        return self.node_ns, InvariantState(*(part.copy() for part in self._state))

    def update(self, window: MeasurementWindow) -> tuple[DetectionOutcomes, PoseArrays]:
        """Carry the state to the newest epoch reached at the window's end.

        Raises
        ------
        EstimatorError
            When a variance in the log or the calibration makes an innovation covariance not positive definite.
        """
        try:
            state, outcomes, pose = process_window((*self._state,), self._walk_density, (*window,))
        except np.linalg.LinAlgError as error:
            raise EstimatorError(
                f"invariant-ekf: between {window.clock[NODE]} and {window.until_ns} ns the expected covariance of a"
                " measurement is not positive definite; give variances above zero in log and calibration"
            ) from error
        self._state = InvariantState(*state)
        return outcomes, pose

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position, and covariance of its coordinates."""
        return self._state.points[1 + slot], landmark_covariance(self._state, 1 + slot)


def start_state(calibration: Calibration) -> InvariantState:
    """State at the start, without landmarks, and the covariance of its xi.

    Errors of the start, ``R = R^ Exp(delta)`` and ``X = X^ + d``, are ``theta = R^ delta``, ``xi_0 = d + [X^]x theta``.
    """
    start, bias_sigma = calibration.start, calibration.imu.gyro_bias_sigma
    R, X = np.ascontiguousarray(start.pose().rotation().matrix()), np.array(start.position_m)
    P = np.zeros((BARE, BARE))
    P[:BIAS, :BIAS] = R @ np.diag(np.square(start.rpy_sigma_rad)) @ R.T
    P[BODY:, :BIAS] = skew(X) @ P[:BIAS, :BIAS]
    P[:BIAS, BODY:] = P[BODY:, :BIAS].T
    P[BODY:, BODY:] = P[BODY:, :BIAS] @ skew(X).T + np.diag(np.square(start.position_sigma_m))
    P[BIAS:BODY, BIAS:BODY] = np.eye(3) * bias_sigma**2
    return InvariantState(R, X[None].copy(), np.zeros(3), 0.5 * (P + P.T))
