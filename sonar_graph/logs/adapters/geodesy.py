"""Latitude, longitude and height on the WGS-84 ellipsoid as metres east, north and up of an origin.

Latitude φ, longitude λ and height h become metres by Earth-centred coordinates::

    N = a / sqrt(1 - e² sin²φ)
    X = (N + h) cos φ cos λ,   Y = (N + h) cos φ sin λ,   Z = (N (1 - e²) + h) sin φ
"""

import numpy as np

from sonar_graph.measurements import Floats

Origin = tuple[float, float, float]
"""Latitude, longitude and height in m; in rad here, in degrees where a log or its configuration states an origin."""
SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


def turned(R: Floats, vectors: Floats) -> Floats:
    """Product of a matrix with each vector, shape (n, 3), whose bits do not depend on the other vectors."""
    return (R @ vectors[:, :, None])[:, :, 0]


def earth_centred(
    latitude_rad: Floats, longitude_rad: Floats, height_m: Floats
) -> Floats:
    """Earth-centred, Earth-fixed coordinates, shape (n, 3), metres."""
    sin = np.sin(latitude_rad)
    cos = np.cos(latitude_rad)
    N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)
    across = (N + height_m) * cos
    along = (N * (1.0 - ECCENTRICITY_SQUARED) + height_m) * sin
    return np.column_stack(
        [across * np.cos(longitude_rad), across * np.sin(longitude_rad), along]
    )


def east_north_up(
    latitude_rad: Floats, longitude_rad: Floats, height_m: Floats, origin: Origin
) -> Floats:
    """Metres east, north and up of an origin, shape (n, 3)."""
    origin_latitude_rad, origin_longitude_rad, _ = origin
    sin_lat = np.sin(origin_latitude_rad)
    cos_lat = np.cos(origin_latitude_rad)
    sin_lon = np.sin(origin_longitude_rad)
    cos_lon = np.cos(origin_longitude_rad)
    centre = earth_centred(*(np.array([value]) for value in origin))
    east = [-sin_lon, cos_lon, 0.0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    enu_R_earth = np.array(
        [east, north, [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]]
    )
    from_centre = earth_centred(latitude_rad, longitude_rad, height_m) - centre
    return turned(enu_R_earth, from_centre)
