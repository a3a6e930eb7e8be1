"""What holds where a covariance is not said or infinite, and which rows measured a part."""

import numpy as np

from sonar_graph.devices.dvl_beams import UNMEASURED_M_S, in_numbers, is_partial


def test_an_infinite_variance_is_that_of_a_direction_not_measured_and_nan_is_not_said():
    whole = np.array([[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 4.0]])
    cov = np.array([whole, whole, np.full((3, 3), np.nan)])
    cov[1, 1], cov[1, :, 1] = np.inf, np.inf
    cov[0, 2, 1] = np.nan
    unsaid = np.arange(9.0).reshape(3, 3)
    whole[2, 1] = 7.0
    found = in_numbers(cov, unsaid)
    np.testing.assert_array_equal(found[0], whole)
    np.testing.assert_array_equal(found[1], [[2.0, 0.0, 0.1], [0.0, UNMEASURED_M_S**2, 0.0], [0.1, 0.0, 4.0]])
    np.testing.assert_array_equal(found[2], unsaid)
    np.testing.assert_array_equal(is_partial(cov), [False, True, False])


def test_a_row_is_partial_by_the_directions_that_it_leaves_whatever_its_axes():
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    for variances, partial in (
        ((1e-4, 1e-4, UNMEASURED_M_S**2), True),
        ((UNMEASURED_M_S**2, 1e-4, 1e-4), True),
        ((1e-4, UNMEASURED_M_S**2, 1e-4), True),
        ((0.2 * UNMEASURED_M_S**2,) * 3, True),
        ((0.16 * UNMEASURED_M_S**2,) * 3, False),
        ((np.nan,) * 3, False),
    ):
        assert is_partial((turn * np.array(variances) @ turn.T)[None])[0] == partial
