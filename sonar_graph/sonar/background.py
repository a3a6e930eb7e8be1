"""What a frame would look like without objects: its local level and the spread of speckle and texture around it.

Both are medians, so that objects that fill less than half of a neighbourhood do not matter:

    B = median over the neighbourhood of the smoothed levels,    sigma = 1.4826 median |level - B|

first along the beams for every range (time-varying gain, the edges of the vertical beam), then in two dimensions on a
grid of about one independent level a node. The factor makes sigma the standard deviation of a normal distribution.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
MEDIAN_TO_SIGMA = 1.4826
LEAST_SPREAD_DB = 0.2
"""Below it a level is not told from its quantisation."""
STEPS_PER_DB = 4.0
DEVIATION_STEPS_PER_DB = 20.0
LARGEST_WINDOW = 127


def background_and_spread(
    image_db: Floats32, smoothing: tuple[int, int], neighbourhood: tuple[int, int]
) -> tuple[Floats32, Floats32, Floats32]:
    """Smoothed levels, their background and their spread, all in dB and of shape (beams, bins).

    Parameters
    ----------
    image_db
        Shape (beams, bins).
    smoothing, neighbourhood
        Beams and bins, odd numbers.
    """
    smooth = cv2.blur(image_db, smoothing[::-1], borderType=cv2.BORDER_REFLECT_101)
    steps = tuple(max(1, size // 2) for size in smoothing)
    nodes = np.ascontiguousarray(smooth[steps[0] // 2 :: steps[0], steps[1] // 2 :: steps[1]])
    trend = np.median(nodes, axis=0, keepdims=True).astype(np.float32)
    window = (
        min(round(np.mean([n / s for n, s in zip(neighbourhood, steps, strict=True)])), LARGEST_WINDOW) // 2 * 2 + 1
    )
    residual = nodes - trend
    local = _median(residual, window, STEPS_PER_DB, 128.0)
    spread = MEDIAN_TO_SIGMA * _median(np.abs(residual - local), window, DEVIATION_STEPS_PER_DB, 0.0)
    size = image_db.shape[::-1]
    background = cv2.resize(local + trend, size, interpolation=cv2.INTER_LINEAR)
    return smooth, background, cv2.resize(np.maximum(spread, np.float32(LEAST_SPREAD_DB)), size)  # type: ignore[return-value]


def _median(values: Floats32, window: int, steps_per_db: float, zero: float) -> Floats32:
    """Median over a square window, to half a step; opencv's median over large windows takes bytes."""
    counts = cv2.convertScaleAbs(np.clip(values * np.float32(steps_per_db) + np.float32(zero), 0, 255))
    return (cv2.medianBlur(counts, window).astype(np.float32) - np.float32(zero)) / np.float32(steps_per_db)
