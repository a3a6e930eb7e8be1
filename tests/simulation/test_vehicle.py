"""The truth is one curve: rates, accelerations and attitude must belong to the same motion."""

import math

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson

from sonar_graph.simulation.vehicle import (
    VehiclePath,
    drive,
    follow,
    hover,
    rpy_from_rotation,
    smooth_noise,
    turn,
)

SECONDS = np.linspace(0, 10, 41)
WANDER = smooth_noise(
    SECONDS, np.array([1.0, 1.0, 1.0, 0.6, 0.6, 1.5]), 2.0, 6, np.random.default_rng(3)
)
PATH = VehiclePath.through(SECONDS, WANDER)


def test_path_goes_through_the_poses_it_was_given():
    at = PATH.at(SECONDS)
    np.testing.assert_allclose(at.position, WANDER[:, :3], atol=1e-12)
    np.testing.assert_allclose(
        np.unwrap(rpy_from_rotation(at.world_R_body), axis=0), WANDER[:, 3:], atol=1e-12
    )


def test_rates_integrate_to_what_they_are_rates_of():
    fine = np.linspace(0, 10, 20_001)
    at = PATH.at(fine)
    for integral, rate in (
        (at.position, at.velocity),
        (at.velocity, at.acceleration),
        (at.angular_velocity, at.angular_acceleration),
    ):
        change = cumulative_simpson(rate, x=fine, axis=0, initial=0)
        np.testing.assert_allclose(change, integral - integral[0], atol=1e-8)


def test_angular_velocity_integrates_to_attitude():
    step = 1e-3
    begin, end = (
        gtsam.Rot3(R) for R in PATH.at(np.array([0.0, 10.0])).world_R_body.as_matrix()
    )
    attitude = begin
    for omega in PATH.at(np.arange(step / 2, 10, step)).angular_velocity:
        attitude = attitude * gtsam.Rot3.Expmap(omega * step)
    assert np.linalg.norm(gtsam.Rot3.Logmap(attitude.between(end))) < 1e-5
    assert np.linalg.norm(gtsam.Rot3.Logmap(begin.between(end))) > 0.1


def test_smooth_noise_is_as_large_as_it_says_and_smooth():
    seconds = np.linspace(0, 20_000, 200_001)
    curves = smooth_noise(
        seconds, np.array([1.0, 3.0]), 5.0, 2, np.random.default_rng(1)
    )
    np.testing.assert_allclose(curves.std(axis=0), [0.66, 1.98], rtol=0.08)
    second = np.diff(curves, 2, axis=0) / 0.1**2
    assert np.abs(np.diff(second, axis=0)).max() < 0.1 * np.abs(second).max()


START = (1.0, -2.0, 0.5)


@given(st.floats(0.1, 20), st.floats(0.05, 1), st.floats(0.5, 5))
def test_drive_ends_its_length_ahead(length_m: float, speed_m_s: float, ramp_s: float):
    piece = drive(START, length_m, speed_m_s, ramp_s)
    end = follow(
        START, [piece], np.array([0.0, piece.duration_s, piece.duration_s + 5])
    )
    ahead = np.array([math.cos(0.5), math.sin(0.5)]) * length_m
    np.testing.assert_allclose(end[0], START, atol=1e-12)
    np.testing.assert_allclose(
        end[1:, :2], np.tile(START[:2] + ahead, (2, 1)), atol=1e-9
    )
    np.testing.assert_allclose(end[:, 2], 0.5, atol=1e-12)


def test_drive_cruises_at_its_speed_and_accelerates_no_more_than_stated():
    piece = drive((0.0, 0.0, 0.0), 3.0, 0.15, 3.0)
    seconds = np.linspace(0, piece.duration_s, 23_001)
    x = follow((0.0, 0.0, 0.0), [piece], seconds)[:, 0]
    step = seconds[1]
    speed = np.diff(x) / step
    acceleration = np.diff(x, 2) / step**2
    np.testing.assert_allclose(speed[5000:15000], 0.15, rtol=1e-6)
    assert speed.min() > -1e-9
    assert np.abs(acceleration).max() == pytest.approx(1.5 * 0.15 / 3.0, rel=1e-3)


def test_legs_follow_each_other_and_a_hover_stays():
    first = drive((0.0, 0.0, 0.0), 2.0, 0.5, 1.0)
    second = turn(first.goal, -math.pi / 2, 4.0)
    third = hover(second.goal, 30.0)
    legs = [first, second, third, drive(third.goal, 1.0, 0.5, 1.0)]
    poses = follow((0.0, 0.0, 0.0), legs, np.cumsum([leg.duration_s for leg in legs]))
    expected = [
        [2, 0, 0],
        [2, 0, -math.pi / 2],
        [2, 0, -math.pi / 2],
        [2, -1, -math.pi / 2],
    ]
    np.testing.assert_allclose(poses, expected, atol=1e-12)
