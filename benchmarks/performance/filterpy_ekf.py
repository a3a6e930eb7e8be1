"""The same EKF-SLAM as `baselines.ekf_slam`, written the way filterpy is used: dense matrices, one prediction a sample.

State, motion model, noise, rules and order of events are the same, the code is not: F, Q and H are full matrices, every
IMU or Doppler sample is a prediction, corrections are filterpy's (Joseph's form). The motion of a sample comes from the
same `sonar_graph.navigation.Odometry`. On request there is one prediction a DVL node instead, over the motion since the
node before, as `baselines.ekf_slam` has it.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import NS_PER_S, Floats, Ints
from sonar_graph.models import (
    ACCEPTED,
    FLOOR_GATE,
    MINIMUM_PROBABILITY,
    elevation_on_floor,
    gravity_direction,
    identify,
    locate_jacobians,
    range_azimuth_jacobians,
)
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence

GRAVITY_INTERVAL_NS = NS_PER_S
NO_BIAS = np.zeros(3)


@dataclass
class FilterpyRun:
    """Result and time of one filter."""

    node_ns: int
    x: Floats
    P: Floats
    slots: dict[int, int]
    nodes: int
    """Predictions to a next DVL node."""
    seconds: float
    """In filterpy and in building its matrices."""


@dataclass
class FilterpySlam:
    """EKF-SLAM on filterpy; `run` feeds it a sequence."""

    calibration: Calibration
    ekf: ExtendedKalmanFilter = field(init=False)
    slots: dict[int, int] = field(default_factory=dict)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        start = self.calibration.start
        self.ekf = ExtendedKalmanFilter(dim_x=6, dim_z=1)
        self.ekf.x = np.concatenate([start.position_m, start.pose().rotation().rpy()])
        self.ekf.P = np.zeros((6, 6))
        self.ekf.P[:3, :3] = np.diag(np.square(start.position_sigma_m))
        self.ekf.P[3:, 3:] = np.diag(np.square(start.rpy_sigma_rad))

    def pose(self) -> gtsam.Pose3:
        """The body in the world."""
        return gtsam.Pose3(gtsam.Rot3.RzRyRx(*self.ekf.x[3:6]), self.ekf.x[:3])

    def timed(self, work: Callable[[], None]) -> None:
        """Do work that counts."""
        before = time.thread_time()
        work()
        self.seconds += time.thread_time() - before

    def predict(self, motion: PreintegratedMotion) -> None:
        """Carry mean and covariance over a motion."""
        n = len(self.ekf.x)
        before, W = self.pose(), body_rates(self.ekf.x)
        after = before.compose(motion.i_T_j)
        R, R_after = before.rotation().matrix(), after.rotation().matrix()
        self.ekf.x = np.concatenate(
            [after.translation(), after.rotation().rpy(), self.ekf.x[6:]]
        )
        E_after = np.linalg.inv(body_rates(self.ekf.x))
        self.ekf.F, G = np.eye(n), np.zeros((n, 6))
        self.ekf.F[:3, 3:6] = -R @ gtsam.Rot3.Hat(motion.i_T_j.translation()) @ W
        self.ekf.F[3:6, 3:6] = E_after @ motion.i_T_j.rotation().matrix().T @ W
        G[:3, 3:], G[3:6, :3] = R_after, E_after
        self.ekf.Q = G @ motion.covariance @ G.T
        self.ekf.predict_x = lambda _: None  # the mean has moved already
        self.ekf.predict()

    def update(
        self,
        z: Floats,
        predicted: Floats,
        H: Floats,
        R: Floats,
        *,
        wrapped: tuple[int, ...] = (),
    ) -> None:
        """Correct as filterpy does, with some innovations wrapped."""

        def residual(measured: Floats, expected: Floats) -> Floats:
            e = measured - expected
            for k in wrapped:
                e[k] = math.remainder(e[k], 2 * math.pi)
            return np.asarray(e)

        self.ekf.update(z, lambda _: H, lambda _: predicted, R=R, residual=residual)
        for k in (3, 5):
            self.ekf.x[k] = math.remainder(self.ekf.x[k], 2 * math.pi)

    def update_state(self, at: int, value: float, variance: float) -> None:
        """Correct by a direct measurement of one number of the state."""
        H = np.zeros((1, len(self.ekf.x)))
        H[0, at] = 1.0
        angle = (0,) if 3 <= at < 6 else ()
        self.update(
            np.array([value]),
            self.ekf.x[[at]],
            H,
            np.array([[variance]]),
            wrapped=angle,
        )

    def carried(self, motion: PreintegratedMotion) -> tuple[gtsam.Pose3, Floats]:
        """The body a motion after the state, and the derivative of its perturbation by the pose state."""
        pose, W = self.pose(), body_rates(self.ekf.x)
        to_perturbation = np.zeros((6, 6))
        to_perturbation[:3, 3:], to_perturbation[3:, :3] = W, pose.rotation().matrix().T
        return pose.compose(
            motion.i_T_j
        ), motion.i_T_j.inverse().AdjointMap() @ to_perturbation

    def update_depth(
        self, motion: PreintegratedMotion, z_m: float, variance: float
    ) -> None:
        """Correct by the height of the pressure port a motion after the state."""
        pose, T = self.carried(motion)
        port, down = (
            np.array(self.calibration.depth.port_m),
            pose.rotation().matrix()[2],
        )
        by_body = np.concatenate([-down @ gtsam.Rot3.Hat(port), down])[None]
        H = np.zeros((1, len(self.ekf.x)))
        H[:, :6] = by_body @ T
        R = variance + by_body @ motion.covariance @ by_body.T
        self.update(
            np.array([z_m]), np.array([pose.translation()[2] + down @ port]), H, R
        )

    def detect(
        self, motion: PreintegratedMotion, landmark: int, z: Floats, R: Floats
    ) -> None:
        """Correct by range and azimuth a motion after the state, or augment."""
        if landmark not in self.slots:
            self.augment(motion, landmark, z, R)
            return
        pose, T = self.carried(motion)
        at = 6 + 3 * self.slots[landmark]
        body_T_sonar = self.calibration.sonar.mounting.pose()
        predicted, by_body, by_landmark = range_azimuth_jacobians(
            pose, body_T_sonar, self.ekf.x[at : at + 3]
        )
        H = np.zeros((2, len(self.ekf.x)))
        H[:, :6], H[:, at : at + 3] = by_body @ T, by_landmark
        R = R + by_body @ motion.covariance @ by_body.T
        self.update(z, predicted, H, R, wrapped=(1,))

    def augment(
        self, motion: PreintegratedMotion, landmark: int, z: Floats, R: Floats
    ) -> None:
        """Append a landmark."""
        pose, T = self.carried(motion)
        sonar, floor, n = (
            self.calibration.sonar,
            self.calibration.floor,
            len(self.ekf.x),
        )
        body_T_sonar = sonar.mounting.pose()
        aperture, elevation = sonar.elevation_aperture_rad, None
        if floor:
            elevation = elevation_on_floor(
                pose.compose(body_T_sonar), z[0], z[1], floor.z_m, aperture
            )
        point, by_body, by_view = locate_jacobians(
            pose, body_T_sonar, z[0], z[1], elevation or 0.0
        )
        noise = np.zeros((3, 3))
        noise[:2, :2], noise[2, 2] = R, aperture**2 / 12
        J = np.eye(n + 3, n)
        J[n:, :6] = by_body @ T
        P = J @ self.ekf.P @ J.T
        P[n:, n:] += (
            by_body @ motion.covariance @ by_body.T + by_view @ noise @ by_view.T
        )
        self.ekf.x, self.ekf.P = np.concatenate([self.ekf.x, point]), P
        self.ekf.dim_x, self.ekf._I = n + 3, np.eye(n + 3)
        self.slots[landmark] = len(self.slots)
        if floor and (floor.z_m - point[2]) ** 2 <= FLOOR_GATE * (
            P[n + 2, n + 2] + floor.sigma_m**2
        ):
            self.update_state(n + 2, floor.z_m, floor.sigma_m**2)


@dataclass
class _Feed:
    """Measurements of a sequence on their way into the filter, in the order of their stamps."""

    sequence: Sequence
    slam: FilterpySlam
    odometry: Odometry
    node_ns: int
    opened_ns: int
    predicts_by_node: bool
    nodes: int = 0

    def motions(self, stamps_ns: Ints, known_ns: int) -> list[PreintegratedMotion]:
        """Motions from each stamp to the next, from rows stamped no later than an instant."""
        known = np.full(len(stamps_ns) - 1, known_ns)
        rows = zip(
            *self.odometry.motions(stamps_ns[:-1], stamps_ns[1:], known, NO_BIAS),
            strict=True,
        )
        return [
            PreintegratedMotion(
                gtsam.Pose3(gtsam.Rot3(dR), dp),
                C,
                D,
                NO_BIAS,
                duration_s,
                impulse / duration_s,
            )
            for (dR, dp, C, D, impulse), duration_s in zip(
                rows, np.diff(stamps_ns) * 1e-9, strict=True
            )
        ]

    def advance(self, until_ns: int) -> None:
        epochs_ns, reached = self.odometry.epochs_reached(self.node_ns, until_ns)
        for node_ns, reached_ns in zip(
            epochs_ns.tolist(), reached.tolist(), strict=True
        ):
            stamps_ns = np.array([self.node_ns, node_ns])
            if not self.predicts_by_node:
                imu_ns = self.sequence.imu.stamps_ns
                first, last = np.searchsorted(imu_ns, stamps_ns)
                stamps_ns = np.unique(np.concatenate([stamps_ns, imu_ns[first:last]]))
                stamps_ns = stamps_ns[stamps_ns >= self.node_ns]
            motions = self.motions(stamps_ns, reached_ns)
            self.slam.timed(
                lambda motions=motions: [
                    self.slam.predict(motion) for motion in motions
                ]
            )  # type: ignore[misc]
            self.node_ns, self.nodes = node_ns, self.nodes + 1
            if (
                self.slam.calibration.use_gravity
                and node_ns - self.opened_ns >= GRAVITY_INTERVAL_NS
            ):
                self.gravity(reached_ns)

    def gravity(self, reached_ns: int) -> None:
        calibration = self.slam.calibration
        stamps_ns = np.array([self.opened_ns, self.node_ns])
        (velocity_i, velocity_j), variances = zip(
            *(self.odometry.velocity_at_imu(int(t)) for t in stamps_ns), strict=True
        )
        (motion,) = self.motions(stamps_ns, reached_ns)
        sigma_m_s = math.sqrt(0.5 * sum(variances))
        self.opened_ns = self.node_ns
        found = gravity_direction(
            motion, velocity_i, velocity_j, sigma_m_s, calibration
        )
        if found is None:
            return
        up, sigma = found
        level = math.hypot(up[1], up[2])
        self.slam.timed(
            lambda: self.slam.update_state(
                3, math.atan2(up[1], up[2]), (sigma / level) ** 2
            )
        )
        self.slam.timed(
            lambda: self.slam.update_state(4, math.atan2(-up[0], level), sigma**2)
        )

    def provisional(self, until_ns: int) -> PreintegratedMotion:
        return self.odometry.motion(self.node_ns, until_ns, NO_BIAS, None, until_ns)

    def depth(self, row: int) -> None:
        depth = self.sequence.depth
        assert depth is not None
        variance = depth.variance_m2[row]
        if np.isnan(variance):
            variance = self.slam.calibration.depth.sigma_m**2
        motion = self.provisional(int(depth.stamps_ns[row]))
        self.slam.timed(
            lambda: self.slam.update_depth(motion, depth.z_m[row], variance)
        )

    def detection(self, row: int) -> None:
        detections = self.sequence.detections
        assert detections is not None
        one = detections.rows(slice(row, row + 1))
        ids, outcomes = identify(one, MINIMUM_PROBABILITY)
        if outcomes[0] != ACCEPTED:
            return
        sonar = self.slam.calibration.sonar
        R = one.range_azimuth_cov[0]
        if np.isnan(R).any():
            R = np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2])
        z = np.array([one.range_m[0], one.azimuth_rad[0]])
        motion = self.provisional(int(one.stamps_ns[0]))
        self.slam.timed(lambda: self.slam.detect(motion, int(ids[0]), z, R))


def run(
    sequence: Sequence, until_ns: int, *, predicts_by_node: bool = False
) -> FilterpyRun:
    """Feed a sequence up to an instant; without the Earth's rotation and the planar constraint.

    Parameters
    ----------
    predicts_by_node
        Predict once a DVL node, over the motion preintegrated since the node before, and not once a sample.
    """
    odometry = Odometry(sequence.calibration)
    odometry.add(
        *(
            rows.between(sequence.start_ns - 1, until_ns)
            for rows in (sequence.imu, sequence.dvl)
        )
    )
    start_ns = odometry.start_by(until_ns)
    assert start_ns is not None
    slam = FilterpySlam(sequence.calibration)
    feed = _Feed(sequence, slam, odometry, start_ns, start_ns, predicts_by_node)
    events = []
    if sequence.depth is not None:
        events += [(int(t), 0, row) for row, t in enumerate(sequence.depth.stamps_ns)]
    if sequence.detections is not None:
        events += [
            (int(t), 1, row) for row, t in enumerate(sequence.detections.stamps_ns)
        ]
    for stamp_ns, kind, row in sorted(events):
        if stamp_ns > until_ns or odometry.start_by(stamp_ns) is None:
            continue
        feed.advance(stamp_ns)
        (feed.depth, feed.detection)[kind](row)
    feed.advance(until_ns)
    return FilterpyRun(
        feed.node_ns, slam.ekf.x, slam.ekf.P, slam.slots, feed.nodes, slam.seconds
    )


def body_rates(x: Floats) -> Floats:
    """Body rates from the rates of roll, pitch and yaw, shape (3, 3)."""
    roll, pitch = x[3], x[4]
    return np.array(
        [
            [1, 0, -np.sin(pitch)],
            [0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
            [0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
        ]
    )
