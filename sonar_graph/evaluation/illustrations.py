"""The report's figures in reading order, each with its heading, caption and a description for those who cannot see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure

from sonar_graph.evaluation.figures import (
    error_figure,
    innovation_figure,
    nees_figure,
    nis_figure,
    timing_figure,
    yaw_figure,
)
from sonar_graph.evaluation.growth_figure import enlargement, growth_figure
from sonar_graph.evaluation.map_figure import map_figure, paths_cut_off
from sonar_graph.evaluation.published_experiment import DURATION_S, MAP_TIMES_S, repeats_published
from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.svg import inline_svg
from sonar_graph.evaluation.wording import finding, score_of, with_unit

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
