"""Real frames: objects found against candidates a frame, over a whole curve of thresholds, for four detectors.

375 frames of an ARIS Explorer 3000 in a tank with boxes around debris (Valdenegro-Toro, Singh, arXiv 2108.06800). The
frames are Cartesian fans without ranges; apex and edges of the fan are fitted in every frame, and all detectors get the
same polar image (128 beams, one bin a pixel). Lengths are in pixels, counted as centimetres.

* ``ours``: `sonar_graph.sonar.cfar.select_candidates`; the probability of a false alarm is swept.
* ``soca``: smallest-of cell averaging along range (40 training, 10 guard cells, Pfa 0.1, gate 65 of 255: the values
  that bruce_slam publishes) on the samples as they are; Pfa and, along with it, the gate are swept.
* ``soca-power``: the same on the echo's power, ``10^(dB / 10)``, without a gate; Pfa is swept.
* ``median``: what anybody would try first: levels smoothed as ours are, minus their median over the beams at each
  range; a threshold in decibels is swept. A local background and its spread must be better than that.
* ``actag``: AcTag's median filter (radius 4) and threshold at the middle between the smallest and largest of a
  neighbourhood (radius 8) minus an offset of 1; the offset is swept.

``...-strongest`` keeps a detector's threshold (ours as it comes, the others' best) and sweeps how many regions are
kept, those with the largest product of level and area first.

What a detector marks becomes regions in the same way for all: gaps closed, connected, gated by area. A box is found
when a region has its centroid in it and a bounding box that overlaps it (intersection over union) by at least 0.2.
"Wall" boxes are counted apart: a wall is no landmark, and gates on area are there to reject it.

A lead is what ours finds more than the best other detector with at most so many candidates a frame, each by the better
of its ways and at its best setting. Its 95 % interval is that of 1,000 resamples of blocks of 15 frames, since frames
in a row show the same objects; in each of them the settings are chosen anew.
"""

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from math import comb
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, note, print_table, recording

from sonar_graph.calibration import SonarImage
from sonar_graph.images import decibels
from sonar_graph.measurements import Floats
from sonar_graph.sonar.cfar import (
    LEAST_COUNT,
    DetectionParams,
    odd_counts,
    select_candidates,
)
from sonar_graph.sonar.regions import measure_regions

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]
"""Left, top, width, height in the Cartesian frame."""
BEAMS = 128
METRES_A_PIXEL = 0.01
LEAST_OVERLAP = 0.2
SETTINGS = DetectionParams(
    false_alarm=1e-3,
    smoothing_m=0.07,
    background_m=1.5,
    closing_m=0.07,
    min_area_m2=0.015,
    max_area_m2=1.0,
    max_extent_m=2.5,
    keep_at_edge=True,
    max_candidates=1000,
)


@dataclass(frozen=True)
class Frame:
    """One frame in polar coordinates, its fan and its boxes."""

    polar: Image
    """Shape (beams, bins)."""
    ranges_m: Floats
    azimuths_rad: Floats
    apex: tuple[float, float]
    """Column and row in the Cartesian frame."""
    boxes: list[tuple[str, Box]]


def frames_of(folder: Path) -> Iterator[Path]:
    """Image files in the order of their numbers."""
    return iter(
        sorted(
            (folder / "Images").glob("*.png"),
            key=lambda path: int(re.findall(r"\d+", path.stem)[-1]),
        )
    )


def read_frame(path: Path) -> Frame:
    """A frame, resampled to beams and bins."""
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    apex, half_angle, (r0, r1) = fit_fan(picture)
    azimuths = np.linspace(half_angle, -half_angle, BEAMS)
    ranges = np.arange(np.ceil(r0) + 1, np.floor(r1))
    columns = apex[0] - np.sin(azimuths)[:, None] * ranges
    rows = apex[1] - np.cos(azimuths)[:, None] * ranges
    polar = cv2.remap(
        picture, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR
    )
    annotation = path.parents[1] / "BoxAnnotations" / f"{path.stem}.xml"
    return Frame(
        np.asarray(polar),
        ranges * METRES_A_PIXEL,
        azimuths,
        apex,
        read_boxes(annotation),
    )


def read_boxes(path: Path) -> list[tuple[str, Box]]:
    """Names and boxes of the annotated objects."""
    found = []
    for thing in ElementTree.parse(path).getroot().findall("object"):
        corner = thing.find("bndbox")
        assert corner is not None
        x, y, w, h = (
            float(corner.findtext(key, "nan")) for key in ("x", "y", "w", "h")
        )
        found.append((thing.findtext("name", ""), (x, y, w, h)))
    return found


def fit_fan(picture: Image) -> tuple[tuple[float, float], float, tuple[float, float]]:
    """Apex (column, row), half of the opening angle, and smallest and largest range in pixels."""
    lit = cv2.morphologyEx(
        (picture > 0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)
    )
    rows = np.flatnonzero(lit.any(axis=1))
    middle = rows[
        (rows > rows[0] + 0.2 * len(rows)) & (rows < rows[0] + 0.85 * len(rows))
    ]
    left = np.array([np.flatnonzero(lit[row])[0] for row in middle])
    right = np.array([np.flatnonzero(lit[row])[-1] for row in middle])
    (a, b), (c, d) = robust_line(middle, left), robust_line(middle, right)
    row = (d - b) / (a - c)
    column = a * row + b
    half = (np.arctan(abs(a)) + np.arctan(abs(c))) / 2
    at = np.flatnonzero(lit[:, round(column)])
    return (
        (float(column), float(row)),
        float(half),
        (float(row - at[-1]), float(row - at[0])),
    )


def robust_line(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, float]:
    """Slope and offset, fitted twice: the second time without what is more than 3 pixels off."""
    slope, offset = np.polyfit(x, y, 1)
    near = np.abs(slope * x + offset - y) < 3
    slope, offset = (
        np.polyfit(x[near], y[near], 1) if near.sum() > 20 else (slope, offset)
    )
    return float(slope), float(offset)


Labels = NDArray[np.int32]
Detector = Callable[[Frame, DetectionParams], tuple[Labels, NDArray[Any]]]
"""Label image and the labels of the accepted regions."""


def ours(
    change: dict[str, float], frame: Frame, settings: DetectionParams
) -> tuple[Labels, NDArray[Any]]:
    level = decibels(frame.polar, SonarImage())
    params = settings.model_copy(update=change)
    candidates = select_candidates(
        level, frame.ranges_m, frame.azimuths_rad, None, params
    )
    return candidates.labels, candidates.accepted + 1


def soca_factor(pfa: float, training: int = 40) -> float:
    """Factor T on the smaller mean, for exponential clutter and n cells on either side.

    ``Pfa / 2 = (2 + T/n)^-n sum_k C(n - 1 + k, k) (2 + T/n)^-k`` over k < n.
    """
    n = training // 2

    def excess(factor: float) -> float:
        base = 2 + factor / n
        return sum(comb(n - 1 + k, k) * base ** -(n + k) for k in range(n)) - pfa / 2

    return float(brentq(excess, 0.0, 1e9))


def soca(
    setting: tuple[float, float],
    is_power: bool,
    frame: Frame,
    settings: DetectionParams,
) -> Any:
    pfa, gate = setting
    image = frame.polar.astype(np.float64)
    cells = (
        10 ** (decibels(frame.polar, SonarImage()).astype(np.float64) / 10)
        if is_power
        else image
    )
    half, guard = 20, 5
    total = np.pad(np.cumsum(cells, axis=1), ((0, 0), (1, 0)))
    bins = cells.shape[1]
    at = np.arange(half + guard, bins - half - guard)
    before = total[:, at - guard] - total[:, at - guard - half]
    after = total[:, at + guard + half + 1] - total[:, at + guard + 1]
    mask = np.zeros(cells.shape, dtype=np.uint8)
    mask[:, at] = (
        cells[:, at] > soca_factor(pfa) * np.minimum(before, after) / half
    ) & (image[:, at] > gate)
    return regions_of(mask, frame, settings)


def median(
    offset_db: float, frame: Frame, settings: DetectionParams
) -> tuple[Labels, NDArray[Any]]:
    level = decibels(frame.polar, SonarImage())
    smooth = cv2.blur(
        level,
        counts(settings.smoothing_m, frame)[::-1],
        borderType=cv2.BORDER_REFLECT_101,
    )
    return regions_of(
        (smooth - np.median(smooth, axis=0) > offset_db).astype(np.uint8),
        frame,
        settings,
    )


def actag(
    offset: float, frame: Frame, settings: DetectionParams
) -> tuple[Labels, NDArray[Any]]:
    padded = cv2.copyMakeBorder(frame.polar, 4, 4, 4, 4, cv2.BORDER_REPLICATE)
    filtered = np.asarray(cv2.medianBlur(padded, 9))[4:-4, 4:-4]
    window = np.ones((17, 17), np.uint8)
    low = cv2.erode(filtered, window, borderType=cv2.BORDER_REPLICATE).astype(
        np.float64
    )
    high = cv2.dilate(filtered, window, borderType=cv2.BORDER_REPLICATE).astype(
        np.float64
    )
    return regions_of(
        (filtered >= (low + high) / 2 - offset).astype(np.uint8), frame, settings
    )


def counts(length_m: float, frame: Frame) -> list[int]:
    """Beams and bins of a length, as `select_candidates` takes them."""
    beam_m = (
        abs(frame.azimuths_rad[1] - frame.azimuths_rad[0])
        * frame.ranges_m[[0, -1]].mean()
    )
    return [
        max(count, LEAST_COUNT)
        for count in odd_counts(length_m, (float(beam_m), METRES_A_PIXEL))
    ]


def regions_of(
    mask: Image, frame: Frame, settings: DetectionParams
) -> tuple[Labels, NDArray[Any]]:
    """Regions of a mask, closed and gated as ours are."""
    closed = cv2.morphologyEx(
        mask, cv2.MORPH_CLOSE, np.ones(counts(settings.closing_m, frame), np.uint8)
    )
    count, labels = cv2.connectedComponents(closed, connectivity=8, ltype=cv2.CV_32S)
    contrast = frame.polar.astype(np.float32)
    found = measure_regions(
        contrast,
        np.asarray(labels),
        count - 1,
        frame.ranges_m,
        frame.azimuths_rad,
        None,
    )
    is_sized = (found.area_m2 >= settings.min_area_m2) & (
        found.area_m2 <= settings.max_area_m2
    )
    accepted = np.flatnonzero(is_sized & (found.extent_m <= settings.max_extent_m))
    strength = (found.level_db * found.area_m2)[accepted]
    return np.asarray(labels), accepted[np.argsort(-strength)][
        : settings.max_candidates
    ] + 1


@dataclass(frozen=True)
class Score:
    """Result of one detector on one frame."""

    candidates: int
    found: tuple[bool, ...]
    """Of each box."""


def score(frame: Frame, labels: Labels, accepted: NDArray[Any]) -> Score:
    """Compare regions with boxes."""
    regions = [cartesian_box(frame, labels, int(label)) for label in accepted]
    found = tuple(
        any(is_hit(*region, box) for region in regions) for _, box in frame.boxes
    )
    return Score(len(accepted), found)


def cartesian_box(
    frame: Frame, labels: Labels, label: int
) -> tuple[tuple[float, float], Box]:
    """Centroid and bounding box of a region in the Cartesian frame."""
    beam, bin_ = np.nonzero(labels == label)
    r = frame.ranges_m[bin_] / METRES_A_PIXEL
    x = frame.apex[0] - r * np.sin(frame.azimuths_rad[beam])
    y = frame.apex[1] - r * np.cos(frame.azimuths_rad[beam])
    centroid = float(np.average(x, weights=r)), float(np.average(y, weights=r))
    return centroid, (
        float(x.min()),
        float(y.min()),
        float(np.ptp(x)),
        float(np.ptp(y)),
    )


def is_hit(centroid: tuple[float, float], region: Box, box: Box) -> bool:
    """Overlap test of a region with a box."""
    (x, y, w, h), (u, v, p, q) = box, region
    across, along = min(x + w, u + p) - max(x, u), min(y + h, v + q) - max(y, v)
    shared = max(across, 0.0) * max(along, 0.0)
    is_inside = x <= centroid[0] <= x + w and y <= centroid[1] <= y + h
    return is_inside and shared >= LEAST_OVERLAP * (w * h + p * q - shared)


OURS = (
    0.2,
    0.05,
    0.02,
    0.01,
    3e-3,
    1e-3,
    1e-4,
    1e-6,
    1e-9,
    1e-13,
    1e-20,
    1e-30,
    1e-45,
    1e-60,
    1e-90,
)
STRONGEST = (1, 2, 3, 4, 5, 6, 8, 12, 16)
SOCA = tuple(
    (pfa, gate)
    for gate in (0, 65, 100)
    for pfa in (0.3, 0.25, 0.2, 0.17, 0.14, 0.12, 0.1, 0.01)
)
PFAS = (
    0.1,
    0.03,
    0.01,
    3e-3,
    1e-3,
    1e-4,
    1e-5,
    1e-6,
    1e-7,
    1e-8,
    1e-10,
    1e-12,
    1e-15,
    1e-20,
)
MEDIAN_OFFSETS_DB = (
    6.0,
    8.0,
    9.0,
    10.0,
    11.0,
    12.0,
    13.0,
    14.0,
    15.0,
    16.0,
    17.0,
    18.0,
    20.0,
    22.0,
    25.0,
    28.0,
)
OFFSETS = (1.0, 0.0, -2.0, -4.0, -6.0, -8.0, -11.0, -15.0, -20.0, -25.0, -30.0, -40.0)


def detectors() -> dict[str, list[tuple[object, Detector]]]:
    """All detectors by name, each with its settings."""
    return {
        "ours": [(p, partial(ours, {"false_alarm": p})) for p in OURS],
        "soca": [(s, partial(soca, s, False)) for s in SOCA],
        "soca-power": [(p, partial(soca, (p, -1.0), True)) for p in PFAS],
        "median": [(o, partial(median, o)) for o in MEDIAN_OFFSETS_DB],
        "actag": [(o, partial(actag, o)) for o in OFFSETS],
        "ours-strongest": strongest(partial(ours, {})),
        "soca-strongest": strongest(partial(soca, (0.3, 100), False)),
        "soca-power-strongest": strongest(partial(soca, (1e-6, -1.0), True)),
        "median-strongest": strongest(partial(median, 12.0)),
        "actag-strongest": strongest(partial(actag, -6.0)),
    }


def strongest(detector: Detector) -> list[tuple[object, Detector]]:
    """A detector that keeps its strongest regions only."""

    def limited(
        limit: int, frame: Frame, settings: DetectionParams
    ) -> tuple[Labels, NDArray[Any]]:
        return detector(frame, settings.model_copy(update={"max_candidates": limit}))

    return [(k, partial(limited, k)) for k in STRONGEST]


PUBLISHED: dict[str, object] = {
    "ours": 1e-3,
    "soca": (0.1, 65),
    "soca-power": 0.1,
    "median": 12.0,
    "actag": 1.0,
}
"""The setting each comes with."""


@dataclass(frozen=True)
class Counts:
    """One setting of one detector, frame by frame."""

    detector: str
    setting: object
    candidates: Floats
    hits: Floats
    """Objects found."""
    walls: Floats
    """Walls found."""


def judge_frame(
    settings: DetectionParams, path: Path
) -> dict[tuple[str, object], tuple[Score, tuple[str, ...]]]:
    """Every detector at every setting on one frame, with the names of the boxes."""
    cv2.setNumThreads(1)
    frame = read_frame(path)
    names = tuple(name for name, _ in frame.boxes)
    return {
        (name, setting): (score(frame, *detector(frame, settings)), names)
        for name, cases in detectors().items()
        for setting, detector in cases
    }


def curves(
    paths: Sequence[Path], settings: DetectionParams, workers: int
) -> tuple[list[Counts], Floats, Floats]:
    """All settings of all detectors, and the number of objects and of walls in each frame."""
    judged = in_parallel(partial(judge_frame, settings), paths, workers, "frame")
    names = [next(iter(frame.values()))[1] for frame in judged]
    walls = np.array([sum(name == "Wall" for name in of) for of in names], float)
    objects = np.array([len(of) for of in names], float) - walls
    found = []
    for key in judged[0]:
        scores = [frame[key][0] for frame in judged]
        at_walls = [
            sum(hit for hit, name in zip(one.found, of, strict=True) if name == "Wall")
            for one, of in zip(scores, names, strict=True)
        ]
        hits = np.array([sum(one.found) for one in scores], float) - at_walls
        found.append(
            Counts(
                *key,
                np.array([one.candidates for one in scores], float),
                hits,
                np.array(at_walls, float),
            )
        )
    return found, objects, walls


Rates = dict[str, tuple[Floats, Floats]]
"""Candidates a frame, and share of the objects found, at the settings of each detector."""


def rates_of(found: Sequence[Counts], objects: Floats, weights: Floats) -> Rates:
    """Rates over frames that count with these weights."""
    rates = {}
    for name in dict.fromkeys(each.detector for each in found):
        candidates, hits = (
            np.array(
                [
                    getattr(each, what) @ weights
                    for each in found
                    if each.detector == name
                ]
            )
            for what in ("candidates", "hits")
        )
        rates[name] = candidates / weights.sum(), hits / (objects @ weights)
    return rates


def envelope(rates: Rates, detector: str, budgets: Sequence[float]) -> list[float]:
    """The best hit rate of a detector with at most so many candidates a frame."""
    candidates, hit_rate = rates[detector]
    return [
        float(hit_rate[candidates <= budget].max(initial=0.0)) for budget in budgets
    ]


def leads(rates: Rates) -> Floats:
    """What ours finds more than the best other detector, each by the better of its ways, by budget."""
    ways = {
        name: np.maximum(
            *(envelope(rates, way, BUDGETS) for way in (name, f"{name}-strongest"))
        )
        for name in PUBLISHED
    }
    return np.asarray(ways.pop("ours") - np.max(list(ways.values()), axis=0))


def lead_intervals(found: Sequence[Counts], objects: Floats, seed: int = 1) -> Floats:
    """95 % intervals of the leads by resampled blocks of frames, shape (2, budgets)."""
    rng, n = np.random.default_rng(seed), len(objects)
    drawn = []
    for _ in range(RESAMPLES):
        starts = rng.integers(0, n, max(1, n // BLOCK_FRAMES))
        at = (starts[:, None] + np.arange(BLOCK_FRAMES)) % n
        drawn.append(
            leads(
                rates_of(
                    found, objects, np.bincount(at.ravel(), minlength=n).astype(float)
                )
            )
        )
    return np.asarray(np.quantile(drawn, (0.025, 0.975), axis=0))


def draw(rates: Rates, path: Path) -> None:
    """Hit rate against candidates a frame."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    budgets, settings = np.geomspace(0.3, 60, 200).tolist(), detectors()
    for name, mark in zip(PUBLISHED, "os^vD", strict=True):
        candidates, hit_rate = rates[name]
        (dots,) = axes.plot(candidates, hit_rate, mark, label=name, ms=4, alpha=0.5)
        color = dots.get_color()
        axes.plot(budgets, envelope(rates, name, budgets), lw=1.2, color=color)
        axes.plot(
            budgets,
            envelope(rates, f"{name}-strongest", budgets),
            ":",
            lw=1.2,
            color=color,
        )
        at = [setting for setting, _ in settings[name]].index(PUBLISHED[name])
        axes.plot(candidates[at], hit_rate[at], mark, ms=10, mfc="none", color=color)
    axes.set(
        xscale="log",
        xlabel="candidates a frame",
        ylabel="objects found (without walls)",
        ylim=(0, 1),
    )
    axes.grid(alpha=0.3)
    axes.legend(title="large: as it comes\ndotted: strongest only", frameon=False)
    figure.savefig(path, dpi=150)


BUDGETS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
BLOCK_FRAMES, RESAMPLES = 15, 1000


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument("--figure", type=Path, help="where the curve is drawn (png)")
    arguments = parser.parse_args()
    data = arguments.data and Path(arguments.data) / "sonar"
    with recording(data, "marine_debris_fls.tar.xz", "marine_debris_fls") as folder:
        paths = list(frames_of(folder))[:: 25 if arguments.quick else 1]
        found, objects, walls = curves(paths, SETTINGS, arguments.workers)
    note(f"{len(paths)} frames")
    print_table(
        ("detector", "setting", "candidates a frame", "objects found", "walls found"),
        [
            (
                c.detector,
                str(c.setting),
                c.candidates.mean(),
                c.hits.sum() / objects.sum(),
                c.walls.sum() / walls.sum(),
            )
            for c in found
        ],
    )
    rates = rates_of(found, objects, np.ones(len(paths)))
    best = {name: envelope(rates, name, BUDGETS) for name in rates}
    lead, (low, high) = leads(rates), lead_intervals(found, objects)
    rows = [*best.items(), ("lead of ours", lead), ("from (95 %)", low), ("to", high)]
    print_table(
        ("objects found with at most", *(f"{b:g}" for b in BUDGETS)),
        [(name, *row) for name, row in rows],
    )
    if arguments.figure:
        draw(rates, arguments.figure)
    figures: dict[str, Any] = {
        "frames": len(paths),
        "candidates_a_frame": list(BUDGETS),
        "passed": bool((lead > 0).all()),
    }
    figures |= {
        name.replace("-", "_"): [round(rate, 4) for rate in row]
        for name, row in best.items()
    }
    figures |= {
        "lead": lead.round(4).tolist(),
        "lead_from": low.round(4).tolist(),
        "lead_to": high.round(4).tolist(),
    }
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
