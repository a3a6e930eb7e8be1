"""A signal against itself, shifted and with noise: truth, and its textbook uncertainty, are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2

from sonar_graph.navigation.alignment.time_offset import Estimate1D, OffsetFit, SampleSeries, _doubt, search_offset

T_S, NOISE = np.arange(200.0), 0.01
NOTHING, STEADY = np.empty((len(T_S) - 1, 3, 0)), np.tile(np.eye(3), (len(T_S) - 1, 1, 1))
NONE = np.empty(0)


def swaying(t_s: np.ndarray) -> np.ndarray:
    return np.column_stack([np.sin(0.31 * t_s + 0.002 * t_s**2), np.cos(0.23 * t_s + 0.003 * t_s**2), 0.2 * t_s])


def turning_every_second(t_s: np.ndarray) -> np.ndarray:
    return np.column_stack([np.sin(2 * np.pi * t_s), np.cos(2 * np.pi * t_s), 0 * t_s])


def searched(signal: Callable[[np.ndarray], np.ndarray], offset_s: float, seed: int = 0) -> OffsetFit:
    measured = signal(T_S + offset_s) + NOISE * np.random.default_rng(seed).standard_normal((len(T_S), 3))

    def line_up(at_s: float) -> list[SampleSeries]:
        y = np.diff(signal(T_S + at_s) - measured, axis=0)
        return [SampleSeries(y, NOTHING, STEADY, np.diff(T_S))]

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


@pytest.mark.slow
def test_errors_spread_as_sigma_says():
    found = [searched(swaying, 0.25, seed).offset() for seed in range(20)]
    errors = np.array([(f.value - 0.25) / f.sigma for f in found])
    assert 0.65 < np.sqrt(np.mean(errors**2)) < 1.4


def test_an_offset_outside_the_range_cannot_be_told():
    assert "no best offset within" in searched(swaying, 2.6).reason


def test_a_motion_that_repeats_cannot_tell():
    assert "fit as well" in searched(turning_every_second, 0.3).reason


@pytest.mark.parametrize("offset_s", [-1.93, 1.94])
def test_the_range_ends_at_two_seconds(offset_s):
    found = searched(swaying, offset_s).offset()
    assert found.is_known
    assert found.value == pytest.approx(offset_s, abs=0.01)
    assert "no best offset within ±2 s" in searched(swaying, 1.35 * offset_s).reason


def test_a_motion_that_repeats_is_named_with_two_of_its_places():
    reason = searched(lambda t_s: turning_every_second(t_s / 1.2), 0.3).reason
    one, other = (float(part.split(" s")[0]) for part in reason.split(" and "))
    assert one != other
    assert {one, other} <= {-0.9, 0.3, 1.5}


GRID_S = np.arange(-20, 21) / 10


@pytest.mark.parametrize(
    ("at", "worse", "is_rival"),
    [
        (0.8, 15.0, True),
        (0.8, 17.0, False),  # four sigmas
        (-0.4, 15.0, True),
        (0.5, 15.0, False),  # a neighbour
        (2.0, 15.0, True),
        (-2.0, 15.0, True),
    ],
)
def test_another_place_within_four_sigmas_of_the_best_is_a_rival(at, worse, is_rival):
    misfit = 500.0 * np.abs(GRID_S - 0.3) + 100.0
    misfit[np.argmin(np.abs(GRID_S - at))] = 100.0 + worse
    reason = _doubt(GRID_S, misfit, int(np.argmin(misfit)))
    assert reason == (f"+0.3 s and {at:+.1f} s fit as well: too little changes in the motion" if is_rival else "")


def test_what_is_too_unsure_is_not_known_and_keeps_the_first_reason():
    assert Estimate1D(1.0, 0.2).limited(0.2, "too little") == Estimate1D(1.0, 0.2)
    assert Estimate1D(1.0, 0.3).limited(0.2, "too little") == Estimate1D(1.0, 0.3, "too little")
    assert Estimate1D(1.0, 0.1, "no motion").limited(0.2, "too little") == Estimate1D(1.0, 0.1, "no motion")
    assert Estimate1D(1.0, 0.3, "no motion").limited(0.2, "too little") == Estimate1D(1.0, 0.3, "no motion")


SCALE, SCALE_SIGMA = 0.04, 1.0


def scaled(offset_s: float, noise: float, seed: int) -> OffsetFit:
    """A signal that is longer too, by a factor that is common to all."""
    measured = (1 + SCALE) * swaying(T_S + offset_s)
    measured = measured + noise * np.random.default_rng(seed).standard_normal(measured.shape)

    def line_up(at_s: float) -> list[SampleSeries]:
        signal = swaying(T_S + at_s)
        return [
            SampleSeries(np.diff(measured - signal, axis=0), np.diff(signal, axis=0)[:, :, None], STEADY, np.diff(T_S))
        ]

    return search_offset(line_up, np.array([SCALE_SIGMA]))


def textbook_covariance(offset_s: float, noise: float) -> np.ndarray:
    """Of offset and scale together, from the samples, each with its own constant and slope."""
    by_offset = (1 + SCALE) * (swaying(T_S + offset_s + 1e-4) - swaying(T_S + offset_s - 1e-4)) / 2e-4
    own, columns = np.vander(T_S, 2), np.stack([by_offset, swaying(T_S + offset_s)])
    left = np.array([(c - own @ np.linalg.lstsq(own, c, rcond=None)[0]).ravel() for c in columns])
    return noise**2 * np.linalg.inv(left @ left.T)


def test_a_common_parameter_is_found_beside_the_offset():
    """Both errors together are what the textbook's covariance, which is that of the fit, says of them."""
    truth, squares = textbook_covariance(0.25, 0.05), []
    size = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    for seed in range(6):
        found = scaled(0.25, 0.05, seed)
        error = np.array([found.offset_s - 0.25, found.fit.parameters[1] - SCALE])
        squares.append(error @ np.linalg.solve(truth, error))
        assert found.fit.covariance / size == pytest.approx(truth / size, abs=0.3)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(squares))
    assert low < np.sum(squares) < high


def test_without_noise_offset_and_scale_are_what_was_put_in():
    found = scaled(-0.347, 1e-6, 0)
    assert found.offset_s == pytest.approx(-0.347, abs=1e-5)
    assert found.fit.parameters[1] == pytest.approx(SCALE, abs=1e-5)


def test_where_nothing_tells_the_offset_stays_in_the_range():
    """Noise alone: steps far beyond the range would be as good as any."""
    for seed in range(2):
        found = searched(lambda t_s: 1e-6 * swaying(t_s), 0.3, seed)
        assert abs(found.offset_s) <= 2.2
        assert found.reason
