"""What a frame would look like without objects: its local level and the spread of speckle and texture around it.

Both are medians, so that objects that fill less than half of a neighbourhood do not matter:

    B = median over the neighbourhood of the smoothed levels,    sigma = 1.4826 median |level - B|

first along the beams for every range (time-varying gain, the edges of the vertical beam), then in two dimensions on a
grid of about one independent level a node. The factor makes sigma the standard deviation of a normal distribution.

Where labelled regions of a polar image lie and how large they are, in metres.

A pixel of ``dr`` by ``da`` covers, in the slant plane, ``r dr da``. On the floor its points are at the horizontal
distance ``g = sqrt(r^2 - h^2)``, so that ``dg = (r / g) dr``, and a step da moves them along a circle by
``|dq/da + dq/de de/da| da`` with ``de/da = -(u . dq/da) / (u . dq/de)``, u the upward direction in the sonar frame. The
two derivatives are perpendicular, of lengths ``r cos e`` and r.
Centroids and second moments are taken over these areas.

What stands out of one sonar frame, and why each of it is or is not followed up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.geometry import FloorView, floor_lift, ranges_azimuths_elevations

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


AREA, LEVEL, X, Y, XX, XY, YY, PIXELS = range(8)


@dataclass(frozen=True, eq=False)
class Regions:
    """One row a region."""

    points_m: Floats
    """Centroid in the sonar frame, shape (n, 3)."""
    range_m: Floats
    azimuth_rad: Floats
    elevation_rad: Floats
    area_m2: Floats
    """0 where no pixel meets the floor."""
    extent_m: Floats
    """Longer side of the rectangle with the same second moments: ``sqrt(12)`` times the largest deviation."""
    level_db: Floats
    """Mean contrast."""


def measure_regions(
    contrast_db: Floats32,
    labels: NDArray[np.int32],
    count: int,
    ranges_m: Floats,
    azimuths_rad: Floats,
    view: FloorView | None,
) -> Regions:
    """Measure regions 1 to ``count`` of a label image, on the floor or (None) in the slant plane."""
    level_R_sonar, height_m = (np.eye(3), 0.0) if view is None else (view.level_R_sonar, view.height_m)
    sums = _sums(contrast_db, labels, count, ranges_m, azimuths_rad, np.ascontiguousarray(level_R_sonar), height_m)
    weight = np.maximum(sums[:, AREA], 1e-12)
    x, y = sums[:, X] / weight, sums[:, Y] / weight
    xx, xy, yy = sums[:, XX] / weight - x * x, sums[:, XY] / weight - x * y, sums[:, YY] / weight - y * y
    largest = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    points = np.stack([x, y, np.full(count, -height_m)], axis=1) @ level_R_sonar
    r, a, e = ranges_azimuths_elevations(points)
    level = sums[:, LEVEL] / np.maximum(sums[:, PIXELS], 1)
    return Regions(points, r, a, e, sums[:, AREA], np.sqrt(12 * np.maximum(largest, 0)), level)


@compiled
def _sums(
    contrast_db: Floats32,
    labels: NDArray[np.int32],
    count: int,
    ranges_m: Floats,
    azimuths_rad: Floats,
    level_R_sonar: Floats,
    height_m: float,
) -> Floats:
    """Sums over the pixels of each region, shape (count, 8)."""
    sums = np.zeros((count, 8))
    beams, bins = labels.shape
    dr = abs(ranges_m[bins - 1] - ranges_m[0]) / (bins - 1)
    da = abs(azimuths_rad[beams - 1] - azimuths_rad[0]) / (beams - 1)
    for beam in range(beams):
        cos_a, sin_a = math.cos(azimuths_rad[beam]), math.sin(azimuths_rad[beam])
        for bin_ in range(bins):
            row = labels[beam, bin_] - 1
            if row < 0:
                continue
            r = ranges_m[bin_]
            if height_m > 0:
                x, y, area = _floor_cell(r, cos_a, sin_a, level_R_sonar, height_m)
                area *= dr * da
            else:
                x, y, area = r * cos_a, r * sin_a, r * dr * da
            sums[row, PIXELS] += 1.0
            sums[row, LEVEL] += contrast_db[beam, bin_]
            if area > 0:
                sums[row, AREA] += area
                sums[row, X] += area * x
                sums[row, Y] += area * y
                sums[row, XX] += area * x * x
                sums[row, XY] += area * x * y
                sums[row, YY] += area * y * y
    return sums


@compiled
def _floor_cell(
    r: float, cos_a: float, sin_a: float, level_R_sonar: Floats, height_m: float
) -> tuple[float, float, float]:
    """Level x and y of a floor point, and area there per unit of range and azimuth; area 0 off the floor."""
    up = level_R_sonar[2]
    cos_e, sin_e = floor_lift(r, cos_a, sin_a, up, height_m)
    g2 = r * r - height_m * height_m
    if not g2 > 0 or not math.isfinite(cos_e):
        return 0.0, 0.0, 0.0
    qx, qy, qz = r * cos_e * cos_a, r * cos_e * sin_a, r * sin_e
    by_elevation = r * (up[2] * cos_e - sin_e * (up[0] * cos_a + up[1] * sin_a))
    ratio = (up[1] * qx - up[0] * qy) / by_elevation
    step = r * math.sqrt(cos_e * cos_e + ratio * ratio)
    x = level_R_sonar[0, 0] * qx + level_R_sonar[0, 1] * qy + level_R_sonar[0, 2] * qz
    y = level_R_sonar[1, 0] * qx + level_R_sonar[1, 1] * qy + level_R_sonar[1, 2] * qz
    return x, y, step * r / math.sqrt(g2)


class CandidateVerdict(IntEnum):
    """What became of a region that stood out; the first that applies."""

    ACCEPTED = 0
    OFF_FLOOR = 1
    """No ray from there meets the floor."""
    AT_EDGE = 2
    """It touches the first or last beam or bin: its extent is unknown."""
    TOO_SMALL = 3
    """Its area is below the gate."""
    TOO_LARGE = 4
    """Its area is above the gate."""
    TOO_LONG = 5
    """Its extent is above the gate."""
    BEYOND_LIMIT = 6
    """More candidates than `DetectionParams.max_candidates`; the strongest were kept."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Regions of a frame that stand out of the background: one row each, rejected ones included.

    Lengths and areas are on the floor where it is known, otherwise in the slant plane of the image.
    """

    verdicts: Ints
    """`CandidateVerdict` of each, shape (n,)."""
    range_m: Floats
    """Slant range of the centroid, shape (n,)."""
    azimuth_rad: Floats
    """Of the centroid, positive to the left, shape (n,)."""
    elevation_rad: Floats
    """On the floor where it is known, otherwise 0, shape (n,)."""
    elevation_sigma_rad: Floats
    """Standard deviation of it, shape (n,)."""
    area_m2: Floats
    """Shape (n,)."""
    extent_m: Floats
    """Length of the longer side of the region's rectangle, from its second moments, shape (n,)."""
    level_db: Floats
    """Mean level over the local background, shape (n,)."""
    boxes: Ints
    """First beam, first bin, number of beams, number of bins, shape (n, 4)."""
    window: Floats
    """What the image covers: smallest and largest range (m), smallest and largest azimuth (rad), shape (2, 2)."""
    labels: NDArray[np.int32]
    """Shape (beams, bins): i + 1 in the pixels of candidate i, 0 elsewhere."""

    def __len__(self) -> int:
        return len(self.verdicts)

    @property
    def accepted(self) -> Ints:
        """Rows of the accepted candidates, in order."""
        return np.flatnonzero(self.verdicts == CandidateVerdict.ACCEPTED)

    def region(self, row: int) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """Where a candidate lies in the image, (beams, bins), and which of those pixels are its own."""
        beam, bin_, beams, bins = self.boxes[row].tolist()
        where = slice(beam, beam + beams), slice(bin_, bin_ + bins)
        return where, self.labels[where] == row + 1
