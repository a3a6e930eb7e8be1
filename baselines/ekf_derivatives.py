"""Derivatives of what is measured, in EKF-SLAM.

All is measured a provisional motion (dR, dp, cov) after the state. It depends on state and motion through how far a
point s fixed in the body (in the axes of the state's body) moves along a direction n (in the same axes)::

    row(n, s) = [ (R n)^T   (s x n)^T W | ((s - dp) x n)^T   n^T ]     by X, (phi, theta, psi) | theta_i, eps
"""

from __future__ import annotations

from typing import NamedTuple

from baselines.euler import rates_from_euler, rotation_from_euler
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    cross,
    dot,
    minus,
    plus,
    times,
    transposed,
    vector,
)


class Moment(NamedTuple):
    """The state, and what lies between it and the instant of a frame."""

    X: Vector
    R: Matrix
    W: Matrix
    motion: Integral


class Row(NamedTuple):
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
def row_along(moment: Moment, n: Vector, s: Vector) -> Row:
    """``row(n, s)`` of the module's docstring."""
    by_angles = times(transposed(moment.W), cross(s, n))
    return Row(times(moment.R, n), by_angles, cross(minus(s, moment.motion.dp), n), n)


@compiled
def motion_covariance(motion: Integral, one: Row, other: Row) -> float:
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
