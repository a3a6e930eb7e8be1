"""The checks that users run on factors and covariances distinguish right from wrong."""

import gtsam
import numpy as np
import pytest

from sonar_graph.testing import check_consistent, check_derivative, check_jacobians

NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.2]))


def bearing_range_like(wrong: float) -> tuple[gtsam.CustomFactor, gtsam.Values]:
    """Range and azimuth of a point, with one entry of the Jacobian off by a factor."""

    def error(
        factor: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[np.ndarray] | None,
    ) -> np.ndarray:
        x, y = values.atPoint2(factor.keys()[0])
        rho = np.hypot(x, y)
        if jacobians is not None:
            jacobians[0] = np.array(
                [[x / rho, y / rho], [-y / rho**2 * wrong, x / rho**2]]
            )
        return np.array([rho - 2.0, np.arctan2(y, x)])

    values = gtsam.Values()
    values.insert(7, np.array([1.5, 1.2]))
    return gtsam.CustomFactor(NOISE, [7], error), values


def test_right_derivatives_pass_and_a_wrong_one_or_nan_is_named():
    check_jacobians(*bearing_range_like(1.0))
    for wrong, said in (
        (
            1.001,
            r"variable 7: derivative of row 1 by direction 0: stated -0\.325\d+, by differences",
        ),
        (np.nan, "nan"),
    ):
        with pytest.raises(AssertionError, match=said):
            check_jacobians(*bearing_range_like(wrong))


def test_a_derivative_has_the_shape_of_the_value_and_angles_are_wrapped():
    check_derivative(lambda x: x[0] * x[1], [3.0, 2.0], at=[2.0, 3.0])
    check_derivative(
        lambda x: np.outer(x, x), [[[2, 0], [1, 1]], [[1, 1], [0, 2]]], at=[1.0, 1.0]
    )
    with pytest.raises(
        ValueError, match=r"expected a Jacobian of shape \(2,\), not \(1, 2\)"
    ):
        check_derivative(lambda x: x[0] * x[1], [[3.0, 2.0]], at=[2.0, 3.0])
    with pytest.raises(
        AssertionError, match="row 0, 1 by direction 1: stated 7, by differences 1"
    ):
        check_derivative(
            lambda x: np.outer(x, x),
            [[[2, 0], [1, 7]], [[1, 1], [0, 2]]],
            at=[1.0, 1.0],
        )

    def azimuth(p: np.ndarray) -> np.ndarray:
        return np.array([np.arctan2(p[1], p[0])])

    check_derivative(azimuth, [[0.0, -1.0]], at=[-1.0, 0.0], angles=[0])
    with pytest.raises(AssertionError, match="row 0"):
        check_derivative(azimuth, [[0.0, -1.0]], at=[-1.0, 0.0])


def test_columns_belong_to_their_variables():
    values = gtsam.Values()
    values.insert(
        3, gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.7, 3.1), np.array([1.0, 2.0, 3.0]))
    )
    values.insert(1, np.array([2.0, -1.0, 0.5]))
    factor = gtsam.RangeFactor3D(3, 1, 2.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.01))
    check_jacobians(factor, values)


@pytest.mark.parametrize(
    ("scale", "said"), [(1.0, None), (0.7, "too large"), (1.4, "too small")]
)
def test_covariances_are_judged_on_both_sides(scale, said):
    nees = scale * (np.random.default_rng(3).standard_normal((200, 3)) ** 2).sum(axis=1)
    if said is None:
        check_consistent(nees, dof=3)
    else:
        with pytest.raises(AssertionError, match=said):
            check_consistent(nees, dof=3)
