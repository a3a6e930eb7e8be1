"""The table of all results, and the scores of a comparison as one: metrics down, estimators across.

Cells have a text for people and numbers for machines. Notebook, pages, CSV and LaTeX show the same `Table`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING

from sonar_graph.evaluation.digits import ABSENT

if TYPE_CHECKING:
    from sonar_graph.evaluation.results import Comparison, Score

RUN_COLOURS = 6
"""Colours that a page has for runs; the next run begins anew."""
TRAJECTORY_LABELS = {
    "ate_raw_m": "Position error, not aligned (ATE, RMS)",
    "ate_yaw_m": "Position error, yaw and translation aligned (ATE, RMS)",
    "ate_se2_m": "Horizontal position error, SE(2) aligned (ATE, RMS)",
    "ate_se3_m": "Position error, SE(3) aligned (ATE, RMS)",
    "rpe_1s_m": "Drift over 1 s (RPE, RMS)",
    "rpe_10s_m": "Drift over 10 s (RPE, RMS)",
    "rpe_1s_rad": "Yaw drift over 1 s (RPE, RMS)",
    "rpe_10s_rad": "Yaw drift over 10 s (RPE, RMS)",
    "yaw_rmse_rad": "Yaw error (RMS)",
    "return_error_m": "Return error: last position",
    "nees_position": "Position NEES per degree of freedom",
    "nees_yaw": "Yaw NEES",
}
SCORES = {
    "causal": TRAJECTORY_LABELS | {"own_map_m": "Horizontal position error on its own map as it was then (RMS)"},
    "smoothed": TRAJECTORY_LABELS,
    "landmarks": {
        "raw_m": "Horizontal landmark error, not aligned (RMS)",
        "se2_m": "Horizontal landmark error, SE(2) aligned (RMS)",
        "count": "Landmarks mapped",
        "nees": "Landmark NEES per degree of freedom",
    },
    "detections": {
        "used": "Detections used",
        "refused": "Detections refused",
        "unnamed": "Detections of no landmark that is probable enough",
        "nis": "NIS per degree of freedom",
    },
    "time": {
        "update_median_ms": "Per update, median",
        "update_p99_ms": "Per update, 99th percentile",
        "update_max_ms": "Per update, longest",
        "total_s": "Whole run",
        "real_time_factor": "Real-time factor: log duration over run time",
    },
    "memory": {"peak_mb": "Peak memory added by the run"},
}
"""Label of every score, by the parts of its key before and after the point."""
LABELS = {name: label for block in SCORES.values() for name, label in block.items()}
BLOCKS = {
    "causal": "Causal: what was known at each instant",
    "smoothed": "Smoothed: what is known at the end about each instant",
    "landmarks": "Landmarks",
    "detections": "Detections",
    "time": "Time",
    "memory": "Memory",
}
DIRECTIONS = {"lower": "lower is better", "higher": "higher is better", "inside": "1 is consistent", "none": ""}


@dataclass(frozen=True)
class Column:
    """One column; columns with the same ``over`` that follow each other share a heading above them."""

    key: str
    """Name in the CSV; more numbers of a cell are ``key_SUFFIX``."""
    heading: str
    over: str = ""
    parts: tuple[str, ...] = ("",)
    """Suffixes of the numbers in a cell."""
    is_number: bool = True
    run: int | None = None
    """Index of the run that the column is about: the heading has its colour."""
    warning: str = ""
    """A word beside the heading."""


@dataclass(frozen=True)
class Cell:
    """One value as people see it, with its numbers in the units of the results."""

    text: str
    numbers: tuple[float | str, ...] = ()
    note: str = ""
    link: str = ""
    """Address within the page or beside it."""
    run: int | None = None
    """Index of the run that the cell names: it has its colour."""

    @property
    def sorting(self) -> float | str:
        """The value by which rows are sorted; empty where there is none."""
        value = self.numbers[0] if self.numbers else self.text
        return value if value == value else ""


@dataclass(frozen=True)
class Table:
    """One table of results."""

    name: str
    """Name of its files and on its page: letters, digits and hyphens."""
    title: str
    caption: str
    columns: list[Column]
    rows: list[list[Cell]] = field(default_factory=list)
    sections: dict[int, str] = field(default_factory=dict)
    """Headings between the rows, by the index of the row below."""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the columns, each with the number of columns below it."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.over:
                found[-1] = (column.over, found[-1][1] + 1)
            else:
                found.append((column.over, 1))
        return found


def words(text: str, link: str = "", run: int | None = None) -> Cell:
    """A cell of text."""
    return Cell(text, (text,), link=link, run=run)


def count(value: int, note: str = "", link: str = "") -> Cell:
    """A cell of a whole number."""
    return Cell(str(value), (value,), note=note, link=link)


def number(value: float, text: str, *others: float, note: str = "") -> Cell:
    """A cell of a number and what belongs to it; a dash for NaN."""
    return Cell(ABSENT if math.isnan(value) else text, (value, *others), note=note)


def absent(parts: int = 1) -> Cell:
    """A cell without a number."""
    return Cell(ABSENT, (math.nan,) * parts)


def text_table(name: str, title: str, headings: list[str], rows: list[list[str]], *, numbers: bool = True) -> Table:
    """A table of texts: the first column of words, the others of numbers or of words too."""
    columns = [Column(heading, heading, is_number=numbers and k > 0) for k, heading in enumerate(headings)]
    return Table(name, title, "", columns, [[words(text) for text in row] for row in rows])


def as_html(table: Table, *, is_sortable: bool = False) -> str:
    """The table as a ``<table>`` element, all texts escaped.

    In a sortable one headings are buttons and cells say their ``sorting``, for the script of a page.
    """

    def named(text: str, run: int | None) -> str:
        if run is None:
            return escape(text)
        breakable = re.sub(r"([/=_,])", r"\1<wbr>", escape(text))
        return f'<span class="run run-{run % RUN_COLOURS}">{breakable}</span>'

    sortable, is_numeric = (' class="sortable"' if is_sortable else ""), ' class="number"'
    lines = [f'<table{sortable} id="table-{escape(table.name)}">']
    caption = f"{table.title}. {table.caption}" if table.caption else table.title
    lines.append(f"<caption><span>{escape(caption)}</span></caption>")
    lines.append("<thead>")
    if len(table.groups) > 1:
        over = (
            f'<th scope="colgroup" colspan="{width}">{escape(heading)}</th>'
            if heading
            else f'<td colspan="{width}"></td>'
            for heading, width in table.groups
        )
        lines.append(f'<tr class="over">{"".join(over)}</tr>')
    lines.append("<tr>")
    for column in table.columns:
        heading = named(column.heading, column.run)
        if column.warning:
            heading += f' <span class="warning">{escape(column.warning)}</span>'
        if is_sortable:
            heading = f'<button type="button">{heading}</button>'
        lines.append(f'<th scope="col"{is_numeric if column.is_number else ""}>{heading}</th>')
    lines += ["</tr>", "</thead>", "<tbody>"]
    for index, row in enumerate(table.rows):
        if index in table.sections:
            title = f'<th scope="rowgroup" colspan="{len(row)}"><span>{escape(table.sections[index])}</span></th>'
            lines += ["</tbody>", "<tbody>"] if index else []
            lines.append(f'<tr class="block">{title}</tr>')
        lines.append("<tr>")
        for place, (column, cell) in enumerate(zip(table.columns, row, strict=True)):
            text = named(cell.text, cell.run)
            if cell.link:
                text = f'<a href="{escape(cell.link)}">{text}</a>'
            if cell.note:
                text += f' <span class="note">{escape(cell.note)}</span>'
            tag, attributes = ("td", "") if place else ("th", ' scope="row"')
            if column.is_number:
                attributes += is_numeric
            if is_sortable:
                attributes += f' data-sort="{escape(str(cell.sorting))}"'
            lines.append(f"<{tag}{attributes}>{text}</{tag}>")
        lines.append("</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"])


def score_keys(comparison: Comparison) -> list[str]:
    """All keys of scores in the order of the table: known ones as in `BLOCKS` and `LABELS`, then others by name."""

    def place(names: list[str], name: str) -> int:
        return names.index(name) if name in names else len(names)

    keys = {key for scores in comparison.scores.values() for key in scores}
    blocks, metrics = list(BLOCKS), list(LABELS)
    return sorted(
        keys, key=lambda key: (place(blocks, key.partition(".")[0]), place(metrics, key.partition(".")[2]), key)
    )


def run_columns(comparison: Comparison) -> list[Column]:
    """A column for each run, in its colour, with a word where it failed."""
    return [
        Column(run.estimator, run.estimator, run=index, warning="failed" if run.status == "failed" else "")
        for index, run in enumerate(comparison.runs)
    ]


def score_table(comparison: Comparison) -> Table:
    """Every score of every run; a dash where a run lacks one.

    Beside the numbers stands what a covariance is judged to be, and at the end of the row the interval in which the
    value of a consistent estimator lies, where it is the same for all runs.
    """
    columns = [Column("metric", "Metric", is_number=False), Column("unit", "Unit", is_number=False)]
    columns += [*run_columns(comparison), Column("reading", "Reading", is_number=False)]
    rows: list[list[Cell]] = []
    sections: dict[int, str] = {}
    for key in score_keys(comparison):
        prefix, _, metric = key.partition(".")
        block = BLOCKS.get(prefix, prefix)
        if block not in sections.values():
            sections[len(rows)] = block
        scores = [comparison.scores.get(run.estimator, {}).get(key) for run in comparison.runs]
        known = [score for score in scores if score is not None]
        intervals = {_expected(score) for score in known}
        common = intervals.pop() if len(intervals) == 1 else ""
        cells = []
        for score in scores:
            if score is None:
                cells.append(Cell(ABSENT))
                continue
            own = "" if common else _expected(score)
            cells.append(Cell(score.text(), (score.value,), note="; ".join(filter(None, [score.verdict, own]))))
        direction = DIRECTIONS[known[0].better]
        reading = f"{direction}; {common}" if direction and common else direction + common
        rows.append([words(LABELS.get(metric, key)), words(known[0].shown_unit), *cells, words(reading)])
    return Table("scores", "Scores by metric and estimator", "", columns, rows, sections)


def _expected(score: Score) -> str:
    """The interval of a consistent estimator's value, in words."""
    if score.interval is None:
        return ""
    lowest, highest = map(score.text, score.interval)
    return f"expected {lowest} to {highest}"
