"""Factors: errors in closed form, derivatives by differences, information by directions."""

from collections.abc import Iterator

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, PlanarMotion, Start
from sonar_graph.models import RobustKernel
from sonar_graph.slam import factors
from sonar_graph.slam.factors import SightingStack
from sonar_graph.slam.odometry_factor import OdometryStack, OdometryWithBias
from sonar_graph.testing import check_jacobians

from .graphs import information
from .made import (
    POSES,
    graph_of,
    plain,
    random_covariance,
    some_motion,
    values_of,
)

BODY_T_SONAR = gtsam.Pose3(
    gtsam.Rot3.RzRyRx(0.1, 0.5, -0.2), np.array([0.4, 0.05, -0.1])
)
poses = pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
SIGMA = np.array([0.02, 0.009])
"""Noise of range and azimuth."""
PLANE = PlanarMotion(z_m=0.4, z_sigma_m=0.01, tilt_sigma_rad=0.02)
Made = Iterator[tuple[gtsam.NoiseModelFactor, gtsam.Values]]


def correlated(correlation: float) -> np.ndarray:
    return np.outer(SIGMA, SIGMA) * [[1, correlation], [correlation, 1]]


def seen_from(
    pose: gtsam.Pose3, azimuth_rad: float, elevation_rad: float, range_m: float
) -> np.ndarray:
    """The point at these spherical coordinates of the mounted sonar, by scipy."""
    beam = Rotation.from_euler("ZY", [azimuth_rad, -elevation_rad]).apply(
        [range_m, 0, 0]
    )
    return pose.transformFrom(BODY_T_SONAR.transformFrom(beam))


def beginnings(pose: gtsam.Pose3, rng: np.random.Generator) -> Made:
    """GTSAM's priors and directions have the derivative of where they are fulfilled."""
    seen = np.array([2.0, 0.3, -0.4])
    values = values_of(
        X0=pose,
        B0=rng.standard_normal(11),
        B1=rng.standard_normal(11),
        L0=pose.transformFrom(seen),
    )
    start = Start(
        position_m=tuple(pose.translation()), rpy_rad=tuple(pose.rotation().rpy())
    )
    yield factors.start_prior(X(0), Calibration(start=start)), values
    yield factors.bias_prior(B(0), np.linspace(0.0, 0.1, 11)), values
    yield factors.bias_walk(B(0), B(1), np.linspace(0.0, 0.1, 11)), values
    yield factors.floor_prior(L(0), -1.7, 0.01), values
    yield factors.first_direction(X(0), L(0), seen), values


def odometries(pose: gtsam.Pose3, rng: np.random.Generator) -> Made:
    """Near no error, far off, and off by nearly half a turn."""
    for spread, turn in ((0.0, 0.0), (1.0, 0.0), (0.1, np.pi - 0.1)):
        motion = some_motion(int(rng.integers(99)), 0.05)
        bias = spread * 0.03 * rng.standard_normal(11)
        X_j = pose.compose(motion.corrected(bias)).compose(
            gtsam.Pose3.Expmap(0.3 * spread * rng.standard_normal(6))
        )
        values = values_of(
            X0=pose,
            X1=X_j.compose(gtsam.Pose3(gtsam.Rot3.Rz(turn), np.zeros(3))),
            B0=bias,
        )
        up = (
            X_j.rotation().matrix()[2]
            if spread
            else gtsam.Rot3.RzRyRx(*rng.uniform(-0.4, 0.4, 3)).matrix()[2]
        )
        yield OdometryWithBias(X(0), X(1), B(0), motion, up), values
        if spread == 0.0:  # GTSAM's has the derivative of no error
            values = values_of(X0=pose, X1=pose.compose(motion.i_T_j))
            yield factors.odometry(X(0), X(1), motion), values


def sightings(pose: gtsam.Pose3, rng: np.random.Generator) -> Made:
    azimuth, elevation = rng.uniform([-1.13, -0.12], [1.13, 0.12])
    z = np.array([2.0, azimuth + 0.02])
    values = values_of(X0=pose, L0=seen_from(pose, azimuth, elevation, 2.1))
    for cov in (correlated(0.0), correlated(0.5)):
        for factor in factors.landmark_sighting(
            X(0), L(0), BODY_T_SONAR, z, cov, plain, 0.07
        ).values():
            yield factor, values
    for off in (
        np.pi - 0.01,
        0.01 - np.pi,
    ):  # behind the sonar, where the azimuth's error jumps
        behind = values_of(X0=pose, L0=seen_from(pose, azimuth + off, elevation, 2.1))
        z = np.array([2.0, azimuth])
        yield (
            factors.CorrelatedSighting(
                X(0), L(0), BODY_T_SONAR, z, plain(factors.gaussian(correlated(0.5)))
            ),
            behind,
        )


def attitudes_and_heights(pose: gtsam.Pose3, rng: np.random.Generator) -> Made:
    values = values_of(X0=pose)
    up_in_body = pose.rotation().matrix().T @ [0, 0, 1.0]
    tilt = gtsam.Rot3.RzRyRx(*rng.uniform(-0.3, 0.3, 2), 0)
    yield factors.depth(X(0), 1.3, np.array([0.3, -0.2, 0.1]), 0.02), values
    yield from ((factor, values) for factor in factors.planar(X(0), PLANE).values())
    tilted = values_of(X0=pose.compose(gtsam.Pose3(tilt, np.zeros(3))))
    yield factors.gravity_direction(X(0), 9.8 * up_in_body, 0.01), tilted
    tilted.insert(B(0), rng.standard_normal(11))
    A = rng.standard_normal((3, 3)) / 9.8
    yield factors.gravity_with_bias(X(0), B(0), 9.8 * up_in_body, A, 0.01), tilted
    for yaw_rad in tilted.atPose3(X(0)).rotation().yaw() + np.array(
        [0.0, 1.0, np.pi - 0.01, 0.01 - np.pi]
    ):
        yield (
            factors.heading(
                X(0), B(0), yaw_rad + tilted.atVector(B(0))[9], 0.02, plain
            ),
            tilted,
        )
    fix = pose.translation() + rng.standard_normal(3)
    yield (
        factors.position(
            X(0), fix, np.array([0.3, -0.2, 0.5]), random_covariance(3, 0.4), plain
        ),
        values,
    )


def fixes_over_gaps(pose: gtsam.Pose3, rng: np.random.Generator) -> Made:
    """Biases of the motion, far from them, and so far that the motion turns by nearly half a turn and by more."""
    antenna = np.array([0.3, -0.2, 0.5])
    motion = some_motion(int(rng.integers(99)), 0.05)
    change = rng.standard_normal(len(motion.bias))
    turn_rad = float(np.linalg.norm(motion.D_bias[:3] @ change))
    for reach_rad in (0.0, 1e-7, 0.3, np.pi - 0.01, np.pi + 0.01):
        bias = motion.bias + reach_rad / turn_rad * change
        fix = pose.translation() + rng.standard_normal(3)
        cov = random_covariance(3, 0.4)
        factor = factors.position_with_biases(
            (X(0), B(0)), fix, motion, antenna, cov, plain
        )
        yield factor, values_of(X0=pose, B0=bias)


@pytest.mark.parametrize(
    "made_at",
    [beginnings, odometries, sightings, attitudes_and_heights, fixes_over_gaps],
)
@poses
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=5)
def test_derivatives_are_those_of_differences(
    made_at,
    pose,
    seed,
):
    for factor, values in made_at(pose, np.random.default_rng(seed)):
        check_jacobians(factor, values)
        assert np.allclose(
            factor.linearize(values).jacobian()[1],
            -factor.whitenedError(values),
            rtol=1e-9,
        )


@poses
@given(
    azimuth=st.floats(-1.13, 1.13),
    elevation=st.floats(-0.12, 0.12),
    range_m=st.floats(0.5, 15),
)
@settings(max_examples=15)
def test_a_sighting_is_range_and_azimuth_whatever_the_elevation(
    pose, azimuth, elevation, range_m
):
    """Errors in sigmas are (predicted - measured) / sigma; azimuth's by half a per cent less at the fan's edge."""
    off = np.array([0.03, np.radians(1.0)])
    shrunk = elevation / np.tan(elevation) if elevation else 1.0
    z = np.array([range_m, azimuth]) - off
    values = values_of(X0=pose, L0=seen_from(pose, azimuth, elevation, range_m))
    camera, distance = factors.landmark_sighting(
        X(0), L(0), BODY_T_SONAR, z, np.diag(SIGMA**2), plain
    ).values()
    across, up = camera.whitenedError(values)
    assert across == pytest.approx(off[1] / SIGMA[1] * shrunk, rel=1.1e-4)
    assert distance.whitenedError(values) == pytest.approx(off[:1] / SIGMA[0], rel=1e-6)
    assert abs(up) < 1e-3


def test_without_an_elevation_a_sighting_says_next_to_nothing_about_it():
    """Information along the unmeasured direction is under a millionth of that across it; with a sigma, it is there."""
    pose = POSES["random"]
    point = seen_from(pose, 0.2, 0.05, 2.0)
    upwards = seen_from(pose, 0.2, 0.05 + 1e-6, 2.0) - point
    upwards /= np.linalg.norm(upwards)
    values = values_of(X0=pose, L0=point)
    z = np.array([2.0, 0.2])
    cov = np.diag(SIGMA**2)
    silent, told = (
        information(
            factors.landmark_sighting(
                X(0), L(0), BODY_T_SONAR, z, cov, plain, s
            ).values(),
            values,
            [L(0), X(0)],
        )[:3, :3]
        for s in (None, 0.07)
    )
    assert upwards @ silent @ upwards < 1e-6
    assert upwards @ told @ upwards == pytest.approx(1 / (2.0 * 0.07) ** 2, rel=0.02)
    assert np.sort(np.linalg.eigvalsh(silent))[1:] == pytest.approx(
        [1 / 0.02**2, 1 / (0.009 * 2) ** 2], rel=0.02
    )


@poses
@given(roll=st.floats(-0.3, 0.3), pitch=st.floats(-0.3, 0.3))
@settings(max_examples=10)
def test_gravity_direction_weighs_the_tilt_and_leaves_the_yaw(pose, roll, pitch):
    up_in_body = pose.rotation().matrix()[2]
    factor = factors.gravity_direction(X(0), 9.8 * up_in_body, 0.01)
    yawed = gtsam.Rot3.Rz(1.3).compose(pose.rotation())
    tilted = yawed.compose(gtsam.Rot3.RzRyRx(roll, pitch, 0))
    for found, expected in ((yawed, 0.0), (tilted, tilted.matrix()[2] - up_in_body)):
        values = values_of(X0=gtsam.Pose3(found, pose.translation()))
        assert np.linalg.norm(factor.whitenedError(values)) == pytest.approx(
            np.linalg.norm(expected) / 0.01, abs=1e-5
        )


@poses
def test_a_gravity_direction_that_does_not_fit_leaves_the_yaw_free(pose):
    """GTSAM's factor with both directions in the world has the residual's square."""
    sigma = 0.01
    up_in_body = pose.rotation().matrix().T @ [0, 0, 1.0]
    tilted = values_of(
        X0=pose.compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.03, 0.04, 0), np.zeros(3)))
    )
    vertical = np.concatenate(
        [tilted.atPose3(X(0)).rotation().matrix().T @ [0, 0, 1.0], np.zeros(3)]
    )
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    in_world = gtsam.AttitudeFactorPose3(
        X(0), gtsam.Unit3(np.array([0, 0, 1.0])), noise, gtsam.Unit3(up_in_body)
    )
    of_yaw = [
        vertical @ information([factor], tilted, [X(0)]) @ vertical
        for factor in (factors.gravity_direction(X(0), up_in_body, sigma), in_world)
    ]
    squared = 2 * in_world.error(tilted)
    assert squared > 10
    assert of_yaw == pytest.approx([0.0, squared], rel=0.01, abs=1e-9)


def test_the_plane_holds_height_roll_and_pitch_and_leaves_the_rest():
    pose = gtsam.Pose3(gtsam.Rot3.Rz(2.0), np.array([5.0, -3.0, 0.4]))
    said = information(factors.planar(X(0), PLANE).values(), values_of(X0=pose), [X(0)])
    assert np.diag(said) == pytest.approx([2500, 2500, 0, 0, 0, 1e4], abs=1e-6)
    off = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.02, 2.0), [5.0, -3.0, 0.43])
    graph = graph_of(factors.planar(X(0), PLANE).values())
    assert graph.error(values_of(X0=off)) == pytest.approx(4.5 + 0.5, rel=1e-4)


def assert_is_each_of(made, stack, values: gtsam.Values) -> None:
    """Errors and linearisations of a stack are those of its factors one by one."""
    assert stack.error(values) == pytest.approx(
        sum(factor.error(values) for factor in made), rel=1e-12
    )
    for found, factor in zip(stack.linear_factors(values), made, strict=True):
        mine = found.augmentedInformation()
        theirs = factor.linearize(values).augmentedInformation()
        assert mine == pytest.approx(theirs, rel=1e-9, abs=1e-9 * np.abs(theirs).max())


def test_correlated_sightings_together_are_what_each_is():
    """Under no kernel and two others, wherever the landmarks lie about the sonars."""
    rng = np.random.default_rng(6)
    values = gtsam.Values()
    made = []
    kernels = [
        plain,
        RobustKernel(shape="huber").robust(),
        RobustKernel(shape="cauchy").robust(),
    ]
    for k in range(5):
        values.insert(X(k), gtsam.Pose3.Expmap(rng.standard_normal(6)))
        values.insert(L(k), 3.0 * rng.standard_normal(3))
    for k in range(60):
        body_T_sonar = gtsam.Pose3.Expmap(rng.standard_normal(6))
        half = 0.1 * rng.standard_normal((2, 2))
        z = rng.uniform((1.0, -3.0), (5.0, 3.0))
        cov = half @ half.T + 1e-3 * np.eye(2)
        keys = X(int(rng.integers(5))), L(int(rng.integers(5)))
        made.append(
            factors.CorrelatedSighting(
                *keys, body_T_sonar, z, kernels[k % 3](factors.gaussian(cov))
            )
        )
    assert_is_each_of(made, SightingStack(made), values)


def test_odometry_factors_together_are_what_each_is():
    """Errors and derivatives, of small and large residuals and corrections, with poses and biases in common."""
    rng = np.random.default_rng(5)
    values = gtsam.Values()
    made = []
    for b in range(3):
        values.insert(B(b), 0.3 * rng.standard_normal(11))
    for k in range(40):
        spread = 10.0 ** rng.uniform(-6, 0.3)
        motion = some_motion(k, 0.05)
        values.insert(X(k), gtsam.Pose3.Expmap(rng.standard_normal(6)))
        if k % 2:
            X_j = values.atPose3(X(k - 1)).compose(
                motion.corrected(values.atVector(B(k % 3)))
            )
            values.update(
                X(k), X_j.compose(gtsam.Pose3.Expmap(spread * rng.standard_normal(6)))
            )
        if k:
            up = values.atPose3(X(k)).rotation().matrix()[2] if k % 3 else np.zeros(3)
            made.append(OdometryWithBias(X(k - 1), X(k), B(k % 3), motion, up))
    assert_is_each_of(made, OdometryStack(made), values)
