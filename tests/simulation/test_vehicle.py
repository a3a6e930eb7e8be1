"""The truth is one curve: rates, accelerations and attitude must belong to the same motion."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson

from sonar_graph.simulation.vehicle import VehiclePath, rotation_from_rpy, rpy_from_rotation, smooth_noise

SECONDS = np.linspace(0, 10, 41)


def lively_path(seed: int = 3) -> VehiclePath:
    rng = np.random.default_rng(seed)
    wander = smooth_noise(SECONDS, np.array([1.0, 1.0, 1.0, 0.6, 0.6, 1.5]), 2.0, 6, rng)
    return VehiclePath.through(SECONDS, wander)


def test_path_goes_through_the_poses_it_was_given():
    rng = np.random.default_rng(0)
    poses = smooth_noise(SECONDS, 0.3, 3.0, 6, rng)
    at = VehiclePath.through(SECONDS, poses).at(SECONDS)
    np.testing.assert_allclose(at.position, poses[:, :3], atol=1e-12)
    np.testing.assert_allclose(rpy_from_rotation(at.world_R_body), poses[:, 3:], atol=1e-12)


@pytest.mark.parametrize(("integral", "rate"), [("position", "velocity"), ("velocity", "acceleration")])
def test_rates_integrate_to_what_they_are_rates_of(integral: str, rate: str):
    fine = np.linspace(0, 10, 20_001)
    at = lively_path().at(fine)
    change = cumulative_simpson(getattr(at, rate), x=fine, axis=0, initial=0)
    np.testing.assert_allclose(change, getattr(at, integral) - getattr(at, integral)[0], atol=1e-8)


def test_angular_velocity_integrates_to_attitude():
    step = 1e-3
    middle = np.arange(step / 2, 10, step)
    path = lively_path()
    ends = path.at(np.array([0.0, 10.0])).world_R_body.as_matrix()
    attitude = gtsam.Rot3(ends[0])
    for omega in path.at(middle).angular_velocity:
        attitude = attitude * gtsam.Rot3.Expmap(omega * step)
    assert np.linalg.norm(gtsam.Rot3.Logmap(attitude.between(gtsam.Rot3(ends[1])))) < 1e-5
    assert np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3(ends[0]).between(gtsam.Rot3(ends[1])))) > 0.1


def test_angular_acceleration_is_the_derivative_of_angular_velocity():
    middle, step = np.linspace(1, 9, 57), 1e-4
    path = lively_path()
    slope = (path.at(middle + step).angular_velocity - path.at(middle - step).angular_velocity) / (2 * step)
    np.testing.assert_allclose(path.at(middle).angular_acceleration, slope, atol=1e-5)


@given(st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1)))
def test_roll_pitch_yaw_means_the_same_as_in_the_calibration(rpy: tuple[float, float, float]):
    rotation = rotation_from_rpy(np.array(rpy))
    np.testing.assert_allclose(rotation.as_matrix(), gtsam.Rot3.RzRyRx(*rpy).matrix(), atol=1e-12)
    np.testing.assert_allclose(rpy_from_rotation(rotation), rpy, atol=1e-6)


def test_positive_pitch_lowers_the_nose():
    nose = rotation_from_rpy(np.array([0.0, 0.5, 0.0])).apply([1.0, 0.0, 0.0])
    assert nose[2] < 0


def test_smooth_noise_is_as_large_as_it_says_and_smooth():
    seconds = np.linspace(0, 20_000, 200_001)
    curves = smooth_noise(seconds, np.array([1.0, 3.0]), 5.0, 2, np.random.default_rng(1))
    np.testing.assert_allclose(curves.std(axis=0), [0.66, 1.98], rtol=0.08)
    second = np.diff(curves, 2, axis=0) / 0.1**2
    assert np.abs(np.diff(second, axis=0)).max() < 0.1 * np.abs(second).max()
