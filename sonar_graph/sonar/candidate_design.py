"""Whether a design can ever be a candidate: refused before a log is read, instead of never found in it."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from sonar_graph.errors import CalibrationError
from sonar_graph.landmark_designs import LEAST_BRIGHT_DB, LandmarkDesign
from sonar_graph.measurements import Floats
from sonar_graph.sonar.detection import DetectionParams

CELL_M = 0.005


def check_candidates(designs: Iterable[LandmarkDesign], params: DetectionParams, search_m: float) -> None:
    """Refuse designs that no setting of the noise would let through.

    Only candidates are compared with designs, and a candidate is one connected bright region. It is compared at its
    centroid and up to ``search_m`` beside it. So some bright part of the design must be of the right size and lie about
    the middle of its square. The part is taken as `select_candidates` would see it without speckle and in a perfect
    image; where the sonar's own resolution decides, nothing is refused here.

    Parameters
    ----------
    designs
        All of them.
    params
        Of the candidate selection.
    search_m
        `AppearanceParams.search_m`.

    Raises
    ------
    CalibrationError
        Naming the design, what it has and what a candidate has.
    """
    for design in designs:
        areas_m2, extents_m, offsets_m = _bright_parts(design, params)
        is_sized = (areas_m2 >= params.min_area_m2) & (areas_m2 <= params.max_area_m2)
        is_sized &= extents_m <= params.max_extent_m
        reach_m = search_m + params.smoothing_m
        if not (is_sized & (offsets_m <= reach_m)).any():
            parts = ", ".join(
                f"{area:.2g} m² with its centre {offset * 100:.0f} cm from the middle"
                for area, offset in zip(areas_m2, offsets_m, strict=True)
            )
            raise CalibrationError(
                f"landmark design {design.name} (id {design.id}) would never be found: its bright parts are "
                f"{parts or 'all smoothed away'}; "
                f"one must have {params.min_area_m2:g} to {params.max_area_m2:g} m², be no longer than "
                f"{params.max_extent_m:g} m and lie within {reach_m * 100:.0f} cm of the middle; "
                "join the parts, change their size, or set detection.closing_m, min_area_m2, max_area_m2, max_extent_m"
            )


def _bright_parts(design: LandmarkDesign, params: DetectionParams) -> tuple[Floats, Floats, Floats]:
    """Area, length and distance from the middle of each connected part that is over the floor, largest first."""
    half = int(np.ceil((design.size_m / 2 + params.smoothing_m + params.closing_m) / CELL_M))
    x_m, y_m = np.meshgrid(*2 * [CELL_M * np.arange(-half, half + 1)], indexing="ij")
    level_db = np.nan_to_num(design.level_db(x_m, y_m)).astype(np.float32)
    smooth_db = cv2.blur(level_db, 2 * (_cells(params.smoothing_m),))
    is_bright = (smooth_db >= LEAST_BRIGHT_DB).astype(np.uint8)
    closed = cv2.morphologyEx(is_bright, cv2.MORPH_CLOSE, np.ones(2 * (_cells(params.closing_m),), np.uint8))
    count, labels = cv2.connectedComponents(closed, connectivity=8)
    places = [np.stack([x_m, y_m])[:, labels == part] for part in range(1, count)]
    places.sort(key=lambda place: -place.shape[1])
    areas = np.array([place.shape[1] * CELL_M**2 for place in places])
    extents = np.array([np.sqrt(12 * np.linalg.eigvalsh(np.cov(place, bias=True)).max()) for place in places])
    offsets = np.array([np.linalg.norm(place.mean(axis=1)) for place in places])
    return areas, extents, offsets


def _cells(length_m: float) -> int:
    """An odd number."""
    return max(1, 2 * round((length_m / CELL_M - 1) / 2) + 1)
