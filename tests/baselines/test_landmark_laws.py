"""Laws of landmarks, for both filters: augmentation, floor, gate, innovation, and views from far away."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

from baselines.kalman import GATED, USED, is_far, judged
from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.models import (
    FLOOR_GATE,
    RobustKernel,
    elevation_on_floor,
    locate,
    polar_measurements,
)
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.testing.numerical import central_differences

from .filters import (
    CALIBRATION,
    NOISE,
    STILL,
    TWIST,
    World,
    begun,
    both,
    motion_of,
    observe_one,
    random_covariance,
    rotation,
    sonar_after,
    world_at,
)
from .runs import seen

LEVEL = np.zeros(3)
TILTED = np.array([0.1, 0.2, 0.3])
MOTION = motion_of(TWIST)


def bare(filter_, angles, scale):
    """An estimate without landmarks, and its covariance."""
    return world_at(angles, []), random_covariance(filter_.bare, scale)


def floored(z_m, sigma_m=1e-2):
    return CALIBRATION.model_copy(
        update={"floor": FloorPrior(z_m=z_m, sigma_m=sigma_m)}
    )


def augmented(filter_, angles, scale, z, calibration=CALIBRATION):
    """Filter that sees its first landmark, and this landmark with its covariance."""
    slam = begun(filter_, *bare(filter_, angles, scale), calibration)
    slam.augment(MOTION, np.array(z), NOISE)
    (position,), covariance = slam.points([0])
    return slam, position, covariance


@both
def test_a_known_floor_fixes_the_height_of_a_new_landmark(filter_):
    true = locate(sonar_after(world_at(LEVEL), MOTION), 2.0, 0.3, 0.05)
    _, position, covariance = augmented(
        filter_, LEVEL, 0.003, [2.0, 0.3], floored(true[2], 1e-3)
    )
    assert_allclose(position, true, atol=1e-3)
    assert covariance[2, 2] == pytest.approx(1e-6, rel=0.01)


@both
@pytest.mark.parametrize(
    ("share", "is_used"), [(0.5, True), (0.999, True), (1.001, False)]
)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_floor_outside_the_aperture_counts_up_to_its_gate(
    filter_, side, share, is_used
):
    """The innovation's variance has the aperture's share, the pose's and the floor's."""
    _, position, covariance = augmented(filter_, TILTED, 0.002, [2.0, 0.3])
    variance = covariance[2, 2]
    floor_variance = 1e-4
    off_m = side * math.sqrt(share * FLOOR_GATE * (variance + floor_variance))
    floor_z_m = position[2] + off_m
    pose = sonar_after(world_at(TILTED), MOTION)
    assert (
        elevation_on_floor(
            pose, 2.0, 0.3, floor_z_m, CALIBRATION.sonar.elevation_aperture_rad
        )
        is None
    )
    _, after, cov = augmented(
        filter_, TILTED, 0.002, [2.0, 0.3], floored(floor_z_m, 1e-2)
    )
    if is_used:
        gain = variance / (variance + floor_variance)
        assert cov[2, 2] == pytest.approx(gain * floor_variance, rel=0.05)
        assert after[2] == pytest.approx(position[2] + gain * off_m, abs=0.01)
    else:
        assert_array_equal(after, position)
        assert_array_equal(cov, covariance)


def test_the_floor_s_gate_is_passed_by_999_of_1000_that_stand_on_it():
    assert pytest.approx(chi_square_quantile(0.999, 1), abs=5e-3) == FLOOR_GATE


@pytest.mark.parametrize("hole", [(0, 0), (1, 1), (0, 1)])
def test_noise_is_the_log_s_or_where_it_is_missing_the_calibration_s(
    hole,
):
    logged = np.array([[[4e-4, 3e-5], [1e-5, 1e-4]]] * 2)
    logged[(1, *hole)] = math.nan
    detections = replace(seen([0, 0], 1.0, 1.0), range_azimuth_cov=logged)
    sonar = SonarCalibration(range_sigma_m=0.03, azimuth_sigma_rad=0.02)
    z, noise = polar_measurements(detections, sonar)
    assert_array_equal(z, np.ones((2, 2)))
    own = np.diag([0.03**2, 0.02**2])
    assert_allclose(noise, [[[4e-4, 2e-5], [2e-5, 1e-4]], own])


# ---------------------------------------------------------------------------------------------- views from far away

FAR_LANDMARK = np.array([25.0, 12.0, -1.0])
APERTURE_RAD = 0.3
AHEAD = CALIBRATION.model_copy(
    update={"sonar": SonarCalibration(elevation_aperture_rad=APERTURE_RAD)}
)
"""A sonar at the origin of the body."""


def look(filter_, X, position_sigma_m, may_be_far, wrong_m=0.0):
    """One exact look at the landmark from X, by a filter that expects to be at the origin.

    Returns its outcome, position and covariance after it, the innovation and its covariance.
    """
    here = World(np.eye(3), np.zeros(3), FAR_LANDMARK[None])

    def error(shift):
        return filter_.error(
            World(rotation(shift[3:6]), shift[:3], here.landmarks + shift[6:]), here
        )

    T = central_differences(error, np.zeros(9))
    P = T @ np.diag(np.repeat(np.square([position_sigma_m, 1e-3, 0.01]), 3)) @ T.T
    slam = begun(filter_, here, P, AHEAD)
    q = FAR_LANDMARK - X
    z = np.array([np.linalg.norm(q) + wrong_m, np.arctan2(q[1], q[0])])
    R_z = np.diag([AHEAD.sonar.range_sigma_m**2, AHEAD.sonar.azimuth_sigma_rad**2])
    judged = slam.observe_far(STILL, 0, z, R_z) if may_be_far else None
    outcome, e, S = judged or observe_one(slam, STILL, 0, z, R_z)
    _, at, covariance = slam.pose_after(STILL)
    return outcome, at, covariance[3:, 3:], e, S


@both
def test_one_look_finds_a_vehicle_that_is_far_from_where_it_was_expected(filter_):
    """And linearised where it was expected it is sure of a wrong place."""
    X = np.array([40.0, 20.0, -0.5])
    outcome, at, P, _, S = look(filter_, X, 30.0, may_be_far=True)
    assert outcome == USED
    assert np.linalg.norm((at - X)[:2]) < 0.5
    assert (at - X) @ np.linalg.solve(P, at - X) < chi2.ppf(0.99, 3)
    assert S[0, 0] == pytest.approx(30.0**2, rel=0.01)
    _, at, P, _, _ = look(filter_, X, 30.0, may_be_far=False)
    assert (at - X) @ np.linalg.solve(P, at - X) > 1000.0


@both
def test_a_vehicle_near_where_it_was_expected_sees_as_without_a_gap(filter_):
    X = np.array([0.1, -0.1, 0.05])
    with_gap = look(filter_, X, 0.2, True)
    without = look(filter_, X, 0.2, False)
    for one, other in zip(with_gap, without, strict=True):
        assert_array_equal(one, other)


@both
def test_what_no_vehicle_in_reach_sees_is_refused(filter_):
    outcome, at, _, e, S = look(
        filter_, np.array([40.0, 20.0, -0.5]), 30.0, True, wrong_m=300.0
    )
    assert outcome == GATED
    assert_allclose(at, 0.0, atol=1e-15)
    assert e @ np.linalg.solve(S, e) > chi_square_quantile(0.999, 2)


def test_linear_is_what_errs_by_less_than_the_noise():
    """Sagitta of an exact circle: across a beam of 10 m, sigma 1 m, a range is 5 cm longer."""
    G_z = np.diag([1.0, 10.0, 10.0])
    longer_m = np.hypot(10.0, 1.0) - 10.0
    for share, is_linear in ((1.05, True), (0.95, False)):
        noise = np.diag([(share * longer_m) ** 2, 1.0])
        assert is_far(np.diag([0.0, 1.0, 0.0]), G_z, 10.0, noise) != is_linear
    for sigma, is_linear in ((0.0101, True), (0.0099, False)):
        noise = np.diag([1.0, sigma**2])
        assert is_far(np.diag([1.0, 1.0, 0.0]), G_z, 10.0, noise) != is_linear
    assert not is_far(1e6 * np.diag([0.0, 0.0, 1.0]), G_z, 10.0, np.diag([1e-4, 1e-4]))


@pytest.mark.parametrize("direction", [(2.0, 1.0), (2.0, -1.0), (1.0, 0.0)])
def test_the_gate_is_an_ellipse_of_a_correlated_innovation(direction):
    """Range and azimuth correlated by 0.9: along the long axis far more passes than across it."""
    S = np.array([[4.0, 1.8], [1.8, 1.0]])
    threshold = chi_square_quantile(0.999, 2)
    e = np.array(direction) * np.sqrt(
        threshold / (direction @ np.linalg.solve(S, direction))
    )
    assert admitted(0.999 * e, S, gate_probability=0.999)[0] == USED
    assert admitted(1.001 * e, S, gate_probability=0.999)[0] == GATED
    assert admitted(1e3 * e, S)[0] == USED


def admitted(e, S, R_z=NOISE, *, gate_probability=1.0, kernel_width=0.0):
    """Judgement by these settings."""
    gate = math.sqrt(chi2.ppf(gate_probability, 2))
    return judged(np.array(e, float), np.array(S), R_z, gate, kernel_width or math.inf)


def test_a_kernel_weighs_range_and_azimuth_each_as_in_the_graph():
    """By GTSAM's own weight at the innovation over its sigma; a correlation of the noise stays as it is."""
    kernel = RobustKernel(shape="cauchy", width=1.2)
    R_z = np.array([[4e-4, 1e-5], [1e-5, 1e-4]])
    S = np.array([[0.04, 0.01], [0.01, 0.09]])
    weight = kernel.estimator().weight
    for e in ([0.6, 0.3], [-0.1, -3.0], [0.0, 0.0], [1e4, 1e4]):
        outcome, widened = admitted(e, S, R_z, kernel_width=1.2)
        spread = [weight(abs(e[i]) / math.sqrt(S[i, i])) ** -0.5 for i in range(2)]
        assert outcome == USED
        assert_allclose(R_z + widened, R_z * np.outer(spread, spread), rtol=1e-12)
    assert_array_equal(admitted([9.0, 9.0], S, R_z)[1], 0.0)
