"""Are landmarks recognised in sonar images, and can the posteriors and covariances be believed? On simulated basins.

Every seed is a basin of its own: route, floor, where the landmarks' headings point, what else lies there. The measured
model that ships comes from other seeds (1001 to 1012). A pass is a stretch of a second or more in which an object is
wholly in view. A detection is accepted as estimators accept it by default: its most probable landmark has a posterior
of at least one half. It is right when that landmark truly lies within 15 cm.

* `passes_recognised`: share of the landmarks' passes with a right detection that is accepted;
* `accepted_right`: share of accepted detections that are right;
* `false_accepts`: share of the passes of other objects in which one of them was accepted as a landmark;
* `ece`: expected calibration error of the most probable class, over all detections;
* `range_rms_m`, `azimuth_rms_deg`: of accepted detections that are right;
* `nis`: normalised error over both, per degree of freedom, of one detection a pass, the middle one: passes are
  independent, the frames of one are not. `nis_band` is its two-sided 95 % band.

The same basins once more by the equations of 2014 as printed; and, on short basins that differ in nothing else, with
speckle drawn anew in every frame, without multipath, and with beams that the log says are equally spaced.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table
from recognition_runs import NONE, UNJUDGED, Detections, Passes, Run, kept_run
from scipy.stats import chi2

from sonar_graph.evaluation.recognition_section import reliability_figure
from sonar_graph.evaluation.reliability import Reliability, reliability
from sonar_graph.simulation.basin import BasinOptions
from sonar_graph.simulation.image_options import ImageOptions

OURS, LITERAL = "virtual-evidence", "jeffrey"
ACCEPTED = 0.5
VARIANTS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "speckle anew in every frame": {"speckle": "frame"},
    "without multipath": {"multipath": False},
    "equally spaced beams": {"measured_lens": False},
}
TARGETS = {
    "passes_recognised": (0.95, 1.0),
    "accepted_right": (0.99, 1.0),
    "false_accepts": (0.0, 0.01),
    "ece": (0.0, 0.05),
    "range_rms_m": (0.0, 0.015),
    "azimuth_rms_deg": (0.0, 0.5),
}


@dataclass(frozen=True)
class Case:
    """What is simulated, apart from the seed."""

    duration_s: float
    laps: int
    variant: str
    rules: tuple[str, ...]
    work: Path | None

    def run(self, seed: int) -> Run:
        """One seed, or what was kept of it."""
        image = ImageOptions.model_validate(VARIANTS[self.variant])
        options = BasinOptions(duration_s=self.duration_s, laps=self.laps, seed=seed, image=image)
        return kept_run(self._path(seed), options, self.rules)

    def _path(self, seed: int) -> Path | None:
        name = f"{self.variant.replace(' ', '_')}-{self.duration_s:g}s-{self.laps}-{seed}.npz"
        return None if self.work is None else self.work / name


@dataclass(frozen=True)
class Summary:
    """The figures of one rule over all seeds of a case."""

    figures: dict[str, float]
    nis_band: tuple[float, float]
    passes: int
    accepted: int
    reliability: Reliability

    @property
    def nis_inside(self) -> bool:
        return self.nis_band[0] <= self.figures["nis"] <= self.nis_band[1]

    @property
    def passed(self) -> bool:
        return self.nis_inside and all(low <= self.figures[name] <= high for name, (low, high) in TARGETS.items())


def summarise(runs: list[Run], rule: str) -> Summary:
    """Over the runs of all seeds."""
    found = [run.detections[rule] for run in runs]
    accepted = [d.is_named & (d.probability >= ACCEPTED) for d in found]
    right = [a & (d.named == d.label) for a, d in zip(accepted, found, strict=True)]
    recognised, fooled, middles = [], [], []
    for run, d, a, r in zip(runs, found, accepted, right, strict=True):
        for row, rows in _by_pass(run.passes, d):
            if run.passes.object_id[row] < 0:
                fooled.append(bool(a[rows].any()))
            else:
                hits = rows[r[rows]]
                recognised.append(len(hits) > 0)
                middles += [_normalised(d, hits[len(hits) // 2])] if len(hits) else []
    error = np.concatenate([d.error[r] for d, r in zip(found, right, strict=True)])
    everything = np.concatenate([_normalised(d, r) for d, r in zip(found, right, strict=True)])
    judged = _reliability(found)
    freedom = 2 * len(middles)
    band = chi2.ppf([0.025, 0.975], freedom) / freedom
    figures = {
        "passes_recognised": float(np.mean(recognised)),
        "accepted_right": float(sum(r.sum() for r in right) / sum(a.sum() for a in accepted)),
        "false_accepts": float(np.mean(fooled)),
        "ece": judged.expected_error,
        "range_rms_m": float(np.sqrt(np.mean(error[:, 0] ** 2))),
        "azimuth_rms_deg": float(np.degrees(np.sqrt(np.mean(error[:, 1] ** 2)))),
        "nis": float(np.mean(middles)),
        "nis_of_all": float(np.mean(everything)),
    }
    total = int(sum(a.sum() for a in accepted))
    return Summary(figures, (float(band[0]), float(band[1])), len(recognised), total, judged)


def _by_pass(passes: Passes, found: Detections) -> list[tuple[int, np.ndarray]]:
    """Each pass with the rows of the detections of its object in it."""
    result = []
    for row in range(len(passes.object_id)):
        during = passes.during(row, found.stamp_s)
        result.append((row, np.flatnonzero(during & (found.label == passes.object_id[row]))))
    return result


def _normalised(found: Detections, rows: Any) -> np.ndarray:
    """Normalised squared error per degree of freedom."""
    e, C = found.error[rows], found.covariance[rows]
    return np.asarray(np.einsum("...i,...i->...", e, np.linalg.solve(C, e[..., None])[..., 0]) / 2)


def _reliability(found: list[Detections]) -> Reliability:
    """Of the most probable class, where the truth can be told."""
    confidence = np.concatenate([d.confidence for d in found])
    label = np.concatenate([np.maximum(d.label, NONE) for d in found])
    said = np.concatenate([np.where(d.is_named, d.named, NONE) for d in found])
    judged = np.concatenate([d.label != UNJUDGED for d in found])
    return reliability(confidence[judged], (said == label)[judged].astype(float))


def show(summaries: dict[str, Summary]) -> None:
    """One line a case."""
    headers = (
        "",
        "passes",
        "recognised",
        "accepted",
        "right",
        "false",
        "ECE",
        "range mm",
        "azimuth deg",
        "NIS",
        "band",
        "NIS of all",
    )
    rows = []
    for name, s in summaries.items():
        f = s.figures
        band = f"{s.nis_band[0]:.2f}..{s.nis_band[1]:.2f}"
        recognised = (s.passes, f["passes_recognised"], s.accepted, f"{f['accepted_right']:.4f}", f["false_accepts"])
        errors = (f["ece"], f"{f['range_rms_m'] * 1e3:.1f}", f["azimuth_rms_deg"], f["nis"], band, f["nis_of_all"])
        rows.append((name, *recognised, *errors))
    print_table(headers, rows)


def draw(ours: Summary, literal: Summary, path: Path) -> None:
    """Reliability of both rules."""
    for name, summary in (("ours", ours), ("2014", literal)):
        figure: Figure = reliability_figure(summary.reliability)
        figure.savefig(path.with_stem(f"{path.stem}-{name}"), dpi=120)


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument("--seeds", type=int, help="number of basins (default: 20; with --quick 2)")
    parser.add_argument("--work", type=Path, help="keep what came of each basin in this folder, and go on from it")
    parser.add_argument("--out", type=Path, help="write the reliability of both rules here (PNG)")
    arguments = parser.parse_args()
    if arguments.work is not None:
        arguments.work.mkdir(parents=True, exist_ok=True)
    short = partial(Case, 200.0, 1)
    published = short if arguments.quick else partial(Case, 2039.0, 3)
    seeds = range(arguments.seeds or (2 if arguments.quick else 20))
    whole = published("as it is", (OURS, LITERAL), arguments.work)
    runs = in_parallel(whole.run, seeds, arguments.workers, "basin")
    summaries = {"ours": summarise(runs, OURS), "2014, as printed": summarise(runs, LITERAL)}
    for variant in VARIANTS:
        case = short(variant, (OURS,), arguments.work)
        runs = in_parallel(case.run, seeds, arguments.workers, variant)
        summaries[f"ours, short, {variant}"] = summarise(runs, OURS)
    show(summaries)
    ours, literal = summaries["ours"], summaries["2014, as printed"]
    if arguments.out is not None:
        draw(ours, literal, arguments.out)
    others = {name: summary.figures for name, summary in summaries.items() if summary is not ours}
    figures: dict[str, Any] = {"seeds": len(seeds), "passes": ours.passes, "accepted": ours.accepted, **ours.figures}
    figures |= {"nis_band": ours.nis_band, "others": others, "passed": ours.passed}
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
