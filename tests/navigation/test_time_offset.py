"""The fit against textbook generalised least squares, and the search on a signal against itself, shifted and noisy."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import block_diag

from sonar_graph.navigation.alignment.time_offset import (
    LeastSquaresFit,
    NormalEquations,
    OffsetFit,
    SampleSeries,
    fit,
    grouped,
    search_offset,
)

Signal = Callable[[np.ndarray], np.ndarray]

RATIOS = np.array([0.3, 0.02])
WIDE = np.array([1e4, 1e4])


def stretch_of(seed: int, walks: tuple[bool, bool, bool]) -> SampleSeries:
    rng = np.random.default_rng(seed)
    m = 20
    y = rng.standard_normal((m, 3))
    A = rng.standard_normal((m, 3, 2))
    return SampleSeries(y, A, np.tile(np.eye(3), (m, 1, 1)), np.ones(m), walks)


def dense_covariance(
    m: int, walks: bool, ratios: np.ndarray = RATIOS, duration_s: float = 1.0
) -> np.ndarray:
    """Of differences of white samples, plus a rate's white noise, plus the walk of a rate from the beginning."""
    difference = np.diff(np.eye(m + 1), axis=0)
    middle = duration_s * (np.arange(m) + 0.5)
    walk = duration_s**2 * np.minimum.outer(middle, middle)
    return (
        difference @ difference.T
        + ratios[0] * duration_s * np.eye(m)
        + ratios[1] * walk * walks
    )


def by_axis(matrices: np.ndarray) -> np.ndarray:
    """Rows of three axes, axis by axis."""
    return matrices.transpose(1, 0, 2).reshape(3 * len(matrices), -1)


def one_problem(stretches: list[SampleSeries]) -> tuple[np.ndarray, np.ndarray]:
    """Columns and right-hand side of all stretches at once, each one's own parameters as columns."""
    A = np.concatenate([by_axis(s.A) for s in stretches])
    columns = np.hstack([A, block_diag(*[by_axis(s.B) for s in stretches])])
    return columns, np.concatenate([s.y.T.ravel() for s in stretches])


def textbook(stretches: list[SampleSeries]) -> tuple[np.ndarray, np.ndarray]:
    """Common parameters and their covariance."""
    columns, y = one_problem(stretches)
    m = len(stretches[0].y)
    weight = np.linalg.inv(
        block_diag(
            *[dense_covariance(m, walks) for s in stretches for walks in s.walks]
        )
    )
    information = columns.T @ weight @ columns
    found = np.linalg.solve(information, columns.T @ weight @ y)
    left = y - columns @ found
    variance = left @ weight @ left / (len(y) - columns.shape[1])
    return found[:2], variance * np.linalg.inv(information)[:2, :2]


@pytest.mark.parametrize(
    "walks", [(True, True, True), (True, True, False), (False, False, False)]
)
def test_fit_is_generalised_least_squares_with_walking_axes(walks):
    stretches = [stretch_of(seed, walks) for seed in range(4)]
    parameters, covariance = textbook(stretches)
    found = fit(stretches, WIDE, RATIOS)
    assert found.parameters == pytest.approx(parameters, rel=1e-6)
    assert found.covariance == pytest.approx(covariance, rel=1e-6)


def noisy_stretch(
    rng: np.random.Generator, ratios: tuple[float, float], duration_s: float = 1.0
) -> SampleSeries:
    """Samples of sigma 0.1, a rate's white noise and its walk, with a constant as the stretch's own parameter."""
    m = 20
    middle = duration_s * (np.arange(m) + 0.5)
    walk = np.linalg.cholesky(np.minimum.outer(middle, middle))
    y = np.diff(rng.standard_normal((m + 1, 3)), axis=0)
    y = y + np.sqrt(ratios[0] * duration_s) * rng.standard_normal((m, 3))
    y = y + np.sqrt(ratios[1]) * duration_s * walk @ rng.standard_normal((m, 3))
    own = duration_s * np.tile(np.eye(3), (m, 1, 1))
    return SampleSeries(
        0.1 * y, rng.standard_normal((m, 3, 2)), own, np.full(m, duration_s)
    )


def restricted_likelihood(stretches: list[SampleSeries], ratios: np.ndarray) -> float:
    """``-2 log L`` but for a constant: Harville's formula with one dense covariance of everything."""
    one = dense_covariance(
        len(stretches[0].y), True, ratios, float(stretches[0].duration_s[0])
    )
    K = block_diag(*[one] * (3 * len(stretches)))
    X, y = one_problem(stretches)
    weight = np.linalg.inv(K)
    left = y - X @ np.linalg.solve(X.T @ weight @ X, X.T @ weight @ y)
    determinants = np.linalg.slogdet(K)[1] + np.linalg.slogdet(X.T @ weight @ X)[1]
    return float((len(y) - X.shape[1]) * np.log(left @ weight @ left) + determinants)


def test_the_ratios_maximise_the_restricted_likelihood():
    rng = np.random.default_rng(3)
    stretches = [noisy_stretch(rng, (0.8, 0.3), 0.5) for _ in range(4)]
    tried = [
        np.array(ratios) for ratios in ((0.8, 0.3), (0.2, 0.3), (0.8, 0.02), (3.0, 1.0))
    ]
    ours = [
        NormalEquations.of(grouped(stretches), ratios).criterion(WIDE)
        for ratios in tried
    ]
    assert np.diff(ours) == pytest.approx(
        np.diff([restricted_likelihood(stretches, r) for r in tried]), rel=1e-6
    )
    stretches = [noisy_stretch(rng, (0.8, 0.3)) for _ in range(12)]
    found = fit(stretches, WIDE).ratios
    for step in (
        (1.5, 1.0),
        (1 / 1.5, 1.0),
        (1.0, 1.5),
        (1.0, 1 / 1.5),
        (1.3, 1.3),
        (1 / 1.3, 1.3),
    ):
        assert restricted_likelihood(stretches, found * step) > restricted_likelihood(
            stretches, found
        )


T_S = np.arange(200.0)
NOISE = 0.01
NOTHING = np.empty((len(T_S) - 1, 3, 0))
STEADY = np.tile(np.eye(3), (len(T_S) - 1, 1, 1))


def searched(signal: Signal, offset_s: float) -> OffsetFit:
    measured = signal(T_S + offset_s)
    noise = np.random.default_rng(0).standard_normal(measured.shape)
    measured = measured + NOISE * noise

    def line_up(at_s: float) -> list[SampleSeries]:
        y = np.diff(measured - signal(T_S + at_s), axis=0)
        return [SampleSeries(y, NOTHING, STEADY, np.diff(T_S))]

    return search_offset(line_up, np.ones(0))


def swaying(t_s: np.ndarray) -> np.ndarray:
    return np.column_stack(
        [
            np.sin(0.31 * t_s + 0.002 * t_s**2),
            np.cos(0.23 * t_s + 0.003 * t_s**2),
            0.2 * t_s,
        ]
    )


def textbook_sigma(offset_s: float) -> float:
    """Of the offset: white noise on samples, whose own constant and slope are fitted too."""
    slope = (swaying(T_S + offset_s + 1e-4) - swaying(T_S + offset_s - 1e-4)) / 2e-4
    own = np.vander(T_S, 2)
    left = slope - own @ np.linalg.lstsq(own, slope, rcond=None)[0]
    return NOISE / float(np.linalg.norm(left))


@pytest.mark.parametrize("offset_s", [-0.43, 0.2, 0.25, 1.36])
def test_sigma_is_the_textbooks_between_grid_points_too(offset_s):
    found = searched(swaying, offset_s).offset()
    assert found.is_known
    assert found.sigma == pytest.approx(textbook_sigma(offset_s), rel=0.15)
    assert abs(found.value - offset_s) < 4 * found.sigma


@pytest.mark.parametrize("valley_s", [0.02, 0.11])
def test_a_hollow_in_a_valley_has_the_sigma_of_the_valley(valley_s):
    """Offsets nearby that fit nearly as well widen it; what the other parameters owe to the offset grows alike."""
    P = np.array([[0.03**2, 0.02 * 0.03**2], [0.02 * 0.03**2, 0.05**2]])
    hollow = OffsetFit(LeastSquaresFit(np.zeros(2), P, 1.0, 1.0, RATIOS), 0.0, "")
    grid = np.linspace(-2.0, 2.0, 41)
    wide = hollow.widened(grid, (grid / valley_s) ** 2).covariance
    assert np.sqrt(wide[0, 0]) == pytest.approx(max(0.03, valley_s))
    assert wide[0, 1] / wide[0, 0] == pytest.approx(P[0, 1] / P[0, 0])
    given_offset = [C[1, 1] - C[0, 1] ** 2 / C[0, 0] for C in (P, wide)]
    assert given_offset[1] == pytest.approx(given_offset[0])


@pytest.mark.parametrize("offset_s", [-1.93, 1.94])
def test_the_range_ends_at_two_seconds(offset_s):
    found = searched(swaying, offset_s).offset()
    assert found.is_known
    assert found.value == pytest.approx(offset_s, abs=0.01)
    assert "no best offset within ±2 s" in searched(swaying, 1.35 * offset_s).reason
