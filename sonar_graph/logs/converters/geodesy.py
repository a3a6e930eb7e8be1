"""Latitude and longitude as metres east, north and up of a point.

WGS-84 ellipsoid, through Earth-centred coordinates, hence without the flat-Earth approximation::

    N = a / sqrt(1 - e² sin²φ)
    X = (N + h) cos φ cos λ,   Y = (N + h) cos φ sin λ,   Z = (N (1 - e²) + h) sin φ
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


def earth_centred(latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats) -> Floats:
    """Earth-centred, Earth-fixed coordinates, shape (n, 3), metres."""
    sin, cos = np.sin(latitude_rad), np.cos(latitude_rad)
    N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)
    across = (N + altitude_m) * cos
    return np.column_stack(
        [
            across * np.cos(longitude_rad),
            across * np.sin(longitude_rad),
            (N * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * sin,
        ]
    )


def enu_R_earth(latitude_rad: float, longitude_rad: float) -> Floats:
    """Rotation from Earth-centred axes to east, north, up at a point, shape (3, 3)."""
    sin_lat, cos_lat = np.sin(latitude_rad), np.cos(latitude_rad)
    sin_lon, cos_lon = np.sin(longitude_rad), np.cos(longitude_rad)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def east_north_up(latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats) -> Floats:
    """Positions relative to the first row horizontally and to altitude 0 vertically, shape (n, 3), metres."""
    origin = earth_centred(latitude_rad[:1], longitude_rad[:1], np.zeros(1))
    offsets = earth_centred(latitude_rad, longitude_rad, altitude_m) - origin
    return offsets @ enu_R_earth(float(latitude_rad[0]), float(longitude_rad[0])).T
