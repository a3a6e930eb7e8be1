"""The report: one self-contained HTML page about a comparison. Layout and wording: templates/report.html.

The report's figures in reading order, each with its heading, caption and a description for those who cannot see.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from matplotlib.figure import Figure

from sonar_graph.evaluation import (
    ABSENT,
    DURATION_S,
    MAP_TIMES_S,
    Comparison,
    RunResult,
    format_value,
    repeats_published,
    write_comparison,
    write_viewer_files,
)
from sonar_graph.files import replacing
from sonar_graph.report.figure_style import ESTIMATOR_COLOURS, inline_svg
from sonar_graph.report.figures import (
    error_figure,
    innovation_figure,
    nees_figure,
    nis_figure,
    recognition_content,
    timing_figure,
    yaw_figure,
)
from sonar_graph.report.landmark_table import PAPER, landmark_table
from sonar_graph.report.maps import enlargement, growth_figure, map_figure, paths_cut_off
from sonar_graph.report.tables import score_blocks
from sonar_graph.report.warnings import by_runs, doubt_of_identities, nameless_landmarks, warning_lines, withheld_lines
from sonar_graph.report.wording import TOLERATED_FACTOR, failed_runs, finding, score_of, with_unit
from sonar_graph.states import Outcome

NO_TRUTH = "The log has no ground truth, so there are no errors to draw."
NO_ERRORS = "No run has errors against the ground truth."


@dataclass(frozen=True)
class Illustration:
    """One figure as the page shows it."""

    name: str
    title: str
    caption: str
    svg: str
    """Empty where there is nothing to draw."""
    instead: str
    """What the page says where there is nothing to draw."""


def illustrations(comparison: Comparison) -> dict[str, Illustration]:
    """All figures of the report, by name."""
    drawn = [*_of_paths(comparison), *_of_errors(comparison), *_of_updates(comparison)]
    return {illustration.name: illustration for illustration in drawn}


def _of_paths(comparison: Comparison) -> list[Illustration]:
    """Where vehicle and landmarks are, at the end and on the way."""
    return [
        _draw(comparison, "map", "Map", map_figure, _map_caption(comparison), "No run has a path to draw."),
        _draw(
            comparison,
            "growth",
            "Map as it grew",
            growth_figure,
            _growth_caption(comparison),
            "No run kept its map on the way.",
        ),
    ]


def _of_errors(comparison: Comparison) -> list[Illustration]:
    """Estimates against the truth, and the yaw with or without one."""
    no_errors = NO_TRUTH if comparison.sequence.truth is None else NO_ERRORS
    return [
        _draw(
            comparison,
            "errors",
            "Error over time",
            error_figure,
            "Estimate minus truth of the causal estimates, not aligned. The shaded band is three reported standard "
            "deviations either side: a consistent estimator leaves it almost never. Each panel has its own scale.",
            no_errors,
        ),
        _draw(
            comparison,
            "yaw",
            "Yaw over time",
            yaw_figure,
            "Heading of the body's x axis, wrapped to ±180°, causal." + _counterpart(comparison, "Fig. 5"),
            "No run has a path to draw.",
        ),
        _draw(
            comparison,
            "nees",
            "Consistency over time",
            nees_figure,
            "Normalised estimation error squared (NEES) of the causal estimates, divided by its degrees of freedom. "
            "Dots are instants, the line is the mean over a fortieth of the run; 1 is consistent. The band holds 95 % "
            "of a consistent estimator's values. Instants of one run depend on each other, so a share near 95 % is a "
            "hint and not a test.",
            f"{no_errors} NEES needs them.",
        ),
    ]


def _of_updates(comparison: Comparison) -> list[Illustration]:
    """What detections say against what was predicted, and how long updates take."""
    return [
        _draw(
            comparison,
            "innovations",
            "Innovations over time",
            innovation_figure,
            "Measured minus predicted range and azimuth of detections that had a prediction; in long runs an even "
            "choice of them, with the extremes.",
            "No run reports innovations.",
        ),
        _draw(
            comparison,
            "nis",
            "Distribution of NIS",
            nis_figure,
            "Normalised innovation squared (NIS) of used detections. Right of the grey curve: innovations larger than "
            "predicted; left: smaller.",
            "No run reports innovations with their covariances.",
        ),
        _draw(
            comparison,
            "timing",
            "Time per update",
            timing_figure,
            "Share of updates that took at most the given time; dots mark the median and the 99th percentile.",
            "No run reports durations.",
        ),
    ]


def _draw(
    comparison: Comparison,
    name: str,
    title: str,
    draw: Callable[[Comparison], Figure | None],
    caption: str,
    instead: str,
) -> Illustration:
    figure = draw(comparison)
    description = f"{title}. {caption} {_in_numbers(comparison, name)}".strip()
    svg = "" if figure is None else inline_svg(figure, name, description)
    return Illustration(name, title, caption, svg, instead)


def _map_caption(comparison: Comparison) -> str:
    caption = (
        "Paths and landmarks in the world of the start pose, not aligned. Ellipses hold 95 % of where each estimator "
        "believes a landmark to be; numbers are landmark IDs. Smoothed paths are drawn where they differ."
    )
    gone = paths_cut_off(comparison)
    return f"{caption} Leaves the picture: {', '.join(gone)}." if gone else caption


def _growth_caption(comparison: Comparison) -> str:
    factor = enlargement(comparison)
    drawn = "" if factor == 1 else f", drawn {factor} times as large"
    caption = (
        "Causal paths until the time T since start, and the landmarks as each estimator knew them then, not aligned. "
        f"Ellipses hold 95 %{drawn}."
    )
    if not repeats_published(comparison.sequence):
        return caption
    caption += _counterpart(comparison, "Fig. 4")
    *others, last = (f"{time_s:.1f}" for time_s in MAP_TIMES_S)
    if abs(comparison.sequence.duration_s - DURATION_S) < 1:
        return f"{caption} T are the instants nearest to its {', '.join(others)} and {last} s."
    return (
        f"{caption} T are the same fractions of this run as its {', '.join(others)} and {last} s of {DURATION_S:.1f} s."
    )


def _counterpart(comparison: Comparison, figure: str) -> str:
    return f" The counterpart of {figure} of the 2014 paper." if repeats_published(comparison.sequence) else ""


def _in_numbers(comparison: Comparison, name: str) -> str:
    """What the figure's numbers are, run by run, for a reader who does not see it."""
    if name == "map":
        return " ".join(finding(comparison))
    keys = {
        "yaw": ("causal.yaw_rmse_rad",),
        "nees": ("causal.nees_position", "causal.nees_yaw"),
        "errors": ("causal.ate_raw_m", "causal.yaw_rmse_rad"),
        "nis": ("detections.nis",),
        "timing": ("time.update_median_ms", "time.update_p99_ms"),
    }.get(name, ())
    told = []
    for run in comparison.runs:
        scores = [score for key in keys if (score := score_of(comparison, run.estimator, key))]
        if scores:
            told.append(f"{run.estimator}: {' and '.join(map(with_unit, scores))}")
    return "; ".join(told) + "." if told else ""


TEMPLATE = "report.html"


PAGE = "report.html"


def write_report(comparison: Comparison, folder: str | Path) -> Path:
    """Write a comparison into a folder: all the files that ``sonar-graph compare`` writes.

    The folder is made where it does not exist. It gets ``report.html``, ``comparison.json``, ``sequence.npz``,
    ``runs/NAME/`` for each estimator, the pictures of recognised landmarks, and ``result.mcap`` with its layouts for
    Foxglove and RViz. An earlier comparison in the folder is replaced; other files stay.

    Parameters
    ----------
    comparison
        From `sonar_graph.evaluation.compare`.
    folder
        Path of the folder.

    Returns
    -------
    Path of ``report.html``.

    Raises
    ------
    EvaluationError
        When the name of an estimator cannot be the name of a folder.
    LogError
        When ``result.mcap`` cannot be written, or a stamp does not fit into a ROS 2 message.

    Examples
    --------
    >>> import tempfile
    >>> from sonar_graph.evaluation import compare
    >>> from sonar_graph.report import write_report
    >>> from sonar_graph.simulation import MissionOptions, simulate_mission
    >>> comparison = compare(simulate_mission(MissionOptions(duration_s=10.0)), ["dead-reckoning"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_report(comparison, folder).name
    'report.html'
    """
    folder = Path(folder)
    write_comparison(comparison, folder)
    write_viewer_files(comparison, folder)
    return write_page(comparison, folder)


def write_page(comparison: Comparison, folder: Path) -> Path:
    """Write only ``report.html``, beside the other files of a comparison, and return its path.

    The page needs nothing but itself: figures are inline SVG in the page's colours, style is inline, there is no
    script. Links lead to the files beside it (``comparison.json``, ``result.mcap``, ``runs/NAME/``).
    """
    with replacing(folder / PAGE) as partial:
        partial.write_text(render_report(comparison), encoding="utf-8")
    return folder / PAGE


def render_report(comparison: Comparison) -> str:
    """The page as text. Everything that comes from a log or an estimator is escaped."""
    environment = Environment(
        loader=PackageLoader("sonar_graph.report", "templates"),
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
