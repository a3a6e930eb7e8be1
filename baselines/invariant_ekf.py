"""The strongest filter to compare with: right-invariant EKF-SLAM with the gyro bias in its state.

The invariant filter over a window of measurements, in one compiled call: what each event of `filter_events` does.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from baselines.filter import FilterShell
from baselines.filter_events import (
    BEFORE_ALL,
    DEPTH,
    FRAME,
    NODE,
    NODE_REACHED,
    GravityInterval,
    MeasurementWindow,
    PoseArrays,
    WindowValues,
    depth_sample,
    frame_at,
    next_event,
    reach_node,
    stamps_of,
    up_at_node,
)
from baselines.filter_inputs import DetectionOutcomes, FilterParams, SonarModel, VehicleModel, nothing_told
from baselines.filter_motion import (
    inflate_shared_motion_with_bias,
    motion_since_node_with_bias,
    motion_to_node_with_bias,
)
from baselines.invariant_equations import BARE, BIAS, BODY, InvariantState, landmark_covariance, pose_after, predict
from baselines.invariant_updates import correct_depth, correct_plane, correct_up, observe_rows
from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.preintegration import Columns
from sonar_graph.numerics import compiled, skew

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
        Fields of a `MeasurementWindow`.

    Returns
    -------
    The state, what became of the detections, and the pose at the window's end.
    """
    window, state = MeasurementWindow(*values), InvariantState(*state_values)
    columns, clock, interval = window.columns, window.clock, GravityInterval(*window.interval)
    vehicle, sonar = VehicleModel(*window.vehicle), SonarModel(*window.sonar)
    stamps, told, event = stamps_of(window), nothing_told(len(window.frame_ns)), BEFORE_ALL
    while True:
        event = next_event(stamps, clock, vehicle.gap[0], event)
        if event.kind == NODE_REACHED:
            _advance_to_node(columns, vehicle, walk_density, state, clock, interval, event.stamp_ns)
            continue
        motion = motion_since_node_with_bias(columns, vehicle, state.R, state.bias, clock[NODE], event.stamp_ns)
        if event.times_told > 0:
            motion = inflate_shared_motion_with_bias(motion, event.times_told)
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
    motion = motion_to_node_with_bias(columns, vehicle, state.R, state.bias, clock[NODE], node_ns)
    predict(state, motion, walk_density**2 * (node_ns - clock[NODE]) * 1e-9)
    reach_node(clock, node_ns)
    up, sigma = up_at_node(columns, vehicle, motion.integral, clock, interval)
    if not math.isnan(sigma):
        correct_up(state, up, sigma**2)
    if vehicle.is_planar:
        correct_plane(state, vehicle.plane_z_m, vehicle.plane_z_variance, vehicle.plane_tilt_variance)


class InvariantEkfParams(FilterParams):
    """Settings of the invariant filter: the same as those of EKF-SLAM, with the same defaults."""


class InvariantEkf(FilterShell):
    """Right-invariant extended Kalman filter over pose, gyro bias and landmarks.

    Same measurements, gates, floor and gaps as `baselines.ekf_slam.EkfSlam`, and what is known to make a filter
    consistent beside it:

    - The error is that of the world's frame (`baselines.invariant_equations`). Directions that nothing observes, the
      world's position and heading, are then the same at every estimate, and no linearisation, however wrong, tells
      anything about them (Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015; in three
      dimensions Zhang, Wu, Song, Huang and Dissanayake, RA-L 2(2), 2017).
    - The gyro bias is a state that walks, with its derivative of every motion, also over gaps of the Doppler log.
    - Attitude is a rotation matrix and has no singular pitch.

    It still linearises once, cannot go back to an association, and has no accelerometer bias: the sigma of gravity's
    direction is widened as everywhere (`sonar_graph.navigation.alignment.gravity`). Derivation:
    docs/theory/invariant_ekf.md.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor. ``imu.gyro_bias_sigma = 0`` means that there is no bias, and none that walks.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = InvariantEkfParams

    def __init__(self, calibration: Calibration, params: InvariantEkfParams | None = None) -> None:
        self._filter = InvariantFilter(calibration)
        super().__init__(calibration, params or InvariantEkfParams(), self._filter)

    def state(self) -> tuple[int, InvariantState]:
        """Stamp (ns) and a copy of the state at the newest node."""
        return self.node_ns, self._filter.state()


class InvariantFilter:
    """State of the invariant filter from one window to the next.

    Parameters
    ----------
    calibration
        Start, and how the gyro bias walks.
    """

    def __init__(self, calibration: Calibration) -> None:
        has_bias = calibration.imu.gyro_bias_sigma > 0
        self._walk_density = calibration.imu.gyro_bias_walk_density if has_bias else 0.0
        self._state = start_state(calibration)

    def run(self, window: MeasurementWindow) -> tuple[DetectionOutcomes, PoseArrays]:
        """Bring the state to the newest node reached at the window's end.

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

    def state(self) -> InvariantState:
        """A copy."""
        return InvariantState(*(part.copy() for part in self._state))


def start_state(calibration: Calibration) -> InvariantState:
    """The start's pose and its covariance as that of xi, no landmark.

    Position errors are along the world's axes, rotations small about the body's: with ``R = R^ Exp(delta)`` and
    ``X = X^ + d`` the error is ``theta = R^ delta`` and ``xi_0 = d + [X^]x theta``.
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
