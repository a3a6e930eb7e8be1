"""The image around a point of the floor, on a square metric grid.

Level axes are those of `sonar_graph.sonar.geometry.FloorView`. A floor point p is the sonar point
``q = level_R_sonar^T p``, seen at range |q| and azimuth atan2(q_y, q_x): each point of the grid is looked up there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.kernels import compiled
from sonar_graph.measurements import Floats
from sonar_graph.sonar.geometry import FloorView

Floats32 = NDArray[np.float32]
_STEPS_A_BEAM = 4


@dataclass(frozen=True, eq=False)
class Patch:
    """The image around a point of the floor."""

    level_db: Floats32
    """Mean level on the grid, shape (side, side), first axis x, second y; 0 where not seen."""
    seen: Floats32
    """1 where the image holds the point, else 0, shape (side, side)."""
    centre_m: Floats
    """(x, y) of its middle on the floor, shape (2,)."""


class PolarGrid:
    """Beams and bins of an image, for looking up ranges and azimuths.

    Parameters
    ----------
    ranges_m
        Middle of each bin, equally spaced, shape (bins,).
    azimuths_rad
        Of each beam, increasing or decreasing, shape (beams,).
    elevation_aperture_rad
        Full vertical opening: what lies outside of it is not in the image, whatever the range.
    """

    def __init__(self, ranges_m: Floats, azimuths_rad: Floats, elevation_aperture_rad: float = math.pi) -> None:
        self.highest_sine = math.sin(min(elevation_aperture_rad, math.pi) / 2)
        self.first_range_m = float(ranges_m[0])
        self.bin_m = float(ranges_m[-1] - ranges_m[0]) / (len(ranges_m) - 1)
        order = np.argsort(azimuths_rad)
        steps = _STEPS_A_BEAM * len(azimuths_rad)
        places = np.linspace(azimuths_rad.min(), azimuths_rad.max(), steps)
        self.first_azimuth_rad, self.azimuth_step_rad = float(places[0]), float(places[1] - places[0])
        self.beam_of_azimuth = np.interp(places, azimuths_rad[order], order.astype(float))

    def patch(self, image_db: Floats32, view: FloorView, centre_m: Floats, side: int, cell_m: float) -> Patch:
        """The image on a grid of ``side`` by ``side`` floor points around a centre."""
        level, seen = sample_floor(
            image_db,
            self.first_range_m,
            self.bin_m,
            self.beam_of_azimuth,
            self.first_azimuth_rad,
            self.azimuth_step_rad,
            view.level_R_sonar,
            view.height_m,
            self.highest_sine,
            centre_m,
            side,
            cell_m,
        )
        return Patch(level, seen, centre_m)


@compiled
def sample_floor(
    image_db: Floats32,
    first_range_m: float,
    bin_m: float,
    beam_of_azimuth: Floats,
    first_azimuth_rad: float,
    azimuth_step_rad: float,
    level_R_sonar: Floats,
    height_m: float,
    highest_sine: float,
    centre: Floats,
    side: int,
    cell_m: float,
) -> tuple[Floats32, Floats32]:
    """Levels on a square grid of the floor, and whether each point is in the image, shapes (side, side).

    Each is the mean of decibels over the range that a cell covers, linear between beams.
    """
    beams, bins = image_db.shape
    level, seen = np.zeros((side, side), np.float32), np.zeros((side, side), np.float32)
    R = level_R_sonar
    half_bins = 0.5 * cell_m / bin_m
    half = 0.5 * (side - 1)
    for i in range(side):
        for j in range(side):
            x, y, z = centre[0] + cell_m * (i - half), centre[1] + cell_m * (j - half), -height_m
            qx = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
            qy = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
            qz = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
            distance = math.sqrt(x * x + y * y + z * z)
            if abs(qz) > highest_sine * distance:
                continue
            place = (math.atan2(qy, qx) - first_azimuth_rad) / azimuth_step_rad
            if not 0 <= place < len(beam_of_azimuth) - 1:
                continue
            k = int(place)
            beam = beam_of_azimuth[k] + (place - k) * (beam_of_azimuth[k + 1] - beam_of_azimuth[k])
            middle = (distance - first_range_m) / bin_m
            first, last = math.floor(middle - half_bins + 1), math.floor(middle + half_bins)
            if beam < 0 or beam > beams - 1 or first < 0 or last >= bins:
                continue
            b = min(int(beam), beams - 2)
            share = beam - b
            total = 0.0
            for n in range(first, last + 1):
                total += (1 - share) * image_db[b, n] + share * image_db[b + 1, n]
            level[i, j] = total / (last - first + 1)
            seen[i, j] = 1.0
    return level, seen
