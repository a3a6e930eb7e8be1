"""Laws of the comparison of two signals: what was done to a signal is found, with an interval that holds it."""

import numpy as np
import pytest
from scipy.signal import lfilter

from sonar_graph.diagnosis.signals import (
    NO_LAG,
    SMALL_SAMPLE,
    Match,
    RobustFit,
    SignalStretch,
    match,
)
from sonar_graph.measurements import Floats

T = np.arange(0.0, 120.0, 0.2)
NOISE = 0.02


def wave(seconds: Floats) -> Floats:
    """A motion that repeats nowhere."""
    return np.sin(0.4 * seconds) + 0.5 * np.sin(0.151 * seconds + 1.0)


def level(seconds: Floats) -> np.ndarray:
    """A way that is no mirror image of itself."""
    return 0.3 * seconds * np.exp(0.02j * seconds) + wave(seconds)


def noise(seed: int, n: int = len(T)) -> Floats:
    return NOISE * np.random.default_rng(seed).standard_normal(n)


def correlated(seed: int) -> Floats:
    """A Gauss-Markov error of 3 s and white noise."""
    drive, white = np.random.default_rng(seed).standard_normal((2, len(T)))
    keep = np.exp(-0.2 / 3.0)
    drive[1:] *= np.sqrt(1 - keep**2)
    return NOISE * (lfilter([1.0], [1.0, -keep], drive) + white)


def of_wave(y: Floats, **settings: float) -> Match:
    return match([SignalStretch(T, y, wave)], **settings)


@pytest.mark.parametrize("gain", [-1.0, 0.3048, 1.0, 3.3])
@pytest.mark.parametrize("lag_s", [-1.3, 0.0, 0.7])
def test_gain_and_lag_are_what_was_done_to_the_signal(gain, lag_s):
    found = of_wave(5.0 + gain * wave(T - lag_s) + noise(1), drift_sigma=0.001)
    assert found.gain.value == pytest.approx(gain, abs=4.5 * found.gain.sigma)
    assert found.lag.value == pytest.approx(lag_s, abs=4.5 * found.lag.sigma)
    assert found.gain.sigma < 0.02
    assert found.scatter == pytest.approx(NOISE, rel=0.2)
    assert not found.is_mirrored


@pytest.mark.parametrize("angle", [-2.0, 0.0, 0.5])
@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_level_way_is_turned_and_mirrored_as_it_was(angle, is_mirrored):
    x = level(T)
    y = 2.0 * np.exp(1j * angle) * (x.conj() if is_mirrored else x) + noise(2)
    found = match([SignalStretch(T, y, level)])
    assert found.is_mirrored == is_mirrored
    assert found.gain.value == pytest.approx(2.0, abs=0.01)
    assert found.angle.value == pytest.approx(angle, abs=0.01)
    assert found.lag.value == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("share", "is_found"), [(0.1, True), (0.5, False)])
def test_few_outliers_change_nothing_and_many_do(share, is_found):
    is_far = np.random.default_rng(4).random(len(T)) < share
    found = of_wave(wave(T) + noise(4) + 20.0 * is_far)
    assert (found.scatter < 2 * NOISE) == is_found
    assert (abs(found.gain.value - 1.0) < 0.02) == is_found


@pytest.mark.parametrize(("more", "left"), [(0, 3 * len(T) // 4), (1, len(T))])
def test_up_to_a_quarter_of_the_rows_is_left_out(more, left):
    """Where more rows are far, the model is wrong, and all rows stay."""
    y = wave(T) + noise(4)
    count = len(T) // 4 + more
    y[:count] += 20.0 * (-1.0) ** np.arange(count)
    fit = RobustFit.of(wave(T)[None, :, None], SignalStretch(T, y, wave), 0.0)
    assert fit.kept.sum() == left


def test_intervals_cover_the_truth_with_correlated_errors():
    """Of 100 logs 95 % intervals hold 90 or more; sigmas by independent rows would hold far fewer."""
    found = [of_wave(wave(T) + correlated(seed)) for seed in range(100)]
    errors = np.array([abs(one.gain.value - 1.0) for one in found])
    sigmas = np.array([one.gain.sigma for one in found])
    spread = np.std(wave(T)) * np.sqrt(len(T))
    naive = np.array([one.scatter for one in found]) / spread
    assert np.sum(errors < 1.96 * sigmas) >= 90
    assert np.sum(errors < 1.96 * naive) < 80


def test_stretches_share_a_gain_and_have_an_offset_each():
    parts = [
        SignalStretch(t, 1.1 * wave(t) + offset + noise(seed), wave)
        for t, offset, seed in ((T, -3.0, 7), (T + 500.0, 40.0, 8))
    ]
    found = match(parts)
    assert found.gain.value == pytest.approx(1.1, abs=4.5 * found.gain.sigma)
    assert found.scatter == pytest.approx(NOISE, rel=0.2)


def test_an_interval_is_of_few_blocks_by_hand():
    """Rows of 1 and -1 by turns: a dozen blocks of one row, whose mean has freedom 11; pairs of rows cancel."""
    n = 12
    rows = np.ones((1, n), dtype=bool)
    residuals = np.tile([1.0, -1.0], n // 2)[None]
    inverse = np.full((1, 1, 1), 1 / n)
    A = np.ones((1, n, 1))
    (sigma,) = RobustFit(A, np.zeros((1, 1)), inverse, residuals, rows, rows).sigmas()
    assert sigma == pytest.approx(SMALL_SAMPLE * np.sqrt(n * n / (n - 1)) / n)


def test_a_reference_that_is_known_nowhere_gives_no_warning():
    """In one of two stretches; and beside the rows, where it has no derivative."""
    known = SignalStretch(T, wave(T), wave)
    unknown = SignalStretch(T + 200.0, wave(T), lambda at: np.nan * at)
    assert match([known, unknown]).gain.value == pytest.approx(1.0)
    at_rows = SignalStretch(
        T, wave(T), lambda at: np.where(np.isin(at, T), wave(at), np.nan)
    )
    found = match([at_rows], lags_s=NO_LAG)
    assert found.gain.value == pytest.approx(1.0)
    assert np.isnan(found.rate)


@pytest.mark.parametrize("far", [2.0, -1.7])
def test_far_rows_on_a_steep_slope_make_no_delay(far):
    """Two of thirty rows are wrong, and the reference changes fast at the first of them."""
    t = np.arange(30.0)

    def steep(seconds: Floats) -> Floats:
        return 0.14 * np.sin(0.25 * seconds) + np.tanh(4.0 * (seconds - 0.1))

    y = steep(t) + 0.01 * np.random.default_rng(5).standard_normal(30)
    y[[0, 27]] += far, 0.7 * far
    found = match([SignalStretch(t, y, steep, has_offset=False)])
    assert found.gain.value == pytest.approx(1.0, abs=4.5 * found.gain.sigma)
    assert found.gain.sigma < 0.05
    assert found.lag.value == pytest.approx(0.0, abs=max(0.2, 4.5 * found.lag.sigma))
    assert found.scatter == pytest.approx(0.01, rel=0.4)
