"""The figures of a comparison with their titles, captions and descriptions, for its page and for a paper."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import (
    DURATION_S,
    MAP_TIMES_S,
    Comparison,
    aligned_to_truth,
    repeats_published,
    unaligned,
)
from sonar_graph.report import sentences
from sonar_graph.report.figure_style import (
    HALF_WIDTH_IN,
    PHONE_WIDTH_IN,
    Illustration,
    arrange,
    inline_svg,
    sized,
)
from sonar_graph.report.figures import error_figures
from sonar_graph.report.figures.maps import (
    enlargement,
    growth_figure,
    map_figure,
    paths_cut_off,
)
from sonar_graph.report.given_map import landmarks_moved, located_line

ALIGNED = "aligned to the truth"


@dataclass(frozen=True)
class Drawing:
    """One kind of figure."""

    title: str
    draw: Callable[[Comparison], Figure | None]
    caption: str
    """With the names of `_words` in braces, as the sentence below."""
    instead: str = "No run has a path to draw."
    """Sentence where there is nothing to draw."""
    columns: int = 2
    """Columns of a journal that it fills, of two."""
    is_aligned_too: bool = False
    """The figure has a second view, after alignment to the truth."""


# in reading order
DRAWINGS = {
    "map": Drawing(
        "Map",
        map_figure,
        "Paths{and_landmarks}, {world}.{ellipses}{paths_cut} {located}",
        columns=1,
        is_aligned_too=True,
    ),
    "growth": Drawing(
        "Map as it grew",
        growth_figure,
        "Causal paths until the time T since start, and landmarks as known then, {world}. Ellipses hold 95 %{as_large}."
        "{fig_4}",
        "No run kept its map on the way.",
        is_aligned_too=True,
    ),
    "errors": Drawing(
        "Error over time and distance",
        error_figures.error_figure,
        "Horizontal distance of the causal position from the truth{and_heading}, {world}. "
        "Left: over time. Right: over the distance travelled.{errors_cut}",
        "{no_errors}",
        is_aligned_too=True,
    ),
    "bounds": Drawing(
        "Errors with their reported 95 % bands",
        error_figures.bounds_figure,
        "Causal estimate minus truth, {world}. The shaded band should hold 95 % of the errors. Rows share their scale.",
        "{no_errors}",
        is_aligned_too=True,
    ),
    "yaw": Drawing(
        "Yaw over time",
        error_figures.yaw_figure,
        "Heading of the body's x axis, wrapped to ±180°, causal.{fig_5}",
        columns=1,
    ),
    "nees": Drawing(
        "Consistency over time",
        error_figures.nees_figure,
        "NEES of the causal estimates per degree of freedom, {world}. Dots are instants, lines are means over a "
        "fortieth of the run. The band holds 95 % of a consistent estimator's values.{in_band}",
        "{no_errors} NEES needs them.",
        columns=1,
    ),
    "innovations": Drawing(
        "Innovations over time",
        error_figures.innovation_figure,
        "Measured minus predicted range and azimuth. Long runs show an even choice, with the extremes.",
        "No run reports innovations.",
    ),
}


# marks the narrow one of two drawings of a figure
PHONE = "phone"
# ends the name of a figure or table before alignment, where there is one after it too
RAW_VIEW = "-raw"


def drawings(comparison: Comparison) -> dict[str, tuple[Comparison, Drawing]]:
    """All figures by name, in reading order: what each shows, and its kind with the caption in full.

    Where errors are known, a figure of paths or errors has two views: after alignment under its name, and before it
    under its name with `RAW_VIEW`.
    """
    # once for all figures: each alignment is a fit over the whole path
    aligned = aligned_to_truth(comparison)
    found = {}
    for name, drawing in DRAWINGS.items():
        views = {name: comparison}
        if aligned is not None and drawing.is_aligned_too:
            views = {name: aligned, name + RAW_VIEW: comparison}
        for view, shown in views.items():
            words = _words(shown)
            caption = drawing.caption.format(**words).rstrip()
            instead = drawing.instead.format(**words)
            found[view] = (shown, replace(drawing, caption=caption, instead=instead))
    return found


def illustrations(comparison: Comparison) -> dict[str, Illustration]:
    """All figures of the page by name: headings, captions, and descriptions that can be read out."""
    return {
        name: _illustration(shown, name, drawing)
        for name, (shown, drawing) in drawings(comparison).items()
    }


def panels_of(comparison: Comparison, name: str, *, aligned: bool) -> list[Axes]:
    """The panels of one figure, in reading order; an `EvaluationError` where there is nothing to draw."""
    shown = aligned_to_truth(comparison) if aligned else comparison
    if shown is None:
        raise EvaluationError("aligned=True: no run has errors against a truth")
    figure = DRAWINGS[name].draw(shown)
    if figure is None:
        instead = DRAWINGS[name].instead.format(**_words(shown))
        raise EvaluationError(f"nothing to draw. {instead}")
    arrange(figure)
    return figure.axes


def _illustration(comparison: Comparison, name: str, drawing: Drawing) -> Illustration:
    """One figure of the page; a map is drawn in two widths, and the page shows the one that fits."""
    widths_in = {"": HALF_WIDTH_IN if drawing.columns > 1 else PHONE_WIDTH_IN}
    described = f"{drawing.title}. {drawing.caption}"
    # a map is drawn twice, because its names cannot be shrunk to a phone
    if drawing.draw is map_figure:
        widths_in = {"": HALF_WIDTH_IN, PHONE: PHONE_WIDTH_IN}
        finding = sentences.headline(comparison, aligned=comparison.is_aligned)
        described = f"{described} {finding}"
    svg = ""
    for width, width_in in widths_in.items():
        with sized(width_in):
            figure = drawing.draw(comparison)
            if figure is not None:
                svg += inline_svg(figure, f"{name}{width}", described, width)
    return Illustration(name, drawing.title, drawing.caption, svg, drawing.instead)


def _words(comparison: Comparison) -> dict[str, str]:
    """What captions, and sentences in their place, have of a comparison."""
    no_errors = "No run has errors against the ground truth."
    if comparison.sequence.truth is None:
        no_errors = "The log has no ground truth, so there are no errors to draw."
    is_aligned = comparison.is_aligned
    factor = enlargement(comparison)
    as_large = "" if factor == 1 else f", drawn {factor} times as large"
    has_map = comparison.sequence.true_landmarks is not None or bool(comparison.maps)
    located = ""
    if not is_aligned:
        located = located_line(comparison).replace("map:", "map (star):", 1)
        if landmarks_moved(comparison):
            located += " Thick lines lead from the given places of landmarks to those where they are mapped again."
    words = {
        "world": ALIGNED if is_aligned else unaligned(comparison.sequence),
        "no_errors": no_errors,
        "as_large": as_large,
        "and_landmarks": " and landmarks" * has_map,
        "ellipses": f" Ellipses hold 95 %{as_large}." * has_map,
        "located": located,
        "and_heading": ", and size of the causal heading's error"
        * error_figures.has_yaw(comparison),
        "paths_cut": _leaving(paths_cut_off(comparison)),
        "errors_cut": _leaving(error_figures.errors_cut_off(comparison)),
        "in_band": error_figures.shares_in_band(comparison),
        "fig_4": "",
        "fig_5": "",
    }
    # only the repeated experiment may name the paper's figures
    if repeats_published(comparison.sequence):
        counterpart = " The counterpart of {} of the 2014 paper."
        *others, last = (f"{time_s:.1f}" for time_s in MAP_TIMES_S)
        times = f"{', '.join(others)} and {last} s"
        of_paper = f"the instants nearest to its {times}."
        if abs(comparison.sequence.duration_s - DURATION_S) >= 1:
            of_paper = (
                f"the same fractions of this run as its {times} of {DURATION_S:.1f} s."
            )
        words["fig_4"] = f"{counterpart.format('Fig. 4')} T are {of_paper}"
        words["fig_5"] = counterpart.format("Fig. 5")
    return words


def _leaving(names: list[str]) -> str:
    return f" Leaves the picture: {', '.join(names)}." if names else ""
