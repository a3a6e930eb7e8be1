"""Dead reckoning: gyros and Doppler log from a given start, and nothing else."""

from __future__ import annotations

from typing import ClassVar

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration, Section
from sonar_graph.estimator import CausalEstimates
from sonar_graph.measurements import Floats, LandmarkDetections, Measurements
from sonar_graph.navigation import Odometry, motion_between_nodes, motion_since_node
from sonar_graph.navigation.alignment import earth_rate_in_world
from sonar_graph.navigation.preintegration import PreintegratedMotion, Preintegrator
from sonar_graph.states import DetectionJournal, DetectionLog, Estimate, LandmarkMap, Outcome, RefusedRow, Trajectory


class DeadReckoningParams(Section):
    """Dead reckoning has nothing to set."""


class DeadReckoning:
    """Composes preintegrated motions and carries their covariance, with that of a gyro bias that it never learns.

    From one DVL stamp to the next, with the motion i_T_j of covariance C and bias derivative D
    (`sonar_graph.navigation.preintegration.motion`)::

        world_T_j = world_T_i i_T_j
        P <- F P F^T + Q,    F = [ Ad(j_T_i)  D ],    Q = diag(C, walk^2 T I)
                                 [ 0          I ]

    for the perturbation [theta, rho, bias]. The bias is *considered*: its mean stays zero, its uncertainty widens the
    covariance and correlates successive errors, as an unknown constant does. Depth, gravity and detections are not
    used; docs/theory/dead_reckoning.md.

    Parameters
    ----------
    calibration
        Noise, mountings, start.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = DeadReckoningParams

    def __init__(self, calibration: Calibration, params: DeadReckoningParams | None = None) -> None:
        self._params = params or DeadReckoningParams()
        self._odometry = Odometry(calibration)
        self._preintegrator = Preintegrator.from_calibration(calibration)
        has_bias = calibration.imu.gyro_bias_sigma > 0
        self._walk_density = calibration.imu.gyro_bias_walk_density if has_bias else 0.0
        self._earth_rate = earth_rate_in_world(calibration)
        self._pose = calibration.start.pose()
        self._P = _start_covariance(calibration)
        self._node_ns: int | None = None
        self._estimates = CausalEstimates()
        self._journal = DetectionJournal()

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in what was measured and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.
        """
        self._odometry.add(measurements.imu, measurements.dvl)
        self._ignore(measurements.detections)
        node_ns = self._odometry.start_by(measurements.end_ns) if self._node_ns is None else self._node_ns
        if node_ns is None or measurements.end_ns < node_ns:
            return None
        node_ns = self._advance(node_ns, measurements.end_ns)
        estimate = self._estimate(node_ns, measurements.end_ns)
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates: dead reckoning does not look back."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """None."""
        return LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def detections(self) -> DetectionLog:
        """Every detection, ignored."""
        return self._journal.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, and why."""
        return self._odometry.refused

    def _ignore(self, detections: LandmarkDetections | None) -> None:
        if detections is None:
            return
        ids, _ = detections.most_probable()
        for stamp_ns, landmark_id in zip(detections.stamps_ns.tolist(), ids.tolist(), strict=True):
            self._journal.record(stamp_ns, landmark_id, Outcome.IGNORED)

    def _advance(self, node_ns: int, instant_ns: int) -> int:
        """Commit all nodes reached by then; returns the newest."""
        for reached_ns in self._odometry.nodes(node_ns, instant_ns).tolist():
            motion = motion_between_nodes(*self._from_node(node_ns, reached_ns))
            self._P = self._carried(motion)
            self._pose = self._pose.compose(motion.i_T_j)
            node_ns = reached_ns
        self._odometry.forget_before(node_ns)
        self._node_ns = node_ns
        return node_ns

    def _from_node(
        self, node_ns: int, until_ns: int
    ) -> tuple[Odometry, Preintegrator, int, int, Floats, Floats | None]:
        """What a motion from the newest node committed needs."""
        earth_rate = None if self._earth_rate is None else self._pose.rotation().matrix().T @ self._earth_rate
        return self._odometry, self._preintegrator, node_ns, until_ns, _ZERO_BIAS, earth_rate

    def _carried(self, motion: PreintegratedMotion) -> Floats:
        """Covariance of [theta, rho, bias] after a motion, shape (9, 9)."""
        F, Q = np.eye(9), np.zeros((9, 9))
        F[:6, :6] = motion.i_T_j.inverse().AdjointMap()
        F[:6, 6:] = motion.D_bias
        Q[:6, :6] = motion.covariance
        Q[6:, 6:] = np.eye(3) * (self._walk_density**2 * motion.duration_s)
        P = F @ self._P @ F.T + Q
        return np.asarray(0.5 * (P + P.T))

    def _estimate(self, node_ns: int, instant_ns: int) -> Estimate:
        motion = motion_since_node(*self._from_node(node_ns, instant_ns))
        return Estimate(instant_ns, self._pose.compose(motion.i_T_j), self._carried(motion)[:6, :6].copy())


_ZERO_BIAS = np.zeros(3)


def _start_covariance(calibration: Calibration) -> Floats:
    """Of [theta, rho, bias] at the start: position along the world's axes, turned into the body's."""
    start: gtsam.Pose3 = calibration.start.pose()
    R = start.rotation().matrix()
    P = np.zeros((9, 9))
    P[:3, :3] = np.diag(np.square(calibration.start.rpy_sigma_rad))
    P[3:6, 3:6] = R.T @ np.diag(np.square(calibration.start.position_sigma_m)) @ R
    P[6:, 6:] = np.eye(3) * calibration.imu.gyro_bias_sigma**2
    return P
