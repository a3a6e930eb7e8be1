import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.logs.convert.akit import earth_centred, east_north_up, enu_R_earth


def test_earth_centred_reproduces_known_points():
    """Equator and pole, by the semi-axes that define WGS-84."""
    points = earth_centred(np.array([0.0, np.pi / 2]), np.array([0.0, 0.0]), np.array([10.0, 0.0]))
    assert np.allclose(points, [[6378147.0, 0, 0], [0, 0, 6356752.3142]], rtol=0, atol=1e-4)


@given(st.floats(-1.3, 1.3), st.floats(-3, 3))
def test_small_offsets_are_the_radii_of_curvature_times_the_angles(latitude, longitude):
    e2, a, d = 6.69437999014e-3, 6378137.0, 1e-6
    meridian = a * (1 - e2) / (1 - e2 * np.sin(latitude) ** 2) ** 1.5
    vertical = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    enu = east_north_up(
        latitude + np.array([0, d, 0, 0]), longitude + np.array([0, 0, d, 0]), np.array([-5.0, -5.0, -5.0, -2.0])
    )
    assert np.allclose(enu[1] - enu[0], [0, (meridian - 5) * d, 0], rtol=0, atol=1e-4)
    assert np.allclose(enu[2] - enu[0], [(vertical - 5) * np.cos(latitude) * d, 0, 0], rtol=0, atol=1e-4)
    assert np.allclose(enu[3] - enu[0], [0, 0, 3], rtol=0, atol=1e-4)
    assert np.allclose(enu[0], [0, 0, -5], rtol=0, atol=1e-6)


def test_local_axes_are_a_right_handed_rotation():
    R = enu_R_earth(0.57, 0.61)
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1)
