"""Candidate selection: what stands out of one polar frame, at a constant false-alarm rate in decibels.

1. Mean level over a patch of `DetectionParams.smoothing_m`, in decibels.
2. Local background B and spread sigma of these means (`sonar_graph.sonar.regions`).
3. A pixel stands out when it exceeds ``B + offset(sigma)``. The offset is that of speckle with as many looks L as sigma
   says, ``sigma^2 = (10 / ln 10)^2 psi'(L)`` with psi the digamma function (`false_alarm_offset_db`).
4. Pixels that stand out, closed over gaps, form regions; areas and extents in metres decide which are candidates.

Because sigma is measured where the pixel is, texture raises the threshold by itself.

Whether a design can ever be a candidate: refused before a log is read, instead of never found in it.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import digamma, gammainccinv, polygamma

from sonar_graph.calibration import Section
from sonar_graph.devices import LEAST_BRIGHT_DB, LandmarkDesign
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sonar.geometry import FloorView, elevation_sigma
from sonar_graph.sonar.regions import Candidates, CandidateVerdict, Floats32, background_of, measure_regions

DB_PER_NEPER = 10.0 / np.log(10.0)


class DetectionParams(Section):
    """Settings of the candidate selection. Lengths are on the ground for landmarks of about 0.3 m."""

    false_alarm: float = Field(1e-3, gt=0, lt=0.5)
    """Probability that a pixel of mere background stands out."""
    smoothing_m: float = Field(0.03, gt=0)
    """Side of the patch over which levels are averaged."""
    background_m: float = Field(0.9, gt=0)
    """Side of the neighbourhood that gives the background; well over twice the landmarks' size."""
    closing_m: float = Field(0.03, ge=0)
    """Gaps up to this width are bridged."""
    min_area_m2: float = Field(0.008, ge=0)
    """Smaller regions are rejected."""
    max_area_m2: float = Field(0.2, gt=0)
    """Larger regions are rejected."""
    max_extent_m: float = Field(0.7, gt=0)
    """Longer regions are rejected."""
    keep_at_edge: bool = False
    """Accept regions that touch the edge of the image; their centroids are then not the objects'."""
    max_candidates: int = Field(16, gt=0)
    """Of those left, this many with the highest level times area are accepted."""
    elevation_aperture_rad: float = Field(0.244, gt=0)
    """Full vertical opening of the sonar: what is known of the elevation without a floor."""


def select_candidates(
    image_db: Floats32,
    ranges_m: Floats,
    azimuths_rad: Floats,
    view: FloorView | None = None,
    params: DetectionParams | None = None,
) -> Candidates:
    """The regions of one polar frame that stand out, rejected ones included.

    Parameters
    ----------
    image_db
        Levels in dB, shape (beams, bins), finite.
    ranges_m, azimuths_rad
        Middle of each bin, shape (bins,), and of each beam, shape (beams,).
    view
        The floor; None: not known, areas are in the slant plane.
    params
        Settings; None for the defaults.

    Raises
    ------
    MeasurementError
        When the shapes do not belong together, or a level is not finite.
    """
    params = params or DetectionParams()
    _require_image(image_db, (len(azimuths_rad), len(ranges_m)))
    cell_m = _cell_m(ranges_m, azimuths_rad)
    smoothing = _odd(params.smoothing_m, cell_m)
    smooth = np.asarray(cv2.blur(image_db, smoothing[::-1], borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)
    background = background_of(smooth, smoothing, _odd(params.background_m, cell_m))
    contrast = smooth - _spread_out(background.level_db, smooth.shape)
    offsets = false_alarm_offsets_db(background.spread_db, params.false_alarm)
    mask = cv2.compare(contrast, _spread_out(offsets, smooth.shape), cv2.CMP_GT)
    closing = cv2.getStructuringElement(cv2.MORPH_RECT, _odd(params.closing_m, cell_m)[::-1])
    # opencv's own choice takes three times as long for the same labels
    count, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        cv2.morphologyEx(mask, cv2.MORPH_CLOSE, closing), 8, cv2.CV_32S, cv2.CCL_GRANA
    )
    return _judged(
        contrast,
        np.asarray(labels, dtype=np.int32),
        stats[1:count].astype(np.int64),
        ranges_m,
        azimuths_rad,
        view,
        params,
    )


def _require_image(image_db: Floats32, beams_and_bins: tuple[int, int]) -> None:
    if image_db.shape != beams_and_bins or min(image_db.shape) < 2:
        raise MeasurementError(f"sonar frame: shape {image_db.shape}; beams and bins are {beams_and_bins}, 2 or more")
    if not np.isfinite(cv2.sumElems(image_db)[0]):
        raise MeasurementError("sonar frame: levels that are not finite; leave the frame out")


def false_alarm_offset_db(spread_db: float, false_alarm: float) -> float:
    """How far over its mean a level must be, in dB, for mere speckle to get there with this probability.

    The intensity is Gamma with L looks, so that its level in dB has the mean ``c psi(L) + const`` and the variance
    ``c^2 psi'(L)``, with ``c = 10 / ln 10``. One look: 5.57 dB, and 9.14 dB for 1 %.
    """
    looks = _looks(spread_db)
    return float(DB_PER_NEPER * (np.log(gammainccinv(looks, false_alarm)) - digamma(looks)))


def false_alarm_offsets_db(spreads_db: Floats32, false_alarm: float) -> Floats32:
    """`false_alarm_offset_db` of each, by interpolation to 0.01 dB."""
    spreads, offsets = _offset_table(false_alarm)
    return np.interp(spreads_db, spreads, offsets).astype(np.float32)


@lru_cache(maxsize=16)
def _offset_table(false_alarm: float) -> tuple[Floats, Floats]:
    spreads = np.linspace(0.05, 12.0, 240)
    return spreads, np.array([false_alarm_offset_db(spread, false_alarm) for spread in spreads])


def _looks(spread_db: float) -> float:
    """L with ``psi'(L) = (spread / c)^2``, by Newton's method on its logarithm."""
    wanted = (spread_db / DB_PER_NEPER) ** 2
    log_looks = -np.log(wanted) if wanted < 1 else -0.5 * np.log(wanted)
    for _ in range(30):
        looks = np.exp(log_looks)
        value = float(polygamma(1, looks))
        log_looks += (np.log(wanted) - np.log(value)) * value / (looks * float(polygamma(2, looks)))
    return float(np.exp(log_looks))


def _cell_m(ranges_m: Floats, azimuths_rad: Floats) -> tuple[float, float]:
    """Width of a beam at mid-range and length of a bin."""
    across = abs(float(azimuths_rad[-1] - azimuths_rad[0])) / (len(azimuths_rad) - 1)
    along = abs(float(ranges_m[-1] - ranges_m[0])) / (len(ranges_m) - 1)
    return across * float(ranges_m[0] + ranges_m[-1]) / 2, along


def _odd(length_m: float, cell_m: tuple[float, float]) -> tuple[int, int]:
    """Beams and bins of a square with this side, odd numbers."""
    beams, bins = (2 * round((length_m / cell - 1) / 2) + 1 for cell in cell_m)
    return max(1, beams), max(1, bins)


def _spread_out(nodes: Floats32, shape: tuple[int, ...]) -> Floats32:
    """Nodes of the background interpolated to every pixel."""
    return np.asarray(cv2.resize(nodes, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _judged(
    contrast: Floats32,
    labels: NDArray[np.int32],
    stats: Ints,
    ranges_m: Floats,
    azimuths_rad: Floats,
    view: FloorView | None,
    params: DetectionParams,
) -> Candidates:
    """Positions, sizes and verdicts of labelled regions."""
    regions = measure_regions(contrast, labels, len(stats), ranges_m, azimuths_rad, view)
    boxes = stats[:, [1, 0, 3, 2]]
    if view is None:
        sigma = np.full(len(stats), elevation_sigma(params.elevation_aperture_rad))
    else:
        sigma = view.elevation_sigmas(regions.points_m)
    return Candidates(
        verdicts=_verdicts(regions.area_m2, regions.extent_m, regions.level_db, boxes, labels.shape, params),
        range_m=regions.range_m,
        azimuth_rad=regions.azimuth_rad,
        elevation_rad=regions.elevation_rad,
        elevation_sigma_rad=sigma,
        area_m2=regions.area_m2,
        extent_m=regions.extent_m,
        level_db=regions.level_db,
        boxes=boxes,
        window=np.array([[ranges_m.min(), ranges_m.max()], [azimuths_rad.min(), azimuths_rad.max()]]),
        labels=labels,
    )


def _verdicts(
    area_m2: Floats, extent_m: Floats, level_db: Floats, boxes: Ints, shape: tuple[int, ...], params: DetectionParams
) -> Ints:
    """`CandidateVerdict` of each region; each overrides those before it."""
    at_edge = (boxes[:, :2] == 0).any(axis=1) | (boxes[:, :2] + boxes[:, 2:] == shape).any(axis=1)
    verdicts = np.full(len(boxes), int(CandidateVerdict.ACCEPTED))
    verdicts[extent_m > params.max_extent_m] = CandidateVerdict.TOO_LONG
    verdicts[area_m2 > params.max_area_m2] = CandidateVerdict.TOO_LARGE
    verdicts[area_m2 < params.min_area_m2] = CandidateVerdict.TOO_SMALL
    verdicts[at_edge & (not params.keep_at_edge)] = CandidateVerdict.AT_EDGE
    verdicts[~(area_m2 > 0)] = CandidateVerdict.OFF_FLOOR
    accepted = np.flatnonzero(verdicts == CandidateVerdict.ACCEPTED)
    strongest_first = accepted[np.argsort(-(level_db * area_m2)[accepted], kind="stable")]
    verdicts[strongest_first[params.max_candidates :]] = CandidateVerdict.BEYOND_LIMIT
    return verdicts


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
