"""EKF-SLAM as published, in its textbook form: the baseline that a smoother has to beat."""

from __future__ import annotations

import math
from typing import ClassVar

import gtsam
import numpy as np
from pydantic import Field

from baselines.causal import CausalEstimates
from baselines.ekf_landmarks import GATED, NEW, NO_SLOT, USED, DetectionColumns, SonarModel
from baselines.ekf_prediction import NODE, GravityInterval, VehicleModel, open_interval
from baselines.ekf_state import LANDMARK, POSE
from baselines.ekf_window import DepthColumns, DetectionOutcomes, PoseArrays, process_window
from baselines.euler import euler_from_rates, euler_from_rotation
from sonar_graph.calibration import Calibration, Section, Start
from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.measurements import Depth, Floats, Ints, LandmarkDetections, Measurements
from sonar_graph.navigation.earth import earth_rate_in_world
from sonar_graph.navigation.gap_motion import gap_values
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.triples import ZERO, matrix, minus, vector
from sonar_graph.slam.association import DetectionJournal, gate_threshold, identify
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Outcome, Trajectory

ROOM = 8
"""Landmarks that the first arrays have room for; doubled when needed."""
SPARE_ROWS = 256
"""IMU rows that may be kept longer than needed."""
SINGULAR_COSINE = 1e-3
"""Below this cosine of the pitch the Euler angles are useless."""
OUTCOMES = {USED: Outcome.USED, NEW: Outcome.NEW, GATED: Outcome.GATED}


class EkfSlamParams(Section):
    """Settings of EKF-SLAM; the paper gives none of them."""

    gate_probability: float = Field(0.999, gt=0, le=1)
    """Share of true innovations that the gate lets pass; 1: no gate."""
    minimum_id_probability: float = Field(0.5, ge=0, le=1)
    """Posterior below which an identity is not believed."""
    gravity_interval_s: float = Field(1.0, gt=0)
    """Over which the specific force is averaged for one correction of roll and pitch."""


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
        self._vehicle = _vehicle_model(calibration, self._params)
        self._sonar = _sonar_model(calibration, self._params)
        self._odometry = Odometry(calibration)
        self._journal = DetectionJournal()
        self._estimates = CausalEstimates()
        self._slots: dict[int, int] = {}
        self._most_rows = SPARE_ROWS
        self._x, self._P = _start_state(calibration.start)
        self._n = POSE
        self._clock: Ints = np.zeros(4, np.int64)
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
        detections, depth = measurements.detections, measurements.depth
        _check(detections, depth, measurements.end_ns)
        ids, refusals = self._identify(detections)
        since_ns = max(self._done_ns, self._reached_ns)
        self._done_ns = max(self._done_ns, measurements.end_ns)
        if measurements.end_ns < max(self._reached_ns, int(self._clock[NODE])):
            self._record(detections, ids, refusals, _NO_OUTCOMES)
            return None
        columns = self._detection_columns(detections, ids, refusals)
        frame_ns = _NO_STAMPS if detections is None else np.maximum(detections.stamps_ns, since_ns)
        outcomes, pose = self._run(_since(depth, since_ns), frame_ns, columns, measurements.end_ns)
        self._record(detections, ids, refusals, outcomes)
        self._forget()
        estimate = Estimate(measurements.end_ns, gtsam.Pose3(gtsam.Rot3(pose[0]), pose[1]), pose[2])
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates: a filter does not look back."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Landmarks in the state, with their blocks of (5)."""
        ids = sorted(self._slots)
        places = [POSE + LANDMARK * self._slots[i] for i in ids]
        return LandmarkMap(
            ids=np.array(ids, dtype=np.int64),
            positions=np.array([self._x[k : k + 3] for k in places]).reshape(-1, 3),
            covariances=np.array([self._P[k : k + 3, k : k + 3] for k in places]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """What became of each detection so far."""
        return self._journal.log()

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

    def _identify(self, detections: LandmarkDetections | None) -> tuple[list[int], list[Outcome | None]]:
        """The most probable identity of each row, and why it is not used, if so."""
        if detections is None:
            return [], []
        identities = identify(detections, self._params.minimum_id_probability)
        refusals = [
            self._refusal(stamp_ns) or reason
            for stamp_ns, reason in zip(detections.stamps_ns.tolist(), identities.refusals, strict=True)
        ]
        return identities.ids.tolist(), refusals

    def _refusal(self, stamp_ns: int) -> Outcome | None:
        """Why nothing stamped then can be used."""
        if stamp_ns < self._reached_ns:
            return Outcome.UNLOCATED
        return Outcome.LATE if stamp_ns < self._done_ns else None

    def _detection_columns(
        self, detections: LandmarkDetections | None, ids: list[int], refusals: list[Outcome | None]
    ) -> DetectionColumns:
        """What compiled code needs of the detections; makes room for those of new landmarks."""
        if detections is None:
            return _NO_DETECTIONS
        slots = [
            NO_SLOT if reason else self._slots.setdefault(landmark_id, len(self._slots))
            for landmark_id, reason in zip(ids, refusals, strict=True)
        ]
        self._make_room()
        return np.array(slots), detections.range_m, detections.azimuth_rad, detections.range_azimuth_cov

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

    def _record(
        self,
        detections: LandmarkDetections | None,
        ids: list[int],
        refusals: list[Outcome | None],
        outcomes: DetectionOutcomes,
    ) -> None:
        if detections is None:
            return
        kinds, innovations, covs = outcomes[0].tolist(), outcomes[1], outcomes[2]
        rows = zip(detections.stamps_ns.tolist(), ids, refusals, strict=True)
        for row, (stamp_ns, landmark_id, reason) in enumerate(rows):
            if reason:
                self._journal.record(stamp_ns, landmark_id, reason)
            else:
                self._journal.record(stamp_ns, landmark_id, OUTCOMES[kinds[row]], innovations[row], covs[row])

    def _make_room(self) -> None:
        needed, room = POSE + LANDMARK * len(self._slots), len(self._x)
        if needed <= room:
            return
        grown = max(2 * room, needed)
        x, P = np.zeros(grown), np.zeros((grown, grown))
        x[:room], P[:room, :room] = self._x, self._P
        self._x, self._P = x, P


_NEVER = int(np.iinfo(np.int64).max)
_NO_STAMPS = np.empty(0, np.int64)
_NO_DEPTH = (_NO_STAMPS, np.empty(0), np.empty(0))
_NO_DETECTIONS = (_NO_STAMPS, np.empty(0), np.empty(0), np.empty((0, 2, 2)))
_NO_OUTCOMES = (_NO_STAMPS, np.empty((0, 2)), np.empty((0, 2, 2)))


def _check(detections: LandmarkDetections | None, depth: Depth | None, end_ns: int) -> None:
    """Refuse what can only be a mistake of the caller."""
    for block in (detections, depth):
        if block is not None and block.stamps_ns[-1] > end_ns:
            raise MeasurementError(
                f"Measurements: {type(block).__name__} has a row at {block.stamps_ns[-1]} ns, after end_ns = {end_ns};"
                " hand it in with the call that reaches it"
            )


def _since(depth: Depth | None, since_ns: int) -> DepthColumns:
    """Depth samples that are not older than an instant."""
    if depth is None:
        return _NO_DEPTH
    if depth.stamps_ns[0] >= since_ns:
        return depth.stamps_ns, depth.z_m, depth.variance_m2
    first = int(np.searchsorted(depth.stamps_ns, since_ns))
    return depth.stamps_ns[first:], depth.z_m[first:], depth.variance_m2[first:]


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


def _vehicle_model(calibration: Calibration, params: EkfSlamParams) -> VehicleModel:
    imu, dvl = calibration.imu, calibration.dvl
    body_p_dvl = dvl.mounting.translation_m
    plane = calibration.planar
    earth_rate = earth_rate_in_world(calibration)
    return VehicleModel(
        gyro_noise_density=imu.gyro_noise_density,
        body_p_dvl=body_p_dvl,
        dvl_p_imu=minus(imu.mounting.translation_m, body_p_dvl),
        earth_rate=ZERO if earth_rate is None else vector(earth_rate),
        body_p_port=calibration.depth.port_m,
        gravity_interval_ns=round(params.gravity_interval_s * 1e9) if calibration.use_gravity else 0,
        accel_noise_density=imu.accel_noise_density,
        accel_bias_sigma=imu.accel_bias_sigma,
        gravity_m_s2=calibration.gravity_m_s2,
        is_planar=plane is not None,
        plane_z_m=plane.z_m if plane else 0.0,
        plane_z_variance=plane.z_sigma_m**2 if plane else 1.0,
        plane_tilt_variance=plane.tilt_sigma_rad**2 if plane else 1.0,
        gap=gap_values(calibration),
        gyro_bias_sigma=imu.gyro_bias_sigma,
    )


def _sonar_model(calibration: Calibration, params: EkfSlamParams) -> SonarModel:
    body_T_sonar = calibration.sonar.mounting.pose()
    floor = calibration.floor
    return SonarModel(
        body_R_sonar=matrix(body_T_sonar.rotation().matrix()),
        body_p_sonar=calibration.sonar.mounting.translation_m,
        gate=gate_threshold(params.gate_probability, 2),
        aperture_rad=calibration.sonar.elevation_aperture_rad,
        range_variance_m2=calibration.sonar.range_sigma_m**2,
        azimuth_variance=calibration.sonar.azimuth_sigma_rad**2,
        has_floor=floor is not None,
        floor_z_m=floor.z_m if floor else 0.0,
        floor_variance_m2=floor.sigma_m**2 if floor else 1.0,
    )
