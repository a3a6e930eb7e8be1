"""Equations of the right-invariant EKF: state and error, prediction, measurement models, update, augmentation.

The state is a rotation and 1 + N points that turn with the world, one element of SE_{1+N}(3), and the biases b of
`sonar_graph.models.biases`. The error is right-invariant::

    R = Exp(theta) R^,    x_k = Exp(theta) x_k^ + J_l(theta) xi_k,    b = b^ + beta                            (1)

with x_0 = X the body, and P the covariance of ``xi = [theta, beta, xi_0, ..., xi_N]``. Prediction over a motion
(dR, dp) with perturbation ``eps = [theta_j, rho]`` in its last frame, ``D = d eps / d b``, ``C = cov(eps)``::

    R' = R dR,    X' = X + R dp                                                                                (2)
    xi' = xi + J (D beta + eps)                                                                                (3)
    rows of J:    theta [R' 0],  beta [0 0],  xi_0 [[X']x R'  R'],  xi_k [[x_k]x R'  0]

A measurement is taken a motion after the state, at R', X': H is its derivative by xi, H_m that by eps, and ::

    H_beta = H_m D                                                                                             (4)

Point q of the body moves there by ``R' Q eps``, ``Q(q) = [ -[q]x  I ]``. Landmark k at ``q = R'^T (x_k - X')`` in range
and azimuth, N their derivative by q::

    H_theta = 0,    H_xi_k = N R'^T = -H_xi_0,    H_m = -N Q(q)                                                (5)

New landmark at ``x = X' + R' q(z)``, q the point of the body that is seen at z = (range, azimuth, elevation)::

    xi_new = xi_0 + R' Q(q) eps + R' (dq / dz) dz                                                              (6)

Position of ``a = X' + R' q``, k = 0, or of a landmark ``a = x_k``, of which H_m is zero; heights are their last rows::

    H_theta = -[a]x,    H_xi_k = I,    H_m = R' Q(q)                                                           (7)

Direction u of the world's up in the body, tilted by A times the bias a of the accelerometers, and the innovation
covariance::

    y = (R (u - A a))_xy = [ -theta_y, theta_x ] + (R A beta_a)_xy + noise                                     (8)
    S = H P H^T + H_m C H_m^T + R_z                                                                            (9)

Compass, with the derivative h of the yaw by a turn in the body, and its bias c in b::

    psi' + c,    H_theta = h R'^T,    H_c = 1,    H_m = [h 0]                                                 (10)

Every H but those of compass and position fixes is zero along a shift of everything in x and y and a turn about the
vertical, at any estimate, so these unobservable directions stay unobservable. Derivation: docs/theory/invariant_ekf.md.
"""

from dataclasses import dataclass, field

import numpy as np

from baselines.event_order import Motion
from baselines.sonar_update import SonarModel, correction
from sonar_graph.measurements import Floats
from sonar_graph.models import (
    ACCEL,
    BIASES,
    COMPASS,
    SCALE,
    by_biases,
    project,
    sonar_point,
    sonar_point_jacobian,
    yaw_and_derivative,
)
from sonar_graph.numerics import compiled, exp_and_mean, store, vec

THETA, BETA, BODY = slice(0, 3), slice(3, 3 + BIASES), slice(3 + BIASES, 6 + BIASES)
"""Places of theta, beta and xi_0 in xi."""
BARE, POINT = 6 + BIASES, 3
"""Length of xi without landmarks, and of one xi_k."""
UP, EYE = np.array([0.0, 0.0, 1.0]), np.eye(3)
SKEWS = np.array([np.cross(e, EYE).T.ravel() for e in EYE])
"""``[e_x]x``, ``[e_y]x`` and ``[e_z]x``, one a row."""


@dataclass(eq=False)
class InvariantState:
    """Estimate and covariance."""

    R: Floats
    """world_R_body, shape (3, 3)."""
    points: Floats
    """Positions of the body and of the landmarks, shape (1 + N, 3), m."""
    bias: Floats
    """b of `sonar_graph.models.biases`, shape (11,)."""
    P: Floats
    """Covariance of xi, shape (17 + 3 N, 17 + 3 N)."""
    body_p_dvl: Floats = field(default_factory=lambda: np.zeros(3))
    """Doppler log in the body, shape (3,), m."""
    is_levelled: bool = True
    """True where gravity levels the vehicle."""

    def up(self) -> Floats:
        """The world's up in the body as it splits the gyros' bias, shape (3,)."""
        return self.R[2] if self.is_levelled else np.zeros(3)

    def D(self, motion: Motion) -> Floats:
        """Derivative of a motion from the state by the biases, shape (6, 11)."""
        return by_biases(motion.D, motion.dR, motion.dp, self.up(), self.R[2], self.body_p_dvl)


def place_of(k: int) -> slice:
    """Place of xi_k in xi."""
    return slice(BODY.start + POINT * k, BODY.stop + POINT * k)


def hat(points: Floats) -> Floats:
    """``[q]x`` of a point, shape (3, 3), or of n points one below the other, shape (3 n, 3)."""
    return (points @ SKEWS).reshape(-1, 3)


@compiled
def exponential(phi: Floats) -> tuple[Floats, Floats]:
    """``Exp(phi)`` and ``J_l(phi)``, shape (3, 3), of the first three numbers of an array."""
    Exp, J_l = np.empty((3, 3)), np.empty((3, 3))
    turn, mean = exp_and_mean(vec(phi))
    store(turn, Exp)
    store(mean, J_l)
    return Exp, J_l


def retract(state: InvariantState, xi: Floats) -> None:
    """Move the estimate by an error, (1)."""
    Exp, J_l = exponential(xi)
    state.R = Exp @ state.R
    state.points = state.points @ Exp.T + xi[BODY.start :].reshape(-1, POINT) @ J_l.T
    state.bias = state.bias + xi[BETA]


def pose(state: InvariantState, motion: Motion) -> tuple[Floats, Floats]:
    """R' and X', a motion after the state, (2), without the scale error of the Doppler log."""
    R = state.R @ motion.dR
    return R, state.points[0] + state.R @ motion.dp + R @ (state.D(motion)[3:, SCALE] * state.bias[SCALE])


def predict(state: InvariantState, motion: Motion, walk_variance: Floats) -> None:
    """Carry estimate and covariance over a motion, (2) and (3).

    ``walk_variance`` is the variance of the biases' walk since, shape (11,).
    """
    D = state.D(motion)
    state.R, state.points[0] = pose(state, motion)
    P, J = state.P, np.zeros((len(state.P), 6))
    J[THETA, :3] = J[BODY, 3:] = state.R
    J[BODY.start :, :3] = hat(state.points) @ state.R
    # P <- F P F^T + J C J^T with F = I + J D E, where E picks beta: P + M + M^T
    JD = J @ D
    M = JD @ (P[BETA] + 0.5 * P[BETA, BETA] @ JD.T) + J @ (0.5 * motion.C) @ J.T
    P += M + M.T
    P[BETA, BETA] += np.diag(walk_variance)


def pose_covariance(state: InvariantState, motion: Motion) -> Floats:
    """Covariance of the pose a motion after the state, in its own perturbation [theta, rho], shape (6, 6).

    The error of the state is there ``[R'^T theta; R'^T (xi_0 - [X']x theta)]``, to which ``D beta + eps`` is added.
    """
    R, X = pose(state, motion)
    A = np.zeros((6, BARE))
    A[:3, THETA] = A[3:, BODY] = R.T
    A[3:, THETA] = -R.T @ hat(X)
    A[:, BETA] = state.D(motion)
    return symmetric(A @ state.P[:BARE, :BARE] @ A.T + motion.C)


def landmark_covariance(state: InvariantState, k: int) -> Floats:
    """Covariance of the coordinates of x_k in the world, ``xi_k - [x_k]x theta``, shape (3, 3), m²."""
    A = np.zeros((POINT, len(state.P)))
    A[:, place_of(k)], A[:, THETA] = EYE, -hat(state.points[k])
    return symmetric(A @ state.P @ A.T)


def Q(q: Floats) -> Floats:
    """``[ -[q]x  I ]``, shape (3, 6): by eps, ``R' Q eps`` moves a point q of the body."""
    return np.concatenate((-hat(q), EYE), axis=1)


def observation(state: InvariantState, k: int, motion: Motion, sonar: SonarModel) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth of landmark k, shape (2,), H (2, 17 + 3 N) and H_m (2, 6) of (5)."""
    R, X = pose(state, motion)
    q = R.T @ (state.points[k] - X)
    z, D_q = project(sonar.body_R_sonar.T @ (q - sonar.body_p_sonar))
    N = D_q @ sonar.body_R_sonar.T
    H, H_m = np.zeros((2, len(state.P))), -N @ Q(q)
    H[:, place_of(k)], H[:, BODY] = N @ R.T, -N @ R.T
    H[:, BETA] = H_m @ state.D(motion)  # (4)
    return z, H, H_m


def location(
    state: InvariantState, motion: Motion, sonar: SonarModel, z: Floats, elevation_rad: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """The point that is seen at range and azimuth z, and the derivatives of its xi by (6).

    Returns the point (3,); G by xi, shape (3, 17 + 3 N); G_m by the motion, shape (3, 6); G_z by range, azimuth and
    elevation, shape (3, 3).
    """
    R, X = pose(state, motion)
    q = sonar.body_p_sonar + sonar.body_R_sonar @ sonar_point(z[0], z[1], elevation_rad)
    G, G_m = np.zeros((3, len(state.P))), R @ Q(q)
    G[:, BODY] = EYE
    G[:, BETA] = G_m @ state.D(motion)  # (4)
    return X + R @ q, G, G_m, R @ sonar.body_R_sonar @ sonar_point_jacobian(z[0], z[1], elevation_rad)


def position_of_body_point(state: InvariantState, motion: Motion, q: Floats) -> tuple[Floats, Floats, Floats]:
    """Position of point q of the body, shape (3,), H (3, 17 + 3 N) and H_m (3, 6) of (7)."""
    R, X = pose(state, motion)
    a = X + R @ q
    H, H_m = np.zeros((3, len(state.P))), R @ Q(q)
    H[:, THETA], H[:, BODY] = -hat(a), EYE
    H[:, BETA] = H_m @ state.D(motion)  # (4)
    return a, H, H_m


def yaw_of_compass(state: InvariantState, motion: Motion) -> tuple[float, Floats, Floats]:
    """Yaw of the body and bias of the compass, H (1, 17 + 3 N) and H_m (1, 6) of (10)."""
    R, _ = pose(state, motion)
    yaw_rad, by_turn = yaw_and_derivative(R)
    H, H_m = np.zeros((1, len(state.P))), np.zeros((1, 6))
    H[0, THETA], H_m[0, :3] = R @ by_turn, by_turn
    H[:, BETA] = H_m @ state.D(motion)  # (4)
    H[0, BETA.start + COMPASS] = 1.0
    return yaw_rad + state.bias[COMPASS], H, H_m


def height_of_point(state: InvariantState, k: int) -> tuple[float, Floats]:
    """Height of x_k and H (1, 17 + 3 N) of (7)."""
    H, a = np.zeros((1, len(state.P))), state.points[k]
    H[0, THETA], H[0, place_of(k)] = (a[1], -a[0], 0.0), UP
    return a[2], H


def up_innovation(state: InvariantState, up: Floats, by_accel: Floats) -> tuple[Floats, Floats]:
    """Innovation y (2,) and H (2, 17 + 3 N) of (8); ``by_accel``: A, shape (3, 3)."""
    H, by_bias = np.zeros((2, len(state.P))), state.R @ by_accel
    H[:, :2] = (0.0, -1.0), (1.0, 0.0)
    H[:, BETA][:, ACCEL] = by_bias[:2]
    return (state.R @ up - by_bias @ state.bias[ACCEL])[:2], H


def innovation_covariance(state: InvariantState, H: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """``H P`` and S of (9); ``noise`` is ``H_m C H_m^T + R_z``, shape (m, m)."""
    HP = H @ state.P
    return HP, symmetric(HP @ H.T + noise)


def correct(state: InvariantState, HP: Floats, S: Floats, e: Floats) -> None:
    """Update by an innovation e: ``xi = K e`` with ``K = P H^T S^-1``, ``P <- P - K S K^T``, estimate moved by (1)."""
    retract(state, correction(state.P, HP, S, e))


def augmented(state: InvariantState, x: Floats, G: Floats, noise: Floats) -> InvariantState:
    """The state with a new landmark x, (6); ``noise`` is ``G_m C G_m^T`` and that of z, shape (3, 3)."""
    GP, own = innovation_covariance(state, G, noise)
    P = np.block([[state.P, GP.T], [GP, own]])
    return InvariantState(state.R, np.vstack((state.points, x)), state.bias, P, state.body_p_dvl, state.is_levelled)


def symmetric(A: Floats) -> Floats:
    """``(A + A^T) / 2``."""
    return 0.5 * (A + A.T)
