"""Axes of drivers turned into those of this package: body x forward, y left, z up; world x east, y north, z up."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation as SpatialRotation

from sonar_graph.measurements import Floats

Rotation = Annotated[Literal["flu", "frd"] | tuple[float, float, float], Field()]
"""``flu`` (x forward, y left, z up: nothing to turn), ``frd`` (y right, z down), or roll, pitch, yaw in degrees of
``ours_R_driver = Rz(yaw) Ry(pitch) Rx(roll)``."""
World = Literal["enu", "ned"]

_FLU_R_FRD = np.diag([1.0, -1.0, -1.0])
_ENU_R_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def axes_matrix(rotation: Rotation) -> Floats:
    """``ours_R_driver``, shape (3, 3)."""
    if rotation == "flu":
        return np.eye(3)
    if rotation == "frd":
        return _FLU_R_FRD
    return np.asarray(SpatialRotation.from_euler("xyz", rotation, degrees=True).as_matrix())


def world_matrix(world: World) -> Floats:
    """``enu_R_world``, shape (3, 3)."""
    return _ENU_R_NED if world == "ned" else np.eye(3)


def turn(rotation: Rotation, vectors: Floats) -> Floats:
    """Vectors along our axes, shape (n, 3); those that need no turning stay as they are to the bit."""
    return vectors if rotation == "flu" else vectors @ axes_matrix(rotation).T


def turn_covariances(rotation: Rotation, covariances: Floats) -> Floats:
    """Covariances along our axes, shape (n, 3, 3)."""
    if rotation == "flu":
        return covariances
    R = axes_matrix(rotation)
    return R @ covariances @ R.T
