"""Odometry that depends on biases, as a factor, and all such factors of a graph at once.

With ``i_T_j`` the preintegrated motion for the biases b_0, C its covariance and D its derivative by them, but for the
turn ``psi = h (b_heading - its b_0)`` about the world's vertical u, seen in body j::

    E = (i_T_j Exp(c))^-1 X_i^-1 X_j Exp(-psi u),    c = D (b - b_0),    e = Log(E) ~ N(0, C)
    de/dX_i = -J(e) Ad(Exp(psi u) X_j^-1 X_i),    de/dX_j = J(e) [I, Exp(psi u)],    J: derivative of Log
    de/db = -J(e) (Ad(E^-1) J(c)^-1 D + [u, 0] h)

About a fixed axis of the body that turn would be a tilt once the estimate tilts, and gravity tell of it. GTSAM has no
compiled factor with these rows. One evaluation in Python takes as long as many compiled ones, so that a solution of
thousands asks for all of them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.slam.biases import HEADING
from sonar_graph.slam.models.factors import ORIGIN, gaussian
from sonar_graph.slam.models.odometry_arrays import odometry_derivatives, odometry_errors
from sonar_graph.slam.models.views import poses_of

UNIT = gtsam.noiseModel.Unit.Create(6)


class OdometryError:
    """Error of one such factor, as GTSAM asks for it."""

    __slots__ = ("D_bias", "_inverse_mean", "_known", "by_turn", "keys", "motion")

    def __init__(self, keys: tuple[int, int, int], motion: PreintegratedMotion, up_j: Floats) -> None:
        self.keys = keys
        self.motion = motion
        self.by_turn = np.zeros(motion.D_bias.shape[1])
        self.by_turn[HEADING] = up_j @ motion.D_bias[:3, HEADING]
        self.D_bias = motion.D_bias.copy()
        self.D_bias[:3] -= np.outer(up_j, self.by_turn)
        self._inverse_mean = motion.i_T_j.inverse()
        self._known: tuple[bytes, gtsam.Pose3, Floats] | None = None

    def _corrected(self, bias: Floats) -> tuple[gtsam.Pose3, Floats]:
        """Inverse of ``i_T_j Exp(c)``, and ``J(c)^-1 D``: biases are linearised anew far more seldom than poses."""
        if self._known is None or self._known[0] != bias.tobytes():
            D = self.D_bias
            correction = D @ (bias - self.motion.bias)
            inverse = gtsam.Pose3.Expmap(-correction).compose(self._inverse_mean)
            self._known = bias.tobytes(), inverse, gtsam.Pose3.ExpmapDerivative(correction) @ D
        return self._known[1:]

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        """Error, shape (6,), unwhitened."""
        key_i, key_j, bias_key = self.keys
        X_j, bias = values.atPose3(key_j), values.atVector(bias_key)
        up, turn_rad = X_j.rotation().matrix()[2], self.by_turn.dot(bias - self.motion.bias)
        turn = gtsam.Rot3.Expmap(-turn_rad * up)
        i_T_j = values.atPose3(key_i).between(X_j).compose(gtsam.Pose3(turn, ORIGIN))
        inverse_corrected, D_correction = self._corrected(bias)
        E = inverse_corrected.compose(i_T_j)
        e = gtsam.Pose3.Logmap(E)
        if jacobians is not None:
            D_log = gtsam.Pose3.LogmapDerivative(e)
            jacobians[0] = -D_log.dot(i_T_j.inverse().AdjointMap())
            jacobians[1] = np.hstack((D_log[:, :3], D_log[:, 3:].dot(turn.matrix().T)))
            jacobians[2] = -D_log.dot(E.inverse().AdjointMap()).dot(D_correction)
            jacobians[2] -= np.outer(D_log[:, :3].dot(up), self.by_turn)
        return e


class OdometryStack:
    """Many `OdometryWithBias`, evaluated together as arrays (`batch_solution.Stack`); the same numbers to rounding."""

    def __init__(self, factors: Sequence[OdometryWithBias]) -> None:
        laws = [factor.law for factor in factors]
        self._keys = [law.keys for law in laws]
        self._pose_keys = np.array([keys[:2] for keys in self._keys], np.uint64).T
        self._bias_keys = sorted({keys[2] for keys in self._keys})
        self._biases = np.searchsorted(self._bias_keys, [keys[2] for keys in self._keys])
        self._bias_0 = np.array([law.motion.bias for law in laws])
        means = np.array([law.motion.i_T_j.matrix() for law in laws])
        self._laws = (
            np.hstack((means[:, :3, :3].reshape(-1, 9), means[:, :3, 3])),
            np.array([law.D_bias for law in laws]),
            np.array([law.by_turn for law in laws]),
            np.linalg.inv(np.linalg.cholesky(np.array([law.motion.covariance for law in laws]))),
        )

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squared whitened errors."""
        e = odometry_errors(*self._at(values), *self._laws)
        return 0.5 * float(np.vdot(e, e))

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """What linearising each of them gives."""
        e, *columns = odometry_derivatives(*self._at(values), *self._laws)
        blocks = (transposed.transpose(0, 2, 1) for transposed in columns)  # stored by columns, as GTSAM stores them
        make = gtsam.JacobianFactor
        return [
            make(i, A_i, j, A_j, b, A_b, rhs, UNIT)
            for (i, j, b), A_i, A_j, A_b, rhs in zip(self._keys, *blocks, -e, strict=True)
        ]

    def _at(self, values: gtsam.Values) -> tuple[Floats, Floats, Floats]:
        """Poses at both ends, as rows of R, and p, shape (n, 12) each, and ``b - b_0``, shape (n, 11)."""
        poses_i, poses_j = poses_of(values, self._pose_keys)
        biases = np.array([values.atVector(key) for key in self._bias_keys])
        return poses_i, poses_j, biases[self._biases] - self._bias_0


class OdometryWithBias(gtsam.CustomFactor):
    """Relative pose from preintegrated gyro and DVL, and the biases b, of which ``D_bias`` has a column each.

    ``up_j``: u when the motion was set, shape (3,), along which ``D_bias`` has that turn; zero without gravity.
    """

    __slots__ = ("law",)
    Stack: ClassVar = OdometryStack

    def __init__(
        self, key_i: int, key_j: int, bias_key: int, motion: PreintegratedMotion, up_j: Floats = ORIGIN
    ) -> None:
        self.law = OdometryError((key_i, key_j, bias_key), motion, up_j)
        super().__init__(gaussian(motion.covariance), [key_i, key_j, bias_key], self.law)
