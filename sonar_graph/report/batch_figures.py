"""The figure of a metric of a batch: every run, by log and contestant.

Each log has a panel with its own scale and a line for each contestant, which keeps its colour and place everywhere.
"""

import math
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from sonar_graph.batch import Metric, RecordedBatch, quantile
from sonar_graph.measurements import Floats
from sonar_graph.report import figure_style as style
from sonar_graph.report.batch_tables import unit_of

ROW_IN = 0.36
PANEL_IN = 0.95
KIND_SHIFT = {"": 0.0, "Causal": -0.17, "Smoothed": 0.17}

SMALL = 9.0


def log_panels(
    batch: RecordedBatch, logs: list[str], x_label: str
) -> tuple[Figure, list[Axes]]:
    """A panel a log with a scale of its own; in each a line for each contestant, the first on top."""
    names = batch.contestants
    height_in = len(logs) * (PANEL_IN + ROW_IN * len(names))
    figure, axes = style.blank_panels(len(logs), 1, (style.width_in(), height_in))
    # names of any width stand beside the panels
    figure.set_layout_engine("constrained")
    panels: list[Axes] = list(axes.flat)
    for panel, log in zip(panels, logs, strict=True):
        panel.set(ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)))
        panel.set_yticklabels(names)
        # lines of contestants are no scale
        panel.grid(False, axis="y")
        for place, label in enumerate(panel.get_yticklabels()):
            label.set_color(style.colour(place))
        style.head_panel(panel, log)
    figure.supxlabel(x_label, color=style.INK, fontsize="medium")
    return figure, panels


def spread_drawing(batch: RecordedBatch, metric: Metric) -> style.Illustration | None:
    """Every run's value as a dot, with the median and the middle 80 %."""
    found = {log: _finite(batch, log, metric) for log in batch.logs}
    found = {log: values for log, values in found.items() if values.size}
    if not found:
        return None
    label = f"{metric.label}{unit_of(metric)}"
    figure, panels = log_panels(batch, list(found), label)
    for panel, (log, values) in zip(panels, found.items(), strict=True):
        # a logarithmic scale for errors that differ by a power of ten, where a linear one would hide the
        # small ones
        if values.min() > 0 and values.max() > SMALL * values.min():
            style.logarithmic(panel, "x")
            panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        for place, contestant in enumerate(batch.contestants):
            for over, key in metric.keys.items():
                own = batch.values(log, contestant, key) * metric.factor
                _draw_spread(panel, own, place, over)
    kinds = "Full dots, above: causal; hollow, below: smoothed. "
    caption = (
        f"{metric.protocol} A dot is a run, the stroke their median, the bar the middle 80 %. "
        f"{'' if '' in metric.keys else kinds}"
        "Runs without a value have no dot; their number stands at the right."
    )
    name = f"spread-{metric.name}".replace("_", "-")
    svg = style.inline_svg(figure, name, f"{metric.label}. {caption}")
    return style.Illustration(name, metric.label, caption, svg, figure=figure)


def _draw_spread(panel: Axes, values: Floats, place: int, over: str) -> None:
    known = values[np.isfinite(values)]
    row = place + KIND_SHIFT[over]
    own = style.colour(place)
    if not known.size:
        return
    # an infinite end would draw a bar to the edge, which looks like a value
    inside = [quantile(values, share) for share in (0.1, 0.9)]
    look: dict[str, Any] = {"linewidth": 7, "alpha": 0.3, "solid_capstyle": "butt"}
    if all(map(math.isfinite, inside)) and len(values) > 1:
        panel.plot(inside, [row, row], color=own, **look)
    # dots of equal values stand beside each other
    shifts = row + 0.05 * np.cos(2.4 * np.arange(len(known)))
    filled = "none" if over == "Smoothed" else own
    panel.plot(known, shifts, "o", color=own, markersize=3.6, markerfacecolor=filled)
    middle = quantile(values, 0.5)
    if math.isfinite(middle):
        look = {"color": style.INK, "markersize": 12, "markeredgewidth": 1.6}
        panel.plot(middle, row, "|", **look)
    # a dot that is missing must not look like a run that is missing
    if len(known) < len(values):
        note = f"{len(values) - len(known)} without"
        look = {"color": style.MUTED, "fontsize": "small", "ha": "left", "va": "center"}
        panel.text(1.01, row, note, transform=panel.get_yaxis_transform(), **look)


def _finite(batch: RecordedBatch, log: str, metric: Metric) -> Floats:
    """The finite values of all runs on a log, of both estimates."""
    places = product(batch.contestants, metric.keys.values())
    values = np.concatenate([batch.values(log, name, key) for name, key in places])
    return values[np.isfinite(values)]
