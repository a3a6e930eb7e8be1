"""A matplotlib figure as an inline SVG that takes its colours from the page around it."""

from __future__ import annotations

import html
import io
import re

import matplotlib as mpl
from matplotlib.figure import Figure

from sonar_graph.evaluation.figure_style import ESTIMATOR_COLOURS, INK, MUTED, RULE, TRUTH

PAGE_COLOURS = {INK: "--ink", MUTED: "--muted", RULE: "--rule", TRUTH: "--truth"} | {
    own: f"--run-{index}" for index, own in enumerate(ESTIMATOR_COLOURS)
}
"""Custom property of the page that takes the place of each colour, so that figures follow dark and light."""
POINTS_PER_INCH = 72


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an ``<svg>`` element for an HTML page.

    Text stays text, colours become the page's custom properties, nothing refers outside, and identifiers start with
    ``name`` so that several figures can share a page.

    Parameters
    ----------
    name
        Letters and hyphens, unique on the page.
    description
        What the figure shows, for those who cannot see it.
    """
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "path.simplify_threshold": 0.25, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    drawing = _without_wrapping(buffer.getvalue())
    drawing = _with_own_identifiers(drawing, name)
    for own, variable in PAGE_COLOURS.items():
        drawing = drawing.replace(own, f"var({variable})")
    return _opening_tag(figure, description) + drawing


def _without_wrapping(svg: str) -> str:
    """What follows the opening tag, without metadata, and without the style rule, which would reach the whole page."""
    body = svg[svg.index(">", svg.index("<svg")) + 1 :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"<style.*?</style>", "", body, flags=re.DOTALL)
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    return re.sub(r"\s*\n\s*", "\n", body)


def _with_own_identifiers(body: str, name: str) -> str:
    body = re.sub(r'(\s)id="([^"]+)"', rf'\1id="{name}-\2"', body)
    body = re.sub(r'(?:xlink:)?href="#([^"]+)"', rf'href="#{name}-\1"', body)
    return re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", body)


def _opening_tag(figure: Figure, description: str) -> str:
    width, height = (float(side) * POINTS_PER_INCH for side in figure.get_size_inches())
    return (
        f'<svg role="img" aria-label="{html.escape(description)}" viewBox="0 0 {width:g} {height:g}"'
        f' style="--natural-width: {width * 96 / POINTS_PER_INCH:.0f}px">'
    )
