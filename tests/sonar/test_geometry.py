import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.errors import CalibrationError
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats
from sonar_graph.simulation.sonar_image.imaging_sonar import DIDSON
from sonar_graph.sonar import Fan, FloorView, with_lens
from sonar_graph.sonar.geometry import (
    point_covariances,
    points,
    ranges_azimuths_elevations,
)

angles = st.floats(-0.3, 0.3)


def point(r: float, a: float, e: float = 0.0) -> Floats:
    return points(np.array([r]), np.array([a]), np.array([e]))


@given(st.floats(0.1, 50), st.floats(-3.1, 3.1), st.floats(-1.5, 1.5))
def test_range_azimuth_and_elevation_are_undone_by_their_point(r, a, e):
    found = ranges_azimuths_elevations(point(r, a, e))
    assert np.allclose(np.ravel(found), [r, a, e], atol=1e-9 * max(r, 1))
    assert (point(2.0, 0.1, 0.2)[0] > 0).all()  # left is positive, and so is up


@given(st.floats(0.5, 1.2), angles, st.floats(0.2, 0.9), st.floats(1.3, 2.5), angles)
def test_floor_points_lie_on_the_floor_at_their_range_and_azimuth(
    height, roll, pitch, r, a
):
    view = FloorView.from_angles(height, roll, pitch)
    q = view.floor_points(np.array([r]), np.array([a]))
    world = gtsam.Rot3.RzRyRx(roll, pitch, 0.0).matrix() @ q[0]
    assert world[2] == pytest.approx(-height, abs=1e-9)
    at = pytest.approx([r, a], abs=1e-9)
    assert np.hstack(ranges_azimuths_elevations(q)[:2]) == at
    assert np.hstack(view.range_azimuth(view.floor_point(r, a)[None])) == at


@pytest.mark.parametrize(
    ("height", "pitch", "words"),
    [
        (0.0, 0.5, "height_m"),
        (-1.0, 0.5, "height_m"),
        (np.nan, 0.5, "height_m"),
        (1.0, np.pi / 2, "vertical"),
    ],
)
def test_a_sonar_must_be_above_the_floor_and_not_look_straight_down(
    height, pitch, words
):
    with pytest.raises(CalibrationError, match=words):
        FloorView.from_angles(height, 0.0, pitch)


def test_covariance_of_a_point_is_that_of_many_samples():
    rng = np.random.default_rng(1)
    R = np.array([[4e-4, 2e-5], [2e-5, 1e-4]])
    r, a = rng.multivariate_normal([2.0, 0.2], R, 200_000).T
    sampled = np.cov(points(r, a, rng.uniform(-0.06, 0.06, 200_000)).T)
    found = point_covariances(point(2.0, 0.2), R, np.array([0.12 / np.sqrt(12)]))[0]
    assert np.allclose(found, sampled, atol=0.02 * np.abs(sampled).max())


def test_a_log_with_equally_spaced_beams_is_put_right_by_the_lens():
    """The simulator holds the published cubic on its own; equal spacing errs by 1.25 degrees, 4 cm at 2 m."""
    even_rad = DIDSON.linear_azimuths_rad()
    assert np.degrees(np.abs(even_rad - DIDSON.azimuths_rad()).max()) > 1.2
    told = SonarFrames(np.zeros(1), np.ones((1, 96, 8)), np.arange(1.0, 9.0), even_rad)
    found = with_lens(told, "didson")
    assert np.allclose(found.azimuths_rad, DIDSON.azimuths_rad(), atol=1e-5)
    assert found.intensity is told.intensity


@pytest.mark.parametrize("turned", [1, -1])
def test_each_pixel_of_a_fan_shows_the_sample_at_its_place(turned):
    """Cartesian pixels are converted back by hand; no sample is farther off than half a step."""
    ranges = DIDSON.ranges_m()
    azimuths = DIDSON.azimuths_rad()[::turned]
    fan = Fan.of(ranges, azimuths, 200)
    row, column = np.nonzero(fan.beam >= 0)
    ahead = fan.lowest_m + (200 - row - 0.5) / fan.pixels_per_m
    left = fan.half_width_m - (column + 0.5) / fan.pixels_per_m
    off_m = np.hypot(ahead, left) - ranges[fan.bin[row, column]]
    off_rad = np.arctan2(left, ahead) - azimuths[fan.beam[row, column]]
    assert np.abs(off_m).max() <= 0.51 * np.diff(ranges)[0]
    assert np.abs(off_rad).max() <= 0.51 * np.abs(np.diff(azimuths)).max()
    sector_m2 = 0.5 * np.ptp(azimuths) * np.ptp(ranges**2)
    assert len(row) / fan.pixels_per_m**2 == pytest.approx(sector_m2, rel=0.01)
