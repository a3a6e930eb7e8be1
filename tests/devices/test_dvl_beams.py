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


@given(valid=st.lists(st.booleans(), min_size=4, max_size=4), seed=st.integers(0, 99))
def test_velocity_is_least_squares_and_information_the_sum_over_beams(valid, seed):
    """The velocity is 0 along what no beam measured."""
    directions = JANUS @ Rotation.random(random_state=seed).as_matrix()
    along = np.random.default_rng(seed).standard_normal((1, 4))
    (velocity,), cov = velocity_of_beams(directions, along, np.array([valid]), SIGMA)
    used = directions[valid]
    expected = np.linalg.pinv(used) @ along[0, valid]
    np.testing.assert_allclose(velocity, expected, atol=1e-12)
    total = used.T @ used / SIGMA**2
    unmeasured = 1 / UNMEASURED_M_S**2
    found = np.linalg.inv(cov[0])
    np.testing.assert_allclose(found, total, atol=2 * unmeasured, rtol=1e-5)
    assert is_partial(cov)[0] == (sum(valid) < 3)


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
