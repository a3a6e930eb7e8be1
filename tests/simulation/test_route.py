"""Intended motions go where they say, in the time they say, without jerks."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.simulation.vehicle import drive, follow, hover, turn

START = (1.0, -2.0, 0.5)


@given(st.floats(0.1, 20), st.floats(0.05, 1), st.floats(0.5, 5))
def test_drive_ends_its_length_ahead(length_m: float, speed_m_s: float, ramp_s: float):
    piece = drive(START, length_m, speed_m_s, ramp_s)
    end = follow(START, [piece], np.array([0.0, piece.duration_s, piece.duration_s + 5]))
    ahead = np.array([math.cos(0.5), math.sin(0.5)]) * length_m
    np.testing.assert_allclose(end[0], START, atol=1e-12)
    np.testing.assert_allclose(end[1:, :2], np.tile(START[:2] + ahead, (2, 1)), atol=1e-9)
    np.testing.assert_allclose(end[:, 2], 0.5, atol=1e-12)


def test_drive_cruises_at_its_speed_and_accelerates_no_more_than_stated():
    piece = drive((0.0, 0.0, 0.0), 3.0, 0.15, 3.0)
    seconds = np.linspace(0, piece.duration_s, 23_001)
    x = follow((0.0, 0.0, 0.0), [piece], seconds)[:, 0]
    step = seconds[1]
    speed, acceleration = np.diff(x) / step, np.diff(x, 2) / step**2
    np.testing.assert_allclose(speed[5000:15000], 0.15, rtol=1e-6)
    assert speed.min() > -1e-9
    assert np.abs(acceleration).max() == pytest.approx(1.5 * 0.15 / 3.0, rel=1e-3)


def test_pieces_follow_each_other():
    first = drive((0.0, 0.0, 0.0), 2.0, 0.5, 1.0)
    second = turn(first.goal, -math.pi / 2, 4.0)
    third = hover(second.goal, 0.0)
    fourth = drive(third.goal, 1.0, 0.5, 1.0)
    pieces = [first, second, third, fourth]
    until = np.cumsum([p.duration_s for p in pieces])
    poses = follow((0.0, 0.0, 0.0), pieces, until)
    expected = [[2, 0, 0], [2, 0, -math.pi / 2], [2, 0, -math.pi / 2], [2, -1, -math.pi / 2]]
    np.testing.assert_allclose(poses, expected, atol=1e-12)


def test_hover_stays():
    still = follow(START, [hover(START, 30.0)], np.linspace(0, 30, 7))
    np.testing.assert_array_equal(still, np.tile(START, (7, 1)))
