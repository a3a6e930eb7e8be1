"""Attitude as roll, pitch and yaw (phi, theta, psi), and their rates.

::

    world_R_body = Rz(psi) Ry(theta) Rx(phi)

    w = W (phi', theta', psi')^T        body rates from Euler rates, W = rates_from_euler
    (phi', theta', psi')^T = E w        E = W^-1; infinite at theta = +-90 degrees

A small rotation of the body, ``world_R_body Exp(delta)``, changes the angles by ``E delta``. Fossen, "Handbook of
Marine Craft Hydrodynamics and Motion Control", 2011, (2.18), (2.28).
"""

from __future__ import annotations

import math

from sonar_graph.navigation.kernels import inlined
from sonar_graph.navigation.triples import Matrix, Vector


@inlined
def rotation_from_euler(angles: Vector) -> Matrix:
    """world_R_body from (phi, theta, psi), rad."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, s_p = math.cos(angles[1]), math.sin(angles[1])
    c_y, s_y = math.cos(angles[2]), math.sin(angles[2])
    return (
        (c_y * c_p, c_y * s_p * s_r - s_y * c_r, c_y * s_p * c_r + s_y * s_r),
        (s_y * c_p, s_y * s_p * s_r + c_y * c_r, s_y * s_p * c_r - c_y * s_r),
        (-s_p, c_p * s_r, c_p * c_r),
    )


@inlined
def euler_from_rotation(R: Matrix) -> Vector:
    """(phi, theta, psi), rad; phi and psi in (-pi, pi], theta in [-pi/2, pi/2]."""
    return (
        math.atan2(R[2][1], R[2][2]),
        math.atan2(-R[2][0], math.hypot(R[2][1], R[2][2])),
        math.atan2(R[1][0], R[0][0]),
    )


@inlined
def rates_from_euler(angles: Vector) -> Matrix:
    """W of the module's docstring."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, s_p = math.cos(angles[1]), math.sin(angles[1])
    return (1.0, 0.0, -s_p), (0.0, c_r, s_r * c_p), (0.0, -s_r, c_r * c_p)


@inlined
def euler_from_rates(angles: Vector) -> Matrix:
    """E of the module's docstring."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, t_p = math.cos(angles[1]), math.tan(angles[1])
    return (1.0, s_r * t_p, c_r * t_p), (0.0, c_r, -s_r), (0.0, s_r / c_p, c_r / c_p)
