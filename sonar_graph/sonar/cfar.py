"""Candidate selection: regions of a polar frame over their background, at a constant false-alarm rate in decibels.

1. Mean level over a patch of `DetectionParams.smoothing_m`, in decibels.
2. Local background B and spread sigma of these means (`sonar_graph.sonar.regions`).
3. Threshold ``B + offset(sigma)``, with the offset of speckle of L looks, ``sigma^2 = (10 / ln 10)^2 psi'(L)``.
4. Regions over the threshold, closed over gaps; areas and extents in metres decide which are candidates.

sigma is measured at each pixel, so that texture raises the threshold. Derivation: docs/theory/candidates.md.
"""

import math
from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np
from pydantic import Field
from scipy.special import digamma, gammainccinv, polygamma

from sonar_graph.calibration import Section
from sonar_graph.devices import LEAST_BRIGHT_DB, LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled
from sonar_graph.sonar.geometry import FloorView
from sonar_graph.sonar.regions import (
    Candidates,
    CandidateVerdict,
    Floats32,
    Regions,
    background_of,
    measure_regions,
)

DB_PER_NEPER = 10.0 / np.log(10.0)


class DetectionParams(Section):
    """Settings of the candidate selection; lengths are on the ground, for landmarks of about 0.3 m."""

    false_alarm: float = Field(4e-3, gt=0, lt=0.5)
    """Probability that a pixel of background exceeds the threshold."""
    smoothing_m: float = Field(0.03, gt=0)
    """Side of the patch over which levels are averaged."""
    background_m: float = Field(0.9, gt=0)
    """Side of the neighbourhood of the background; well over twice the size of a landmark."""
    closing_m: float = Field(0.05, ge=0)
    """Gaps up to this width are bridged."""
    min_area_m2: float = Field(0.008, ge=0)
    """Smaller regions are rejected."""
    max_area_m2: float = Field(0.2, gt=0)
    """Larger regions are rejected."""
    max_extent_m: float = Field(0.7, gt=0)
    """Longer regions are rejected."""
    keep_at_edge: bool = False
    """Accept regions cut off by the edge of the image, whose centroids are not the objects'."""
    max_candidates: int = Field(16, gt=0)
    """Of the rest, so many with the highest level times area are accepted."""
    elevation_aperture_rad: float = Field(0.244, gt=0)
    """Full vertical opening of the sonar, which bounds the elevation without a floor."""


def select_candidates(
    image_db: Floats32,
    ranges_m: Floats,
    azimuths_rad: Floats,
    view: FloorView | None = None,
    params: DetectionParams | None = None,
) -> Candidates:
    """Regions of one polar frame over the threshold, rejected ones included.

    Levels in dB, shape (beams, bins), are finite: `FrameCheck` refuses other frames. Ranges are those of the middles of
    the bins, azimuths those of the beams. Without a floor (view of None) areas are in the slant plane.
    """
    params = params or DetectionParams()
    shape = (len(azimuths_rad), len(ranges_m))
    # width of a beam at mid-range, and length of a bin
    across = abs(float(azimuths_rad[-1] - azimuths_rad[0])) / (len(azimuths_rad) - 1)
    along = abs(float(ranges_m[-1] - ranges_m[0])) / (len(ranges_m) - 1)
    cell_m = across * float(ranges_m[0] + ranges_m[-1]) / 2, along
    smoothing, neighbourhood, closing = (
        odd_counts(length_m, cell_m)
        for length_m in (params.smoothing_m, params.background_m, params.closing_m)
    )
    # fewer cells would leave the speckle of single looks
    smoothing = np.maximum(smoothing, LEAST_COUNT).tolist()
    wide = np.maximum(closing, LEAST_COUNT).tolist()
    closing = wide if params.closing_m > 0 else closing
    smooth = np.asarray(
        cv2.blur(image_db, smoothing[::-1], borderType=cv2.BORDER_REFLECT_101),
        dtype=np.float32,
    )
    level_db, spread_db = background_of(smooth, smoothing, neighbourhood)
    contrast = smooth - _at_pixels(level_db, shape)
    offsets = false_alarm_offsets_db(spread_db, params.false_alarm)
    # bytes, as opencv wants them
    mask = cv2.compare(contrast, _at_pixels(offsets, shape), cv2.CMP_GT)
    closed = cv2.morphologyEx(
        mask, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, closing[::-1])
    )
    # opencv's default algorithm takes three times as long for the same labels
    count, found, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        closed, 8, cv2.CV_32S, cv2.CCL_GRANA
    )
    labels = np.asarray(found, dtype=np.int32)
    boxes = stats[1:count].astype(np.int64)[:, [1, 0, 3, 2]]
    regions = measure_regions(
        contrast, labels, len(boxes), ranges_m, azimuths_rad, view
    )
    if view is None:
        # in which the elevation is uniform
        aperture_rad = params.elevation_aperture_rad
        elevation_sigmas = np.full(len(boxes), aperture_rad / math.sqrt(12.0))
    else:
        elevation_sigmas = view.elevation_sigmas(regions.points_m)
    window = np.array(
        [[ranges_m.min(), ranges_m.max()], [azimuths_rad.min(), azimuths_rad.max()]]
    )
    return Candidates(
        **vars(regions),
        verdicts=judged(regions, boxes, shape, params),
        elevation_sigma_rad=elevation_sigmas,
        boxes=boxes,
        window=window,
        labels=labels,
    )


def judged(
    regions: Regions, boxes: Ints, shape: tuple[int, int], params: DetectionParams
) -> Ints:
    """`CandidateVerdict` of each region in an image of this shape; each overrides those before it."""
    area_m2 = regions.area_m2
    at_edge = (boxes[:, :2] == 0).any(axis=1) | (
        boxes[:, :2] + boxes[:, 2:] == shape
    ).any(axis=1)
    verdicts = np.full(len(boxes), int(CandidateVerdict.ACCEPTED))
    verdicts[regions.extent_m > params.max_extent_m] = CandidateVerdict.TOO_LONG
    verdicts[area_m2 > params.max_area_m2] = CandidateVerdict.TOO_LARGE
    verdicts[area_m2 < params.min_area_m2] = CandidateVerdict.TOO_SMALL
    verdicts[at_edge & (not params.keep_at_edge)] = CandidateVerdict.AT_EDGE
    # the last ones override the others: what is off the floor has no size
    verdicts[~(area_m2 > 0)] = CandidateVerdict.OFF_FLOOR
    accepted = np.flatnonzero(verdicts == CandidateVerdict.ACCEPTED)
    strongest_first = accepted[
        np.argsort(-(regions.level_db * area_m2)[accepted], kind="stable")
    ]
    verdicts[strongest_first[params.max_candidates :]] = CandidateVerdict.BEYOND_LIMIT
    return verdicts


def odd_counts(length_m: float, cell_m: tuple[float, float]) -> tuple[int, int]:
    """Odd numbers of beams and bins nearest to a length."""
    beams, bins = (2 * round((length_m / cell - 1) / 2) + 1 for cell in cell_m)
    return max(1, beams), max(1, bins)


def _at_pixels(nodes: Floats32, shape: tuple[int, int]) -> Floats32:
    """Nodes of the background interpolated to every pixel."""
    return np.asarray(
        cv2.resize(nodes, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32
    )


def false_alarm_offset_db(spread_db: float, false_alarm: float) -> float:
    """Offset over the mean level, in dB, that mere speckle exceeds with this probability.

    The intensity is Gamma with L looks: its level in dB has the mean ``c psi(L) + const`` and the variance
    ``c^2 psi'(L)``, ``c = 10 / ln 10``. L follows from the spread by Newton's method on its logarithm. One look has
    5.57 dB, and an offset of 9.14 dB for 1 %.
    """
    wanted = (spread_db / DB_PER_NEPER) ** 2
    # psi'(L) is about 1 / L for many looks, and 1 / L^2 for few
    log_looks = -np.log(wanted) if wanted < 1 else -0.5 * np.log(wanted)
    for _ in range(30):
        looks = np.exp(log_looks)
        value = float(polygamma(1, looks))
        log_looks += (
            (np.log(wanted) - np.log(value))
            * value
            / (looks * float(polygamma(2, looks)))
        )
    looks = float(np.exp(log_looks))
    return float(
        DB_PER_NEPER * (np.log(gammainccinv(looks, false_alarm)) - digamma(looks))
    )


SPREADS_DB = np.linspace(0.05, 12.0, 240)
"""Spreads at which offsets are tabulated."""


@lru_cache(maxsize=16)
def offset_table(false_alarm: float) -> Floats32:
    """Offsets of `SPREADS_DB`, for interpolation."""
    return np.array(
        [false_alarm_offset_db(spread, false_alarm) for spread in SPREADS_DB.tolist()],
        np.float32,
    )


def false_alarm_offsets_db(spreads_db: Floats32, false_alarm: float) -> Floats32:
    """`false_alarm_offset_db` of each, by interpolation to 0.01 dB."""
    return interpolated(
        spreads_db,
        float(SPREADS_DB[0]),
        float(SPREADS_DB[1] - SPREADS_DB[0]),
        offset_table(false_alarm),
    )


@compiled
def interpolated(
    values: Floats32, first: float, step: float, table: Floats32
) -> Floats32:
    """A table of what belongs to equally spaced values, looked up for each; its ends beyond it."""
    found = np.empty_like(values)
    for n in range(values.size):
        place = min(max((float(values.flat[n]) - first) / step, 0.0), len(table) - 1.0)
        row = min(int(place), len(table) - 2)
        found.flat[n] = table[row] + (place - row) * (table[row + 1] - table[row])
    return found


LEAST_COUNT = 3
"""Least beams and bins of smoothing and closing, where a long window has fewer in that length: speckle of one look
would raise the threshold over an object, and break it into pieces."""
CELL_M = 0.005
"""Grid on which designs are checked."""


def check_candidates(
    designs: Iterable[LandmarkDesign], params: DetectionParams, search_m: float
) -> None:
    """Refuse designs that can never be a candidate.

    Only candidates are compared with designs, and a candidate is one connected bright region, whose centroid is where
    the design's figure is looked for, and up to ``search_m`` beside it. So some bright part of a design must have the
    right size and lie about the middle of its figure (`LandmarkDesign.figure_m`). Parts are taken as
    `select_candidates` sees them in a perfect image without speckle.

    Raises `CalibrationError` naming the design, its parts and the limits.
    """
    for design in designs:
        areas_m2, extents_m, offsets_m = bright_parts(design, params)
        is_sized = (areas_m2 >= params.min_area_m2) & (areas_m2 <= params.max_area_m2)
        is_sized &= extents_m <= params.max_extent_m
        if (is_sized & (offsets_m <= search_m)).any():
            continue
        parts = ", ".join(
            f"{area:.2g} m² with its centre {offset * 100:.0f} cm from that of the largest"
            for area, offset in zip(areas_m2, offsets_m, strict=True)
        )
        raise CalibrationError(
            f"landmark design {design.name} (id {design.id}) would never be found: its bright parts are "
            f"{parts or 'all smoothed away'}; one must have {params.min_area_m2:g} to {params.max_area_m2:g} m², be no "
            f"longer than {params.max_extent_m:g} m and lie within {search_m * 100:.1f} cm of the largest; "
            "join the parts, change their size, or set detection.closing_m, min_area_m2, max_area_m2, max_extent_m"
        )


def bright_parts(
    design: LandmarkDesign, params: DetectionParams
) -> tuple[Floats, Floats, Floats]:
    """Area, length and distance from the design's figure of each connected part over the floor, largest first."""
    half = int(
        np.ceil((design.size_m / 2 + params.smoothing_m + params.closing_m) / CELL_M)
    )
    x_m, y_m = np.meshgrid(*2 * [CELL_M * np.arange(-half, half + 1)], indexing="ij")
    level_db = np.nan_to_num(design.level_db(x_m, y_m)).astype(np.float32)
    smooth_db = cv2.blur(level_db, odd_counts(params.smoothing_m, (CELL_M, CELL_M)))
    is_bright = (smooth_db >= LEAST_BRIGHT_DB).astype(np.uint8)
    closing = np.ones(odd_counts(params.closing_m, (CELL_M, CELL_M)), np.uint8)
    count, labels = cv2.connectedComponents(
        cv2.morphologyEx(is_bright, cv2.MORPH_CLOSE, closing), connectivity=8
    )
    places = [np.stack([x_m, y_m])[:, labels == part] for part in range(1, count)]
    # the largest part is the figure
    places.sort(key=lambda place: -place.shape[1])
    areas = np.array([place.shape[1] * CELL_M**2 for place in places])
    extents = np.array(
        [
            # as `Regions.extent_m`
            np.sqrt(12 * np.linalg.eigvalsh(np.cov(place, bias=True)).max())
            for place in places
        ]
    )
    offsets = np.array(
        [np.linalg.norm(place.mean(axis=1) - design.figure_m) for place in places]
    )
    return areas, extents, offsets
