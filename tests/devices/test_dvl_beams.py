"""Doppler beams against hand algebra and the laws of information."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.devices import UNMEASURED_M_S, is_partial, velocity_of_beams

TILT = np.radians(30.0)
SIGMA = 0.02
AZIMUTHS = np.radians([45.0, -45.0, -135.0, 135.0])
JANUS = np.column_stack(
    [
        np.sin(TILT) * np.cos(AZIMUTHS),
        np.sin(TILT) * np.sin(AZIMUTHS),
        np.full(4, np.cos(TILT)),
    ]
)
VELOCITY = np.array([1.2, -0.3, 0.1])
subsets = st.lists(st.booleans(), min_size=4, max_size=4)
seeds = st.integers(0, 2**32 - 1)


def solved(directions, valid):
    """One ping of a known velocity without noise."""
    velocity, cov = velocity_of_beams(
        directions, (directions @ VELOCITY)[None], np.array([valid]), SIGMA
    )
    return velocity[0], cov[0]


def test_four_janus_beams_give_velocity_and_covariance_of_the_textbook():
    """By least squares; horizontally sigma^2 / (2 sin^2 tilt), vertically sigma^2 / (4 cos^2 tilt)."""
    along = JANUS @ VELOCITY + SIGMA * np.random.default_rng(0).standard_normal((1, 4))
    velocity, cov = velocity_of_beams(JANUS, along, np.ones((1, 4), dtype=bool), SIGMA)
    across = SIGMA**2 / (2 * np.sin(TILT) ** 2)
    down = SIGMA**2 / (4 * np.cos(TILT) ** 2)
    np.testing.assert_allclose(velocity, along @ np.linalg.pinv(JANUS).T, atol=1e-12)
    np.testing.assert_allclose(cov[0], np.diag([across, across, down]), atol=1e-16)


@given(valid=subsets, seed=seeds)
def test_the_information_is_the_sum_over_the_beams(valid, seed):
    directions = JANUS @ Rotation.random(random_state=seed).as_matrix()
    velocity, cov = solved(directions, valid)
    used = directions[np.array(valid)]
    total = used.T @ used / SIGMA**2
    np.testing.assert_allclose(
        np.linalg.inv(cov), total, atol=2 / UNMEASURED_M_S**2, rtol=1e-5
    )
    np.testing.assert_allclose(used @ velocity, used @ VELOCITY, atol=1e-12)
    assert is_partial(cov[None])[0] == (sum(valid) < 3)


def test_rows_do_not_mix_and_what_is_not_valid_may_be_anything():
    rng = np.random.default_rng(0)
    velocities = rng.standard_normal((50, 3))
    valid = rng.random((50, 4)) < 0.6
    along = np.where(valid, velocities @ JANUS.T, np.nan)
    together, covs = velocity_of_beams(JANUS, along, valid, SIGMA)
    for k in range(50):
        alone, cov = velocity_of_beams(
            JANUS, velocities[k : k + 1] @ JANUS.T, valid[k : k + 1], SIGMA
        )
        np.testing.assert_allclose(alone[0], together[k], atol=1e-14)
        np.testing.assert_array_equal(cov[0], covs[k])
