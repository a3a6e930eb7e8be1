"""The figures of a comparison with their titles, captions and descriptions, for its page and for a paper."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from matplotlib.figure import Figure

from sonar_graph.evaluation import (
    DURATION_S,
    MAP_TIMES_S,
    Comparison,
    repeats_published,
    unaligned,
)
from sonar_graph.report import sentences
from sonar_graph.report.figure_style import (
    PAGE_WIDTH_IN,
    Illustration,
    inline_svg,
    sized,
)
from sonar_graph.report.figures import detection_figures, error_figures
from sonar_graph.report.figures.maps import (
    enlargement,
    growth_figure,
    map_figure,
    paths_cut_off,
)

MAP_WIDTH_IN = 4.8
"""Width of the map on the page: whole on a phone, where wider figures scroll."""


@dataclass(frozen=True)
class Drawing:
    """One kind of figure."""

    title: str
    draw: Callable[[Comparison], Figure | None]
    caption: str = ""
    instead: str = "No run has a path to draw."
    """Sentence where there is nothing to draw."""
    scores: tuple[str, ...] = ()
    """Keys of scores that are read out for who does not see the figure."""
    columns: int = 2
    """Columns of a journal that it fills, of two."""


DRAWINGS = {
    "map": Drawing("Map", map_figure, columns=1),
    "growth": Drawing(
        "Map as it grew", growth_figure, instead="No run kept its map on the way."
    ),
    "errors": Drawing(
        "Error over time and distance",
        error_figures.error_figure,
        "Horizontal distance of the causal position from the truth{and_heading}, "
        "{unaligned}. Left: over time; right: over the distance that the truth has travelled.{cut}",
        "{no_errors}",
        ("causal.ate_raw_m", "causal.yaw_rmse_rad"),
    ),
    "bounds": Drawing(
        "Errors and what was believed of them",
        error_figures.bounds_figure,
        "Estimate minus truth of the causal estimates, {unaligned}. The shaded band is three reported standard "
        "deviations either side: a consistent estimator leaves it almost never. Scales are shared by row.",
        "{no_errors}",
        ("causal.ate_raw_m", "causal.yaw_rmse_rad"),
    ),
    "own_map": Drawing(
        "Where am I on my map?",
        error_figures.own_map_figure,
        "Horizontal error of the causal position after the map, as the estimator had it at that instant, is aligned "
        "to the true landmarks. A smoother that moves its map when it learns moves itself with it: the path told "
        "before is left behind, and only the other errors count that.",
        "No run has a map of three true landmarks while the truth is known.",
        ("causal.own_map_m",),
        columns=1,
    ),
    "yaw": Drawing(
        "Yaw over time",
        error_figures.yaw_figure,
        scores=("causal.yaw_rmse_rad",),
        columns=1,
    ),
    "nees": Drawing(
        "Consistency over time",
        error_figures.nees_figure,
        "Normalised estimation error squared (NEES) of the causal estimates, divided by its degrees of freedom. "
        "Dots are instants, the line is the mean over a fortieth of the run; 1 is consistent. The band holds 95 % "
        "of a consistent estimator's values. Instants of one run depend on each other, so a share near 95 % is a "
        "hint and not a test.",
        "{no_errors} NEES needs them.",
        ("causal.nees_position", "causal.nees_yaw"),
    ),
    "innovations": Drawing(
        "Innovations over time",
        detection_figures.innovation_figure,
        "Measured minus predicted range and azimuth of detections that had a prediction; in long runs an even "
        "choice of them, with the extremes.",
        "No run reports innovations.",
    ),
    "nis": Drawing(
        "Distribution of NIS",
        detection_figures.nis_figure,
        "Normalised innovation squared (NIS) of used detections. Right of the grey curve: innovations larger than "
        "predicted; left: smaller.",
        "No run reports innovations with their covariances.",
        ("detections.nis",),
        columns=1,
    ),
    "timing": Drawing(
        "Time per update",
        detection_figures.timing_figure,
        "Share of updates that took at most the given time; dots mark the median and the 99th percentile.",
        "No run reports durations.",
        ("time.update_median_ms", "time.update_p99_ms"),
        columns=1,
    ),
}
"""In reading order."""


def illustrations(comparison: Comparison) -> dict[str, Illustration]:
    """All figures of the page by name, in reading order: headings, captions, and descriptions that can be read out."""
    found = {}
    for name, drawing in drawings(comparison).items():
        told = []  # the figure's numbers, run by run, for a reader who does not see it
        for run in comparison.runs:
            scores = [
                score
                for key in drawing.scores
                if (score := comparison.score_of(run.estimator, key))
            ]
            if scores:
                told.append(
                    f"{run.estimator}: {' and '.join(score.with_unit for score in scores)}"
                )
        numbers = (
            " ".join(sentences.finding(comparison))
            if name == "map"
            else f"{'; '.join(told)}."
            if told
            else ""
        )
        with sized(MAP_WIDTH_IN if drawing.draw is map_figure else PAGE_WIDTH_IN):
            figure = drawing.draw(comparison)
            described = f"{drawing.title}. {drawing.caption} {numbers}".strip()
            svg = "" if figure is None else inline_svg(figure, name, described)
        found[name] = Illustration(
            name, drawing.title, drawing.caption, svg, drawing.instead
        )
    return found


def drawings(comparison: Comparison) -> dict[str, Drawing]:
    """Kinds of figures by name, with their captions in full."""
    captions = _captions(comparison)
    return {
        name: replace(
            drawing,
            caption=captions.get(name, drawing.caption),
            instead=_instead(comparison, drawing),
        )
        for name, drawing in DRAWINGS.items()
    }


def _instead(comparison: Comparison, drawing: Drawing) -> str:
    no_errors = "No run has errors against the ground truth."
    if comparison.sequence.truth is None:
        no_errors = "The log has no ground truth, so there are no errors to draw."
    return drawing.instead.format(no_errors=no_errors)


def _captions(comparison: Comparison) -> dict[str, str]:
    """Captions that depend on the comparison."""
    is_repeated, world = (
        repeats_published(comparison.sequence),
        unaligned(comparison.sequence),
    )
    counterpart = " The counterpart of {} of the 2014 paper." if is_repeated else ""
    factor = enlargement(comparison)
    as_large = "" if factor == 1 else f", drawn {factor} times as large"
    growth = (
        f"Causal paths until the time T since start, and the landmarks as each estimator knew them then, {world}. "
        f"Ellipses hold 95 %{as_large}."
        f"{counterpart.format('Fig. 4')}"
    )
    if is_repeated:
        *others, last = (f"{time_s:.1f}" for time_s in MAP_TIMES_S)
        if abs(comparison.sequence.duration_s - DURATION_S) < 1:
            growth += (
                f" T are the instants nearest to its {', '.join(others)} and {last} s."
            )
        else:
            growth += f" T are the same fractions of this run as its {', '.join(others)} and {last} s of {DURATION_S:.1f} s."
    has_map = comparison.sequence.true_landmarks is not None or any(
        run.landmarks is not None and len(run.landmarks) for run in comparison.runs
    )
    landmarks = f" Ellipses hold 95 % of where each estimator believes a landmark to be{as_large}; numbers are landmark IDs."
    gone, far = paths_cut_off(comparison), error_figures.errors_cut_off(comparison)
    return {
        "map": (
            f"Paths{' and landmarks' * has_map} in the world of the start pose, {world}.{landmarks * has_map} Smoothed "
            f"paths are drawn where they differ.{_leaving(gone)}"
        ),
        "growth": growth,
        "errors": DRAWINGS["errors"].caption.format(
            unaligned=world,
            and_heading=", and size of the causal heading's error"
            if error_figures.has_yaw(comparison)
            else "",
            cut=_leaving(far),
        ),
        "bounds": DRAWINGS["bounds"].caption.format(unaligned=world),
        "yaw": f"Heading of the body's x axis, wrapped to ±180°, causal.{counterpart.format('Fig. 5')}",
    }


def _leaving(names: list[str]) -> str:
    return f" Leaves the picture: {', '.join(names)}." if names else ""
