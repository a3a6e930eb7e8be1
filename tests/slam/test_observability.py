"""Directions left open, rows that are no measurements, and factors that are withheld."""

import re
from itertools import product

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.slam import factors
from sonar_graph.slam.smoother import FactorGroup, Factors, Smoother
from sonar_graph.slam.smoother.observability import LEAST_SAID, left_open

from .made import (
    graph_of,
    isotropic,
    plain,
    point_prior,
    smoother_with,
    values_of,
)

HERE = values_of(X0=gtsam.Pose3(), L1=np.array([2.0, 0.0, 0.0]))


def along(direction: list[float], sigma: float) -> gtsam.NonlinearFactor:
    """A landmark is at its estimate, to sigma, along one direction."""
    J = np.array([direction]) / np.linalg.norm(direction)

    def error(_, found, jacobians):
        if jacobians is not None:
            jacobians[0] = J
        return J @ (found.atPoint3(L(1)) - [2.0, 0.0, 0.0])

    return gtsam.CustomFactor(isotropic(1, sigma), [L(1)], error)


def test_a_range_leaves_open_what_is_across_it():
    """Of the landmark when the pose is known; weak information counts as missing."""
    distance = gtsam.RangeFactor3D(X(0), L(1), 2.0, isotropic(1, 0.1))
    (across,) = left_open(graph_of([distance]), HERE, [L(1)])
    assert np.linalg.matrix_rank(across.directions) == 2
    np.testing.assert_allclose(across.directions[:, 0], 0.0, atol=1e-9)
    weak = [
        along([0.0, 1.0, 0.0], 0.9 / LEAST_SAID),
        along([0.0, 0.0, 1.0], 1.1 / LEAST_SAID),
    ]
    assert left_open(graph_of([distance, *weak]), HERE, [L(1)]) == []
    (left,) = left_open(graph_of([distance, *weak]), HERE, [L(1)], LEAST_SAID)
    assert left.axes() == "z"


@pytest.mark.parametrize(
    "cov",
    [
        np.zeros((2, 2)),
        np.diag([1.0, -1.0]),
    ],
)
def test_noise_that_is_no_covariance_is_refused_where_gtsam_takes_it(cov):
    assert gtsam.noiseModel.Gaussian.Covariance(cov, False) is not None
    with pytest.raises(
        MeasurementError,
        match="expected a positive definite covariance, not one with an eigenvalue",
    ):
        factors.gaussian(cov)


STEP = gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array([1.0, 0.0, 0.0]))
SIGMAS = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01] * 3 + [0.05] * 3))


def range_factor(pose: int, landmark: int, range_m: float) -> gtsam.NonlinearFactor:
    return gtsam.RangeFactor3D(X(pose), L(landmark), range_m, isotropic(1, 0.05))


def begun(*, is_bounded: bool = False) -> Smoother:
    """Two keyframes and a landmark."""
    smoother = smoother_with(3.5, 1e-3, 1e9, is_bounded=is_bounded)
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    smoother.add({"prior": gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), SIGMAS)})
    smoother.add_landmark(L(3), np.array([4.0, 1.0, 0.5]))
    smoother.add({"prior": point_prior(L(3), [4.1, 1.0, 0.5])})
    smoother.add({"range": range_factor(0, 3, 4.3)})
    smoother.update(0.0)
    step(smoother, 1)
    return smoother


def step(smoother: Smoother, k: int, more: Factors | None = None) -> None:
    smoother.add_pose(X(k), smoother.values.atPose3(X(k - 1)).compose(STEP), float(k))
    smoother.add({"odometry": gtsam.BetweenFactorPose3(X(k - 1), X(k), STEP, SIGMAS)})
    smoother.add({"range": range_factor(k, 3, 4.0 - 0.7 * k)})
    smoother.add(more or {})
    smoother.update(float(k))


def same(one: Smoother, other: Smoother, tolerance: float = 1e-9) -> None:
    """Values, graphs and marginals, to rounding, or to what a linearisation at another estimate changes."""
    rtol = 100 * tolerance
    assert one.values.equals(other.values, tolerance)
    assert one.graph.size() == other.graph.size()
    for key in (X(5), L(3)):
        found, expected = (
            smoother.marginals.marginalCovariance(key) for smoother in (one, other)
        )
        assert np.allclose(
            found, expected, rtol=rtol, atol=rtol * np.abs(expected).max()
        )
    values, marginals = one.solve_history()
    others, other_marginals = other.solve_history()
    assert values.equals(others, tolerance)
    found, expected = (
        of.marginalCovariance(L(3)) for of in (marginals, other_marginals)
    )
    assert np.allclose(found, expected, rtol=rtol, atol=0)


POINT = np.array([5.0, 0.2, 0.3])
OF_7 = {L(7): POINT}
FROM_1 = r"from keyframe 1 at 1\.000 s: 1"
MISSING = "an elevation, a floor prior or a view from elsewhere is missing"
SIGHTING = factors.landmark_sighting(
    X(1), L(7), gtsam.Pose3(), np.array([4.0, 0.05]), np.diag([1e-4, 1e-4]), plain
)
FAULTY = {
    "lone range": (
        OF_7,
        {"range": range_factor(1, 7, 3.0)},
        rf"landmark 7, {FROM_1} range; open: .*; {MISSING}",
    ),
    "no elevation": (
        OF_7,
        SIGHTING,
        rf"landmark 7, {FROM_1} azimuth, 1 range; open: mostly z \(.*\); {MISSING}",
    ),
    "no number": (
        {},
        {"range": range_factor(1, 3, np.nan)},
        rf"landmark 3, {FROM_1} range gives an error that is no number",
    ),
    "infinite": (
        OF_7,
        {"prior": point_prior(L(7), [5.0, np.inf, 0.0])},
        "landmark 7: 1 prior gives an error that is no number",
    ),
}
WAYS = list(product(FAULTY, ("update", "flush", "exchange")))
WAYS.remove(("no elevation", "flush"))  # flushed it is linearised elsewhere


@pytest.mark.parametrize("is_bounded", [False, True], ids=["whole", "bounded"])
@pytest.mark.parametrize(("fault", "way"), WAYS)
def test_what_has_no_solution_is_withheld_by_name_whichever_way_it_comes(
    fault, is_bounded, way
):
    smoother = begun(is_bounded=is_bounded)
    other = begun(is_bounded=is_bounded)
    landmarks, new, said = FAULTY[fault]
    step(other, 2)
    if not way.startswith("update"):
        step(smoother, 2)
    if way == "exchange":
        smoother.exchange(2.0, (), [FactorGroup(new)], landmarks)
        other.exchange(2.0, (), [FactorGroup({})])
    elif landmarks:
        smoother.add_landmark(L(7), POINT)
    if way == "flush":
        smoother.add(new)
        smoother.flush(2.0)
        other.flush(2.0)
    elif way != "exchange":
        step(smoother, 2, new)
    for k in range(3, 6):
        step(smoother, k)
        step(other, k)
    assert re.fullmatch(f"{said}; withheld", smoother.withheld[0]), smoother.withheld
    assert not other.withheld
    assert not smoother.values.exists(L(7))
    is_linearised_anew = (fault, way) == ("no elevation", "update")
    same(smoother, other, 1e-4 if is_linearised_anew else 1e-9)


def test_a_keyframe_without_odometry_is_named_with_what_is_missing():
    smoother = begun()
    smoother.add_pose(X(2), gtsam.Pose3(), 2.0)
    smoother.add({"range": range_factor(2, 3, 3.0)})
    with pytest.raises(
        EstimatorError,
        match=r"keyframe 2 at 2\.000 s: 1 range; open: .*; odometry from another",
    ):
        smoother.update(2.0)
