"""A signal against itself, shifted and with noise: truth, and its textbook uncertainty, are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sonar_graph.navigation.differenced_fit import Stretch
from sonar_graph.navigation.offset_search import OffsetFit, search_offset

T_S, NOISE = np.arange(200.0), 0.01
NOTHING, STEADY = np.empty((len(T_S) - 1, 3, 0)), np.tile(np.eye(3), (len(T_S) - 1, 1, 1))
NONE = np.empty(0)


def swaying(t_s: np.ndarray) -> np.ndarray:
    return np.column_stack([np.sin(0.31 * t_s + 0.002 * t_s**2), np.cos(0.23 * t_s + 0.003 * t_s**2), 0.2 * t_s])


def turning_every_second(t_s: np.ndarray) -> np.ndarray:
    return np.column_stack([np.sin(2 * np.pi * t_s), np.cos(2 * np.pi * t_s), 0 * t_s])


def searched(signal: Callable[[np.ndarray], np.ndarray], offset_s: float, seed: int = 0) -> OffsetFit:
    measured = signal(T_S + offset_s) + NOISE * np.random.default_rng(seed).standard_normal((len(T_S), 3))

    def line_up(at_s: float) -> list[Stretch]:
        y = np.diff(signal(T_S + at_s) - measured, axis=0)
        return [Stretch(y, NOTHING, STEADY, np.diff(T_S))]

    return search_offset(line_up, NONE)


def textbook_sigma(offset_s: float) -> float:
    """White noise on samples: their own constant and slope, alike to a constant in the differences, are fitted too."""
    slope = (swaying(T_S + offset_s + 1e-4) - swaying(T_S + offset_s - 1e-4)) / 2e-4
    own = np.vander(T_S, 2)
    left = slope - own @ np.linalg.lstsq(own, slope, rcond=None)[0]
    return float(NOISE / np.sqrt(np.sum(left**2)))


@pytest.mark.parametrize("offset_s", [-0.43, 0.2, 0.25, 1.36])
def test_sigma_is_the_textbooks_wherever_the_offset_lies_between_grid_points(offset_s):
    found = searched(swaying, offset_s).offset()
    assert found.is_known
    assert found.sigma == pytest.approx(textbook_sigma(offset_s), rel=0.15)
    assert abs(found.value - offset_s) < 4 * found.sigma


def test_errors_spread_as_sigma_says():
    found = [searched(swaying, 0.25, seed).offset() for seed in range(20)]
    errors = np.array([(f.value - 0.25) / f.sigma for f in found])
    assert 0.65 < np.sqrt(np.mean(errors**2)) < 1.4


def test_an_offset_outside_the_range_cannot_be_told():
    assert "no best offset within" in searched(swaying, 2.6).reason


def test_a_motion_that_repeats_cannot_tell():
    assert "fit as well" in searched(turning_every_second, 0.3).reason
