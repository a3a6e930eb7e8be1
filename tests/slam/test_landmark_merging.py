"""Which two landmarks of a graph are one."""

import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import chi2

from sonar_graph.calibration import SonarCalibration
from sonar_graph.slam.landmarks.sighting import LandmarkSightings, Sighting, SightingFactors
from sonar_graph.slam.landmarks.unknown import LandmarkMerging
from sonar_graph.slam.smoother.batch_solution import JointCovariance, Sightline

from .made import smoother_with

PROBABILITY = 0.99
NOISE_M = 0.02
LIKELY = math.log(1.0)


def nearest(
    points: dict[int, list[float]],
    cov: np.ndarray,
    named: list[int],
    frames: dict[int, list[int]],
    log_rival: float = LIKELY,
    range_m: float = 2.0,
) -> tuple[int, int] | None:
    """Of landmarks at points with a joint covariance, each seen in some frames."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    landmarks = LandmarkSightings(smoother, SightingFactors(SonarCalibration(), lambda noise: noise))
    values = gtsam.Values()
    for i, point in points.items():
        values.insert(L(i), np.array(point))
        for stamp_ns in frames[i]:
            noise = np.diag([NOISE_M**2, (NOISE_M / 2) ** 2])
            sighting = Sighting(stamp_ns, 0, Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.0])), noise, None)
            landmarks.enter(sighting, i, [])
    joint = JointCovariance(cov, {L(i): 3 * k for k, i in enumerate(points)})
    merging = LandmarkMerging(landmarks, PROBABILITY, log_rival)
    return merging.nearest(values, joint, named, [i for i in points if i not in named])


def shared(count: int, common_sigma: float, own_sigma: float) -> np.ndarray:
    """An error that all share, and one of each."""
    return common_sigma**2 * np.kron(np.ones((count, count)), np.eye(3)) + own_sigma**2 * np.eye(3 * count)


APART = {5: [1], 7: [2], 9: [3]}


@pytest.mark.parametrize("is_named", [True, False])
def test_two_within_the_gate_of_their_difference_are_one(is_named: bool):
    """``P_aa + P_bb - P_ab - P_ba``: what both share does not count."""
    cov = shared(2, 3.0, 0.05)
    reach = math.sqrt(chi2.ppf(PROBABILITY, 3) * (2 * 0.05**2 + NOISE_M**2))
    named = [5] if is_named else []
    for factor, merged in ((0.98, (5, 7)), (1.02, None)):
        points = {5: [1.0, 2.0, 0.0], 7: [1.0 + factor * reach, 2.0, 0.0]}
        assert nearest(points, cov, named, APART, log_rival=-10.0) == merged


def test_the_named_one_stays():
    points = {7: [0.0, 0.0, 0.0], 5: [0.01, 0.0, 0.0]}
    assert nearest(points, shared(2, 1.0, 0.05), [7], APART) == (7, 5)
    assert nearest(points, shared(2, 1.0, 0.05), [], APART) == (5, 7)


def test_two_named_ones_stay_two():
    assert nearest({5: [0.0] * 3, 7: [0.0] * 3}, shared(2, 1.0, 0.05), [5, 7], APART) is None


def test_two_of_one_frame_stay_two():
    points, cov = {5: [0.0] * 3, 7: [0.0] * 3}, shared(2, 1.0, 0.05)
    assert nearest(points, cov, [], {5: [1, 2], 7: [2, 3]}) is None
    assert nearest(points, cov, [], {5: [1, 2], 7: [3, 4]}) == (5, 7)


@pytest.mark.parametrize("own_sigma", [0.1, 1.0])
def test_a_wide_difference_says_nothing(own_sigma: float):
    """Compatible with zero, but no denser there, horizontally, than other landmarks are."""
    density = 1 / (2 * math.pi * (2 * own_sigma**2 + NOISE_M**2))
    points, cov = {5: [0.0] * 3, 7: [0.0] * 3}, shared(2, 1.0, own_sigma)
    assert nearest(points, cov, [], APART, math.log(0.99 * density)) == (5, 7)
    assert nearest(points, cov, [], APART, math.log(1.01 * density)) is None


def test_of_several_pairs_the_nearest():
    points = {5: [0.0, 0.0, 0.0], 7: [0.1, 0.0, 0.0], 9: [0.13, 0.0, 0.0]}
    assert nearest(points, shared(3, 1.0, 0.05), [], APART) == (7, 9)


@pytest.mark.parametrize("range_m", [0.5, 2.0, 6.0])
def test_the_noise_of_a_sighting_is_across_the_beam_where_that_is_larger(range_m: float):
    """``max(range sigma, range times azimuth sigma)`` beside two landmarks that are known well."""
    sigma = max(NOISE_M, range_m * NOISE_M / 2)
    reach = math.sqrt(chi2.ppf(PROBABILITY, 3) * (2 * 0.001**2 + sigma**2))
    for factor, merged in ((0.98, (5, 7)), (1.02, None)):
        points = {5: [1.0, 2.0, 0.0], 7: [1.0 + factor * reach, 2.0, 0.0]}
        assert nearest(points, shared(2, 1.0, 0.001), [], APART, log_rival=-10.0, range_m=range_m) == merged
