"""Odometry that depends on biases, as a factor, and all such factors of a graph at once.

With ``i_T_j`` the preintegrated motion for the biases b_0, C its covariance and D its derivative by them, but for the
turn ``psi = h (b_heading - its b_0)`` about the world's vertical u, seen in body j::

    E = (i_T_j Exp(c))^-1 X_i^-1 X_j Exp(-psi u),    c = D (b - b_0),    e = Log(E) ~ N(0, C)
    de/dX_i = -J(e) Ad(Exp(psi u) X_j^-1 X_i),    de/dX_j = J(e) [I, Exp(psi u)],    J: derivative of Log
    de/db = -J(e) (Ad(E^-1) J(c)^-1 D + [u, 0] h)

About a fixed axis of the body that turn would be a tilt once the estimate tilts, and gravity tell of it. GTSAM has no
compiled factor with these rows; `odometry_arrays` has them. A question of GTSAM's, in Python, still takes as long as
many compiled ones, so that a solution of thousands asks for all of them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import HEADING
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.slam.factors import ORIGIN, gaussian
from sonar_graph.slam.odometry_arrays import odometry_derivatives, odometry_errors, pose_row, poses_of

UNIT = gtsam.noiseModel.Unit.Create(6)


class OdometryError:
    """Error of one such factor, as GTSAM asks for it."""

    __slots__ = ("bias_0", "keys", "law")

    def __init__(self, keys: tuple[int, int, int], motion: PreintegratedMotion, up_j: Floats) -> None:
        self.keys, self.bias_0 = keys, motion.bias
        by_turn = np.zeros(motion.D_bias.shape[1])
        by_turn[HEADING] = up_j @ motion.D_bias[:3, HEADING]
        D = motion.D_bias.copy()
        D[:3] -= np.outer(up_j, by_turn)
        self.law = pose_row(motion.i_T_j)[None], D[None], by_turn[None], np.eye(6)[None]

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        """Error, shape (6,), unwhitened."""
        i, j, bias_key = self.keys
        poses = pose_row(values.atPose3(i))[None], pose_row(values.atPose3(j))[None]
        at = *poses, (values.atVector(bias_key) - self.bias_0)[None], *self.law
        if jacobians is None:
            return odometry_errors(*at)[0]
        (e,), *columns = odometry_derivatives(*at)
        for k, (transposed,) in enumerate(columns):
            jacobians[k] = transposed.T
        return np.asarray(e)


class OdometryStack:
    """Many `OdometryWithBias`, evaluated together as arrays (`batch_solution.Stack`); the same numbers to rounding."""

    def __init__(self, factors: Sequence[OdometryWithBias]) -> None:
        laws = [factor.law for factor in factors]
        self._keys = [law.keys for law in laws]
        self._pose_keys = np.array([keys[:2] for keys in self._keys], np.uint64).T
        self._bias_keys = sorted({keys[2] for keys in self._keys})
        self._biases = np.searchsorted(self._bias_keys, [keys[2] for keys in self._keys])
        self._bias_0 = np.array([law.bias_0 for law in laws])
        means, Ds, turns, _ = map(np.concatenate, zip(*(law.law for law in laws), strict=True))
        covariances = np.array([factor.covariance for factor in factors])
        self._laws = means, Ds, turns, np.linalg.inv(np.linalg.cholesky(covariances))

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

    __slots__ = ("covariance", "law")
    Stack: ClassVar = OdometryStack

    def __init__(
        self, key_i: int, key_j: int, bias_key: int, motion: PreintegratedMotion, up_j: Floats = ORIGIN
    ) -> None:
        self.law, self.covariance = OdometryError((key_i, key_j, bias_key), motion, up_j), motion.covariance
        super().__init__(gaussian(motion.covariance), [key_i, key_j, bias_key], self.law)
