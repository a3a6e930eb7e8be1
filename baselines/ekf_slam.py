"""EKF-SLAM as published, in its textbook form: the baseline that a smoother has to beat."""

from __future__ import annotations

import math
from typing import ClassVar

import gtsam
import numpy as np

from baselines.causal import CausalEstimates
from baselines.ekf_landmarks import DetectionColumns
from baselines.ekf_prediction import CLOCK, NODE, GravityInterval, open_interval
from baselines.ekf_state import LANDMARK, POSE
from baselines.ekf_window import DepthColumns, DetectionOutcomes, PoseArrays, process_window
from baselines.euler import euler_from_rates, euler_from_rotation
from baselines.filter_intake import NO_OUTCOMES, NO_STAMPS, DetectionIntake, check_rows, depth_since
from baselines.filter_models import FilterParams, sonar_model, vehicle_model
from sonar_graph.calibration import Calibration, Section, Start
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats, Ints, Measurements
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.triples import matrix, vector
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, RefusedRow, Trajectory

ROOM = 8
"""Landmarks that the first arrays have room for; doubled when needed."""
SPARE_ROWS = 256
"""IMU rows that may be kept longer than needed."""
SINGULAR_COSINE = 1e-3
"""Below this cosine of the pitch the Euler angles are useless."""


class EkfSlamParams(FilterParams):
    """Settings of EKF-SLAM; the paper gives none of them."""


class EkfSlam:
    """Extended Kalman filter over pose and landmarks.

    State (4) and covariance (5), prediction by gyros and Doppler log, observation (6) and innovation (7) of range and
    azimuth, augmentation at first sight; the numbers are those of "Experimental Results of Real-time Sonar-based
    Underwater Localization Using Landmarks". Equations: `baselines.ekf_state`, `baselines.ekf_landmarks`,
    `baselines.ekf_prediction`. Derivation: docs/theory/ekf_slam.md.

    What the paper leaves open, and how it is settled here:

    - Prediction runs from one DVL stamp to the next, over the same steps as every other estimator's
      (`sonar_graph.navigation.odometry`); attitude is integrated exactly for a constant rate, Q is the covariance of
      the integrated gyro and Doppler noise, lever arms included.
    - There is no gyro bias in the state (4). Its drift is not in the covariance either: with a biased gyro this filter
      trusts its heading too much, and gates true detections sooner or later.
    - While the Doppler log has no bottom lock the prediction is that of `sonar_graph.navigation.gap_motion`, common to
      all estimators; only there Q holds the gyro bias, which tilts gravity. The state does not grow: what is measured
      in a gap is related to the state before it, ever more weakly (`baselines.ekf_motion.told_again`).
    - A new landmark's elevation comes from the floor where its height is known, else it is 0; its sigma is the
      aperture over sqrt(12). A known floor enters once for each landmark, as a measurement of its height.
    - Identities need a posterior, innovations a gate (`EkfSlamParams`). A refused detection changes nothing.
    - Depth, the direction of gravity and planar motion, where the calibration has them, are further corrections;
      none is gated. Gravity's sigma is widened for the bias that successive directions share.
    - Several detections of one frame are taken one after the other, in the order of their rows.
    - Corrections are ``P - K S K^T`` in a form that stays symmetric, the Jacobians are taken once (no iteration).

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = EkfSlamParams

    def __init__(self, calibration: Calibration, params: EkfSlamParams | None = None) -> None:
        self._calibration = calibration
        self._params = params or EkfSlamParams()
        self._vehicle = vehicle_model(calibration, self._params.gravity_interval_s)
        self._sonar = sonar_model(calibration, self._params.gate_probability)
        self._odometry = Odometry(calibration)
        self._intake = DetectionIntake(self._params.minimum_id_probability)
        self._estimates = CausalEstimates()
        self._most_rows = SPARE_ROWS
        self._x, self._P = _start_state(calibration.start)
        self._n = POSE
        self._clock: Ints = np.zeros(CLOCK, np.int64)
        self._interval = GravityInterval(np.eye(3), np.zeros(3), np.zeros(4))
        self._vehicle_values, self._sonar_values = (*self._vehicle,), (*self._sonar,)
        self._interval_values = (*self._interval,)
        self._depth_variance = calibration.depth.sigma_m**2
        self._reached_ns = _NEVER
        self._done_ns = int(np.iinfo(np.int64).min)

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in what was measured and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.

        Raises
        ------
        EstimatorError
            When the pitch comes so near 90 degrees that the Euler angles are singular.
        MeasurementError
            When a row is stamped after ``end_ns``.
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
        self._make_room()
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
        """Landmarks in the state, with their blocks of (5)."""
        slots = self._intake.slots
        ids = sorted(slots)
        places = [POSE + LANDMARK * slots[i] for i in ids]
        return LandmarkMap(
            ids=np.array(ids, dtype=np.int64),
            positions=np.array([self._x[k : k + 3] for k in places]).reshape(-1, 3),
            covariances=np.array([self._P[k : k + 3, k : k + 3] for k in places]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """What became of each detection so far."""
        return self._intake.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, and why."""
        return self._odometry.refused

    def state(self) -> tuple[int, Floats, Floats]:
        """Stamp (ns), x of equation (4) and P of (5) at the newest node; copies."""
        n = self._n
        return int(self._clock[NODE]), self._x[:n].copy(), self._P[:n, :n].copy()

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
        open_interval(columns, self._vehicle.dvl_p_imu, self._interval, self._clock)

    def _run(
        self, depth: DepthColumns, frame_ns: Ints, detections: DetectionColumns, until_ns: int
    ) -> tuple[DetectionOutcomes, PoseArrays]:
        """Take the filter to an instant."""
        self._n, outcomes, pose = process_window(
            self._odometry.columns(),
            self._vehicle_values,
            self._sonar_values,
            self._x,
            self._P,
            self._n,
            self._clock,
            self._interval_values,
            depth,
            self._depth_variance,
            frame_ns,
            detections,
            until_ns,
        )
        if math.cos(self._x[4]) < SINGULAR_COSINE:
            raise EstimatorError(
                f"ekf-slam: pitch is {math.degrees(self._x[4]):.2f} deg at {int(self._clock[NODE])} ns, where the Euler"
                " angles of its state are singular; use isam2 for this log"
            )
        return outcomes, pose

    def _forget(self) -> None:
        """Drop used rows now and then: that costs as much as keeping a few."""
        self._odometry.settle(int(self._clock[NODE]))
        if len(self._odometry.columns()[0]) > self._most_rows:
            self._odometry.forget_before(int(self._clock[NODE]))
            self._most_rows = len(self._odometry.columns()[0]) + SPARE_ROWS

    def _make_room(self) -> None:
        needed, room = POSE + LANDMARK * len(self._intake.slots), len(self._x)
        if needed <= room:
            return
        grown = max(2 * room, needed)
        x, P = np.zeros(grown), np.zeros((grown, grown))
        x[:room], P[:room, :room] = self._x, self._P
        self._x, self._P = x, P


_NEVER = int(np.iinfo(np.int64).max)


def _start_state(start: Start) -> tuple[Floats, Floats]:
    """State and covariance of the start pose: world axes for position, small body rotations for attitude."""
    room = POSE + LANDMARK * ROOM
    x, P = np.zeros(room), np.zeros((room, room))
    x[:3] = start.position_m
    x[3:POSE] = euler_from_rotation(matrix(start.pose().rotation().matrix()))
    E = np.array(euler_from_rates(vector(x[3:])))
    P[:3, :3] = np.diag(np.square(start.position_sigma_m))
    P[3:POSE, 3:POSE] = E @ np.diag(np.square(start.rpy_sigma_rad)) @ E.T
    return x, P
