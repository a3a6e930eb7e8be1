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

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled


@compiled
def rotation_from_euler(angles: Floats) -> Floats:
    """world_R_body, shape (3, 3), from (phi, theta, psi), shape (3,), rad."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, s_p = math.cos(angles[1]), math.sin(angles[1])
    c_y, s_y = math.cos(angles[2]), math.sin(angles[2])
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = c_y * c_p, c_y * s_p * s_r - s_y * c_r, c_y * s_p * c_r + s_y * s_r
    R[1, 0], R[1, 1], R[1, 2] = s_y * c_p, s_y * s_p * s_r + c_y * c_r, s_y * s_p * c_r - c_y * s_r
    R[2, 0], R[2, 1], R[2, 2] = -s_p, c_p * s_r, c_p * c_r
    return R


@compiled
def euler_from_rotation(R: Floats) -> Floats:
    """(phi, theta, psi), shape (3,), rad; phi and psi in (-pi, pi], theta in [-pi/2, pi/2]."""
    angles = np.empty(3)
    angles[0] = math.atan2(R[2, 1], R[2, 2])
    angles[1] = math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2]))
    angles[2] = math.atan2(R[1, 0], R[0, 0])
    return angles


@compiled
def rates_from_euler(angles: Floats) -> Floats:
    """W of the module's docstring, shape (3, 3)."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, s_p = math.cos(angles[1]), math.sin(angles[1])
    W = np.zeros((3, 3))
    W[0, 0], W[0, 2] = 1.0, -s_p
    W[1, 1], W[1, 2] = c_r, s_r * c_p
    W[2, 1], W[2, 2] = -s_r, c_r * c_p
    return W


@compiled
def euler_from_rates(angles: Floats) -> Floats:
    """E of the module's docstring, shape (3, 3)."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, t_p = math.cos(angles[1]), math.tan(angles[1])
    E = np.zeros((3, 3))
    E[0, 0], E[0, 1], E[0, 2] = 1.0, s_r * t_p, c_r * t_p
    E[1, 1], E[1, 2] = c_r, -s_r
    E[2, 1], E[2, 2] = s_r / c_p, c_r / c_p
    return E
