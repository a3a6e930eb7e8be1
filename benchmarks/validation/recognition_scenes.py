"""Are landmarks still recognised as waters get worse, and strangers not? On simulated basins.

Short basins (200 s, one lap) that differ in contrast, in cover by sediment, in the plate, and the presets of harder
scenes. Beside each landmark lie two unknown objects, of nine kinds in turn. Both rules see the same frames. Seeds are
those of `recognition.py`, or from `--first-seed` on; the measured model that ships comes from others (1001 to 1004,
3001 to 3218). Nothing is fitted to these scenes.

* `recognised`: share of the landmarks' passes with a right detection that is accepted (posterior at least one half; in
  the second row of each case at least `MINIMUM_PROBABILITY`, which estimators ask for);
* `natural`, `look_alikes`: share of the passes of unknown objects in which one was accepted as a landmark; stones and
  ragged patches elsewhere on the route count as natural;
* `right`: share of accepted detections that are right;
* `ece_of_tracks`: expected calibration error of the most probable class, of the last detection of each track;
* `wrong_above_99`: share of the tracks with more than 0.99 at their end that are wrong;
* `range_bias_m`, `azimuth_bias_deg`: mean error of right accepted detections, each pass as one;
* `nis`: normalised error per degree of freedom, each pass as one; `nis_of_reports` that of the mean of the detections
  that are reported as independent, one in every `Confusion.report_interval_s`: 1 if they were.

Intervals are Wilson's at 95 %, over passes. It passes when our rule reaches `LEAST_RECOGNISED` where one is given, and
`MOST` everywhere.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import conclude, in_parallel, make_parser, print_table
from recognition import (
    ACCEPTED,
    LITERAL,
    OURS,
    digest,
    normalised,
    normalised_mean,
    reliability,
)
from recognition_runs import NONE, UNJUDGED, Detections, Run, kept_run

from sonar_graph.models import MINIMUM_PROBABILITY
from sonar_graph.simulation import BasinOptions
from sonar_graph.simulation.sonar_image import ImageOptions
from sonar_graph.simulation.sonar_image.strangers import GROUPS
from sonar_graph.sonar import SHIPPED, read_confusion

STRANGERS = {"strangers": ["natural", "look-alikes"]}
CASES: dict[str, dict[str, Any]] = {
    **{f"{c:g} dB": {"contrast_db": c} for c in (0.0, -3.0, -4.5, -6.0)},
    **{
        f"{c:g} dB, a quarter covered": {"contrast_db": c, "sediment": 0.25}
        for c in (0.0, -3.0, -4.5, -6.0)
    },
    "plate as bright as the floor": {"plate_db": 0.0},
    **{scene: {"scene": scene} for scene in ("murky", "worn", "hard")},
    **{f"window of {length} m": {"window_m": float(length)} for length in (7, 10)},
}
LEAST_RECOGNISED = {
    **{"0 dB": 0.95, "-3 dB": 0.95, "-4.5 dB": 0.90, "-6 dB": 0.75},
    **{"0 dB, a quarter covered": 0.85, "plate as bright as the floor": 0.8},
}
MOST = {"natural": 0.05, "look_alikes": 0.10, "ece_of_tracks": 0.05}
SURE = 0.99


@dataclass(frozen=True)
class Case:
    """One condition."""

    name: str
    work: Path | None

    def run(self, seed: int) -> Run:
        """One seed by both rules, or what was kept of it."""
        image = ImageOptions.model_validate(STRANGERS | CASES[self.name])
        options = BasinOptions(duration_s=200.0, laps=1, seed=seed, image=image)
        name = f"scene-{self.name.replace(' ', '_')}-{seed}-{digest()}.npz"
        return kept_run(
            None if self.work is None else self.work / name, options, (OURS, LITERAL)
        )


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Wilson's interval of a share, 95 %."""
    if total == 0:
        return 0.0, 1.0
    z, share = 1.96, hits / total
    middle, half = (
        share + z**2 / (2 * total),
        z * np.sqrt(share * (1 - share) / total + z**2 / (4 * total**2)),
    )
    scale = 1 + z**2 / total
    return max(0.0, float(middle - half) / scale), min(
        1.0, float(middle + half) / scale
    )


def summary(
    runs: list[Run], rule: str, accepted_from: float = ACCEPTED
) -> dict[str, Any]:
    """Figures of one rule over all seeds, of detections that are accepted from this posterior on."""
    outcomes: dict[str, list[bool]] = {
        "recognised": [],
        "natural": [],
        "look_alikes": [],
    }
    accepted, right, bias, ends, nis, nis_of_reports = 0, 0, [], [], [], []
    interval_s = read_confusion(SHIPPED).report_interval_s
    for run in runs:
        found = run.detections[rule]
        is_accepted = found.is_named & (found.probability >= accepted_from)
        is_right = is_accepted & (found.named == found.label)
        accepted, right = accepted + int(is_accepted.sum()), right + int(is_right.sum())
        for row, object_id in enumerate(run.passes.object_id.tolist()):
            of_it = run.passes.during(row, found.stamp_s) & (found.label == object_id)
            if object_id > 0:
                hits = is_right & of_it
                outcomes["recognised"].append(bool(hits.any()))
                if hits.any():
                    rows = np.flatnonzero(hits)
                    bias.append(found.error[rows].mean(axis=0))
                    nis.append(float(normalised(found, rows).mean()))
                    reports = [rows[0]]
                    for later in rows:
                        if (
                            found.stamp_s[later] - found.stamp_s[reports[-1]]
                            >= interval_s
                        ):
                            reports.append(later)
                    nis_of_reports.append(normalised_mean(found, np.array(reports)))
            else:
                looks_alike = run.passes.kind[row] in GROUPS["look-alikes"]
                outcomes["look_alikes" if looks_alike else "natural"].append(
                    bool((is_accepted & of_it).any())
                )
        ends.append(last_of_tracks(found))
    confidence, is_correct = (
        np.concatenate(column) for column in zip(*ends, strict=True)
    )
    sure = confidence > SURE
    mean_bias = np.mean(bias, axis=0) if bias else np.full(2, np.nan)
    counts = {name: (sum(hits), len(hits)) for name, hits in outcomes.items()}
    return {
        **{
            name: {"hits": k, "passes": n, "interval": wilson(k, n)}
            for name, (k, n) in counts.items()
        },
        "accepted": accepted,
        "right": right / accepted if accepted else None,
        "tracks": len(confidence),
        "ece_of_tracks": reliability(confidence, is_correct).expected_error,
        "wrong_above_99": (int((is_correct[sure] == 0).sum()), int(sure.sum())),
        "range_bias_m": float(mean_bias[0]) if bias else None,
        "azimuth_bias_deg": float(np.degrees(mean_bias[1])) if bias else None,
        "nis": float(np.mean(nis)) if nis else None,
        "nis_of_reports": float(np.mean(nis_of_reports)) if nis else None,
    }


def last_of_tracks(found: Detections) -> tuple[np.ndarray, np.ndarray]:
    """Confidence at the end of each track, and whether its most probable class is right; what is judged."""
    rows = {track: row for row, track in enumerate(found.track.tolist()) if track >= 0}
    last = np.array([*rows.values()], dtype=int)
    last = last[found.label[last] != UNJUDGED]
    said = np.where(found.is_named, found.named, NONE)[last]
    return found.confidence[last], (said == np.maximum(found.label[last], NONE)).astype(
        float
    )


def reaches(name: str, figures: dict[str, Any]) -> bool:
    """Whether one case is as good as it must be."""
    share = {
        n: figures[n]["hits"] / max(figures[n]["passes"], 1)
        for n in ("recognised", "natural", "look_alikes")
    }
    share["ece_of_tracks"] = figures["ece_of_tracks"]
    is_found = share["recognised"] >= LEAST_RECOGNISED.get(name, 0.0)
    return is_found and all(share[n] <= most for n, most in MOST.items())


def show(summaries: dict[str, dict[str, dict[str, Any]]]) -> None:
    """One line a case and rule."""
    rows = []
    for name, rules in summaries.items():
        for rule, s in rules.items():
            shares = [
                f"{s[n]['hits']}/{s[n]['passes']}"
                for n in ("recognised", "natural", "look_alikes")
            ]
            wrong, sure = s["wrong_above_99"]
            right = "" if s["right"] is None else f"{s['right']:.4f}"
            bias = "" if s["range_bias_m"] is None else f"{s['range_bias_m'] * 1e3:.1f}"
            nis = [
                "" if s[n] is None else f"{s[n]:.2f}" for n in ("nis", "nis_of_reports")
            ]
            ece, wrong_share = f"{s['ece_of_tracks']:.3f}", f"{wrong}/{sure}"
            rows.append(
                (name, rule, *shares, right, s["tracks"], ece, wrong_share, bias, *nis)
            )
    headers = (
        "",
        "rule",
        "passes",
        "natural",
        "look-alikes",
        "right",
        "tracks",
        "ECE",
        "wrong > 0.99",
        "range bias mm",
        "NIS",
        "of reports",
    )
    print_table(headers, rows)


def main() -> None:
    parser = make_parser(__doc__, workers=True)
    parser.add_argument(
        "--seeds",
        type=int,
        help="number of basins of each case (default: 10; with --quick 1)",
    )
    parser.add_argument(
        "--first-seed",
        type=int,
        default=0,
        help="seed of the first basin (default: %(default)s)",
    )
    parser.add_argument(
        "--cases", help=f"of {', '.join(CASES)}; separated by semicolons (default: all)"
    )
    parser.add_argument(
        "--work",
        type=Path,
        help="keep what came of each basin in this folder, and go on from it",
    )
    arguments = parser.parse_args()
    chosen = (
        [*CASES]
        if arguments.cases is None
        else [name.strip() for name in arguments.cases.split(";")]
    )
    if unknown := [name for name in chosen if name not in CASES]:
        parser.error(
            f"--cases: there is no {unknown[0]}; there are: {'; '.join(CASES)}"
        )
    if arguments.work is not None:
        arguments.work.mkdir(parents=True, exist_ok=True)
    first = arguments.first_seed
    seeds = range(first, first + (arguments.seeds or (1 if arguments.quick else 10)))
    summaries = {}
    for name in chosen:
        runs = in_parallel(
            Case(name, arguments.work).run, seeds, arguments.workers, name
        )
        summaries[name] = {
            OURS: summary(runs, OURS),
            f"{OURS}, {MINIMUM_PROBABILITY}": summary(runs, OURS, MINIMUM_PROBABILITY),
            LITERAL: summary(runs, LITERAL),
        }
    show(summaries)
    passed = all(reaches(name, rules[OURS]) for name, rules in summaries.items())
    conclude(
        {
            "first_seed": first,
            "seeds": len(seeds),
            "cases": summaries,
            "passed": passed,
        },
        is_quick=arguments.quick,
    )


if __name__ == "__main__":
    main()
