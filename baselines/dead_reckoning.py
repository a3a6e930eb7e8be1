"""Dead reckoning: gyros and Doppler log from a given start; docs/theory/dead_reckoning.md."""

from typing import ClassVar

import numpy as np

from sonar_graph.calibration import Calibration, Section
from sonar_graph.measurements import Floats, Measurements
from sonar_graph.navigation import Odometry, PreintegratedMotion, motion_between_nodes, motion_since_node
from sonar_graph.navigation.alignment import earth_rate_in_world
from sonar_graph.navigation.preintegration import Preintegrator
from sonar_graph.states import (
    CausalEstimates,
    DetectionJournal,
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    RefusedRow,
    Trajectory,
)


class DeadReckoningParams(Section):
    """Settings of dead reckoning: none."""


class DeadReckoning:
    """Composition of preintegrated motions, with the covariance of an unestimated gyro bias.

    From one DVL stamp to the next, with the motion i_T_j of covariance C and bias derivative D
    (`sonar_graph.navigation.preintegration`)::

        world_T_j = world_T_i i_T_j
        P <- F P F^T + Q,    F = [ Ad(j_T_i)  D ],    Q = diag(C, walk^2 T I)
                                 [ 0          I ]

    for the perturbation [theta, rho, bias]. The bias is *considered*: its mean stays zero, and its uncertainty widens
    the covariance and correlates successive errors. Depth, gravity and detections are not used.

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
        R, start = self._pose.rotation().matrix(), calibration.start
        self._P = np.zeros((9, 9))
        self._P[:3, :3] = np.diag(np.square(start.rpy_sigma_rad))
        self._P[3:6, 3:6] = R.T @ np.diag(np.square(start.position_sigma_m)) @ R
        self._P[6:, 6:] = np.eye(3) * calibration.imu.gyro_bias_sigma**2
        self._node_ns: int | None = None
        self._estimates = CausalEstimates()
        self._journal = DetectionJournal()

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.
        """
        self._odometry.add(measurements.imu, measurements.dvl)
        if (detections := measurements.detections) is not None:
            ids = detections.most_probable()[0].tolist()
            for stamp_ns, landmark_id in zip(detections.stamps_ns.tolist(), ids, strict=True):
                self._journal.record(stamp_ns, landmark_id, Outcome.IGNORED)
        node_ns = self._odometry.start_by(measurements.end_ns) if self._node_ns is None else self._node_ns
        if node_ns is None or measurements.end_ns < node_ns:
            return None
        for reached_ns in self._odometry.nodes(node_ns, measurements.end_ns).tolist():
            motion = motion_between_nodes(*self._motion_inputs(node_ns, reached_ns))
            self._P = self._carried(motion)
            self._pose = self._pose.compose(motion.i_T_j)
            node_ns = reached_ns
        self._odometry.forget_before(node_ns)
        self._node_ns = node_ns
        motion = motion_since_node(*self._motion_inputs(node_ns, measurements.end_ns))
        pose, covariance = self._pose.compose(motion.i_T_j), self._carried(motion)[:6, :6].copy()
        estimate = Estimate(measurements.end_ns, pose, covariance)
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates; dead reckoning does not revise them."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """An empty map."""
        return LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def detections(self) -> DetectionLog:
        """Every detection, ignored."""
        return self._journal.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, with the reason."""
        return self._odometry.refused

    def _motion_inputs(
        self, node_ns: int, until_ns: int
    ) -> tuple[Odometry, Preintegrator, int, int, Floats, Floats | None]:
        """Arguments of a motion from the newest epoch."""
        earth_rate = None if self._earth_rate is None else self._pose.rotation().matrix().T @ self._earth_rate
        return self._odometry, self._preintegrator, node_ns, until_ns, ZERO_BIAS, earth_rate

    def _carried(self, motion: PreintegratedMotion) -> Floats:
        """Covariance of [theta, rho, bias] after a motion, shape (9, 9)."""
        F, Q = np.eye(9), np.zeros((9, 9))
        F[:6, :6] = motion.i_T_j.inverse().AdjointMap()
        F[:6, 6:] = motion.D_bias
        Q[:6, :6] = motion.covariance
        Q[6:, 6:] = np.eye(3) * (self._walk_density**2 * motion.duration_s)
        P = F @ self._P @ F.T + Q
        return np.asarray(0.5 * (P + P.T))


ZERO_BIAS = np.zeros(3)
