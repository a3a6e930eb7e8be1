"""Doppler beams against hand algebra and the laws of information."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.devices.dvl_beams import UNMEASURED_M_S, velocity_of_beams
from sonar_graph.navigation.samples import is_partial

TILT = np.radians(30.0)
JANUS = np.array(
    [
        [np.sin(TILT) * np.cos(azimuth), np.sin(TILT) * np.sin(azimuth), np.cos(TILT)]
        for azimuth in np.radians([45.0, -45.0, -135.0, 135.0])
    ]
)
SIGMA = 0.02
VELOCITY = np.array([1.2, -0.3, 0.1])
subsets = st.lists(st.booleans(), min_size=4, max_size=4)
seeds = st.integers(0, 2**32 - 1)


def solved(directions, valid):
    """One ping of a known velocity without noise."""
    velocity, cov = velocity_of_beams(directions, (directions @ VELOCITY)[None], np.array([valid]), SIGMA)
    return velocity[0], cov[0]


def test_four_beams_of_a_janus_are_a_velocity_with_the_covariance_of_the_textbook():
    """Horizontally sigma^2 / (2 sin^2 tilt), vertically sigma^2 / (4 cos^2 tilt)."""
    velocity, cov = solved(JANUS, [True] * 4)
    across, down = SIGMA**2 / (2 * np.sin(TILT) ** 2), SIGMA**2 / (4 * np.cos(TILT) ** 2)
    np.testing.assert_allclose(velocity, VELOCITY, atol=1e-14)
    np.testing.assert_allclose(cov, np.diag([across, across, down]), atol=1e-16)


@given(valid=subsets, seed=seeds)
def test_the_information_is_the_sum_over_the_beams(valid, seed):
    directions = JANUS @ Rotation.random(random_state=seed).as_matrix()
    velocity, cov = solved(directions, valid)
    used = directions[np.array(valid)]
    total = used.T @ used / SIGMA**2
    np.testing.assert_allclose(np.linalg.inv(cov), total, atol=2 / UNMEASURED_M_S**2, rtol=1e-5)
    np.testing.assert_allclose(used @ velocity, used @ VELOCITY, atol=1e-12)
    assert is_partial(cov[None])[0] == (sum(valid) < 3)


@given(valid=subsets, more=st.integers(0, 3))
def test_a_further_beam_never_takes_information_away(valid, more):
    _, before = solved(JANUS, valid)
    _, after = solved(JANUS, [v or k == more for k, v in enumerate(valid)])
    gained = np.linalg.eigvalsh(np.linalg.inv(after) - np.linalg.inv(before))
    assert gained[0] > -1e-4
    assert (gained[-1] > 1.0 / SIGMA**2 - 1e-3) == (not valid[more])


def test_what_is_not_valid_may_be_anything():
    along = (JANUS @ VELOCITY)[None].copy()
    along[0, 2] = np.nan
    velocity, _ = velocity_of_beams(JANUS, along, np.array([[True, True, False, True]]), SIGMA)
    assert velocity[0] == pytest.approx(VELOCITY)


def test_rows_do_not_mix():
    rng = np.random.default_rng(0)
    velocities = rng.standard_normal((50, 3))
    valid = rng.random((50, 4)) < 0.6
    together, covs = velocity_of_beams(JANUS, velocities @ JANUS.T, valid, SIGMA)
    for k in range(50):
        alone, cov = velocity_of_beams(JANUS, velocities[k : k + 1] @ JANUS.T, valid[k : k + 1], SIGMA)
        np.testing.assert_allclose(alone[0], together[k], atol=1e-14)
        np.testing.assert_array_equal(cov[0], covs[k])
