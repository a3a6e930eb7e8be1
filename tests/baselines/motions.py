"""Motions for tests of compiled code, from numpy and gtsam."""

from __future__ import annotations

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration.recursion import Integral
from sonar_graph.numerics.mat3 import ZERO, matrix, vector


def motion_of(twist: Floats, cov: Floats) -> Integral:
    """A motion by rotation vector and displacement, with the covariance of its perturbation [theta, rho] at its end."""
    dR = gtsam.Rot3.Expmap(twist[:3]).matrix()
    turn = np.kron(np.eye(2), dR)
    first = turn @ cov @ turn.T
    return Integral(
        matrix(dR), vector(twist[3:]), ZERO, matrix(first[:3, :3]), matrix(first[3:, :3]), matrix(first[3:, 3:])
    )
