"""EKF-SLAM as published, in its textbook form: the estimator, and the update of its state over a window.

Equations (4) to (7) of the paper are in `baselines.ekf_equations`; docs/theory/ekf_slam.md.
"""

import math
from typing import ClassVar

import numpy as np

from baselines.ekf_equations import (
    LANDMARK,
    POSE,
    correct_depth,
    correct_state,
    correct_up,
    observe_rows,
    pose_after,
    predict,
)
from baselines.filter import FilterShell
from baselines.filter_motion import (
    inflate_shared_motion,
    motion_since_node,
    motion_to_node,
    no_provisional_motion,
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
from baselines.sonar_update import DetectionOutcomes, SonarModel, no_outcomes
from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.motion import MotionSource
from sonar_graph.numerics import compiled, euler_from_rates, euler_from_rotation, matrix, vector


@compiled
def process_window(x: Floats, P: Floats, n: int, values: WindowValues) -> tuple[int, DetectionOutcomes, PoseArrays]:
    """Carry the state to the newest epoch reached at the window's end, with all measurements on the way.

    Returns the length of the state, the outcomes of the detections, and the pose at the window's end. x and P (changed)
    have room for all landmarks of the window; ``values`` are the fields of a `MeasurementWindow`.
    """
    window = MeasurementWindow(*values)
    columns, clock, interval = window.columns, window.clock, GravityInterval(*window.interval)
    vehicle, sonar = VehicleModel(*window.vehicle), SonarModel(*window.sonar)
    stamps, outcomes = stamps_of(window), no_outcomes(len(window.frame_ns))
    event, running = BEFORE_ALL, no_provisional_motion()
    while True:
        event = next_event(stamps, clock, vehicle.gap[0], event)
        if event.kind == NODE_REACHED:
            motion = motion_to_node(columns, vehicle, x, clock[NODE], event.stamp_ns)
            predict(x, P, n, motion)
            reach_node(clock, event.stamp_ns)
            up, sigma = up_at_node(columns, vehicle, motion, clock, interval)
            if not math.isnan(sigma):
                correct_up(x, P, n, up, sigma)
            if vehicle.is_planar:
                plane = (vehicle.plane_z_m, 0.0, 0.0)
                variances = (vehicle.plane_z_variance, vehicle.plane_tilt_variance, vehicle.plane_tilt_variance)
                for k in range(3):
                    correct_state(x, P, n, 2 + k, plane[k], variances[k])
            continue
        running, motion = motion_since_node(columns, vehicle, x, running, clock[NODE], event.stamp_ns)
        if event.count_in_gap > 0:
            motion = inflate_shared_motion(motion, event.count_in_gap)
        if event.kind == DEPTH:
            z_m, variance_m2 = depth_sample(window.depth, event, vehicle)
            correct_depth(x, P, n, motion, vehicle.body_p_port, z_m, variance_m2)
        elif event.kind == FRAME:
            n = observe_rows(x, P, n, motion, sonar, frame_at(window.detections, event, outcomes, clock))
        else:
            return n, outcomes, pose_after(x, P, motion)


ROOM = 8
"""Landmarks that the first arrays have room for; doubled when needed."""
SINGULAR_COSINE = 1e-3
"""Below this cosine of the pitch the Euler angles are taken as singular."""


class EkfSlamParams(FilterParams):
    """Settings of EKF-SLAM; the paper gives none of them."""


class EkfSlam(FilterShell):
    """Extended Kalman filter over pose and landmarks.

    State (4) and covariance (5), prediction by gyros and Doppler log, observation (6) and innovation (7) of range and
    azimuth, and augmentation at first sight, after "Experimental Results of Real-time Sonar-based Underwater
    Localization Using Landmarks". Choices that the paper leaves open are in docs/theory/ekf_slam.md; those to know:

    - There is no gyro bias in the state (4), and its drift is not in the covariance: with a biased gyro the filter is
      overconfident in its heading and in time gates true detections.
    - A gap of the Doppler log is bridged as by every estimator; there Q holds the gyro bias, which tilts gravity.
      Measurements in a gap are related to the state before it, with growing variance.
    - A new landmark's elevation comes from a floor of known height, else it is 0 with sigma aperture / sqrt(12).
    - Depth, the direction of gravity and planar motion, where the calibration has them, are ungated updates.
    - Jacobians are taken once (no iteration); detections of a frame are used one after the other.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor.
    odometry
        Source of motion, its own.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = EkfSlamParams

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: EkfSlamParams | None = None) -> None:
        super().__init__(calibration, odometry, params or EkfSlamParams())
        start, room = calibration.start, POSE + LANDMARK * ROOM
        self._n, self._x, self._P = POSE, np.zeros(room), np.zeros((room, room))
        self._x[:3] = start.position_m
        self._x[3:POSE] = euler_from_rotation(matrix(start.pose().rotation().matrix()))
        E = np.array(euler_from_rates(vector(self._x[3:])))
        self._P[:3, :3] = np.diag(np.square(start.position_sigma_m))
        self._P[3:POSE, 3:POSE] = E @ np.diag(np.square(start.rpy_sigma_rad)) @ E.T

    def state(self) -> tuple[int, Floats, Floats]:
        """Stamp (ns), x of equation (4) and P of (5) at the newest epoch; copies."""
        n = self._n
        return self.node_ns, self._x[:n].copy(), self._P[:n, :n].copy()

    def update(self, window: MeasurementWindow) -> tuple[DetectionOutcomes, PoseArrays]:
        """Carry the state to the newest epoch reached at the window's end.

        Raises
        ------
        EstimatorError
            When the pitch comes so near 90 degrees that the Euler angles are singular.
        """
        needed, room = POSE + LANDMARK * (1 + max(window.detections[0].tolist(), default=-1)), len(self._x)
        if needed > room:
            grown = max(2 * room, needed)
            x, P = np.zeros(grown), np.zeros((grown, grown))
            x[:room], P[:room, :room] = self._x, self._P
            self._x, self._P = x, P
        self._n, outcomes, pose = process_window(self._x, self._P, self._n, (*window,))
        if math.cos(self._x[4]) < SINGULAR_COSINE:
            raise EstimatorError(
                f"ekf-slam: pitch is {math.degrees(self._x[4]):.2f} deg at {window.clock[NODE]} ns, where the Euler"
                " angles of its state are singular; use isam2 for this log"
            )
        return outcomes, pose

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position, and its block of (5)."""
        block = slice(POSE + LANDMARK * slot, POSE + LANDMARK * (slot + 1))
        return self._x[block], self._P[block, block]
