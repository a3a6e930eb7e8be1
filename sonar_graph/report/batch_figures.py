"""Figures of a batch: each a pure function to an illustration with its data, None where there is nothing to draw.

Each log has a panel with its own scale and a line for each contestant, which keeps its colour and place everywhere.
"""

import math
import re

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from sonar_graph.batch import KINDS, Metric, RecordedBatch, failure_rate, quantile
from sonar_graph.measurements import Floats
from sonar_graph.report import figure_style as style
from sonar_graph.report.batch_tables import (
    SAME_EVIDENCE,
    Tests,
    anees_of,
    is_evidence,
    unit_of,
)
from sonar_graph.report.rendering import csv_text

ROW_IN = 0.36
PANEL_IN = 0.95
# largest number of logs below each other; more make small multiples
STACKED = 2
MOST_COLUMNS = 3
# width of names beside and headings above small panels
NAME_LETTERS, HEADING_LETTERS = 18, 20
KIND_SHIFT = {"": 0.0, "Causal": -0.17, "Smoothed": 0.17}
FILLED = {"": True, "Causal": True, "Smoothed": False}
SMALL = 9.0
# consistency is drawn from a quarter to four times its expected value, or farther: small deviations look small
LEAST_SPAN = 4.0
Rows = list[list[str]]


def log_panels(
    batch: RecordedBatch, logs: list[str], x_label: str
) -> tuple[Figure, list[Axes]]:
    """A panel a log with a scale of its own; in each a line for each contestant, the first on top."""
    names = batch.contestants
    # two logs below each other use the width, of many small panels show more at once
    columns = 1 if len(logs) <= STACKED else min(MOST_COLUMNS, len(logs) - 1)
    rows = -(-len(logs) // columns)
    height_in = rows * (PANEL_IN + ROW_IN * len(names))
    figure, axes = style.blank_panels(rows, columns, (style.width_in(), height_in))
    # names of any width stand beside the panels
    figure.set_layout_engine("constrained")
    panels: list[Axes] = list(axes.flat)
    for panel in panels[len(logs) :]:
        panel.remove()
    for index, log in enumerate(logs):
        panel = panels[index]
        narrow = columns > 1
        shown = names if index % columns == 0 else [""] * len(names)
        labels = [folded(name, NAME_LETTERS) if narrow else name for name in shown]
        panel.set(
            ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)), yticklabels=labels
        )
        # lines of contestants are no scale
        panel.grid(False, axis="y")
        for place, label in enumerate(panel.get_yticklabels()):
            label.set_color(style.colour(place))
            # folded names stand closer than lines of contestants
            label.set_linespacing(0.95)
        style.head_panel(panel, folded(log, HEADING_LETTERS) if narrow else log)
    figure.supxlabel(x_label, color=style.INK, fontsize="medium")
    return figure, panels[: len(logs)]


def folded(name: str, letters: int) -> str:
    r"""A name in lines of at most so many letters, where it has a slash, an equals sign or a comma to break after.

    Examples
    --------
    >>> folded("isam2/identity.policy=gate", 18)
    'isam2/\nidentity.policy=\ngate'
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
    style.logarithmic(panel, "x")
    panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))


def spread_drawing(batch: RecordedBatch, metric: Metric) -> style.Illustration | None:
    """Every run's value as a dot, with the median and the middle 80 %."""
    logs = [
        log
        for log in batch.logs
        if any(_finite(batch, log, name, metric).size for name in batch.contestants)
    ]
    if not logs:
        return None
    figure, panels = log_panels(batch, logs, f"{metric.label}{unit_of(metric)}")
    for panel, log in zip(panels, logs, strict=True):
        values = np.concatenate(
            [_finite(batch, log, name, metric) for name in batch.contestants]
        )
        # a logarithmic scale for errors that differ by a power of ten, where a linear one would hide the
        # small ones
        if values.min() > 0 and values.max() > SMALL * values.min():
            spread_out(panel)
        for place, contestant in enumerate(batch.contestants):
            for over, key in metric.keys.items():
                _draw_spread(
                    panel,
                    batch.values(log, contestant, key) * metric.factor,
                    place,
                    over,
                )
    caption = (
        f"{metric.protocol} A dot is a run, the stroke their median, the bar the middle 80 %. {_kinds_told(metric)}"
        "Runs without a value have no dot; their number stands at the right."
    )
    rows = [["log", "contestant", "seed", "key", "column", "value"]]
    for run in batch.runs:
        seed = "" if run.seed is None else str(run.seed)
        rows += [
            [run.log, run.contestant, seed, run.key, key, _text(run.value(key))]
            for key in metric.keys.values()
        ]
    return _drawn(figure, f"spread-{metric.name}", metric.label, caption, rows)


def difference_drawing(
    batch: RecordedBatch, metric: Metric, tests: Tests
) -> style.Illustration | None:
    """Mean differences to the reference with their intervals."""
    found = {
        place: test
        for place, (test, _) in tests.items()
        if place[0] in metric.keys.values()
    }
    logs = [
        log
        for log in batch.logs
        if any(place[1] == log and math.isfinite(t.mean) for place, t in found.items())
    ]
    if not logs:
        return None
    figure, panels = log_panels(
        batch, logs, f"difference to {batch.reference}{unit_of(metric)}"
    )
    for panel, log in zip(panels, logs, strict=True):
        # left of it the contestant is better
        panel.axvline(0, color=style.TRUTH, linewidth=1.6)
        for place, contestant in enumerate(batch.contestants):
            for over, key in metric.keys.items():
                test = found.get((key, log, contestant))
                if test is not None and math.isfinite(test.mean):
                    ends = np.array([test.mean, *test.interval]) * metric.factor
                    _draw_interval(panel, ends, place, over)
    caption = (
        f"{metric.label}: mean of the differences on the same log and seed, with 95 % intervals (of few pairs none); "
        f"left of the line the error is smaller than that of {batch.reference}. {_kinds_told(metric)}A "
        "group in which a run has no value has no mean difference and is not drawn."
    )
    rows = [
        [
            "log",
            "contestant",
            "column",
            "pairs",
            "pairs_of",
            "mean_difference",
            "low",
            "high",
        ]
    ]
    rows += [
        [
            log,
            name,
            key,
            str(test.pairs),
            test.each,
            *map(_text, (test.mean, *test.interval)),
        ]
        for (key, log, name), test in found.items()
    ]
    return _drawn(
        figure,
        f"difference-{metric.name}",
        f"{metric.label}: against {batch.reference}",
        caption,
        rows,
    )


def consistency_drawing(batch: RecordedBatch, what: str) -> style.Illustration | None:
    """ANEES over independent runs against its chi-square band."""
    rows: Rows = [["log", "contestant", "estimate", "runs", "anees", "low", "high"]]
    known: dict[tuple[str, str], list[tuple[str, float]]] = {}
    bands: dict[str, set[tuple[float, float]]] = {}
    for log in batch.logs:
        for contestant in batch.contestants:
            both = {
                kind: anees_of(batch, log, contestant, kind, what) for kind in KINDS
            }
            for kind, told in both.items():
                if told is None:
                    continue
                rows.append(
                    [
                        log,
                        contestant,
                        kind,
                        str(told.runs),
                        _text(told.mean),
                        *map(_text, told.band),
                    ]
                )
                if math.isfinite(told.mean) and is_evidence(both, kind):
                    known.setdefault((log, contestant), []).append(
                        (kind.capitalize(), told.mean)
                    )
                    bands.setdefault(log, set()).add(told.band)
    if not known:
        return None
    logs = [log for log in batch.logs if log in bands]
    figure, panels = log_panels(batch, logs, f"ANEES of {what} at the last instant")
    for panel, log in zip(panels, logs, strict=True):
        spread_out(panel)
        for low, high in bands[log]:
            if math.isfinite(low):
                panel.axvspan(low, high, color=style.TRUTH, alpha=0.25, linewidth=0)
        # what a consistent estimator has on average
        panel.axvline(1, color=style.TRUTH, linewidth=1.6)
        for place, contestant in enumerate(batch.contestants):
            for over, mean in known.get((log, contestant), []):
                _draw_point(panel, mean, place, over)
        # a scale that is too narrow would make small deviations look large
        low, high = panel.get_xlim()
        panel.set_xlim(min(low, 1 / LEAST_SPAN), max(high, LEAST_SPAN))
    caption = (
        f"Normalised squared error of {what} at the last instant, average over runs per degree of freedom. The grey "
        "band holds 95 % of the averages of consistent estimators; right of it covariances are too small, left "
        f"too large. Full: causal. Hollow: smoothed. {SAME_EVIDENCE} A group with a run that did not end has no "
        "average and is not drawn."
    )
    return _drawn(figure, f"anees-{what}", f"Consistency of {what}", caption, rows)


def failure_drawing(batch: RecordedBatch) -> style.Illustration | None:
    """Failure rates with their intervals; None where every run ended."""
    if all(run.ended for run in batch.runs):
        return None
    figure, panels = log_panels(batch, batch.logs, "runs that did not end (%)")
    rows: Rows = [
        ["log", "contestant", "runs", "failed", "failure_rate", "low", "high"]
    ]
    for panel, log in zip(panels, batch.logs, strict=True):
        # with room for the dots at 0 and 100 %
        panel.set_xlim(-3, 103)
        for place, contestant in enumerate(batch.contestants):
            group = batch.group(log, contestant)
            if group:
                failed = sum(not run.ended for run in group)
                rate = failure_rate(failed, len(group))
                _draw_interval(
                    panel, 100 * np.array([rate.share, rate.low, rate.high]), place, ""
                )
                numbers = [
                    str(len(group)),
                    str(failed),
                    *map(_text, (rate.share, rate.low, rate.high)),
                ]
                rows.append([log, contestant, *numbers])
    caption = "Share of runs that failed, took too long, needed too much memory or were killed, with 95 % intervals."
    return _drawn(figure, "failures", "Runs that did not end", caption, rows)


def cost_drawing(batch: RecordedBatch) -> style.Illustration | None:
    """Median and 99th percentile of the time of an update, over all runs of a group."""
    keys = ("update_p50_ms", "update_p99_ms")
    if not any(keys[0] in run.values for run in batch.runs):
        return None
    figure, panels = log_panels(batch, batch.logs, "time of an update (ms)")
    rows: Rows = [["log", "contestant", *keys]]
    for panel, log in zip(panels, batch.logs, strict=True):
        spread_out(panel)
        for place, contestant in enumerate(batch.contestants):
            ends = [quantile(batch.values(log, contestant, key), 0.5) for key in keys]
            rows.append([log, contestant, *map(_text, ends)])
            if all(map(math.isfinite, ends)):
                panel.plot(
                    ends, [place, place], color=style.colour(place), linewidth=2.4
                )
                panel.plot(ends[0], place, "o", color=style.colour(place), markersize=6)
                panel.plot(
                    ends[1],
                    place,
                    "|",
                    color=style.colour(place),
                    markersize=11,
                    markeredgewidth=2.4,
                )
    caption = "Dot: median over runs of the median time of an update. Stroke: median over runs of the 99th percentile."
    return _drawn(figure, "costs", "Time of an update", caption, rows)


def _draw_spread(panel: Axes, values: Floats, place: int, over: str) -> None:
    known = values[np.isfinite(values)]
    row = place + KIND_SHIFT[over]
    own = style.colour(place)
    if not known.size:
        return
    # an infinite end would draw a bar to the edge, which looks like a value
    inside = [quantile(values, share) for share in (0.1, 0.9)]
    if all(map(math.isfinite, inside)) and len(values) > 1:
        panel.plot(
            inside, [row, row], color=own, alpha=0.3, linewidth=7, solid_capstyle="butt"
        )
    # dots of equal values stand beside each other
    shifts = row + 0.05 * np.cos(2.4 * np.arange(len(known)))
    panel.plot(
        known,
        shifts,
        "o",
        color=own,
        markersize=3.6,
        markerfacecolor=own if FILLED[over] else "none",
    )
    middle = quantile(values, 0.5)
    if math.isfinite(middle):
        panel.plot(
            middle, row, "|", color=style.INK, markersize=12, markeredgewidth=1.6
        )
    # a dot that is missing must not look like a run that is missing
    if len(known) < len(values):
        across = panel.get_yaxis_transform()
        note = f"{len(values) - len(known)} without"
        panel.text(
            1.01,
            row,
            note,
            transform=across,
            ha="left",
            va="center",
            color=style.MUTED,
            fontsize="small",
        )


def _draw_interval(panel: Axes, ends: Floats, place: int, over: str) -> None:
    """A point with the interval about it, shape (3,): point, low, high."""
    row = place + KIND_SHIFT[over]
    if np.isfinite(ends[1:]).all():
        panel.plot(ends[1:], [row, row], color=style.colour(place), linewidth=1.8)
    _draw_point(panel, float(ends[0]), place, over)


def _draw_point(panel: Axes, value: float, place: int, over: str) -> None:
    own = style.colour(place)
    face = own if FILLED[over] else "none"
    panel.plot(
        value,
        place + KIND_SHIFT[over],
        "o",
        color=own,
        markerfacecolor=face,
        markersize=6.5,
        markeredgewidth=1.6,
    )


def _finite(batch: RecordedBatch, log: str, contestant: str, metric: Metric) -> Floats:
    values = np.concatenate(
        [batch.values(log, contestant, key) for key in metric.keys.values()]
    )
    return np.asarray(values[np.isfinite(values)])


def _kinds_told(metric: Metric) -> str:
    return (
        ""
        if "" in metric.keys
        else "Full dots, above: causal; hollow, below: smoothed. "
    )


def _text(value: float) -> str:
    return repr(float(value)) if math.isfinite(value) else ""


def _drawn(
    figure: Figure, name: str, title: str, caption: str, rows: Rows
) -> style.Illustration:
    plain_name = name.replace("_", "-").replace(".", "-")
    svg = style.inline_svg(figure, plain_name, f"{title}. {caption}")
    return style.Illustration(
        plain_name, title, caption, svg, data=csv_text(rows), figure=figure
    )
