"""Are landmarks recognised in sonar images, and can the posteriors and covariances be believed? On simulated basins.

Every seed is a basin of its own: route, floor, where the landmarks' headings point, what else lies there. The measured
model that ships comes from other seeds (1001 to 1004, 3001 to 3218). A pass is a stretch of a second or more in which
an object is wholly in view. A detection is accepted when its most probable landmark has a posterior of at least one
half; estimators ask for 0.7 by default. It is right when that landmark truly lies within 15 cm.

* `passes_recognised`: share of the landmarks' passes with a right detection that is accepted;
* `accepted_right`: share of accepted detections that are right;
* `false_accepts`: share of the passes of other objects in which one of them was accepted as a landmark;
* `ece`: expected calibration error of the most probable class, over all detections; `ece_of_passes` of one a pass, the
  middle one, so that a long pass counts as much as a short one;
* `range_rms_m`, `azimuth_rms_deg`: of accepted detections that are right;
* `nis`: normalised error over both, per degree of freedom, of the middle one of each pass, with its two-sided 95 % band
  `nis_band`, and `nis_of_seeds`, the interval that the spread of the basins' own means gives;
* `pass_mean_nis`: the same of the mean over a pass, as if its frames were independent: by how much a variance is too
  small for one who takes them so;
* `seconds_to_name`: median time from the landmark being wholly in view to the first right detection.

The same basins once more by the equations of 2014 (with our unknown class, assignment and tracks); and, on short basins
that differ in nothing else: with speckle drawn anew in every frame, without multipath, with beams that the log says are
equally spaced, with landmarks 3 dB brighter than their designs, with a sound speed that is 1 % off, and with windows
whose bins are wider than the cells in which appearances are compared.
"""

import hashlib
import sys
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table
from recognition_runs import NONE, UNJUDGED, Detections, Passes, Run, kept_run
from scipy.stats import chi2

import sonar_graph
from sonar_graph.measurements import Floats, Ints
from sonar_graph.simulation import BasinOptions
from sonar_graph.simulation.sonar_image import ImageOptions

OURS, LITERAL = "virtual-evidence", "jeffrey"
ACCEPTED = 0.5
VARIANTS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "speckle anew in every frame": {"speckle": "frame"},
    "without multipath": {"multipath": False},
    "equally spaced beams": {"measured_lens": False},
    "landmarks 3 dB brighter": {
        "designs": str(Path(__file__).with_name("brighter_landmarks.toml"))
    },
    "sound speed 1 % off": {"sound_speed_error": 0.01},
    "window of 7 m": {"window_m": 7.0},
    "window of 9 m": {"window_m": 9.0},
    "window of 10 m": {"window_m": 10.0},
}
TARGETS = {
    "passes_recognised": (0.95, 1.0),
    "accepted_right": (0.99, 1.0),
    "false_accepts": (0.0, 0.01),
    "ece": (0.0, 0.05),
    "range_rms_m": (0.0, 0.015),
    "azimuth_rms_deg": (0.0, 0.5),
}


BINS = 10


@dataclass(frozen=True, eq=False)
class Reliability:
    """Confidence and truth by bins of equal width from 0 to 1."""

    count: Ints
    """Detections in each bin, shape (10,)."""
    confidence: Floats
    """Their mean confidence; NaN in an empty bin."""
    right: Floats
    """Share of them whose class is right; NaN in an empty bin."""

    @property
    def expected_error(self) -> float:
        """The expected calibration error."""
        return float(
            np.nansum(self.count * np.abs(self.confidence - self.right))
            / max(self.count.sum(), 1)
        )


def reliability(confidence: Floats, right: Floats) -> Reliability:
    """Bins of detections, shape (n,) each."""
    row = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(row, minlength=BINS)
    some = np.maximum(count, 1)
    means = [
        np.where(count > 0, np.bincount(row, v, BINS) / some, np.nan)
        for v in (confidence, right)
    ]
    return Reliability(count, *means)


@dataclass(frozen=True)
class Case:
    """Options of the simulation, apart from the seed."""

    duration_s: float
    laps: int
    variant: str
    rules: tuple[str, ...]
    work: Path | None

    def run(self, seed: int) -> Run:
        """One seed, or what was kept of it."""
        image = ImageOptions.model_validate(VARIANTS[self.variant])
        options = BasinOptions(
            duration_s=self.duration_s, laps=self.laps, seed=seed, image=image
        )
        return kept_run(self._path(seed), options, self.rules)

    def _path(self, seed: int) -> Path | None:
        variant = self.variant.replace(" ", "_").replace("%", "percent")
        name = f"{variant}-{self.duration_s:g}s-{self.laps}-{seed}-{digest()}.npz"
        return None if self.work is None else self.work / name


@cache
def digest() -> str:
    """Hash of the code and the model; other code does not go on from kept runs."""
    root = Path(sonar_graph.__file__).parent
    here = [
        Path(__file__).with_name(name)
        for name in ("recognition_runs.py", "brighter_landmarks.toml")
    ]
    files = [*sorted(root.glob("*.*")), *here]
    for folder in ("sonar", "simulation", "navigation", "evaluation"):
        files += sorted(
            path
            for path in (root / folder).rglob("*.*")
            if path.suffix in {".py", ".json", ".toml"}
        )
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[
        :12
    ]


@dataclass(frozen=True)
class Summary:
    """The figures of one rule over all seeds of a case."""

    figures: dict[str, float]
    nis_band: tuple[float, float]
    nis_of_seeds: tuple[float, float]
    passes: int
    accepted: int
    reliability: Reliability

    @property
    def nis_inside(self) -> bool:
        return self.nis_band[0] <= self.figures["nis"] <= self.nis_band[1]

    @property
    def passed(self) -> bool:
        return self.nis_inside and all(
            low <= self.figures[name] <= high for name, (low, high) in TARGETS.items()
        )


def summarise(runs: list[Run], rule: str) -> Summary:
    """Over the runs of all seeds."""
    found = [run.detections[rule] for run in runs]
    accepted = [d.is_named & (d.probability >= ACCEPTED) for d in found]
    right = [a & (d.named == d.label) for a, d in zip(accepted, found, strict=True)]
    watched = [
        _watched(run, d, a, r)
        for run, d, a, r in zip(runs, found, accepted, right, strict=True)
    ]
    recognised, fooled, delays_s = (
        np.concatenate([getattr(w, n) for w in watched]) for n in Watched._fields[:3]
    )
    middles, means = (
        np.concatenate([getattr(w, n) for w in watched]) for n in ("nis", "mean_nis")
    )
    error = np.concatenate([d.error[r] for d, r in zip(found, right, strict=True)])
    everything = np.concatenate(
        [normalised(d, r) for d, r in zip(found, right, strict=True)]
    )
    judged = _reliability(found, [np.arange(len(d.named)) for d in found])
    freedom = 2 * len(middles)
    band = chi2.ppf([0.025, 0.975], freedom) / freedom
    of_seeds = np.array([w.nis.mean() for w in watched if len(w.nis)])
    half = (
        1.96 * of_seeds.std(ddof=1) / np.sqrt(len(of_seeds))
        if len(of_seeds) > 1
        else 0.0
    )
    figures = {
        "passes_recognised": float(np.mean(recognised)),
        "accepted_right": float(
            sum(r.sum() for r in right) / max(sum(a.sum() for a in accepted), 1)
        ),
        "false_accepts": float(np.mean(fooled)) if len(fooled) else 0.0,
        "ece": judged.expected_error,
        "ece_of_passes": _reliability(
            found, [w.middle for w in watched]
        ).expected_error,
        "range_rms_m": float(np.sqrt(np.mean(error[:, 0] ** 2))),
        "azimuth_rms_deg": float(np.degrees(np.sqrt(np.mean(error[:, 1] ** 2)))),
        "nis": float(np.mean(middles)),
        "nis_of_all": float(np.mean(everything)),
        "pass_mean_nis": float(np.mean(means)),
        "seconds_to_name": float(np.median(delays_s)),
    }
    total = int(sum(a.sum() for a in accepted))
    interval = float(of_seeds.mean() - half), float(of_seeds.mean() + half)
    return Summary(
        figures,
        (float(band[0]), float(band[1])),
        interval,
        len(recognised),
        total,
        judged,
    )


class Watched(NamedTuple):
    """Results of the passes of one run."""

    recognised: np.ndarray
    """Of each landmark's pass, whether it was."""
    fooled: np.ndarray
    """Of each pass of another object, whether it was accepted as a landmark."""
    delay_s: np.ndarray
    """Of the recognised ones, until the first right detection."""
    nis: np.ndarray
    """Normalised error of the middle one of their right detections."""
    mean_nis: np.ndarray
    """Of the mean over all of them, as if they were independent."""
    middle: np.ndarray
    """Row of the middle detection of every pass that has one."""


def _watched(
    run: Run, found: Detections, accepted: np.ndarray, right: np.ndarray
) -> Watched:
    recognised, fooled, delay_s, nis, mean_nis, middle = [], [], [], [], [], []
    for row, rows in _by_pass(run.passes, found):
        middle += [rows[len(rows) // 2]] if len(rows) else []
        if run.passes.object_id[row] < 0:
            fooled.append(bool(accepted[rows].any()))
            continue
        hits = rows[right[rows]]
        recognised.append(len(hits) > 0)
        if len(hits):
            delay_s.append(found.stamp_s[hits[0]] - run.passes.begin_s[row])
            nis.append(normalised(found, hits[len(hits) // 2]))
            mean_nis.append(normalised_mean(found, hits))
    return Watched(
        np.array(recognised),
        np.array(fooled),
        np.array(delay_s),
        np.array(nis),
        np.array(mean_nis),
        np.array(middle, dtype=int),
    )


def _by_pass(passes: Passes, found: Detections) -> list[tuple[int, np.ndarray]]:
    """Each pass with the rows of the detections of its object in it."""
    result = []
    for row in range(len(passes.object_id)):
        during = passes.during(row, found.stamp_s)
        result.append(
            (row, np.flatnonzero(during & (found.label == passes.object_id[row])))
        )
    return result


def normalised(found: Detections, rows: Any) -> np.ndarray:
    """Normalised squared error per degree of freedom."""
    e, C = found.error[rows], found.covariance[rows]
    return np.asarray(
        np.einsum("...i,...i->...", e, np.linalg.solve(C, e[..., None])[..., 0]) / 2
    )


def normalised_mean(found: Detections, rows: np.ndarray) -> float:
    """NEES of the information-weighted mean per degree of freedom, as if errors were independent."""
    information = np.linalg.inv(found.covariance[rows])
    total = np.einsum("nij,nj->i", information, found.error[rows])
    return float(total @ np.linalg.solve(information.sum(axis=0), total) / 2)


def _reliability(found: list[Detections], rows: list[np.ndarray]) -> Reliability:
    """Accuracy of the most probable class, where the truth is known."""
    confidence = np.concatenate(
        [d.confidence[r] for d, r in zip(found, rows, strict=True)]
    )
    label = np.concatenate([d.label[r] for d, r in zip(found, rows, strict=True)])
    said = np.concatenate(
        [
            np.where(d.is_named, d.named, NONE)[r]
            for d, r in zip(found, rows, strict=True)
        ]
    )
    judged = label != UNJUDGED
    return reliability(
        confidence[judged], (said == np.maximum(label, NONE))[judged].astype(float)
    )


def show(summaries: dict[str, Summary]) -> None:
    """One line a case."""
    headers = (
        "",
        "passes",
        "named",
        "after s",
        "accepted",
        "right",
        "false",
        "ECE",
        "of passes",
    )
    errors = ("range mm", "azimuth deg", "NIS", "band", "NIS of all", "pass mean NIS")
    rows = []
    for name, s in summaries.items():
        f = s.figures
        band = f"{s.nis_band[0]:.2f}..{s.nis_band[1]:.2f}"
        accepted = (
            s.accepted,
            f"{f['accepted_right']:.4f}",
            f["false_accepts"],
            f["ece"],
            f["ece_of_passes"],
        )
        accuracy = (
            f"{f['range_rms_m'] * 1e3:.1f}",
            f["azimuth_rms_deg"],
            f["nis"],
            band,
            f["nis_of_all"],
        )
        named = (s.passes, f["passes_recognised"], f"{f['seconds_to_name']:.1f}")
        rows.append((name, *named, *accepted, *accuracy, f["pass_mean_nis"]))
    print_table((*headers, *errors), rows)


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds", type=int, help="number of basins (default: 20; with --quick 2)"
    )
    parser.add_argument(
        "--work",
        type=Path,
        help="keep what came of each basin in this folder, and go on from it",
    )
    arguments = parser.parse_args()
    if arguments.work is not None:
        arguments.work.mkdir(parents=True, exist_ok=True)
    short = partial(Case, 200.0, 1)
    published = short if arguments.quick else partial(Case, 2039.0, 3)
    seeds = range(arguments.seeds or (2 if arguments.quick else 20))
    whole = published("as it is", (OURS, LITERAL), arguments.work)
    runs = in_parallel(whole.run, seeds, arguments.workers, "basin")
    summaries = {
        "ours": summarise(runs, OURS),
        "2014, as printed": summarise(runs, LITERAL),
    }
    for variant in VARIANTS:
        case = short(variant, (OURS,), arguments.work)
        runs = in_parallel(case.run, seeds, arguments.workers, variant)
        summaries[f"ours, short, {variant}"] = summarise(runs, OURS)
    show(summaries)
    ours = summaries["ours"]
    others = {
        name: summary.figures
        for name, summary in summaries.items()
        if summary is not ours
    }
    figures: dict[str, Any] = {
        "seeds": len(seeds),
        "passes": ours.passes,
        "accepted": ours.accepted,
        **ours.figures,
    }
    figures |= {
        "nis_band": ours.nis_band,
        "nis_of_seeds": ours.nis_of_seeds,
        "others": others,
        "passed": ours.passed,
    }
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
