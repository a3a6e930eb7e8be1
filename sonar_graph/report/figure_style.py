"""The style of all figures: colours, sizes, panels, margins, thinning of long series, and inline SVG for pages.

Widths and sizes of text are matplotlib's own settings while a figure is drawn (`sized`), so that the same functions
draw for a page and for a paper.
"""

import html
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as MarkPath
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from sonar_graph.evaluation import Comparison
from sonar_graph.measurements import Floats, Ints

INK = "#1c2024"
MUTED = "#5d656d"
RULE = "#d5d9dd"
TRUTH = "#8b9198"
# after Okabe and Ito, distinct with any colour vision; darkened where white paper needs more contrast
ESTIMATOR_COLOURS = ("#0072b2", "#d55e00", "#00805e", "#a8508a", "#7a6a00", "#5b53b0")
LINE_STYLES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.6)),
    (0, (4, 1.4, 1, 1.4)),
    (0, (1.2, 1.2)),
)
TRUTH_LOOK: dict[str, Any] = {"color": TRUTH, "linewidth": 3.2, "alpha": 0.6}
TIME_LABEL = "time since start (s)"
PAGE_WIDTH_IN = 7.4
# 610 px: two figures stand beside each other on a screen of 1280 px
HALF_WIDTH_IN = 6.35
# width of the content of a page on a phone, 357 of 390 px
PHONE_WIDTH_IN = 3.72
# 12.3 px on a page that shows figures at their natural width or wider
PAGE_TEXT_PT = 9.2
# points that a drawn series keeps: more cannot be seen at the width of a page
SERIES_POINTS = 700
# mean width of a letter, in sizes of the text
LETTER = 0.62
# width of a line in the legend
HANDLE_IN = 0.6
# lowest and highest panel of a map, in its widths
SHAPES = (0.45, 1.25)
# custom property of the page that replaces each colour, so that figures follow dark and light
PAGE_COLOURS = {INK: "--ink", MUTED: "--muted", RULE: "--rule", TRUTH: "--truth"} | {
    own: f"--run-{index}" for index, own in enumerate(ESTIMATOR_COLOURS)
}
# settings of matplotlib for the size of texts
TEXTS = ("axes.labelsize", "axes.titlesize", "xtick.labelsize", "ytick.labelsize", "legend.fontsize")  # fmt: skip
POINTS_PER_INCH = 72
CSS_PIXELS_PER_INCH = 96
LEAST_TICKS = 3
# width of a bold letter or digit, in sizes of the text
BOLD_LETTER = 0.72
# height of a name with what hangs below its line, in sizes of the text
NAME_HEIGHT = 1.25
# half the size of the mark of a landmark, inches
MARK_IN = 0.07
# directions from a point in which its name may stand, best first
NAME_PLACES = ((1, 1), (-1, 1), (1, -1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True)
class Illustration:
    """One figure as a page shows it."""

    name: str
    """Letters, digits and hyphens, unique on the page."""
    title: str
    caption: str
    svg: str = ""
    """Empty where there is nothing to draw."""
    instead: str = ""
    """Sentence in place of the caption where there is nothing to draw."""
    figure: Figure | None = None


def colour(index: int) -> str:
    """Colour of the comparison's run with this index, the same in every figure."""
    return ESTIMATOR_COLOURS[index % len(ESTIMATOR_COLOURS)]


def run_look(index: int, width: float) -> dict[str, Any]:
    """Colour, line style and line width (points) of the comparison's run with this index, where runs share a panel."""
    line_style = LINE_STYLES[index % len(LINE_STYLES)]
    return {"color": colour(index), "linestyle": line_style, "linewidth": width}


@contextmanager
def sized(
    width_in: float = PAGE_WIDTH_IN,
    text_pt: float = PAGE_TEXT_PT,
    font: str = "sans-serif",
) -> Iterator[None]:
    """Let all figures that are drawn in the block have this width and size of text."""
    # settings, not arguments: the same functions then draw for a page and for a paper
    settings: Any = dict.fromkeys(TEXTS, "medium") | {
        "figure.figsize": (width_in, width_in),
        "font.size": text_pt,
        "font.family": font,
    }
    with mpl.rc_context(settings):
        yield


def width_in() -> float:
    """Width of figures, as the block of `sized` sets it."""
    return float(mpl.rcParams["figure.figsize"][0])


def text_pt() -> float:
    """Size of text, as the block of `sized` sets it."""
    return float(mpl.rcParams["font.size"])


def size_in(rows: int, row_in: float = 1.75) -> tuple[float, float]:
    """Width and height of a figure of rows, inches; on a narrow one they are lower."""
    # a phone shows a figure as wide as itself: as high as on a page it would fill the screen
    narrow = min(1.0, 0.55 + 0.45 * width_in() / PAGE_WIDTH_IN)
    return width_in(), ((row_in if rows > 1 else 2.3) * rows + 0.8) * narrow


def blank_panels(
    rows: int, columns: int, size_in: tuple[float, float], **sharing: Any
) -> tuple[Figure, NDArray[Any]]:
    """A figure of styled, empty panels, shape (rows, columns), without any state of pyplot."""
    # not by pyplot, whose figures stay in memory until they are closed
    figure = Figure(figsize=size_in, facecolor="none")
    axes = figure.subplots(rows, columns, squeeze=False, **sharing)
    for panel in axes.flat:
        panel.set_facecolor("none")
        panel.grid(True, color=RULE, linewidth=0.6)
        # grid lines behind the data
        panel.set_axisbelow(True)
        panel.tick_params(which="both", color=RULE, labelcolor=MUTED)
        panel.xaxis.label.set_color(INK)
        panel.yaxis.label.set_color(INK)
        for axis, most in ((panel.xaxis, 8 if columns == 1 else 5), (panel.yaxis, 5)):
            axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
        for side, spine in panel.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(RULE)
    return figure, axes


def arrange(figure: Figure) -> None:
    """Set margins below the legend, and the height of maps, from what the figure holds.

    A figure that has a layout engine keeps it.
    """
    if figure.get_layout_engine() is not None:
        return
    panel = figure.axes[0]
    is_map = panel.get_aspect() == 1
    for one in figure.axes if is_map else ():
        # panels that shrink to their scale would leave room that the fit does not see
        one.set_aspect("auto")
    _fit(figure)
    # on a map a metre is as long in x as in y, so the height follows from what is drawn
    if is_map:
        place = panel.get_subplotspec()
        assert place is not None, "maps stand in a grid"
        room = place.get_position(figure)
        width, height = map(float, figure.get_size_inches())
        shape = np.clip(np.ptp(panel.get_ylim()) / np.ptp(panel.get_xlim()), *SHAPES)
        missing_in = shape * room.width * width - room.height * height
        rows = place.get_gridspec().nrows
        figure.set_size_inches(width, height + rows * missing_in)
        _fit(figure)
        for one in figure.axes:
            one.set_aspect("equal", adjustable="box")
            # names are placed before matplotlib draws, which would apply the scale later
            one.apply_aspect()


def _fit(figure: Figure) -> None:
    """Fit the panels into the figure, below its legend, which matplotlib leaves out of account."""
    # tight_layout leaves a figure's legend out of account
    legend_px = sum(legend.get_window_extent().height for legend in figure.legends)
    top = 1.0 - legend_px / figure.bbox.height
    figure.tight_layout(pad=0.5, rect=(0.0, 0.0, 1.0, top))
    figure.align_ylabels()


def head_panel(panel: Axes, title: str, own_colour: str = INK) -> None:
    """Put a left-aligned heading over a panel."""
    panel.set_title(
        title, loc="left", color=own_colour, fontweight="bold", y=1.0, pad=4
    )


def logarithmic(panel: Axes, direction: Literal["x", "y"]) -> None:
    """Put an axis on a logarithmic scale with plain numbers at the powers of ten."""
    axis = panel.xaxis if direction == "x" else panel.yaxis
    panel.set(**{f"{direction}scale": "log"})
    axis.set_major_locator(SeveralTicks())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    # minor ticks between labelled ones are clutter at this size
    axis.set_minor_locator(NullLocator())


class SeveralTicks(LogLocator):
    """Ticks at powers of ten, and between them where a logarithmic axis would have fewer than `LEAST_TICKS`."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Places of the ticks for an axis between two values."""
        low, high = sorted([vmin, vmax])
        for between in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)):
            self.set_params(subs=between)
            ticks = np.asarray(super().tick_values(vmin, vmax))
            if np.count_nonzero((ticks >= low) & (ticks <= high)) >= LEAST_TICKS:
                return ticks
        return MaxNLocator(LEAST_TICKS + 1).tick_values(vmin, vmax)


def label_points(panel: Axes, names: list[str], points: Floats) -> None:
    """Write names beside points, shape (n, 2), where neither another name nor a point is; a name without room is left out.

    The figure must have its final size (`arrange`), because the room is measured in inches.
    """
    scale = 1.0 / panel.figure.dpi
    places_in = panel.transData.transform(points) * scale  # (n, 2)
    frame = panel.get_window_extent().get_points() * scale
    size_in = text_pt() / POINTS_PER_INCH
    height = NAME_HEIGHT * size_in
    # names must not cover the marks of other landmarks
    taken = [(at - MARK_IN, at + MARK_IN) for at in places_in]
    for name, at, point in zip(names, places_in, points, strict=True):
        width = size_in * BOLD_LETTER * len(name)
        for x, y in NAME_PLACES:
            left = -width / 2 if x == 0 else min(x, 0) * width
            low = at + np.array([x * MARK_IN, y * MARK_IN])
            low += np.array([left, (y - 1) / 2 * height])
            high = low + np.array([width, height])
            # two boxes are apart where they are apart in one direction
            is_free = all(
                np.any((high <= other_low) | (low >= other_high))
                for other_low, other_high in taken
            )
            if not is_free or np.any(low < frame[0]) or np.any(high > frame[1]):
                continue
            taken.append((low, high))
            panel.annotate(
                name,
                tuple(point),
                xytext=tuple((low - at) * POINTS_PER_INCH),
                textcoords="offset points",
                color=INK,
                fontweight="bold",
                verticalalignment="bottom",
                zorder=6,
            )
            break


def legend_above(figure: Figure, panel: Axes) -> None:
    """One legend for the figure, outside the data, in as many columns as there is room for."""
    handles, labels = panel.get_legend_handles_labels()
    longest_in = LETTER * text_pt() / POINTS_PER_INCH * max(map(len, labels), default=0)
    room = int(figure.get_figwidth() / (HANDLE_IN + longest_in))
    figure.legend(
        handles,
        labels,
        loc="upper left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.1,
        ncols=min(max(room, 1), 4),
        frameon=False,
        labelcolor=INK,
        handlelength=2.4,
    )


def dots(panel: Axes, x: Floats, y: Floats, own_colour: str, label: str = "") -> None:
    """Dots as strokes without length: one element of the drawing, where each marker is one."""
    points = np.column_stack([x, y])
    strokes = [MarkPath.MOVETO, MarkPath.LINETO] * len(x)
    path = MarkPath(np.repeat(points, 2, axis=0), strokes)
    # simplification would leave out strokes without length
    path.should_simplify = False
    dots = PathPatch(
        path,
        capstyle="round",
        transform=panel.transData,
        edgecolor=own_colour,
        facecolor="none",
        linewidth=2.0,
        alpha=0.5,
    )
    panel.add_artist(dots)
    # a patch that is added does not widen the axes
    panel.update_datalim(points)
    panel.autoscale_view()
    if label:
        # the legend takes its mark from a line without points, because the patch has none
        panel.plot([], [], ".", color=own_colour, label=label)


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
    edges = np.linspace(0, n, points // 2 + 1).astype(np.int64).tolist()
    rows = [0, n - 1]
    for first, last in pairwise(edges):
        stretch = values[first:last]
        # argmin and argmax give the first NaN of a stretch that has one, which keeps the gap
        rows += [first + int(np.argmin(stretch)), first + int(np.argmax(stretch))]
    return np.unique(np.array(rows, dtype=np.int64))


def evenly(n: int, points: int = SERIES_POINTS) -> Ints:
    """At most ``points`` rows out of n, equally spaced, first and last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, points)).round().astype(np.int64))


def evenly_with_extremes(values: Floats, points: int) -> Ints:
    """At most three times so many rows: equally spaced ones, and those of `thinned`."""
    return np.union1d(evenly(len(values), 2 * points), thinned(values, points))


def inline_svg(figure: Figure, name: str, description: str, width: str = "") -> str:
    """The figure as an ``<svg>`` element for an HTML page.

    Text stays text, colours become the page's custom properties, and nothing refers outside. Identifiers begin with
    ``name`` (letters, digits and hyphens, unique on the page), so that several figures can share a page.

    ``description``: content of the figure in words, for those who cannot see it. ``width``: "phone" for the narrow one
    of two drawings of a figure.
    """
    # here and not by the caller, so that no figure can reach a page without margins
    arrange(figure)
    buffer = io.StringIO()
    # with a fixed salt and no date the same result gives the same page, byte for byte
    with mpl.rc_context(
        {"svg.fonttype": "none", "path.simplify_threshold": 0.25, "svg.hashsalt": name}
    ):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index(">", svg.index("<svg")) + 1 :]
    for found, instead in (
        # metadata and comments are of no use; a style rule would reach the whole page
        (r"(?s)<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", ""),
        (r"\s*\n\s*", "\n"),
        (r'(\s)id="([^"]+)"', rf'\1id="{name}-\2"'),
        (r'(?:xlink:)?href="#([^"]+)"', rf'href="#{name}-\1"'),
        (r"url\(#([^)]+)\)", rf"url(#{name}-\1)"),
    ):
        svg = re.sub(found, instead, svg)
    for own, variable in PAGE_COLOURS.items():
        svg = svg.replace(own, f"var({variable})")
    width_in, height_in = map(float, figure.get_size_inches())
    purpose = f' data-for="{width}"' if width else ""
    return (
        f'<svg role="img"{purpose} aria-label="{html.escape(description)}" viewBox="0 0 {width_in * POINTS_PER_INCH:g} '
        f'{height_in * POINTS_PER_INCH:g}" style="--natural-width: {width_in * CSS_PIXELS_PER_INCH:.0f}px">{svg}'
    )
