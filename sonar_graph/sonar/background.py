"""What a frame would look like without objects: its local level and the spread of speckle and texture around it.

Both are medians, so that objects that fill less than half of a neighbourhood do not matter:

    B = median over the neighbourhood of the smoothed levels,    sigma = 1.4826 median |level - B|

first along the beams for every range (time-varying gain, the edges of the vertical beam), then in two dimensions on a
grid of about one independent level a node. The factor makes sigma the standard deviation of a normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
MEDIAN_TO_SIGMA = 1.4826
LEAST_SPREAD_DB = 0.2
"""Below it a level is not told from its quantisation."""
STEPS_PER_DB = 8.0
DEVIATION_STEPS_PER_DB = 40.0
LARGEST_WINDOW = 127
TREND_NODES = 5
"""The median along the beams is itself averaged over so many nodes in range."""


@dataclass(frozen=True, eq=False)
class Background:
    """On a grid of nodes over the image, about one independent level each, shape (nodes, nodes)."""

    level_db: Floats32
    """B."""
    spread_db: Floats32
    """sigma."""


def background_of(smooth_db: Floats32, smoothing: tuple[int, int], neighbourhood: tuple[int, int]) -> Background:
    """Background and spread of smoothed levels.

    Parameters
    ----------
    smooth_db
        Shape (beams, bins).
    smoothing, neighbourhood
        Beams and bins over which levels were averaged, and over which medians are taken; odd numbers.
    """
    beams, bins = smoothing
    nodes = np.ascontiguousarray(smooth_db[beams // 2 :: beams, bins // 2 :: bins])
    ordered, count = np.sort(nodes, axis=0), len(nodes)
    medians = (ordered[[(count - 1) // 2]] + ordered[[count // 2]]) / 2  # np.median takes three times as long
    trend = cv2.blur(medians, (TREND_NODES, 1))
    window = min(round((neighbourhood[0] / beams + neighbourhood[1] / bins) / 2), LARGEST_WINDOW) // 2 * 2 + 1
    residual = nodes - trend
    local = _median(residual, window, STEPS_PER_DB, 128.0)
    spread = MEDIAN_TO_SIGMA * _median(np.abs(residual - local), window, DEVIATION_STEPS_PER_DB, 0.0)
    return Background(local + trend, np.maximum(spread, np.float32(LEAST_SPREAD_DB)))


def _median(values: Floats32, window: int, steps_per_db: float, zero: float) -> Floats32:
    """Median over a square window, to half a step.

    Mirrored at the edges: opencv would repeat the edge, whose few nodes then had most of the votes. In bytes, because
    its median over large windows takes nothing else.
    """
    half = window // 2
    counts = cv2.convertScaleAbs(np.maximum(values, -zero / steps_per_db), alpha=steps_per_db, beta=zero)
    mirrored = cv2.copyMakeBorder(counts, half, half, half, half, cv2.BORDER_REFLECT_101)
    middle = np.s_[half : half + values.shape[0], half : half + values.shape[1]]
    medians = np.asarray(cv2.medianBlur(mirrored, window), dtype=np.float32)[middle]
    return (medians - np.float32(zero)) / np.float32(steps_per_db)
