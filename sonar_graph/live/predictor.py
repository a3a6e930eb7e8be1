"""Pose at the newest IMU row: the newest estimate, moved on by gyros and Doppler log.

    world_T_b(t) = world_T_b(t_k) motion(t_k, t),    P(t) = A P(t_k) A^T + C(t_k, t),    A = Ad(motion^-1)

An estimate is late by the lateness budget and the time that it takes; the prediction is not. Frames are those of
REP-105: ``odom`` moves on smoothly and drifts, ``map`` jumps when an estimate comes, ``map_T_odom`` is the difference.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation import Odometry
from sonar_graph.states import Estimate

EARLIEST_NS = -(2**63)
BIAS = np.zeros(3)
"""Gyro bias: a contract of estimates has none. Over half a second 1e-3 rad/s turns by 5e-4 rad."""


class Prediction(NamedTuple):
    """Poses at an instant, as matrices.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.live import Prediction
    >>> Prediction(0, np.eye(4), np.eye(6), np.eye(4), np.zeros(3)).velocity_m_s.shape
    (3,)
    """

    stamp_ns: int
    world_T_body: Floats
    """Shape (4, 4)."""
    covariance: Floats
    """Of the body-frame perturbation [rotation, translation], shape (6, 6)."""
    odom_T_body: Floats
    """Shape (4, 4)."""
    velocity_m_s: Floats
    """Of the IMU's point at the newest epoch, body axes, shape (3,); NaN before the first."""


class Predictor:
    """Poses at the rate of the IMU.

    Examples
    --------
    >>> from sonar_graph import load_estimator
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> estimator = load_estimator("dead-reckoning")(world.calibration, Odometry(world.calibration))
    >>> predictor = Predictor(world.calibration)
    >>> first, second = list(world.replay(world.instants(rate_hz=1.0)))[:2]
    >>> for step in (first, second):
    ...     predictor.add(step.imu, step.dvl)
    >>> predictor.correct(estimator.process(first))
    >>> prediction = predictor.predict()
    >>> prediction.stamp_ns == second.end_ns, prediction.covariance.shape
    (True, (6, 6))
    """

    def __init__(self, calibration: Calibration) -> None:
        self._odometry = Odometry(calibration)
        self._estimate: Estimate | None = None
        self._odom_T_estimate = gtsam.Pose3()
        self._newest_ns = 0

    def add(self, imu: Imu | None, dvl: Dvl | None) -> None:
        """Take in rows as they come."""
        self._odometry.add(imu, dvl)
        if imu is not None:
            self._newest_ns = max(self._newest_ns, int(imu.stamps_ns[-1]))

    def correct(self, estimate: Estimate) -> None:
        """Begin at a newer estimate; an older one is ignored."""
        before = self._estimate
        if before is not None and estimate.stamp_ns <= before.stamp_ns:
            return
        # the smooth frame moves on by odometry alone, so that it never jumps
        if before is not None:
            step = self._odometry.motion(
                before.stamp_ns, estimate.stamp_ns, BIAS, known_ns=self._newest_ns
            )
            self._odom_T_estimate = self._odom_T_estimate.compose(step.i_T_j)
        self._estimate = estimate
        self._odometry.forget_before(estimate.stamp_ns)

    def lose(self) -> None:
        """Forget the estimate: the vehicle is nowhere until the next one."""
        self._estimate = None

    @property
    def map_T_odom(self) -> Floats:
        """Correction of the smooth frame by the newest estimate, shape (4, 4)."""
        assert self._estimate is not None
        correction = self._estimate.world_T_body.compose(
            self._odom_T_estimate.inverse()
        )
        return np.ascontiguousarray(correction.matrix())

    def predict(self) -> Prediction | None:
        """Poses at the newest IMU row; None before the first estimate."""
        estimate = self._estimate
        if estimate is None:
            return None
        # an estimate may be of an instant after the newest row
        newest_ns = max(self._newest_ns, estimate.stamp_ns)
        motion = self._odometry.motion(estimate.stamp_ns, newest_ns, BIAS)
        # the covariance is of the body at the newest row
        A = motion.i_T_j.inverse().AdjointMap()
        world_T_body = estimate.world_T_body.compose(motion.i_T_j)
        odom_T_body = self._odom_T_estimate.compose(motion.i_T_j)
        return Prediction(
            newest_ns,
            np.ascontiguousarray(world_T_body.matrix()),
            A @ estimate.covariance @ A.T + motion.covariance,
            np.ascontiguousarray(odom_T_body.matrix()),
            self._velocity(newest_ns),
        )

    def _velocity(self, until_ns: int) -> Floats:
        """Velocity of the IMU's point at the newest epoch, body axes, shape (3,), m/s."""
        epochs_ns = self._odometry.epochs(EARLIEST_NS, until_ns)
        if not len(epochs_ns):
            return np.full(3, np.nan)
        velocity, _ = self._odometry.velocity_at_imu(int(epochs_ns[-1]))
        return velocity
