"""The truth is one curve: rates, accelerations and attitude must belong to the same motion."""

import numpy as np
import pytest

from sonar_graph.simulation.vehicle import (
    drive,
    follow,
    smooth_noise,
)


def test_smooth_noise_is_as_large_as_it_says_and_smooth():
    seconds = np.linspace(0, 20_000, 200_001)
    curves = smooth_noise(
        seconds, np.array([1.0, 3.0]), 5.0, 2, np.random.default_rng(1)
    )
    np.testing.assert_allclose(curves.std(axis=0), [0.66, 1.98], rtol=0.08)
    second = np.diff(curves, 2, axis=0) / 0.1**2
    assert np.abs(np.diff(second, axis=0)).max() < 0.1 * np.abs(second).max()


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
