"""Where labelled regions of a polar image lie and how large they are, in metres.

A pixel of ``dr`` by ``da`` covers, in the slant plane, ``r dr da``. On the floor its points are at the horizontal
distance ``g = sqrt(r^2 - h^2)``, so that ``dg = (r / g) dr``, and a step da moves them along a circle by
``|dq/da + dq/de de/da| da`` with ``de/da = -(u . dq/da) / (u . dq/de)``, u the upward direction in the sonar frame. The
two derivatives are perpendicular, of lengths ``r cos e`` and r.
Centroids and second moments are taken over these areas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.kernels import compiled
from sonar_graph.measurements import Floats
from sonar_graph.sonar.background import Floats32
from sonar_graph.sonar.geometry import FloorView, floor_lift, ranges_azimuths_elevations

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
