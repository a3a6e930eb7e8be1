from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from sonar_graph.sonar.regions import MEDIAN_TO_SIGMA, background_of

BEAMS, BINS = 3, 5
WINDOW = 9
HALF_STEP_DB, HALF_DEVIATION_STEP_DB = 1 / 16, 1 / 80


def medians(values: np.ndarray) -> np.ndarray:
    """Over a square window, mirrored at the edges."""
    mirrored = np.pad(values, WINDOW // 2, mode="reflect")
    return np.median(sliding_window_view(mirrored, (WINDOW, WINDOW)), axis=(2, 3))


@pytest.mark.parametrize("nodes", [20, 21])
@pytest.mark.parametrize("shaded", [0.0, 0.4])
def test_the_background_is_a_median_and_the_spread_the_median_of_what_is_left(nodes: int, shaded: float):
    """A shadow 40 dB deep over less than half of the beams is below what bytes reach, -16 dB."""
    rng = np.random.default_rng(nodes)
    level = rng.normal(40, 2, (nodes, 30)) + 0.3 * np.arange(30)
    level[: int(shaded * nodes)] -= 40
    level = level.astype(np.float32)
    found = background_of(
        np.kron(level, np.ones((BEAMS, BINS), np.float32)), (BEAMS, BINS), (WINDOW * BEAMS, WINDOW * BINS)
    )
    along = np.pad(np.median(level, axis=0), 2, mode="reflect")
    trend = sliding_window_view(along, 5).mean(axis=1)
    residual = level - trend
    local = medians(np.clip(residual, -16, 127 / 8))
    assert found.level_db == pytest.approx(local + trend, abs=1.01 * HALF_STEP_DB)
    spread = MEDIAN_TO_SIGMA * medians(np.minimum(np.abs(residual - (found.level_db - trend)), 255 / 40))
    assert found.spread_db == pytest.approx(
        np.maximum(spread, 0.2), abs=MEDIAN_TO_SIGMA * 1.01 * HALF_DEVIATION_STEP_DB
    )
