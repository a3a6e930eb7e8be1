"""The report: one self-contained HTML page about a comparison. Layout and wording: templates/report.html."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from sonar_graph.evaluation.figure_style import ESTIMATOR_COLOURS
from sonar_graph.evaluation.identity_doubts import doubt_of_identities, nameless_landmarks
from sonar_graph.evaluation.illustrations import illustrations
from sonar_graph.evaluation.landmark_table import PAPER, landmark_table
from sonar_graph.evaluation.log_doubts import warning_lines
from sonar_graph.evaluation.published_experiment import repeats_published
from sonar_graph.evaluation.recognition_section import recognition_content
from sonar_graph.evaluation.refusals import by_runs, withheld_lines
from sonar_graph.evaluation.results import Comparison, RunResult
from sonar_graph.evaluation.score_table import score_blocks
from sonar_graph.evaluation.wording import ABSENT, TOLERATED_FACTOR, failed_runs, finding, format_value
from sonar_graph.states import Outcome

TEMPLATE = "report.html"


def write_report(comparison: Comparison, path: Path) -> None:
    """Write the page that shows a comparison.

    The page needs nothing but itself: figures are inline SVG in the page's colours, style is inline, there is no
    script. Links lead to the files beside it (``comparison.json``, ``result.mcap``, ``runs/NAME/``).
    """
    path.write_text(render_report(comparison), encoding="utf-8")


def render_report(comparison: Comparison) -> str:
    """The page as text. Everything that comes from a log or an estimator is escaped."""
    environment = Environment(
        loader=PackageLoader("sonar_graph.evaluation", "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["svg"] = Markup
    return environment.get_template(TEMPLATE).render(**_content(comparison))


def _content(comparison: Comparison) -> dict[str, Any]:
    """What the template shows, by the names it uses."""
    return {
        "name": comparison.sequence.name,
        "summary": _summary(comparison),
        "finding": finding(comparison),
        "failed": failed_runs(comparison),
        "doubts": [
            *doubt_of_identities(comparison),
            *withheld_lines(comparison),
            *warning_lines(comparison.sequence.notes),
        ],
        "runs": comparison.runs,
        "colours": len(ESTIMATOR_COLOURS),
        "blocks": score_blocks(comparison),
        "nees_limits": [f"{1 / TOLERATED_FACTOR:g}", f"{TOLERATED_FACTOR:g}"],
        "figures": illustrations(comparison),
        "landmarks": landmark_table(comparison),
        "nameless": nameless_landmarks(comparison),
        "paper": PAPER if repeats_published(comparison.sequence) else "",
        "outcomes": _outcomes(comparison),
        "refused": _refused(comparison),
        "recognition": recognition_content(comparison),
        "files": {run.estimator: _files(run) for run in comparison.runs},
        "settings": {run.estimator: _as_json(run.params) for run in comparison.runs},
        "calibration": _as_json(comparison.sequence.calibration.model_dump(mode="json")),
        "notes": comparison.sequence.notes,
        "environment": comparison.environment,
    }


def _summary(comparison: Comparison) -> str:
    sequence = comparison.sequence
    detections = len(sequence.detections) if sequence.detections else 0
    planar = "planar" if sequence.calibration.planar else "three-dimensional"
    truth = "with ground truth" if sequence.truth is not None else "without ground truth"
    return (
        f"{format_value(round(sequence.duration_s, 1))} s of {planar} motion {truth}, "
        f"{_counted(detections, 'landmark detection')}, {len(comparison.instants_ns)} instants, "
        f"{_counted(len(comparison.runs), 'estimator')}."
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _outcomes(comparison: Comparison) -> dict[str, list[str]]:
    """What became of the detections: for each outcome that occurred, count and share by run; a total at the end."""
    counts = [Counter(run.detections.outcomes) if run.detections else None for run in comparison.runs]
    rows = {
        outcome.value.capitalize(): [_share(count, outcome) for count in counts]
        for outcome in Outcome
        if any(count and count[outcome] for count in counts)
    }
    if rows:
        rows["All detections"] = [ABSENT if count is None else str(count.total()) for count in counts]
    return rows


def _share(count: Counter[Outcome] | None, outcome: Outcome) -> str:
    if count is None:
        return ABSENT
    percent = 100 * count[outcome] / max(count.total(), 1)
    return f"{count[outcome]} ({percent:.1f} %)"


def _refused(comparison: Comparison) -> list[dict[str, str]]:
    """Rows of IMU and Doppler log that were not used."""
    start_ns = comparison.sequence.start_ns
    return [
        {
            "sensor": rows.sensor,
            "count": str(rows.count),
            "times": rows.times(start_ns),
            "reason": rows.reason,
            "distances": rows.distances() or ABSENT,
            "estimators": ", ".join(names),
        }
        for rows, names in by_runs(comparison).items()
    ]


def _files(run: RunResult) -> dict[str, str]:
    """Files of a run beside the report: name and address."""
    present = {
        "trajectory.tum": run.smoothed is not None,
        "causal.tum": run.causal is not None,
        "landmarks.csv": run.landmarks is not None,
        "result.json": True,
    }
    return {name: f"runs/{quote(run.estimator)}/{name}" for name, there in present.items() if there}


def _as_json(values: Any) -> str:
    return json.dumps(values, indent=2, default=str, ensure_ascii=False)
