"""Real frames: objects found against candidates a frame, over a whole curve of thresholds, for three detectors.

375 frames of an ARIS Explorer 3000 in a tank with boxes around debris (Valdenegro-Toro, Singh, arXiv 2108.06800). The
frames are Cartesian fans without ranges; apex and edges of the fan are fitted in every frame, and all detectors get the
same polar image (128 beams, one bin a pixel). Lengths are in pixels, counted as centimetres.

* ``ours``: `sonar_graph.sonar.cfar.select_candidates`; the probability of a false alarm is swept.
* ``soca``: smallest-of cell averaging along range (40 training, 10 guard cells, Pfa 0.1, gate 65 of 255: the values
  that bruce_slam publishes) on the samples as they are; Pfa and, along with it, the gate are swept.
* ``soca-power``: the same on the echo's power, ``10^(dB / 10)``, without a gate; Pfa is swept.
* ``actag``: AcTag's median filter (radius 4) and threshold at the middle between the smallest and largest of a
  neighbourhood (radius 8) minus an offset of 1; the offset is swept.

``...-strongest`` keeps a detector's threshold (ours as it comes, the others' best) and sweeps how many regions are
kept, those with the largest product of level and area first.

What a detector marks becomes regions in the same way for all: gaps closed, connected, gated by area. A box is found
when a region has its centroid in it and a bounding box that overlaps it (intersection over union) by at least 0.2.
"Wall" boxes are counted apart: a wall is no landmark, and gates on area are there to reject it.
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
from sonar_graph.sonar.cfar import DetectionParams, select_candidates
from sonar_graph.sonar.regions import measure_regions

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]
"""Left, top, width, height in the Cartesian frame."""
BEAMS = 128
METRES_A_PIXEL = 0.01
LEAST_OVERLAP = 0.2
SETTINGS = DetectionParams(
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
    return iter(sorted((folder / "Images").glob("*.png"), key=lambda path: int(re.findall(r"\d+", path.stem)[-1])))


def read_frame(path: Path) -> Frame:
    """A frame, resampled to beams and bins."""
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    apex, half_angle, (r0, r1) = fit_fan(picture)
    azimuths = np.linspace(half_angle, -half_angle, BEAMS)
    ranges = np.arange(np.ceil(r0) + 1, np.floor(r1))
    columns = apex[0] - np.sin(azimuths)[:, None] * ranges
    rows = apex[1] - np.cos(azimuths)[:, None] * ranges
    polar = cv2.remap(picture, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    annotation = path.parents[1] / "BoxAnnotations" / f"{path.stem}.xml"
    return Frame(np.asarray(polar), ranges * METRES_A_PIXEL, azimuths, apex, read_boxes(annotation))


def read_boxes(path: Path) -> list[tuple[str, Box]]:
    """Names and boxes of the annotated objects."""
    found = []
    for thing in ElementTree.parse(path).getroot().findall("object"):
        corner = thing.find("bndbox")
        assert corner is not None
        x, y, w, h = (float(corner.findtext(key, "nan")) for key in ("x", "y", "w", "h"))
        found.append((thing.findtext("name", ""), (x, y, w, h)))
    return found


def fit_fan(picture: Image) -> tuple[tuple[float, float], float, tuple[float, float]]:
    """Apex (column, row), half of the opening angle, and smallest and largest range in pixels."""
    lit = cv2.morphologyEx((picture > 0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    rows = np.flatnonzero(lit.any(axis=1))
    middle = rows[(rows > rows[0] + 0.2 * len(rows)) & (rows < rows[0] + 0.85 * len(rows))]
    left = np.array([np.flatnonzero(lit[row])[0] for row in middle])
    right = np.array([np.flatnonzero(lit[row])[-1] for row in middle])
    (a, b), (c, d) = robust_line(middle, left), robust_line(middle, right)
    row = (d - b) / (a - c)
    column = a * row + b
    half = (np.arctan(abs(a)) + np.arctan(abs(c))) / 2
    at = np.flatnonzero(lit[:, round(column)])
    return (float(column), float(row)), float(half), (float(row - at[-1]), float(row - at[0]))


def robust_line(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, float]:
    """Slope and offset, fitted twice: the second time without what is more than 3 pixels off."""
    slope, offset = np.polyfit(x, y, 1)
    near = np.abs(slope * x + offset - y) < 3
    slope, offset = np.polyfit(x[near], y[near], 1) if near.sum() > 20 else (slope, offset)
    return float(slope), float(offset)


Labels = NDArray[np.int32]
Detector = Callable[[Frame, DetectionParams], tuple[Labels, NDArray[Any]]]
"""Label image and the labels of the accepted regions."""


def ours(change: dict[str, float], frame: Frame, settings: DetectionParams) -> tuple[Labels, NDArray[Any]]:
    level = decibels(frame.polar, SonarImage())
    params = settings.model_copy(update=change)
    candidates = select_candidates(level, frame.ranges_m, frame.azimuths_rad, None, params)
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


def soca(setting: tuple[float, float], is_power: bool, frame: Frame, settings: DetectionParams) -> Any:
    pfa, gate = setting
    image = frame.polar.astype(np.float64)
    cells = 10 ** (decibels(frame.polar, SonarImage()).astype(np.float64) / 10) if is_power else image
    half, guard = 20, 5
    total = np.pad(np.cumsum(cells, axis=1), ((0, 0), (1, 0)))
    bins = cells.shape[1]
    at = np.arange(half + guard, bins - half - guard)
    before = total[:, at - guard] - total[:, at - guard - half]
    after = total[:, at + guard + half + 1] - total[:, at + guard + 1]
    mask = np.zeros(cells.shape, dtype=np.uint8)
    mask[:, at] = (cells[:, at] > soca_factor(pfa) * np.minimum(before, after) / half) & (image[:, at] > gate)
    return regions_of(mask, frame, settings)


def actag(offset: float, frame: Frame, settings: DetectionParams) -> tuple[Labels, NDArray[Any]]:
    padded = cv2.copyMakeBorder(frame.polar, 4, 4, 4, 4, cv2.BORDER_REPLICATE)
    filtered = np.asarray(cv2.medianBlur(padded, 9))[4:-4, 4:-4]
    window = np.ones((17, 17), np.uint8)
    low = cv2.erode(filtered, window, borderType=cv2.BORDER_REPLICATE).astype(np.float64)
    high = cv2.dilate(filtered, window, borderType=cv2.BORDER_REPLICATE).astype(np.float64)
    return regions_of((filtered >= (low + high) / 2 - offset).astype(np.uint8), frame, settings)


def regions_of(mask: Image, frame: Frame, settings: DetectionParams) -> tuple[Labels, NDArray[Any]]:
    """Regions of a mask, closed and gated as ours are."""
    bins = 2 * round((settings.closing_m / METRES_A_PIXEL - 1) / 2) + 1
    beam_m = abs(frame.azimuths_rad[1] - frame.azimuths_rad[0]) * frame.ranges_m[[0, -1]].mean()
    beams = max(1, 2 * round((settings.closing_m / beam_m - 1) / 2) + 1)
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((beams, bins), np.uint8))
    count, labels = cv2.connectedComponents(closed, connectivity=8, ltype=cv2.CV_32S)
    contrast = frame.polar.astype(np.float32)
    found = measure_regions(contrast, np.asarray(labels), count - 1, frame.ranges_m, frame.azimuths_rad, None)
    is_sized = (found.area_m2 >= settings.min_area_m2) & (found.area_m2 <= settings.max_area_m2)
    accepted = np.flatnonzero(is_sized & (found.extent_m <= settings.max_extent_m))
    strength = (found.level_db * found.area_m2)[accepted]
    return np.asarray(labels), accepted[np.argsort(-strength)][: settings.max_candidates] + 1


@dataclass(frozen=True)
class Score:
    """Result of one detector on one frame."""

    candidates: int
    found: tuple[bool, ...]
    """Of each box."""


def score(frame: Frame, labels: Labels, accepted: NDArray[Any]) -> Score:
    """Compare regions with boxes."""
    regions = [cartesian_box(frame, labels, int(label)) for label in accepted]
    found = tuple(any(is_hit(*region, box) for region in regions) for _, box in frame.boxes)
    return Score(len(accepted), found)


def cartesian_box(frame: Frame, labels: Labels, label: int) -> tuple[tuple[float, float], Box]:
    """Centroid and bounding box of a region in the Cartesian frame."""
    beam, bin_ = np.nonzero(labels == label)
    r = frame.ranges_m[bin_] / METRES_A_PIXEL
    x = frame.apex[0] - r * np.sin(frame.azimuths_rad[beam])
    y = frame.apex[1] - r * np.cos(frame.azimuths_rad[beam])
    centroid = float(np.average(x, weights=r)), float(np.average(y, weights=r))
    return centroid, (float(x.min()), float(y.min()), float(np.ptp(x)), float(np.ptp(y)))


def is_hit(centroid: tuple[float, float], region: Box, box: Box) -> bool:
    """Overlap test of a region with a box."""
    (x, y, w, h), (u, v, p, q) = box, region
    across, along = min(x + w, u + p) - max(x, u), min(y + h, v + q) - max(y, v)
    shared = max(across, 0.0) * max(along, 0.0)
    is_inside = x <= centroid[0] <= x + w and y <= centroid[1] <= y + h
    return is_inside and shared >= LEAST_OVERLAP * (w * h + p * q - shared)


OURS = (0.2, 0.05, 0.02, 0.01, 3e-3, 1e-3, 1e-4, 1e-6, 1e-9, 1e-13, 1e-20, 1e-30, 1e-45, 1e-60, 1e-90)
STRONGEST = (1, 2, 3, 4, 5, 6, 8, 12, 16)
SOCA = tuple((pfa, gate) for gate in (0, 65, 100) for pfa in (0.3, 0.25, 0.2, 0.17, 0.14, 0.12, 0.1, 0.01))
PFAS = (0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-12, 1e-15, 1e-20)
OFFSETS = (1.0, 0.0, -2.0, -4.0, -6.0, -8.0, -11.0, -15.0, -20.0, -25.0, -30.0, -40.0)


def detectors() -> dict[str, list[tuple[object, Detector]]]:
    """All detectors by name, each with its settings."""
    return {
        "ours": [(p, partial(ours, {"false_alarm": p})) for p in OURS],
        "soca": [(s, partial(soca, s, False)) for s in SOCA],
        "soca-power": [(p, partial(soca, (p, -1.0), True)) for p in PFAS],
        "actag": [(o, partial(actag, o)) for o in OFFSETS],
        "ours-strongest": strongest(partial(ours, {})),
        "soca-strongest": strongest(partial(soca, (0.3, 100), False)),
        "soca-power-strongest": strongest(partial(soca, (1e-6, -1.0), True)),
        "actag-strongest": strongest(partial(actag, -6.0)),
    }


def strongest(detector: Detector) -> list[tuple[object, Detector]]:
    """A detector that keeps its strongest regions only."""

    def limited(limit: int, frame: Frame, settings: DetectionParams) -> tuple[Labels, NDArray[Any]]:
        return detector(frame, settings.model_copy(update={"max_candidates": limit}))

    return [(k, partial(limited, k)) for k in STRONGEST]


PUBLISHED: dict[str, object] = {"ours": 1e-3, "soca": (0.1, 65), "soca-power": 0.1, "actag": 1.0}
"""The setting each comes with."""


@dataclass(frozen=True)
class Point:
    """One setting of one detector over all frames."""

    detector: str
    setting: object
    candidates: float
    """A frame."""
    hit_rate: float
    """Of the objects."""
    wall_rate: float
    """Of the walls."""


def judge_frame(settings: DetectionParams, path: Path) -> dict[tuple[str, object], tuple[Score, tuple[str, ...]]]:
    """Every detector at every setting on one frame, with the names of the boxes."""
    cv2.setNumThreads(1)
    frame = read_frame(path)
    names = tuple(name for name, _ in frame.boxes)
    return {
        (name, setting): (score(frame, *detector(frame, settings)), names)
        for name, cases in detectors().items()
        for setting, detector in cases
    }


def curves(paths: Sequence[Path], settings: DetectionParams, workers: int) -> list[Point]:
    """All points of all detectors."""
    judged = in_parallel(partial(judge_frame, settings), paths, workers, "frame")
    return [point(key, [frame[key] for frame in judged]) for key in judged[0]]


def point(key: tuple[str, object], scores: list[tuple[Score, tuple[str, ...]]]) -> Point:
    """Means over frames and boxes."""
    found = np.array([hit for judged, _ in scores for hit in judged.found])
    is_wall = np.array([name == "Wall" for _, names in scores for name in names])
    candidates = float(np.mean([judged.candidates for judged, _ in scores]))
    return Point(*key, candidates, float(found[~is_wall].mean()), float(found[is_wall].mean()))


def envelope(points: Sequence[Point], detector: str, budgets: Sequence[float]) -> list[float]:
    """The best hit rate of a detector with at most so many candidates a frame."""
    return [
        max((p.hit_rate for p in points if p.detector == detector and p.candidates <= b), default=0.0) for b in budgets
    ]


def draw(points: Sequence[Point], path: Path) -> None:
    """Hit rate against candidates a frame."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for name, mark in zip(PUBLISHED, "os^D", strict=True):
        own = sorted((p for p in points if p.detector == name), key=lambda p: p.candidates)
        axes.plot([p.candidates for p in own], [p.hit_rate for p in own], mark, label=name, ms=4, alpha=0.5)
        budgets = np.geomspace(0.3, 60, 200)
        axes.plot(budgets, envelope(points, name, budgets.tolist()), lw=1.2, color=axes.lines[-1].get_color())
        published = next(p for p in own if p.setting == PUBLISHED[name])
        color = axes.lines[-1].get_color()
        ranked = [envelope(points, f"{name}-strongest", [b])[0] for b in budgets]
        axes.plot(budgets, ranked, ":", lw=1.2, color=color)
        axes.plot(published.candidates, published.hit_rate, mark, ms=10, mfc="none", color=color)
    axes.set(xscale="log", xlabel="candidates a frame", ylabel="objects found (without walls)", ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(title="large: as it comes\ndotted: strongest only", frameon=False)
    figure.savefig(path, dpi=150)


def is_ahead(best: dict[str, list[float]]) -> list[bool]:
    """Check that we find more than every other detector at each number of candidates, by the better way of each."""
    ways = {name: np.maximum(best[name], best[f"{name}-strongest"]) for name in best if not name.endswith("-strongest")}
    return [all(ways["ours"][i] > row[i] for name, row in ways.items() if name != "ours") for i in range(len(BUDGETS))]


BUDGETS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument("--figure", type=Path, help="where the curve is drawn (png)")
    arguments = parser.parse_args()
    data = arguments.data and Path(arguments.data) / "sonar"
    with recording(data, "marine_debris_fls.tar.xz", "marine_debris_fls") as folder:
        paths = list(frames_of(folder))[:: 25 if arguments.quick else 1]
        points = curves(paths, SETTINGS, arguments.workers)
    note(f"{len(paths)} frames")
    header = ("detector", "setting", "candidates a frame", "objects found", "walls found")
    print_table(header, [(p.detector, str(p.setting), p.candidates, p.hit_rate, p.wall_rate) for p in points])
    best = {name: envelope(points, name, BUDGETS) for name in detectors()}
    print_table(("objects found with at most", *(f"{b:g}" for b in BUDGETS)), [(n, *row) for n, row in best.items()])
    if arguments.figure:
        draw(points, arguments.figure)
    ahead = is_ahead(best)
    figures: dict[str, Any] = {"frames": len(paths), "candidates_a_frame": list(BUDGETS), "passed": all(ahead)}
    figures |= {name.replace("-", "_"): [round(rate, 4) for rate in row] for name, row in best.items()}
    conclude(figures | {"ahead": ahead}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
