"""What the sensors see in the invariant filter: predictions, and H for the error xi of `baselines.invariant_state`.

A measurement is taken a provisional motion (dR, dp) after the state. H is the derivative by xi, H_m that by the
motion's perturbation [theta_i, eps], through which the gyro bias acts as well: ``H_beta = H_m [D_t; D_r]``.

Landmark k. Its place in the axes of the state's body depends on no rotation of the world, by (1)::

    p_n = R^T (x_k - X) = p_n^ + R^^T (xi_k - xi_0),    p_b = dR^T (p_n - dp),    q = sonar_T_body p_b

Range and azimuth change along ``n = dR body_R_sonar D_q^T``, one row of D_q each (`sonar_graph.slam.models`)::

    H_xi_k = n^T R^T = -H_xi_0,    H_theta = 0,    H_m = [ (n x (p_n - dp))^T   -n^T ]                        (4)

A new landmark at ``x = X + R s``, with ``s = dp + dR p_b`` and p_b by range, azimuth and elevation::

    xi_new = xi_0 + R [ -[s - dp]x   I ] [theta_i; eps] + R dR body_R_sonar (point's derivative) dz           (5)

Height of a point x_k, or of a body's point at ``a = X + R s``, k = 0, along ``n = R^T e_z``::

    H_theta = (a x e_z)^T,    H_xi_k = e_z^T,    H_m = [ ((s - dp) x n)^T   n^T ]  of a body's point          (6)

Direction u of the world's up, measured in the body: by how much R u misses the world's own up, with the same H always::

    y = (R^ u)_xy = [ -theta_y, theta_x ] + noise                                                             (7)

Each H is zero along a shift of vehicle and landmarks in x and y and a turn of all about the vertical, at any estimate:
what cannot be observed stays so, however often it is linearised.
"""

from __future__ import annotations

import numpy as np

from baselines.filter_models import SonarModel
from baselines.gravity_interval import UP
from baselines.invariant_state import BIAS, BODY, POINT, THETA, InvariantState, by_bias, put
from baselines.sonar_views import point_seen, predicted_view
from sonar_graph.measurements import Floats
from sonar_graph.navigation.gap_motion import GapMotion
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.triples import (
    IDENTITY,
    Vector,
    cross,
    matrix,
    minus,
    place,
    product,
    scaled,
    times,
    times_skew,
    transformed,
    vector,
)
from sonar_graph.slam.models import sonar_point_jacobian


@compiled
def observation(state: InvariantState, k: int, motion: GapMotion, sonar: SonarModel) -> tuple[Floats, Floats, Floats]:
    """Predicted range and azimuth (2,), H (2, 9 + 3 N) and H_m (2, 6) of (4)."""
    R, X = matrix(state.R), vector(state.points[0])
    z, p_n, by_range, by_azimuth = predicted_view(X, R, motion.integral, sonar, vector(state.points[k]))
    H, H_m, at = np.zeros((2, len(state.P))), np.empty((2, 6)), BODY + POINT * k
    for r, n in enumerate((by_range, by_azimuth)):
        put(H[r, at:], times(R, n))
        put(H[r, BODY:], times(R, scaled(-1.0, n)))
        put(H_m[r], cross(n, minus(p_n, motion.integral.dp)))
        put(H_m[r, 3:], scaled(-1.0, n))
    H[:, BIAS:BODY] += by_bias(H_m, motion)
    return z, H, H_m


@compiled
def location(
    state: InvariantState, motion: GapMotion, sonar: SonarModel, z: tuple[float, float], elevation_rad: float
) -> tuple[Vector, Floats, Floats, Floats]:
    """The point that a detection shows, and by (5) the derivatives of its xi.

    Returns
    -------
    The point; G by xi, shape (3, 9 + 3 N); G_m by the motion, shape (3, 6); G_z by (range, azimuth, elevation), shape
    (3, 3).
    """
    R, dR, dp = matrix(state.R), motion.integral.dR, motion.integral.dp
    s = point_seen(motion.integral, sonar, z, elevation_rad)
    G, G_m, G_z = np.zeros((3, len(state.P))), np.empty((3, 6)), np.empty((3, 3))
    place(IDENTITY, G, 0, BODY)
    place(times_skew(R, minus(dp, s)), G_m, 0, 0)
    place(R, G_m, 0, 3)
    G[:, BIAS:BODY] += by_bias(G_m, motion)
    by_view = product(dR, product(sonar.body_R_sonar, matrix(sonar_point_jacobian(z[0], z[1], elevation_rad))))
    place(product(R, by_view), G_z, 0, 0)
    return transformed(vector(state.points[0]), R, s), G, G_m, G_z


@compiled
def height_of_body_point(
    state: InvariantState, motion: GapMotion, body_p_point: Vector
) -> tuple[float, Floats, Floats]:
    """Height of a point of the body, H (1, 9 + 3 N) and H_m (1, 6) of (6)."""
    R, turned = matrix(state.R), times(motion.integral.dR, body_p_point)
    a = transformed(transformed(vector(state.points[0]), R, motion.integral.dp), R, turned)
    H, H_m = np.zeros((1, len(state.P))), np.empty((1, 6))
    put(H[0, THETA:], cross(a, UP))
    put(H[0, BODY:], UP)
    put(H_m[0], cross(turned, R[2]))
    put(H_m[0, 3:], R[2])
    H[:, BIAS:BODY] += by_bias(H_m, motion)
    return a[2], H, H_m


@compiled
def height_of_point(state: InvariantState, k: int) -> tuple[float, Floats]:
    """Height of x_k and H (1, 9 + 3 N) of (6)."""
    H, x = np.zeros((1, len(state.P))), vector(state.points[k])
    put(H[0, THETA:], cross(x, UP))
    put(H[0, BODY + POINT * k :], UP)
    return x[2], H


@compiled
def missed_up(state: InvariantState, up: Vector) -> tuple[Floats, Floats]:
    """Y (2,) and H (2, 9 + 3 N) of (7)."""
    H, seen = np.zeros((2, len(state.P))), times(matrix(state.R), up)
    H[0, THETA + 1], H[1, THETA] = -1.0, 1.0
    return np.array(seen[:2]), H
