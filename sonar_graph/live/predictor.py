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

BIAS = np.zeros(3)
"""Gyro bias: a contract of estimates has none. Over half a second 1e-3 rad/s turns by 5e-4 rad."""


class Prediction(NamedTuple):
    """Pose at an instant."""

    stamp_ns: int
    world_T_body: gtsam.Pose3
    covariance: Floats
    """Of the body-frame perturbation [rotation, translation], shape (6, 6)."""
    odom_T_body: gtsam.Pose3
    velocity_m_s: Floats
    """Of the IMU's point at the newest epoch, body axes, shape (3,)."""


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
        self._velocity = np.zeros(3)
        self._epoch_ns: int | None = None

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
        if before is not None:
            step = self._odometry.motion(before.stamp_ns, estimate.stamp_ns, BIAS, known_ns=self._newest_ns)
            self._odom_T_estimate = self._odom_T_estimate.compose(step.i_T_j)
        self._estimate = estimate
        self._odometry.forget_before(estimate.stamp_ns)

    @property
    def map_T_odom(self) -> gtsam.Pose3:
        """Correction of the smooth frame by the newest estimate."""
        assert self._estimate is not None
        return self._estimate.world_T_body.compose(self._odom_T_estimate.inverse())

    def predict(self) -> Prediction | None:
        """Pose at the newest IMU row; None before the first estimate."""
        at, newest_ns = self._estimate, self._newest_ns
        if at is None:
            return None
        newest_ns = max(newest_ns, at.stamp_ns)
        motion = self._odometry.motion(at.stamp_ns, newest_ns, BIAS)
        A = motion.i_T_j.inverse().AdjointMap()
        epochs_ns = self._odometry.epochs(newest_ns - 1_000_000_000, newest_ns)
        if len(epochs_ns) and epochs_ns[-1] != self._epoch_ns:
            self._epoch_ns = int(epochs_ns[-1])
            self._velocity, _ = self._odometry.velocity_at_imu(self._epoch_ns)
        return Prediction(
            newest_ns,
            at.world_T_body.compose(motion.i_T_j),
            A @ at.covariance @ A.T + motion.covariance,
            self._odom_T_estimate.compose(motion.i_T_j),
            self._velocity,
        )
