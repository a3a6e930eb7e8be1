"""What stands out of one sonar frame, and why each of it is or is not followed up."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints


class Verdict(IntEnum):
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
    """`Verdict` of each, shape (n,)."""
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
        return np.flatnonzero(self.verdicts == Verdict.ACCEPTED)

    def region(self, row: int) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """Where a candidate lies in the image, (beams, bins), and which of those pixels are its own."""
        beam, bin_, beams, bins = self.boxes[row].tolist()
        where = slice(beam, beam + beams), slice(bin_, bin_ + bins)
        return where, self.labels[where] == row + 1
