"""A closer look at the candidates that tracks took: which design fits, and where its centre is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonar_graph.measurements import Floats, Ints, SonarFrames
from sonar_graph.sonar.appearance import Appearance, Fit
from sonar_graph.sonar.candidates import Candidates
from sonar_graph.sonar.confusion import Confusion
from sonar_graph.sonar.floor_patch import Floats32, PolarGrid
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.scores import soft_scores

CENTROID_SIGMA_M = 0.04
"""Of a candidate's own centroid, along and across, where no design fits: a landmark's middle may be elsewhere."""
SLANT_PLANE = FloorView(np.eye(3), 1e-3)
"""Where no floor is known, patches lie in the plane of the image."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """A track's candidate in one frame, and how the designs fit it."""

    fit: Fit | None
    """None where too little of it is in the image."""
    range_m: float
    azimuth_rad: float
    covariance: Floats
    """Of both, shape (2, 2)."""
    is_fitted: bool = False
    """Whether range and azimuth are those of a design's centre, not of the candidate's centroid."""


class Look:
    """Compares candidates with the designs.

    Parameters
    ----------
    appearance
        The designs.
    confusion
        The measured model.
    elevation_aperture_rad
        Full vertical opening of the sonar.
    """

    def __init__(self, appearance: Appearance, confusion: Confusion, elevation_aperture_rad: float) -> None:
        self._appearance, self._confusion = appearance, confusion
        self._aperture_rad = elevation_aperture_rad
        self._grid: PolarGrid | None = None
        self._shape: tuple[Floats, Floats] | None = None

    def at(
        self,
        image_db: Floats32,
        frame: SonarFrames,
        view: FloorView | None,
        candidates: Candidates,
        rows: Ints,
    ) -> list[Sighting | None]:
        """What each track took; None for a row of -1."""
        grid, floor = self._grid_of(frame), view or SLANT_PLANE
        return [None if row < 0 else self._one(image_db, grid, floor, candidates, row) for row in rows.tolist()]

    def scores(self, sightings: Sequence[Sighting | None]) -> Floats:
        """Soft scores of the features, shape (M, designs + 1); rows of 0 where nothing was compared."""
        scores = np.zeros((len(sightings), self._appearance.designs + 1))
        for row, sighting in enumerate(sightings):
            if sighting is not None and (fit := sighting.fit) is not None:
                model = self._confusion
                found = soft_scores(fit.correlation[None], np.array([fit.visible]), model.sharpness, model.threshold)
                scores[row] = found[0]
        return scores

    def _grid_of(self, frame: SonarFrames) -> PolarGrid:
        """The lookup of the frame's beams and bins, made once for all frames that share them."""
        shape = (frame.ranges_m, frame.azimuths_rad)
        if self._grid is None or self._shape is None or not all(map(_is_same, self._shape, shape)):
            self._grid, self._shape = PolarGrid(*shape, self._aperture_rad), shape
        return self._grid

    def _one(self, image_db: Floats32, grid: PolarGrid, view: FloorView, candidates: Candidates, row: int) -> Sighting:
        range_m, azimuth_rad = float(candidates.range_m[row]), float(candidates.azimuth_rad[row])
        loose = np.square([CENTROID_SIGMA_M, CENTROID_SIGMA_M / range_m])
        unfitted = Sighting(None, range_m, azimuth_rad, np.diag(loose))
        centre = view.floor_point(range_m, azimuth_rad)
        if centre is None:
            return unfitted
        appearance = self._appearance
        fit = appearance.fit(grid.patch(image_db, view, centre, appearance.patch_side, appearance.params.cell_m))
        if fit.correlation.max() < 0:
            return unfitted
        if fit.correlation.max() < self._confusion.threshold:
            return Sighting(fit, range_m, azimuth_rad, unfitted.covariance)
        covariance = self._confusion.range_azimuth_cov(fit.visible)
        return Sighting(fit, *view.range_azimuth(fit.centre_m), covariance, is_fitted=True)


def _is_same(one: Floats, other: Floats) -> bool:
    return one is other or np.array_equal(one, other)
