"""The Earth's rotation, which gyros feel."""

from __future__ import annotations

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats

EARTH_RATE_RAD_S = 7.292115e-5
"""WGS 84."""


def earth_rate_in_world(calibration: Calibration) -> Floats | None:
    """Earth's angular rate in a world with x east, y north, z up, shape (3,), rad/s; None where it is not removed."""
    latitude = calibration.earth_rate_latitude_rad
    if latitude is None:
        return None
    return EARTH_RATE_RAD_S * np.array([0.0, np.cos(latitude), np.sin(latitude)])
