"""State and covariance of EKF-SLAM: the paper's equations (4) and (5), their prediction, and how a correction enters.

::

    x = [X, Y, Z, phi, theta, psi, p_1, ..., p_N]            (4)  p_i: landmark in the world, 3 numbers

    P = [ P_vv    P_vm ]                                     (5)
        [ P_vm^T  P_mm ]

Prediction from one DVL stamp to the next, with the motion (dR, dp) that gyros and Doppler log measured in between::

    X'    = X + R dp                    R = Rz(psi) Ry(theta) Rx(phi)
    R'    = R dR                        the exact integral of the Euler kinematics for a constant rate
    P_vv' = F P_vv F^T + Q,  P_vm' = F P_vm

    F = [ I  -R [dp]x W  ]      Q = G cov G^T,  G = [ 0         R ]
        [ 0   E' dR^T W  ]                          [ E' dR^T   0 ]

W, E: see `sonar_graph.numerics.mat3`; cov: of the motion's perturbation [theta_i, eps], see `baselines.filter_motion`.
Arrays have room for more landmarks than there are; ``n`` is the length of the state. Everything happens in place.

Derivatives of what is measured, in EKF-SLAM.

All is measured a provisional motion (dR, dp, cov) after the state. It depends on state and motion through how far a
point s fixed in the body (in the axes of the state's body) moves along a direction n (in the same axes)::

    row(n, s) = [ (R n)^T   (s x n)^T W | ((s - dp) x n)^T   n^T ]     by X, (phi, theta, psi) | theta_i, eps

EKF-SLAM without landmarks: prediction from node to node, depth, gravity and the planar constraint.

Nodes are the stamps of the Doppler log (`sonar_graph.navigation.odometry`); a depth sample between two of them is
related to the earlier by a provisional motion.

Gravity. From the specific force over about a second follows the direction of the world's up in the body
(`sonar_graph.navigation.alignment.gravity`), of which roll and pitch are ``atan2(up_y, up_z)`` and
``atan2(-up_x, hypot(up_y, up_z))``: corrections of one state each, with the variance of the tilt (for roll over
``cos(theta)^2``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.filter_events import GravityInterval, reach_node, up_at_node
from baselines.filter_inputs import VehicleModel
from baselines.sonar_update import correct_jointly
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.preintegration import Columns, Integral
from sonar_graph.numerics import (
    Matrix,
    Vector,
    compiled,
    cross,
    dot,
    euler_from_rates,
    euler_from_rotation,
    inlined,
    matrix,
    minus,
    place,
    plus,
    product,
    rates_from_euler,
    rotation_from_euler,
    sandwich,
    scaled,
    skew_times,
    sum_of,
    symmetric,
    times,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.models import wrap_angle

POSE = 6
"""Numbers of x_v."""
LANDMARK = 3
"""Numbers of p_i."""


@inlined
def predict(x: Floats, P: Floats, n: int, motion: Integral) -> None:
    """Carry state and covariance over a motion."""
    angles = vector(x[3:])
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    angles_after = euler_from_rotation(product(R, motion.dR))
    E_dR = product(euler_from_rates(angles_after), transposed(motion.dR))
    X_by_angles, angles_by_angles = product(R, skew_times(scaled(-1.0, motion.dp), W)), product(E_dR, W)
    _set_triple(x, 0, transformed(vector(x), R, motion.dp))
    _set_triple(x, 3, angles_after)
    _predict_pose(P, X_by_angles, angles_by_angles, motion, R, E_dR)
    _predict_landmarks(P, n, X_by_angles, angles_by_angles)


@inlined
def _predict_pose(P: Floats, A: Matrix, B: Matrix, motion: Integral, R: Matrix, E_dR: Matrix) -> None:
    """``P_vv <- F P_vv F^T + Q`` with ``F = [[I, A], [0, B]]``."""
    XX, XE, EE = matrix(P[:, :3]), matrix(P[:, 3:]), matrix(P[3:, 3:])
    XE_carried = sum_of(XE, product(A, EE))
    XX = sum_of(sum_of(XX, product(XE_carried, transposed(A))), product(A, transposed(XE)))
    XX = sum_of(XX, sandwich(R, motion.cov_rr, R))
    XE = sum_of(product(XE_carried, transposed(B)), sandwich(R, motion.cov_rt, E_dR))
    EE = sum_of(sandwich(B, EE, B), sandwich(E_dR, motion.cov_tt, E_dR))
    place_symmetric(symmetric(XX), transposed(XE), symmetric(EE), P)


@inlined
def _predict_landmarks(P: Floats, n: int, A: Matrix, B: Matrix) -> None:
    """``P_vm <- F P_vm``, and its transpose."""
    for c in range(POSE, n):
        angles = (P[3, c], P[4, c], P[5, c])
        column = plus((P[0, c], P[1, c], P[2, c]), times(A, angles)) + times(B, angles)
        for r in range(POSE):
            P[r, c] = P[c, r] = column[r]


@inlined
def place_symmetric(first: Matrix, mixed: Matrix, second: Matrix, out: Floats) -> None:
    """Write ``[[first, mixed^T], [mixed, second]]``."""
    place(first, out, 0, 0)
    place(transposed(mixed), out, 0, 3)
    place(mixed, out, 3, 0)
    place(second, out, 3, 3)


@inlined
def pose_after(x: Floats, P: Floats, motion: Integral) -> tuple[Floats, Floats, Floats]:
    """The body a motion after the state, and the covariance of its perturbation [theta, rho].

    ``theta = dR^T (W d(angles) + theta_i)`` and ``rho = dR^T (R^T dX - [dp]x W d(angles) + eps)``.

    Returns
    -------
    world_R_body (3, 3), position (3,), covariance (6, 6).
    """
    angles = vector(x[3:])
    R, W = rotation_from_euler(angles), rates_from_euler(angles)
    V, node_R_world, j_R_i = skew_times(scaled(-1.0, motion.dp), W), transposed(R), transposed(motion.dR)
    XX, XE, EE = matrix(P[:, :3]), product(node_R_world, matrix(P[:, 3:])), matrix(P[3:, 3:])
    XE_carried = sum_of(XE, product(V, EE))
    tt = sum_of(sandwich(W, EE, W), motion.cov_tt)
    rt = sum_of(product(XE_carried, transposed(W)), motion.cov_rt)
    rr = sum_of(sandwich(node_R_world, XX, node_R_world), motion.cov_rr)
    rr = sum_of(rr, sum_of(product(XE_carried, transposed(V)), product(V, transposed(XE))))
    own = np.empty((POSE, POSE))
    place_symmetric(
        symmetric(sandwich(j_R_i, tt, j_R_i)),
        sandwich(j_R_i, rt, j_R_i),
        symmetric(sandwich(j_R_i, rr, j_R_i)),
        own,
    )
    return np.array(product(R, motion.dR)), np.array(transformed(vector(x), R, motion.dp)), own


@inlined
def _set_triple(x: Floats, at: int, value: Vector) -> None:
    """Three numbers of the state."""
    x[at], x[at + 1], x[at + 2] = value


@inlined
def correct(x: Floats, P: Floats, n: int, cross_cov: Floats, S: float, innovation: float) -> None:
    """Correction by one number.

    ``w = P H^T / sqrt(S)``, ``P <- P - w w^T``, ``x <- x + w innovation / sqrt(S)``: the textbook's ``(I - K H) P`` in
    a form whose products commute, so that P stays symmetric to the last bit. Joseph's form, which also keeps P positive
    for a wrong gain, costs several times as much and is not needed for the optimal one in double precision.

    Parameters
    ----------
    cross_cov
        ``P H^T``, shape (n,); overwritten.
    S
        Innovation variance.
    """
    root = math.sqrt(S)
    w, share = cross_cov, innovation / root
    for i in range(n):
        w[i] /= root
    for i in range(n):
        for j in range(n):
            P[i, j] -= w[i] * w[j]
        x[i] += w[i] * share
    _wrap(x)


@inlined
def correct_pair(x: Floats, P: Floats, n: int, cross_cov: Floats, S: Floats, innovation: Floats) -> None:
    """Correction by two numbers at once: as `correct`, with the Cholesky factor of S in place of the root.

    Parameters
    ----------
    cross_cov
        ``H P``, shape (2, n); overwritten.
    S
        Innovation covariance, shape (2, 2).
    innovation
        Shape (2,).
    """
    l_00 = math.sqrt(S[0, 0])
    l_10 = S[1, 0] / l_00
    l_11 = math.sqrt(S[1, 1] - l_10 * l_10)
    first, second = cross_cov[0], cross_cov[1]
    for i in range(n):
        first[i] /= l_00
        second[i] = (second[i] - l_10 * first[i]) / l_11
    y_0 = innovation[0] / l_00
    y_1 = (innovation[1] - l_10 * y_0) / l_11
    for i in range(n):
        for j in range(n):
            P[i, j] -= first[i] * first[j] + second[i] * second[j]
        x[i] += first[i] * y_0 + second[i] * y_1
    _wrap(x)


@compiled
def correct_by(x: Floats, P: Floats, n: int, cross_cov: Floats, S: Floats, innovation: Floats) -> None:
    """Correction by m numbers at once: as `correct_pair`, with shapes (m, n), (m, m) and (m,)."""
    correct_jointly(P, n, cross_cov, S, innovation, x)
    _wrap(x)


@inlined
def _wrap(x: Floats) -> None:
    """Keep roll and yaw in (-pi, pi]."""
    x[3], x[5] = wrap_angle(x[3]), wrap_angle(x[5])


class Moment(NamedTuple):
    """The state, and what lies between it and the instant of a frame."""

    X: Vector
    R: Matrix
    W: Matrix
    motion: Integral


class MeasurementRow(NamedTuple):
    """Derivative of one number by the pose state and by the motion since."""

    by_X: Vector
    by_angles: Vector
    by_theta: Vector
    by_eps: Vector


@compiled
def moment_after(x: Floats, motion: Integral) -> Moment:
    """The state and a motion after it."""
    angles = vector(x[3:])
    return Moment(vector(x), rotation_from_euler(angles), rates_from_euler(angles), motion)


@inlined
def row_along(moment: Moment, n: Vector, s: Vector) -> MeasurementRow:
    """``row(n, s)`` of the module's docstring."""
    by_angles = times(transposed(moment.W), cross(s, n))
    return MeasurementRow(times(moment.R, n), by_angles, cross(minus(s, moment.motion.dp), n), n)


@compiled
def motion_covariance(motion: Integral, one: MeasurementRow, other: MeasurementRow) -> float:
    """``H_m cov H_m^T`` of two numbers."""
    theta = plus(times(motion.cov_tt, other.by_theta), times(transposed(motion.cov_rt), other.by_eps))
    eps = plus(times(motion.cov_rt, other.by_theta), times(motion.cov_rr, other.by_eps))
    return dot(one.by_theta, theta) + dot(one.by_eps, eps)


@inlined
def add_covariances(P: Floats, n: int, at: int, factors: Vector, out: Floats) -> None:
    """``out += factors^T P[at : at + 3]``, shape (n,)."""
    for k in range(3):
        factor = factors[k]
        for c in range(n):
            out[c] += factor * P[at + k, c]


@compiled
def advance_to_node(
    columns: Columns,
    vehicle: VehicleModel,
    x: Floats,
    P: Floats,
    n: int,
    clock: Ints,
    interval: GravityInterval,
    node_ns: int,
    motion: Integral,
) -> None:
    """Predict over a motion to a node and apply what holds there.

    Parameters
    ----------
    x, P, n, clock, interval
        Filter state; changed.
    """
    predict(x, P, n, motion)
    reach_node(clock, node_ns)
    up, sigma = up_at_node(columns, vehicle, motion, clock, interval)
    if not math.isnan(sigma):
        _correct_up(x, P, n, up, sigma)
    if vehicle.is_planar:
        values = (vehicle.plane_z_m, 0.0, 0.0)
        variances = (vehicle.plane_z_variance, vehicle.plane_tilt_variance, vehicle.plane_tilt_variance)
        for k in range(3):
            _correct_state(x, P, n, 2 + k, values[k], variances[k])


@inlined
def _correct_up(x: Floats, P: Floats, n: int, up: Vector, sigma: float) -> None:
    """Correct roll and pitch."""
    level = math.hypot(up[1], up[2])
    _correct_state(x, P, n, 3, math.atan2(up[1], up[2]), (sigma / level) ** 2)
    _correct_state(x, P, n, 4, math.atan2(-up[0], level), sigma**2)


@inlined
def _correct_state(x: Floats, P: Floats, n: int, at: int, value: float, variance: float) -> None:
    """Correct by a direct measurement of Z or of an angle."""
    innovation = value - x[at] if at < 3 else wrap_angle(value - x[at])
    correct(x, P, n, P[at, :n].copy(), P[at, at] + variance, innovation)


@inlined
def correct_depth(x: Floats, P: Floats, n: int, motion: Integral, port: Vector, z_m: float, variance_m2: float) -> None:
    """Correct by the height of the pressure port, ``(X + R s)_z`` with ``s = dp + dR port``: row(n, s) along up."""
    moment = moment_after(x, motion)
    s = transformed(motion.dp, motion.dR, port)
    row = row_along(moment, moment.R[2], s)
    U = np.zeros(n)
    add_covariances(P, n, 0, row.by_X, U)
    add_covariances(P, n, 3, row.by_angles, U)
    S = dot(row.by_X, vector(U)) + dot(row.by_angles, vector(U[3:])) + motion_covariance(motion, row, row) + variance_m2
    correct(x, P, n, U, S, z_m - x[2] - dot(moment.R[2], s))
