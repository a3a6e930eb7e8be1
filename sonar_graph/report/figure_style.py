"""The style of all figures: colours, panels, thinning of long series, and inline SVG in the colours of the page."""

import html
import io
import re
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from sonar_graph.evaluation import Comparison
from sonar_graph.measurements import Floats, Ints

INK = "#1c2024"
MUTED = "#5d656d"
RULE = "#d5d9dd"
TRUTH = "#8b9198"
ESTIMATOR_COLOURS = ("#0072b2", "#d55e00", "#00805e", "#a8508a", "#7a6a00", "#5b53b0")
"""After Okabe and Ito, told apart with any colour vision; darkened where white paper asks for more contrast."""
LINE_STYLES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (4, 1.4, 1, 1.4)), (0, (1.2, 1.2)))
LABEL_SIZE, TICK_SIZE = 9.5, 9.0
SERIES_POINTS = 700
"""Points that a drawn series keeps: more cannot be seen at the width of a page."""
PAGE_COLOURS = {INK: "--ink", MUTED: "--muted", RULE: "--rule", TRUTH: "--truth"} | {
    own: f"--run-{index}" for index, own in enumerate(ESTIMATOR_COLOURS)
}
"""Custom property of the page that replaces each colour, so that figures follow dark and light."""
POINTS_PER_INCH = 72


@dataclass(frozen=True)
class Illustration:
    """One figure as a page shows it."""

    name: str
    """Letters, digits and hyphens, unique on the page."""
    title: str
    caption: str
    svg: str
    """Empty where there is nothing to draw."""
    instead: str = ""
    """Sentence in place of the caption where there is nothing to draw."""
    data: str = ""
    """The drawn values as CSV, in the units of the results."""


def colour(index: int) -> str:
    """Colour of the comparison's run with this index, the same in every figure."""
    return ESTIMATOR_COLOURS[index % len(ESTIMATOR_COLOURS)]


def line_style(index: int) -> Any:
    """Line style of the comparison's run with this index, for figures in which runs share a panel."""
    return LINE_STYLES[index % len(LINE_STYLES)]


def blank_panels(rows: int, columns: int, size_in: tuple[float, float], **sharing: Any) -> tuple[Figure, NDArray[Any]]:
    """A figure of styled, empty panels, shape (rows, columns), without any state of pyplot."""
    figure = Figure(figsize=size_in, layout="constrained", facecolor="none")
    axes = figure.subplots(rows, columns, squeeze=False, **sharing)
    for panel in axes.flat:
        panel.set_facecolor("none")
        panel.grid(True, color=RULE, linewidth=0.6)
        panel.set_axisbelow(True)
        panel.tick_params(which="both", color=RULE, labelcolor=MUTED, labelsize=TICK_SIZE)
        for side, spine in panel.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(RULE)
    return figure, axes


def name_axes(panel: Axes, x: str = "", y: str = "") -> None:
    """Label the axes; an empty label is left out."""
    panel.set_xlabel(x, color=INK, fontsize=LABEL_SIZE)
    panel.set_ylabel(y, color=INK, fontsize=LABEL_SIZE)


def head_panel(panel: Axes, title: str, own_colour: str = INK) -> None:
    """Put a left-aligned heading over a panel."""
    panel.set_title(title, loc="left", color=own_colour, fontsize=LABEL_SIZE, fontweight="bold")


def logarithmic(panel: Axes, direction: Literal["x", "y"]) -> None:
    """Put an axis on a logarithmic scale with plain numbers at the powers of ten."""
    axis = panel.xaxis if direction == "x" else panel.yaxis
    panel.set(**{f"{direction}scale": "log"})
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_above(figure: Figure, panel: Axes, columns: int = 4) -> None:
    """One legend for the figure, outside the data."""
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=columns,
        frameon=False,
        labelcolor=INK,
        fontsize=TICK_SIZE,
        handlelength=2.6,
    )


def seconds_since_start(comparison: Comparison, stamps_ns: Ints) -> Floats:
    """Seconds since the sequence's first instant with IMU and DVL."""
    return np.asarray((stamps_ns - comparison.sequence.start_ns) * 1e-9)


def thinned(values: Floats, points: int = SERIES_POINTS) -> Ints:
    """Rows that draw like the whole series: first, last, and the extremes of each of ``points / 2`` equal stretches.

    Thinning never hides a jump; a stretch with a gap (NaN) keeps the gap.
    """
    n = len(values)
    if n <= points:
        return np.arange(n)
    edges = np.linspace(0, n, points // 2 + 1).astype(np.int64)
    stretches = list(pairwise(edges.tolist()))
    lowest = [first + int(np.argmin(values[first:last])) for first, last in stretches]
    highest = [first + int(np.argmax(values[first:last])) for first, last in stretches]
    return np.unique(np.array([0, *lowest, *highest, n - 1], dtype=np.int64))


def evenly(n: int, points: int = SERIES_POINTS) -> Ints:
    """At most ``points`` rows out of n, equally spaced, first and last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, points)).round().astype(np.int64)) if n else np.empty(0, np.int64)


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an ``<svg>`` element for an HTML page.

    Text stays text, colours become the page's custom properties, and nothing refers outside. Identifiers begin with
    ``name`` (letters, digits and hyphens, unique on the page), so that several figures can share a page.

    ``description``: content of the figure in words, for those who cannot see it.
    """
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "path.simplify_threshold": 0.25, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index(">", svg.index("<svg")) + 1 :]
    # metadata and comments are of no use; a style rule would reach the whole page
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r"\s*\n\s*", "\n", svg)
    svg = re.sub(r'(\s)id="([^"]+)"', rf'\1id="{name}-\2"', svg)
    svg = re.sub(r'(?:xlink:)?href="#([^"]+)"', rf'href="#{name}-\1"', svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", svg)
    for own, variable in PAGE_COLOURS.items():
        svg = svg.replace(own, f"var({variable})")
    width, height = (float(side) * POINTS_PER_INCH for side in figure.get_size_inches())
    return (
        f'<svg role="img" aria-label="{html.escape(description)}" viewBox="0 0 {width:g} {height:g}"'
        f' style="--natural-width: {width * 96 / POINTS_PER_INCH:.0f}px">{svg}'
    )
