"""The fit against textbook generalised least squares with the dense covariance, written down anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from sonar_graph.navigation.alignment.time_offset import SampleSeries, _Reduced, fit, rate_noise_power

RATIOS = np.array([0.3, 0.02])
WIDE = np.array([1e4, 1e4])


def stretch_of(seed: int, walks: tuple[bool, bool, bool]) -> SampleSeries:
    rng = np.random.default_rng(seed)
    m = 20
    return SampleSeries(
        rng.standard_normal((m, 3)), rng.standard_normal((m, 3, 2)), np.tile(np.eye(3), (m, 1, 1)), np.ones(m), walks
    )


def dense_covariance(m: int, walks: bool) -> np.ndarray:
    """Of differences of white samples, plus a rate's white noise, plus the walk of a rate from the beginning."""
    difference = np.diff(np.eye(m + 1), axis=0)
    walk = np.minimum.outer(np.arange(m) + 0.5, np.arange(m) + 0.5)
    return difference @ difference.T + RATIOS[0] * np.eye(m) + RATIOS[1] * walk * walks


def textbook(stretches: list[SampleSeries]) -> tuple[np.ndarray, np.ndarray]:
    """Common parameters and covariance, each stretch's own as columns of one large problem; rows axis by axis."""
    m = len(stretches[0].y)
    A = np.concatenate([s.A.transpose(1, 0, 2).reshape(3 * m, -1) for s in stretches])
    B = block_diag(*[s.B.transpose(1, 0, 2).reshape(3 * m, -1) for s in stretches])
    y = np.concatenate([s.y.T.ravel() for s in stretches])
    weight = np.linalg.inv(block_diag(*[dense_covariance(m, walks) for s in stretches for walks in s.walks]))
    columns = np.hstack([A, B])
    information = columns.T @ weight @ columns
    found = np.linalg.solve(information, columns.T @ weight @ y)
    left = y - columns @ found
    variance = left @ weight @ left / (len(y) - columns.shape[1])
    return found[:2], variance * np.linalg.inv(information)[:2, :2]


@pytest.mark.parametrize("walks", [(True, True, True), (True, True, False), (False, False, False)])
def test_fit_is_generalised_least_squares_with_a_walk_on_the_axes_that_walk(walks):
    stretches = [stretch_of(seed, walks) for seed in range(4)]
    parameters, covariance = textbook(stretches)
    found = fit(stretches, WIDE, RATIOS)
    assert found.parameters == pytest.approx(parameters, rel=1e-6)
    assert found.covariance == pytest.approx(covariance, rel=1e-6)


def test_which_axes_walk_matters():
    both = [fit([stretch_of(0, walks)], WIDE, RATIOS).parameters for walks in ((True,) * 3, (True, True, False))]
    assert np.abs(both[0] - both[1]).max() > 1e-3


def whitened_power(stretch: SampleSeries) -> float:
    """``tr(P (K - D))`` with dense matrices, rows axis by axis; D is the covariance of differences of white samples."""
    m = len(stretch.y)
    K = block_diag(*[dense_covariance(m, walks) for walks in stretch.walks])
    difference = block_diag(*[np.diff(np.eye(m + 1), axis=0)] * 3)
    B = stretch.B.transpose(1, 0, 2).reshape(3 * m, -1)
    weight = np.linalg.inv(K)
    P = weight - weight @ B @ np.linalg.inv(B.T @ weight @ B) @ B.T @ weight
    return float(np.trace(P @ (K - difference @ difference.T)))


def test_power_of_the_rates_noise_is_the_trace_with_dense_matrices():
    stretches = [stretch_of(0, (True, True, False)), stretch_of(1, (True, True, True))]
    assert rate_noise_power(stretches, RATIOS) == pytest.approx(sum(map(whitened_power, stretches)), rel=1e-9)


def test_a_column_that_holds_the_rates_noise_is_biased_by_its_power():
    """y is noise alone, its rates' part also in the only column: it takes the bias off to find nothing."""
    rng = np.random.default_rng(5)
    m, found, corrected = 20, [], []
    signal = rng.standard_normal((m, 3, 1))
    factor = np.linalg.cholesky(dense_covariance(m, True) - dense_covariance(m, False) + RATIOS[0] * np.eye(m))
    for _ in range(400):
        rates = factor @ rng.standard_normal((m, 3))
        y = np.diff(rng.standard_normal((m + 1, 3)), axis=0) + rates
        stretch = SampleSeries(y, 4 * signal + rates[:, :, None], np.tile(np.eye(3), (m, 1, 1)), np.ones(m))
        result = fit([stretch], WIDE[:1], RATIOS)
        found.append(result.parameters[0])
        corrected.append(found[-1] - result.covariance[0, 0] * rate_noise_power([stretch], RATIOS))
    of_mean = np.std(found) / np.sqrt(len(found))
    assert np.mean(found) > 8 * of_mean
    assert abs(np.mean(corrected)) < 3 * of_mean


def test_a_narrow_prior_holds_a_parameter_that_the_data_do_not_see():
    stretch = stretch_of(0, (True, True, True))
    blind = SampleSeries(stretch.y, 0 * stretch.A, stretch.B, stretch.duration_s)
    found = fit([blind], np.array([0.1, 3.0]), RATIOS)
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx([0.1, 3.0])


def noisy_stretch(rng: np.random.Generator, ratios: tuple[float, float], duration_s: float = 1.0) -> SampleSeries:
    """Samples of sigma 0.1, a rate's white noise and its walk, with a constant as the stretch's own parameter."""
    m = 20
    middle = duration_s * (np.arange(m) + 0.5)
    walk = np.linalg.cholesky(np.minimum.outer(middle, middle))
    y = np.diff(rng.standard_normal((m + 1, 3)), axis=0)
    y = y + np.sqrt(ratios[0] * duration_s) * rng.standard_normal((m, 3))
    y = y + np.sqrt(ratios[1]) * duration_s * walk @ rng.standard_normal((m, 3))
    own = duration_s * np.tile(np.eye(3), (m, 1, 1))
    return SampleSeries(0.1 * y, rng.standard_normal((m, 3, 2)), own, np.full(m, duration_s))


def restricted_likelihood(stretches: list[SampleSeries], ratios: np.ndarray) -> float:
    """``-2 log L`` but for a constant: Harville's formula with one dense covariance of everything."""
    m, n = len(stretches[0].y), len(stretches)
    duration_s = float(stretches[0].duration_s[0])
    difference, middle = np.diff(np.eye(m + 1), axis=0), duration_s * (np.arange(m) + 0.5)
    one = difference @ difference.T + ratios[0] * duration_s * np.eye(m)
    one = one + ratios[1] * duration_s**2 * np.minimum.outer(middle, middle)
    K = block_diag(*[one] * (3 * n))
    A = np.concatenate([s.A.transpose(1, 0, 2).reshape(3 * m, -1) for s in stretches])
    X = np.hstack([A, block_diag(*[s.B.transpose(1, 0, 2).reshape(3 * m, -1) for s in stretches])])
    y = np.concatenate([s.y.T.ravel() for s in stretches])
    weight = np.linalg.inv(K)
    left = y - X @ np.linalg.solve(X.T @ weight @ X, X.T @ weight @ y)
    freedom = len(y) - X.shape[1]
    determinants = np.linalg.slogdet(K)[1] + np.linalg.slogdet(X.T @ weight @ X)[1]
    return float(freedom * np.log(left @ weight @ left) + determinants)


def test_the_criterion_is_the_restricted_likelihood_with_one_dense_covariance():
    rng = np.random.default_rng(3)
    stretches = [noisy_stretch(rng, (0.8, 0.3), 0.5) for _ in range(4)]
    tried = [np.array(ratios) for ratios in ((0.8, 0.3), (0.2, 0.3), (0.8, 0.02), (3.0, 1.0))]
    ours = [_Reduced.of(stretches, ratios).criterion(WIDE) for ratios in tried]
    dense = [restricted_likelihood(stretches, ratios) for ratios in tried]
    assert np.diff(ours) == pytest.approx(np.diff(dense), rel=1e-6)


def test_the_ratios_have_the_highest_restricted_likelihood_of_all_about_them():
    rng = np.random.default_rng(3)
    stretches = [noisy_stretch(rng, (0.8, 0.3)) for _ in range(12)]
    found = fit(stretches, WIDE).ratios
    top = restricted_likelihood(stretches, found)
    for step in ((1.5, 1.0), (1 / 1.5, 1.0), (1.0, 1.5), (1.0, 1 / 1.5), (1.3, 1.3), (1 / 1.3, 1.3)):
        assert restricted_likelihood(stretches, found * step) > top


@pytest.mark.parametrize("duration_s", [0.5, 1.0])
def test_ratios_are_those_of_the_noise_that_was_simulated(duration_s: float):
    rng = np.random.default_rng(4)
    found = fit([noisy_stretch(rng, (0.8, 0.3), duration_s) for _ in range(300)], WIDE)
    assert found.ratios == pytest.approx([0.8, 0.3], rel=0.35)
    assert found.variance == pytest.approx(0.01, rel=0.1)


def test_a_stretch_own_parameter_that_is_there_twice_counts_once():
    """As gravity and its turning do in a stretch of one difference: a basis of all columns would take rows away."""
    stretches = [stretch_of(seed, (True, True, False)) for seed in range(3)]
    twice = [replace(s, B=np.concatenate([s.B, 3 * s.B[:, :, ::-1]], axis=2)) for s in stretches]
    once, again = (fit(s, WIDE, RATIOS) for s in (stretches, twice))
    assert again.parameters == pytest.approx(once.parameters, rel=1e-9)
    assert again.covariance == pytest.approx(once.covariance, rel=1e-9)
    assert rate_noise_power(twice, RATIOS) == pytest.approx(rate_noise_power(stretches, RATIOS), rel=1e-9)


def test_what_fits_nearly_exactly_is_told_as_exactly():
    """Differences that are the model's but for a ten thousandth: the variance is that of the little left over."""
    rng, p = np.random.default_rng(6), np.array([2.0, -3.0])
    exact = [replace(s, y=s.A @ p + s.B @ np.ones(3)) for s in (stretch_of(seed, (True,) * 3) for seed in range(3))]
    noisy = [replace(s, y=s.y + 1e-4 * np.diff(rng.standard_normal((21, 3)), axis=0)) for s in exact]
    found = fit(noisy, WIDE, np.array([1e-6, 1e-6]))
    assert found.parameters == pytest.approx(p, abs=1e-3)
    assert found.variance == pytest.approx(1e-8, rel=0.5)
