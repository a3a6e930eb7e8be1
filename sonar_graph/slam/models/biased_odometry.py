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
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.slam.biases import HEADING
from sonar_graph.slam.models.factors import ORIGIN, gaussian

SERIES_RAD2 = 1e-2
"""Squared angle below which series serve: their next terms are below 1e-12."""
Transforms = tuple[Floats, Floats]
"""n rotations, shape (n, 3, 3), and translations, shape (n, 3)."""
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
        means = np.array([law.motion.i_T_j.matrix() for law in laws])
        self._mean_R, self._mean_p = means[:, :3, :3], means[:, :3, 3]
        self._D = np.array([law.D_bias for law in laws])
        self._by_turn = np.array([law.by_turn for law in laws])
        self._bias_0 = np.array([law.motion.bias for law in laws])
        self._whitening = np.linalg.inv(np.linalg.cholesky(np.array([law.motion.covariance for law in laws])))

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squared whitened errors."""
        e = self._evaluated(values)[0]
        return 0.5 * float(np.vdot(e, e))

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """What linearising each of them gives."""
        e, theta, E, i_T_j, (tilt, way_m), (turn, up) = self._evaluated(values)
        J = self._whitening @ log_derivatives(theta, E[1])
        by_correction = np.linalg.solve(log_derivatives(tilt, way_m), self._D)
        by_i, by_bias = -J @ inverse_adjoints(*i_T_j), -J @ inverse_adjoints(*E) @ by_correction
        by_bias -= times(J[:, :, :3], up)[..., None] * self._by_turn[:, None, :]
        J[:, :, 3:] = J[:, :, 3:] @ turn.transpose(0, 2, 1)
        make = gtsam.JacobianFactor
        return [
            make(i, A_i, j, A_j, b, A_b, rhs, UNIT)
            for (i, j, b), A_i, A_j, A_b, rhs in zip(self._keys, by_i, J, by_bias, -e, strict=True)
        ]

    def _evaluated(self, values: gtsam.Values) -> tuple[Floats, Floats, Transforms, Transforms, Transforms, Transforms]:
        """Terms of the equations above.

        Whitened errors, shape (n, 6); Log of the rotation of E, E, ``X_i^-1 X_j Exp(-psi u)``; c as a turn and the
        translation of Exp(c); Exp(-psi u) and u.
        """
        keys = np.fromiter(values.keys(), np.uint64)
        poses = gtsam.utilities.extractPose3(values)  # rows of R, and p, by ascending key
        i, j = np.searchsorted(keys[keys >> np.uint64(56) == ord("x")], self._pose_keys)
        R, p = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:]
        change = np.array([values.atVector(key) for key in self._bias_keys])[self._biases] - self._bias_0
        c = times(self._D, change)
        tilt = c[:, :3]
        way_m = np.asarray(np.linalg.solve(chord_inverses(tilt), c[:, 3:, None])[..., 0], np.float64)
        corrected = self._mean_R @ Rotation.from_rotvec(tilt).as_matrix(), self._mean_p + times(self._mean_R, way_m)
        up = R[j][:, 2]
        turn = Rotation.from_rotvec(-np.einsum("nb,nb->n", self._by_turn, change)[:, None] * up).as_matrix()
        i_R_j, i_p_j = between((R[i], p[i]), (R[j], p[j]))
        i_T_j = i_R_j @ turn, i_p_j
        E = between(corrected, i_T_j)
        theta = Rotation.from_matrix(E[0]).as_rotvec()
        e = np.hstack((theta, times(chord_inverses(theta), E[1])))
        return times(self._whitening, e), theta, E, i_T_j, (tilt, way_m), (turn, up)


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


def times(matrices: Floats, vectors: Floats) -> Floats:
    """Product of each matrix with its vector."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def between(a: Transforms, b: Transforms) -> Transforms:
    """``a^-1 b`` of each pair."""
    inverse_R = a[0].transpose(0, 2, 1)
    return inverse_R @ b[0], times(inverse_R, b[1] - a[1])


def crosses(v: Floats) -> Floats:
    """[v]x of each vector, shape (n, 3, 3)."""
    return -np.cross(v[:, None, :], np.eye(3))


def chord_inverses(theta: Floats) -> Floats:
    """V^-1 of each rotation vector, with ``Log(R, t) = (theta, V^-1 t)``: ``I - [theta]x / 2 + a [theta]x^2``."""
    K = crosses(theta)
    return np.eye(3) - 0.5 * K + curvature(theta)[0] * (K @ K)


def curvature(theta: Floats) -> tuple[Floats, Floats]:
    """Factor a of each rotation vector, shape (n, 1, 1), and its derivative by the angle, over the angle."""
    x2 = np.einsum("ni,ni->n", theta, theta)[:, None, None]
    y2 = np.maximum(x2, SERIES_RAD2)
    half = 0.5 * np.sqrt(y2)
    g = half / np.tan(half)
    is_small = x2 < SERIES_RAD2
    a = np.where(is_small, 1 / 12 + x2 * (1 / 720 + x2 / 30240), (1 - g) / y2)
    slope = ((half / np.sin(half)) ** 2 + g - 2) / y2**2
    return a, np.where(is_small, 1 / 360 + x2 * (1 / 7560 + x2 / 201600), slope)


def log_derivatives(theta: Floats, t: Floats) -> Floats:
    """J of each transform ``(Exp(theta), t)``, shape (n, 6, 6): ``Log(T Exp(d)) ~ Log(T) + J d``."""
    a, slope = curvature(theta)
    K, column = crosses(theta), theta[..., None]
    by_turn = 0.5 * crosses(t) + slope * ((K @ K) @ t[..., None]) * theta[:, None, :]
    dot = np.einsum("ni,ni->n", theta, t)[:, None, None] * np.eye(3)
    by_turn = by_turn + a * (column * t[:, None, :] + dot - 2 * t[..., None] * theta[:, None, :])
    J = np.zeros((len(t), 6, 6))
    J[:, :3, :3] = J[:, 3:, 3:] = chord_inverses(theta).transpose(0, 2, 1)
    J[:, 3:, :3] = by_turn @ J[:, :3, :3]
    return J


def inverse_adjoints(R: Floats, t: Floats) -> Floats:
    """``Ad(T^-1)`` of each transform, shape (n, 6, 6)."""
    Ad = np.zeros((len(R), 6, 6))
    Ad[:, :3, :3] = Ad[:, 3:, 3:] = R.transpose(0, 2, 1)
    Ad[:, 3:, :3] = -Ad[:, :3, :3] @ crosses(t)
    return Ad
