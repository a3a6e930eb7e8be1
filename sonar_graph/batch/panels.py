"""Panels of a batch's figures: one a log, a line for each contestant; many logs stand beside each other."""

from __future__ import annotations

import re

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from sonar_graph.batch.recorded import RecordedBatch
from sonar_graph.evaluation.figure_style import INK, LABEL_SIZE, blank_panels, colour, head_panel, logarithmic

ROW_IN, PANEL_IN, WIDTH_IN = 0.36, 0.95, 7.4
STACKED = 2
"""So many logs stand below each other; more make small multiples."""
COLUMNS = 3
NAME_LETTERS, HEADING_LETTERS = 18, 20
"""Width of names beside and headings above small panels."""


def log_panels(batch: RecordedBatch, logs: list[str], x_label: str) -> tuple[Figure, list[Axes]]:
    """A panel a log with a scale of its own; in each a line for each contestant, the first on top."""
    names = batch.contestants
    columns = 1 if len(logs) <= STACKED else min(COLUMNS, len(logs) - 1)
    rows = -(-len(logs) // columns)
    height_in = rows * (PANEL_IN + ROW_IN * len(names))
    figure, axes = blank_panels(rows, columns, (WIDTH_IN, height_in))
    panels: list[Axes] = list(axes.flat)
    for panel in panels[len(logs) :]:
        panel.remove()
    for index, log in enumerate(logs):
        _name_lines(panels[index], names if index % columns == 0 else [""] * len(names), narrow=columns > 1)
        head_panel(panels[index], folded(log, HEADING_LETTERS) if columns > 1 else log)
    figure.supxlabel(x_label, color=INK, fontsize=LABEL_SIZE)
    return figure, panels[: len(logs)]


def _name_lines(panel: Axes, names: list[str], *, narrow: bool) -> None:
    labels = [folded(name, NAME_LETTERS) if narrow else name for name in names]
    panel.set(ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)), yticklabels=labels)
    panel.grid(False, axis="y")
    for place, label in enumerate(panel.get_yticklabels()):
        label.set_color(colour(place))
        label.set_linespacing(0.95)


def folded(name: str, letters: int) -> str:
    r"""A name in lines of at most so many letters where it can be: they end after a slash, an equals sign or a comma.

    Examples
    --------
    >>> folded("isam2/identity_policy=gnc", 18)
    'isam2/\nidentity_policy=\ngnc'
    >>> folded("tracks, wrong_id_rate=0.05", 20)
    'tracks,\nwrong_id_rate=0.05'
    """
    lines = [""]
    for part in re.findall(r"[^/=,]+[/=,]?\s*|[/=,]\s*", name):
        if lines[-1] and len((lines[-1] + part).rstrip()) > letters:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def spread_out(panel: Axes) -> None:
    """A logarithmic scale with numbers at 1, 2 and 5 of each power of ten."""
    logarithmic(panel, "x")
    panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
