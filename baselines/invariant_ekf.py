"""The strongest filter to compare with: right-invariant EKF-SLAM with the gyro bias in its state."""

from __future__ import annotations

from typing import ClassVar

import gtsam
import numpy as np

from baselines.causal import CausalEstimates
from baselines.ekf_landmarks import DetectionColumns
from baselines.ekf_prediction import CLOCK, NODE, GravityInterval, open_interval
from baselines.ekf_window import DepthColumns, DetectionOutcomes, PoseArrays
from baselines.filter_intake import NO_OUTCOMES, NO_STAMPS, DetectionIntake, check_rows, depth_since
from baselines.filter_models import FilterParams, sonar_model, vehicle_model
from baselines.invariant_state import BARE, BIAS, BODY, InvariantState, landmark_covariance
from baselines.invariant_window import process_window
from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Ints, Measurements
from sonar_graph.navigation.kernels import skew
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, RefusedRow, Trajectory

SPARE_ROWS = 256
"""IMU rows that may be kept longer than needed."""
_NEVER, _LONG_AGO = int(np.iinfo(np.int64).max), int(np.iinfo(np.int64).min)


class InvariantEkfParams(FilterParams):
    """Settings of the invariant filter: the same as those of EKF-SLAM, with the same defaults."""


class InvariantEkf:
    """Right-invariant extended Kalman filter over pose, gyro bias and landmarks.

    Same measurements, gates, floor and gaps as `baselines.ekf_slam.EkfSlam`, and what is known to make a filter
    consistent beside it:

    - The error is that of the world's frame (`baselines.invariant_state`). Directions that nothing observes, the
      world's position and heading, are then the same at every estimate, and no linearisation, however wrong, tells
      anything about them (Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015; in three
      dimensions Zhang, Wu, Song, Huang and Dissanayake, RA-L 2(2), 2017).
    - The gyro bias is a state that walks, with its derivative of every motion, also over gaps of the Doppler log.
    - Attitude is a rotation matrix and has no singular pitch.

    It still linearises once, cannot go back to an association, and has no accelerometer bias: the sigma of gravity's
    direction is widened as everywhere (`sonar_graph.navigation.alignment`). Derivation: docs/theory/invariant_ekf.md.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor. ``imu.gyro_bias_sigma = 0`` means that there is no bias, and none that walks.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = InvariantEkfParams

    def __init__(self, calibration: Calibration, params: InvariantEkfParams | None = None) -> None:
        self._params = params or InvariantEkfParams()
        self._vehicle_values = (*vehicle_model(calibration, self._params.gravity_interval_s),)
        self._sonar_values = (*sonar_model(calibration, self._params.gate_probability),)
        self._lever_m = self._vehicle_values[2]
        has_bias = calibration.imu.gyro_bias_sigma > 0
        self._walk_density = calibration.imu.gyro_bias_walk_density if has_bias else 0.0
        self._depth_variance = calibration.depth.sigma_m**2
        self._odometry = Odometry(calibration)
        self._intake = DetectionIntake(self._params.minimum_id_probability)
        self._estimates = CausalEstimates()
        self._most_rows = SPARE_ROWS
        self._state = start_state(calibration)
        self._clock: Ints = np.zeros(CLOCK, np.int64)
        self._interval_values = (*GravityInterval(np.eye(3), np.zeros(3), np.zeros(4)),)
        self._reached_ns, self._done_ns = _NEVER, _LONG_AGO

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in what was measured and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.

        Raises
        ------
        MeasurementError
            When a row is stamped after ``end_ns``.
        EstimatorError
            When a variance in the log or the calibration makes an innovation covariance not positive definite.
        """
        self._odometry.add(measurements.imu, measurements.dvl)
        self._start()
        check_rows(measurements)
        named = self._intake.name(measurements.detections, self._reached_ns, self._done_ns)
        since_ns = max(self._done_ns, self._reached_ns)
        self._done_ns = max(self._done_ns, measurements.end_ns)
        if measurements.end_ns < max(self._reached_ns, int(self._clock[NODE])):
            self._intake.record(named, NO_OUTCOMES)
            return None
        columns = self._intake.columns(named)
        frame_ns = NO_STAMPS if named.detections is None else np.maximum(named.detections.stamps_ns, since_ns)
        outcomes, pose = self._run(depth_since(measurements.depth, since_ns), frame_ns, columns, measurements.end_ns)
        self._intake.record(named, outcomes)
        self._forget()
        estimate = Estimate(measurements.end_ns, gtsam.Pose3(gtsam.Rot3(pose[0]), pose[1]), pose[2])
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates: a filter does not look back."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Landmarks in the state, with the covariances of their coordinates."""
        slots = self._intake.slots
        ids = sorted(slots)
        return LandmarkMap(
            ids=np.array(ids, dtype=np.int64),
            positions=np.array([self._state.points[1 + slots[i]] for i in ids]).reshape(-1, 3),
            covariances=np.array([landmark_covariance(self._state, 1 + slots[i]) for i in ids]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """What became of each detection so far."""
        return self._intake.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, and why."""
        return self._odometry.refused

    def state(self) -> tuple[int, InvariantState]:
        """Stamp (ns) and a copy of the state at the newest node."""
        return int(self._clock[NODE]), InvariantState(*(part.copy() for part in self._state))

    def _start(self) -> None:
        """Set the clock once the first node is covered by IMU rows from both sides."""
        if self._reached_ns < _NEVER:
            return
        start_ns = self._odometry.start_ns()
        if start_ns is None:
            return
        columns = self._odometry.columns()
        imu_ns = columns[0]
        self._reached_ns = int(imu_ns[np.searchsorted(imu_ns, start_ns)])
        self._clock[NODE] = start_ns
        open_interval(columns, self._lever_m, GravityInterval(*self._interval_values), self._clock)

    def _run(
        self, depth: DepthColumns, frame_ns: Ints, detections: DetectionColumns, until_ns: int
    ) -> tuple[DetectionOutcomes, PoseArrays]:
        """Take the filter to an instant."""
        try:
            state, outcomes, pose = process_window(
                self._odometry.columns(),
                self._vehicle_values,
                self._walk_density,
                self._sonar_values,
                (*self._state,),
                self._clock,
                self._interval_values,
                depth,
                self._depth_variance,
                frame_ns,
                detections,
                until_ns,
            )
        except np.linalg.LinAlgError as error:
            raise EstimatorError(
                f"invariant-ekf: between {int(self._clock[NODE])} and {until_ns} ns the expected covariance of a"
                " measurement is not positive definite; give variances above zero in log and calibration"
            ) from error
        self._state = InvariantState(*state)
        return outcomes, pose

    def _forget(self) -> None:
        """Drop used rows now and then: that costs as much as keeping a few."""
        self._odometry.settle(int(self._clock[NODE]))
        if len(self._odometry.columns()[0]) > self._most_rows:
            self._odometry.forget_before(int(self._clock[NODE]))
            self._most_rows = len(self._odometry.columns()[0]) + SPARE_ROWS


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
