"""EKF-SLAM without landmarks: prediction from node to node, depth, gravity and the planar constraint.

Nodes are the stamps of the Doppler log (`sonar_graph.navigation.odometry`); a depth sample between two of them is
related to the earlier by a provisional motion.

Gravity. From the specific force over about a second follows the direction of the world's up in the body
(`sonar_graph.navigation.alignment`), of which roll and pitch are ``atan2(up_y, up_z)`` and
``atan2(-up_x, hypot(up_y, up_z))``: corrections of one state each, with the variance of the tilt (for roll over
``cos(theta)^2``).
"""

from __future__ import annotations

import math

import numpy as np

from baselines.ekf_derivatives import add_covariances, moment_after, motion_covariance, row_along
from baselines.ekf_state import correct, predict
from baselines.filter_clock import reach_node
from baselines.filter_models import VehicleModel
from baselines.gravity_interval import GravityInterval, up_at_node
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.steps import Columns
from sonar_graph.navigation.triples import Vector, dot, transformed, vector
from sonar_graph.slam.models import wrap_angle


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
