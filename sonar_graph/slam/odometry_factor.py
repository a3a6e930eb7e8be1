"""Odometry that depends on biases, as a factor, and all such factors of a graph at once.

With ``i_T_j`` the preintegrated motion for the biases b_0, C its covariance and D its derivative by them, but for the
turn ``psi = h (b - b_0)`` about the world's vertical u, seen in body j::

    E = (i_T_j Exp(c))^-1 X_i^-1 X_j Exp(-psi u),    c = D (b - b_0),    e = Log(E) ~ N(0, C)                  (1)
    de/dX_i = -J(e) Ad(Exp(psi u) X_j^-1 X_i)         J: derivative of Log                                     (2)
    de/dX_j = J(e) [I, Exp(psi u)]                                                                             (3)
    de/db   = -J(e) (Ad(E^-1) J(c)^-1 D + [u, 0] h)                                                            (4)

About a fixed axis of the body that turn would become a tilt as soon as the estimate tilts, and gravity would constrain
it. With ``E = (R, t)``, ``theta = Log(R)`` and V the mean of ``Exp(s theta)`` over s in [0, 1]::

    Log(E) = (theta, V^-1 t),    V^-1 = I - [theta]x / 2 + a [theta]x^2                                        (5)
    a = (1 - y cot y) / |theta|^2,    y = |theta| / 2
    J = [ V^-T   0   ]     B: derivative of V^-1 t by theta                                                    (6)
        [ B V^-T V^-T ]

GTSAM has no compiled factor with these rows. It calls Python once for each factor, which takes as long as many compiled
ones, so that a solution of thousands evaluates them together (`OdometryStack`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import HEADING
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.numerics import (
    I3,
    O3,
    ZERO,
    Mat3,
    Mat6,
    Vec3,
    Vec6,
    chord_inverse,
    compiled,
    curvature,
    exp_and_mean,
    inlined,
    mat6,
    outer,
    rodrigues,
    rotation_log,
    skew,
    store_all,
    store_row6,
    vec,
)
from sonar_graph.slam.factors import ORIGIN, gaussian, poses_of

UNIT = gtsam.noiseModel.Unit.Create(6)
UNWHITENED = np.eye(6)[None]


class OdometryError:
    """Error of one factor, called by GTSAM."""

    __slots__ = (
        "D",
        "_R",
        "_motion",
        "_p",
        "_poses",
        "_result",
        "bias_0",
        "h",
        "i_T_j",
        "keys",
    )

    def __init__(
        self, keys: tuple[int, int, int], motion: PreintegratedMotion, up_j: Floats
    ) -> None:
        self.keys = keys
        self.bias_0 = motion.bias
        i_R_j = motion.i_T_j.rotation().matrix()
        # (12,)
        self.i_T_j = np.concatenate((i_R_j.ravel(), motion.i_T_j.translation()))
        self.h = np.zeros(motion.D_bias.shape[1])
        self.h[HEADING] = up_j @ motion.D_bias[:3, HEADING]
        self.D = motion.D_bias.copy()
        # the turn about the vertical is psi's alone
        self.D[:3] -= np.outer(up_j, self.h)
        self._motion = (self.i_T_j[None], self.D[None], self.h[None], UNWHITENED)
        # GTSAM calls thousands of times: poses are written into arrays made once
        self._poses = np.empty((2, 1, 12))
        self._R = self._poses[:, 0, :9].reshape(2, 3, 3)
        self._p = self._poses[:, 0, 9:]
        self._result = OdometryDerivatives.empty(1, len(self.h))

    def __call__(
        self,
        _: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[Floats] | None,
    ) -> Floats:
        """Error, shape (6,), unwhitened."""
        for k in range(2):
            world_T_body = values.atPose3(self.keys[k]).matrix()  # (4, 4)
            self._R[k] = world_T_body[:3, :3]
            self._p[k] = world_T_body[:3, 3]
        X_i, X_j = self._poses  # (1, 12) each
        change = (values.atVector(self.keys[2]) - self.bias_0)[None]  # (1, 11)
        if jacobians is None:
            return odometry_errors(X_i, X_j, change, self._motion)[0]
        found = self._result
        write_derivatives(X_i, X_j, change, self._motion, (*found,))
        jacobians[0] = found.by_i[0].T  # back to rows
        jacobians[1] = found.by_j[0].T
        jacobians[2] = found.by_b[0].T
        return found.errors[0]


class OdometryWithBias(gtsam.CustomFactor):
    """Relative pose from preintegrated gyro and DVL, and the biases b; ``D_bias`` has a column for each.

    ``up_j``: u when the motion was set, shape (3,), along which ``D_bias`` has that turn; zero without gravity.
    """

    __slots__ = ("covariance", "law")
    Stack: ClassVar[type[OdometryStack]]

    def __init__(
        self,
        key_i: int,
        key_j: int,
        bias_key: int,
        motion: PreintegratedMotion,
        up_j: Floats = ORIGIN,
    ) -> None:
        self.law = OdometryError((key_i, key_j, bias_key), motion, up_j)
        self.covariance = motion.covariance
        super().__init__(
            gaussian(motion.covariance), [key_i, key_j, bias_key], self.law
        )


BiasedMotions = tuple[Floats, Floats, Floats, Floats]
"""Constants of n motions: rows of R, and p, shape (n, 12); D, shape (n, 6, 11); h, shape (n, 11); W with ``W C W^T = I``,
shape (n, 6, 6)."""


class OdometryDerivatives(NamedTuple):
    """Errors of n motions, and their derivatives, transposed."""

    errors: Floats
    """Shape (n, 6)."""
    by_i: Floats
    """By the first pose, shape (n, 6, 6)."""
    by_j: Floats
    """By the second pose, shape (n, 6, 6)."""
    by_b: Floats
    """By b, shape (n, 11, 6)."""

    @classmethod
    def empty(cls, n: int, biases: int) -> OdometryDerivatives:
        """Arrays to be filled."""
        return cls(
            np.empty((n, 6)),
            np.empty((n, 6, 6)),
            np.empty((n, 6, 6)),
            np.empty((n, biases, 6)),
        )


class OdometryStack:
    """Many `OdometryWithBias`, evaluated together as arrays (`batch_solution.Stack`); the same numbers to rounding."""

    def __init__(self, factors: Sequence[OdometryWithBias]) -> None:
        laws = [factor.law for factor in factors]
        self._keys = [law.keys for law in laws]
        self._pose_keys = np.array([keys[:2] for keys in self._keys], np.uint64).T
        self._bias_keys = sorted({keys[2] for keys in self._keys})
        self._bias_of = np.searchsorted(
            self._bias_keys, [keys[2] for keys in self._keys]
        )
        self._bias_0 = np.array([law.bias_0 for law in laws])
        covariances = np.array([factor.covariance for factor in factors])
        self._motions = (
            np.array([law.i_T_j for law in laws]),
            np.array([law.D for law in laws]),
            np.array([law.h for law in laws]),
            np.linalg.inv(np.linalg.cholesky(covariances)),
        )

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squared whitened errors."""
        e = odometry_errors(*self._states(values), self._motions)
        return 0.5 * float(np.vdot(e, e))

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """Each factor, linearised."""
        found = OdometryDerivatives.empty(*self._motions[2].shape)
        write_derivatives(*self._states(values), self._motions, (*found,))
        e, *columns = found
        # stored by columns, as GTSAM stores them
        blocks = (transposed.transpose(0, 2, 1) for transposed in columns)
        return [
            gtsam.JacobianFactor(i, A_i, j, A_j, b, A_b, rhs, UNIT)
            for (i, j, b), A_i, A_j, A_b, rhs in zip(
                self._keys, *blocks, -e, strict=True
            )
        ]

    def _states(self, values: gtsam.Values) -> tuple[Floats, Floats, Floats]:
        """Poses at both ends, as rows of R, and p, shape (n, 12) each, and ``b - b_0``, shape (n, 11)."""
        X_i, X_j = poses_of(values, self._pose_keys)
        # many motions share the biases of a stretch: each is read once
        biases = np.array([values.atVector(key) for key in self._bias_keys])
        return X_i, X_j, biases[self._bias_of] - self._bias_0


OdometryWithBias.Stack = OdometryStack


# GTSAM calls these for single factors: numba takes longer to return an array, or a named tuple, than to evaluate one
@compiled
def odometry_errors(
    X_i: Floats, X_j: Floats, changes: Floats, motions: BiasedMotions
) -> Floats:
    """Whitened errors of n motions, shape (n, 6), from `OdometryStack._states`."""
    i_T_j, D, h, whitening = motions
    errors = np.empty((len(i_T_j), 6))
    for k in range(len(i_T_j)):
        found = evaluated(X_i[k], X_j[k], changes[k], i_T_j[k], D[k], h[k])
        store_row6(mat6(whitening[k]) @ found.e, errors, k, 0)
    return errors


@compiled
def write_derivatives(
    X_i: Floats,
    X_j: Floats,
    changes: Floats,
    motions: BiasedMotions,
    linear: tuple[Floats, Floats, Floats, Floats],
) -> None:
    """As `odometry_errors`; fills the arrays of `OdometryDerivatives`."""
    i_T_j, D, h, whitening = motions
    errors, by_i, by_j, by_b = linear
    n, biases = changes.shape
    for k in range(n):
        found = evaluated(X_i[k], X_j[k], changes[k], i_T_j[k], D[k], h[k])
        W = mat6(whitening[k])
        J = W @ log_derivative(found.e.a, found.E.p)
        store_row6(W @ found.e, errors, k, 0)
        store_all((-1.0 * J @ inverse_adjoint(found.turned)).T, by_i[k])  # (2)
        store_all((J @ Mat6(I3, O3, O3, found.turn.T)).T, by_j[k])  # (3)
        # (4), a column at a time; J(c)^-1 has the blocks V^T, 0, -V^T B, V^T
        V_T = exp_and_mean(found.tilt)[1].T
        V_T_B = V_T @ log_derivative(found.tilt, found.way).c
        by_c = J @ inverse_adjoint(found.E)
        by_psi = J @ Vec6(found.up, ZERO)
        columns = by_b[k]
        for m in range(biases):
            a = V_T @ vec(D[k, :3, m])
            column = by_c @ Vec6(a, V_T @ vec(D[k, 3:, m]) - V_T_B @ a)
            h_m = h[k, m]
            store_row6(
                Vec6(
                    -1.0 * column.a - h_m * by_psi.a, -1.0 * column.b - h_m * by_psi.b
                ),
                columns,
                m,
                0,
            )


class Transform(NamedTuple):
    """Rotation and translation."""

    R: Mat3
    p: Vec3


class Evaluated(NamedTuple):
    """Error of one motion, with the parts of its derivatives."""

    e: Vec6
    E: Transform
    turned: Transform
    """``X_i^-1 X_j Exp(-psi u)``."""
    tilt: Vec3
    """Turn of c."""
    way: Vec3
    """Translation of ``Exp(c)``."""
    turn: Mat3
    """``Exp(-psi u)``."""
    up: Vec3
    """u."""


@inlined
def evaluated(
    X_i: Floats, X_j: Floats, change: Floats, mean: Floats, D: Floats, h: Floats
) -> Evaluated:
    """Error (1) of one motion."""
    R_i, p_i = pose(X_i)
    R_j, p_j = pose(X_j)
    R_m, p_m = pose(mean)
    tilt = ZERO
    chord = ZERO
    psi = 0.0
    for m in range(len(change)):
        tilt = tilt + change[m] * vec(D[:3, m])
        chord = chord + change[m] * vec(D[3:, m])
        psi += h[m] * change[m]
    exp_tilt, V = exp_and_mean(tilt)
    way = V @ chord  # Exp(c) = (Exp(tilt), V chord)
    up = R_j.z  # the last row of R_j: the world's vertical in body j
    turn = exp_and_mean(-psi * up)[0]
    turned = Transform(R_i.T @ R_j @ turn, R_i.T @ (p_j - p_i))
    corrected = Transform(R_m @ exp_tilt, R_m @ way + p_m)  # i_T_j Exp(c)
    E = Transform(corrected.R.T @ turned.R, corrected.R.T @ (turned.p - corrected.p))
    theta = rotation_log(E.R)
    e = Vec6(theta, chord_inverse(theta) @ E.p)  # (5)
    return Evaluated(e, E, turned, tilt, way, turn, up)


@inlined
def pose(rows: Floats) -> Transform:
    """Transform from the rows of R, and p, shape (12,)."""
    return Transform(Mat3(vec(rows[:3]), vec(rows[3:6]), vec(rows[6:9])), vec(rows[9:]))


@inlined
def log_derivative(theta: Vec3, t: Vec3) -> Mat6:
    """J of the transform ``(Exp(theta), t)``: ``Log(T Exp(d)) ~ Log(T) + J d``."""
    x = theta @ theta
    along = theta @ t
    a, slope = curvature(x)
    V_inverse = rodrigues(theta, x, -0.5, a)
    bent = slope * (along * theta - x * t) - 2.0 * a * t
    B = (
        outer(bent, theta)
        + a * outer(theta, t)
        + (a * along) * I3
        + 0.5 * (I3 @ skew(t))
    )
    return Mat6(V_inverse.T, O3, B @ V_inverse.T, V_inverse.T)  # (6)


@inlined
def inverse_adjoint(T: Transform) -> Mat6:
    """``Ad(T^-1)``."""
    return Mat6(T.R.T, O3, -1.0 * (T.R.T @ skew(T.p)), T.R.T)
