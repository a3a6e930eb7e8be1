import numpy as np
import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.navigation.alignment.gravity import earth_rate_in_world


def rate_deg_h(latitude_deg: float) -> np.ndarray:
    return np.degrees(earth_rate_in_world(Calibration(earth_rate_latitude_rad=np.radians(latitude_deg)))) * 3600


def test_the_earth_turns_once_a_sidereal_day():
    assert 360 / np.linalg.norm(rate_deg_h(36.0)) == pytest.approx(23.9345, abs=1e-4)


def test_the_axis_points_north_at_the_equator_and_up_at_the_north_pole():
    assert rate_deg_h(0) == pytest.approx([0, 15.041, 0], abs=1e-3)
    assert rate_deg_h(90) == pytest.approx([0, 0, 15.041], abs=1e-3)
    assert rate_deg_h(-90) == pytest.approx([0, 0, -15.041], abs=1e-3)


def test_no_latitude_means_that_it_is_not_removed():
    assert earth_rate_in_world(Calibration()) is None
