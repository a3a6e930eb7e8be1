"""What a sonar sees, and where it is, from a body that is a motion (dR, dp) after the state: the same for both filters.

All vectors are in the axes of the state's body, where neither filter's choice of error matters. A landmark p lies at
``p_n = R^T (p - X)``, ``p_b = dR^T (p_n - dp)`` in the body then, and what is seen of it changes along ::

    n = dR body_R_sonar D_q^T        for range and azimuth each, D_q of `sonar_graph.slam.models.project`

A detection shows the point ``s = dp + dR (body_p_sonar + body_R_sonar q)``.
"""

from __future__ import annotations

import math

import numpy as np

from baselines.filter_detections import Noise
from baselines.filter_models import SonarModel
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    minus,
    product,
    times,
    transformed,
    transposed,
    vector,
)
from sonar_graph.slam.models import floor_elevation, project, sonar_point


@inlined
def predicted_view(
    X: Vector, R: Matrix, motion: Integral, sonar: SonarModel, p: Vector
) -> tuple[Floats, Vector, Vector, Vector]:
    """Range and azimuth of a landmark (2,), p_n, and n of each."""
    p_n = times(transposed(R), minus(p, X))
    p_b = times(transposed(motion.dR), minus(p_n, motion.dp))
    q = times(transposed(sonar.body_R_sonar), minus(p_b, sonar.body_p_sonar))
    z, D_q = project(np.array(q))
    node_R_sonar = product(motion.dR, sonar.body_R_sonar)
    return z, p_n, times(node_R_sonar, vector(D_q[0])), times(node_R_sonar, vector(D_q[1]))


@inlined
def point_seen(motion: Integral, sonar: SonarModel, z: tuple[float, float], elevation_rad: float) -> Vector:
    """The point s that a detection shows."""
    p_b = transformed(sonar.body_p_sonar, sonar.body_R_sonar, vector(sonar_point(z[0], z[1], elevation_rad)))
    return transformed(motion.dp, motion.dR, p_b)


@inlined
def elevation_of_new(X: Vector, R: Matrix, motion: Integral, sonar: SonarModel, z: tuple[float, float]) -> float:
    """Elevation of a new landmark: that on the floor; 0 without one, or where it is outside the aperture."""
    if not sonar.has_floor:
        return 0.0
    node_p_sonar = transformed(motion.dp, motion.dR, sonar.body_p_sonar)
    world_R_sonar = product(product(R, motion.dR), sonar.body_R_sonar)
    height_m = sonar.floor_z_m - transformed(X, R, node_p_sonar)[2]
    elevation = floor_elevation(np.array(world_R_sonar[2]), height_m, z[0], z[1], sonar.aperture_rad)
    return 0.0 if math.isnan(elevation) else elevation


@inlined
def noise_of_view(R_z: Noise, aperture_rad: float) -> Matrix:
    """Covariance of range, azimuth and an elevation anywhere in the aperture: variance ``aperture^2 / 12``."""
    return (R_z[0], R_z[1], 0.0), (R_z[1], R_z[2], 0.0), (0.0, 0.0, aperture_rad**2 / 12.0)
