"""Background of a polar frame, and regions of it in metres.

Background B and spread sigma are medians, which objects in less than half of a neighbourhood do not change::

    B = median of the smoothed levels,    sigma = 1.4826 median |level - B|

first along the beams at every range (time-varying gain, edges of the vertical beam), then in two dimensions on a grid
of about one independent level a node. Regions have centroids and second moments over the area of their pixels: on the
floor where it is known, else in the slant plane. Derivation: docs/theory/candidates.md.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled, inlined
from sonar_graph.sonar.geometry import FloorView, ranges_azimuths_elevations

Floats32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
MEDIAN_TO_SIGMA = 1.4826
LEAST_SPREAD_DB = 0.2
"""Smaller differences of level are lost in the quantisation."""
STEPS_PER_DB = 8.0
DEVIATION_STEPS_PER_DB = 40.0
LARGEST_WINDOW = 127
TREND_NODES = 5
"""Nodes in range over which the median along the beams is averaged."""


def background_of(
    smooth_db: Floats32, smoothing: tuple[int, int], neighbourhood: tuple[int, int]
) -> tuple[Floats32, Floats32]:
    """B and sigma of levels averaged over beams and bins, by medians over a larger neighbourhood of them.

    On a grid of nodes, about one independent level each, shapes (nodes, nodes).
    """
    beams, bins = smoothing
    # one node a smoothing patch: nearly independent levels, and hundreds of times fewer
    nodes = np.ascontiguousarray(smooth_db[beams // 2 :: beams, bins // 2 :: bins])
    ordered = np.sort(nodes, axis=0)
    count = len(nodes)
    medians = (
        ordered[[(count - 1) // 2]] + ordered[[count // 2]]
    ) / 2  # np.median takes three times as long
    # time-varying gain and the edges of the vertical beam change along range only
    trend = cv2.blur(medians, (TREND_NODES, 1))
    window = (
        min(
            round((neighbourhood[0] / beams + neighbourhood[1] / bins) / 2),
            LARGEST_WINDOW,
        )
        // 2
        * 2
        + 1
    )
    residual = nodes - trend
    local = _median(residual, window, STEPS_PER_DB, 128.0)
    spread = MEDIAN_TO_SIGMA * _median(
        np.abs(residual - local), window, DEVIATION_STEPS_PER_DB, 0.0
    )
    return local + trend, np.maximum(spread, np.float32(LEAST_SPREAD_DB))


def _median(
    values: Floats32, window: int, steps_per_db: float, zero: float
) -> Floats32:
    """Median over a square window, to half a step; mirrored at the edges."""
    half = window // 2
    # as bytes, of which a histogram finds the median
    counts = cv2.convertScaleAbs(
        np.maximum(values, -zero / steps_per_db), alpha=steps_per_db, beta=zero
    )
    mirrored = np.asarray(
        cv2.copyMakeBorder(counts, half, half, half, half, cv2.BORDER_REFLECT_101),
        np.uint8,
    )
    return (
        running_median(mirrored, window).astype(np.float32) - np.float32(zero)
    ) / np.float32(steps_per_db)


@compiled
def running_median(counts: Bytes, window: int) -> Bytes:
    """Median of each square of an odd number of bytes along its sides, shape (rows - window + 1, columns - window + 1).

    By the histogram of a square that moves along a row (Huang, Yang, Tang 1979): of a few thousand nodes it is faster
    than opencv's median. ``below`` of the square's bytes are less than the median.
    """
    rows = counts.shape[0] - window + 1
    columns = counts.shape[1] - window + 1
    medians = np.empty((rows, columns), np.uint8)
    middle = window * window // 2
    for i in range(rows):
        histogram = np.zeros(256, np.int64)
        median = 0
        below = 0
        for k in range(window):
            for j in range(window):
                histogram[counts[i + k, j]] += 1
        for j in range(columns):
            # move by one column: one column leaves, one enters
            for k in range(window if j else 0):
                gone = counts[i + k, j - 1]
                come = counts[i + k, j + window - 1]
                histogram[gone] -= 1
                histogram[come] += 1
                below += int(come < median) - int(gone < median)
            # the median moves by few steps, since few bytes changed
            while below > middle:
                median -= 1
                below -= histogram[median]
            while below + histogram[median] <= middle:
                below += histogram[median]
                median += 1
            medians[i, j] = median
    return medians


AREA, LEVEL, X, Y, XX, XY, YY, PIXELS = range(8)


@dataclass(frozen=True, eq=False)
class Regions:
    """Measured regions, one row each; lengths on the floor where it is known, otherwise in the slant plane."""

    points_m: Floats
    """Centroid in the sonar frame, shape (n, 3)."""
    range_m: Floats
    azimuth_rad: Floats
    elevation_rad: Floats
    """Of the centroid, shape (n,); elevation 0 in the slant plane."""
    area_m2: Floats
    """0 where no pixel meets the floor."""
    extent_m: Floats
    """Longer side of the rectangle with the same second moments: ``sqrt(12)`` times the largest deviation."""
    level_db: Floats
    """Mean level over the local background."""


def measure_regions(
    contrast_db: Floats32,
    labels: NDArray[np.int32],
    count: int,
    ranges_m: Floats,
    azimuths_rad: Floats,
    view: FloorView | None,
) -> Regions:
    """Measure regions 1 to ``count`` of a label image, on the floor or (None) in the slant plane."""
    level_R_sonar, height_m = (
        (np.eye(3), 0.0) if view is None else (view.level_R_sonar, view.height_m)
    )
    sums = pixel_sums(
        contrast_db,
        labels,
        count,
        ranges_m,
        azimuths_rad,
        np.ascontiguousarray(level_R_sonar),
        height_m,
    )
    # off the floor a region has no area; its centroid is not used
    weight = np.maximum(sums[:, AREA], 1e-12)
    x = sums[:, X] / weight
    y = sums[:, Y] / weight
    xx = sums[:, XX] / weight - x * x
    xy = sums[:, XY] / weight - x * y
    yy = sums[:, YY] / weight - y * y
    # larger eigenvalue of the 2 by 2 matrix of second moments
    largest = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    points = np.stack([x, y, np.full(count, -height_m)], axis=1) @ level_R_sonar
    r, a, e = ranges_azimuths_elevations(points)
    level = sums[:, LEVEL] / np.maximum(sums[:, PIXELS], 1)
    return Regions(
        points, r, a, e, sums[:, AREA], np.sqrt(12 * np.maximum(largest, 0)), level
    )


@inlined
def floor_cell(
    r: float,
    cos_a: float,
    sin_a: float,
    R: tuple[tuple[float, ...], ...],
    height_m: float,
) -> tuple[float, float, float]:
    """Level x and y of the floor point at a range and azimuth, and area per unit of both there; 0 off the floor.

    R is ``level_R_sonar``. The elevation is that of `FloorView.floor_points`. Steps in range and in azimuth, at constant
    height below the sonar, are perpendicular: ``dg = (r / sqrt(r^2 - h^2)) dr`` and ``|dq/da + dq/de de/da| da`` with
    ``de/da = -(u . dq/da) / (u . dq/de)``.
    """
    (xx, xy, xz), (yx, yy, yz), (up_x, up_y, up_z) = R
    across = up_x * cos_a + up_y * sin_a
    # u . q = -h with q = r (cos e c + sin e z)
    k = -height_m / r
    norm2 = across * across + up_z * up_z
    # the solution nearer to the centre beam
    w = math.copysign(math.sqrt(norm2 - k * k), up_z)
    cos_e = (across * k + up_z * w) / norm2
    sin_e = (up_z * k - across * w) / norm2
    ratio = (up_y * cos_a - up_x * sin_a) * cos_e / (up_z * cos_e - sin_e * across)
    area = (
        r
        * r
        * math.sqrt((cos_e * cos_e + ratio * ratio) / (r * r - height_m * height_m))
    )
    # nearer than the floor, or beyond the horizon; NaN compares false
    if not (area > 0 and r > height_m):
        return 0.0, 0.0, 0.0
    px = r * cos_e * cos_a
    py = r * cos_e * sin_a
    pz = r * sin_e
    return xx * px + xy * py + xz * pz, yx * px + yy * py + yz * pz, area


@compiled
def pixel_sums(
    contrast_db: Floats32, labels: NDArray[np.int32], count: int, ranges_m: Floats, azimuths_rad: Floats,
    level_R_sonar: Floats, height_m: float,
) -> Floats:  # fmt: skip
    """Sums over the pixels of each region, shape (count, 8); on the floor, or for a height of 0 in the slant plane."""
    sums = np.zeros((count, 8))
    (beams, bins) = labels.shape
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = level_R_sonar
    R = (xx, xy, xz), (yx, yy, yz), (zx, zy, zz)
    dr = abs(ranges_m[-1] - ranges_m[0]) / max(bins - 1, 1)
    da = abs(azimuths_rad[-1] - azimuths_rad[0]) / max(beams - 1, 1)
    for beam in range(beams):
        cos_a = math.cos(azimuths_rad[beam])
        sin_a = math.sin(azimuths_rad[beam])
        for n in range(bins):
            # nearly all pixels are background
            if labels[beam, n] == 0:
                continue
            r = ranges_m[n]
            row = sums[labels[beam, n] - 1]
            x, y, area = (
                floor_cell(r, cos_a, sin_a, R, height_m)
                if height_m > 0
                else (r * cos_a, r * sin_a, r)
            )
            # regions are measured in area on the ground, not in pixels: a far pixel is larger
            area *= dr * da
            row[AREA] += area
            row[LEVEL] += contrast_db[beam, n]
            row[PIXELS] += 1
            row[X] += area * x
            row[Y] += area * y
            row[XX] += area * x * x
            row[XY] += area * x * y
            row[YY] += area * y * y
    return sums


class CandidateVerdict(IntEnum):
    """Verdict on a region over the threshold; the first that applies."""

    ACCEPTED = 0
    OFF_FLOOR = 1
    """Its rays do not meet the floor."""
    AT_EDGE = 2
    """It touches the first or last beam or bin."""
    TOO_SMALL = 3
    """Its area is below the gate."""
    TOO_LARGE = 4
    """Its area is above the gate."""
    TOO_LONG = 5
    """Its extent is above the gate."""
    BEYOND_LIMIT = 6
    """More candidates than `DetectionParams.max_candidates`; the strongest were kept."""


@dataclass(frozen=True, eq=False)
class Candidates(Regions):
    """Regions of a frame over the threshold, one row each, rejected ones included."""

    verdicts: Ints
    """`CandidateVerdict` of each, shape (n,)."""
    elevation_sigma_rad: Floats
    """Standard deviation of the elevation, shape (n,)."""
    boxes: Ints
    """First beam, first bin, number of beams, number of bins, shape (n, 4)."""
    window: Floats
    """Smallest and largest range (m), smallest and largest azimuth (rad) of the image, shape (2, 2)."""
    labels: NDArray[np.int32]
    """Shape (beams, bins): i + 1 in the pixels of candidate i, 0 elsewhere."""

    def __len__(self) -> int:
        return len(self.verdicts)

    @property
    def accepted(self) -> Ints:
        """Rows of the accepted candidates, in order."""
        return np.flatnonzero(self.verdicts == CandidateVerdict.ACCEPTED)
