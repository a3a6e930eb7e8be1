"""The scores of a comparison as rows: metrics down, estimators across, in a fixed order with nothing left out.

Tables as data: columns with their headings, cells with the text for people and the numbers for machines.

Tables as files for others: CSV for machines, LaTeX with booktabs for papers.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path

from sonar_graph.evaluation import ABSENT, LABELS, Comparison, Score
from sonar_graph.files import replacing
from sonar_graph.report.wording import consistency, display_unit, display_value

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
class ScoreCell:
    """One value as shown, with what is to be said about it."""

    text: str
    note: str = ""


@dataclass(frozen=True)
class ScoreRow:
    """One metric for every run, in the order of the runs."""

    key: str
    label: str
    unit: str
    direction: str
    expected: str
    """Interval in which a consistent estimator's value lies; empty where there is none, or it differs by run."""
    protocols: dict[str, str]
    """How the number was got, with the runs for which it was got so: one entry where all agree."""
    cells: list[ScoreCell]


def score_blocks(comparison: Comparison) -> dict[str, list[ScoreRow]]:
    """Every score of the comparison in rows, by title of their block; blocks without a score are left out."""
    keys = {key for scores in comparison.scores.values() for key in scores}
    blocks: dict[str, list[ScoreRow]] = {}
    for key in sorted(keys, key=_position):
        prefix = key.partition(".")[0]
        blocks.setdefault(BLOCKS.get(prefix, prefix), []).append(_row(comparison, key))
    return blocks


def _position(key: str) -> tuple[int, int, str]:
    prefix, _, metric = key.partition(".")
    return _index(list(BLOCKS), prefix), _index(list(LABELS), metric), key


def _index(names: list[str], name: str) -> int:
    return names.index(name) if name in names else len(names)


def _row(comparison: Comparison, key: str) -> ScoreRow:
    scores = {run.estimator: comparison.scores.get(run.estimator, {}).get(key) for run in comparison.runs}
    known = {name: score for name, score in scores.items() if score is not None}
    example = next(iter(known.values()))
    intervals = {_expected(score) for score in known.values()}
    expected = intervals.pop() if len(intervals) == 1 else ""
    return ScoreRow(
        key=key,
        label=LABELS.get(key.partition(".")[2], key),
        unit=display_unit(example),
        direction=DIRECTIONS[example.better],
        expected=expected,
        protocols=_protocols(known),
        cells=[_cell(score, own_interval=not expected) for score in scores.values()],
    )


def _expected(score: Score) -> str:
    if score.interval is None:
        return ""
    lowest, highest = (display_value(score, bound) for bound in score.interval)
    return f"expected {lowest} to {highest}"


def _cell(score: Score | None, own_interval: bool) -> ScoreCell:
    if score is None:
        return ScoreCell(ABSENT)
    interval = _expected(score) if own_interval else ""
    return ScoreCell(display_value(score), "; ".join(filter(None, [consistency(score), interval])))


def _protocols(known: dict[str, Score]) -> dict[str, str]:
    runs: dict[str, list[str]] = {}
    for name, score in known.items():
        runs.setdefault(score.protocol, []).append(name)
    return {protocol: "" if len(runs) == 1 else ", ".join(names) for protocol, names in runs.items()}


@dataclass(frozen=True)
class Column:
    """One column; columns with the same ``over`` that follow each other share a heading above them."""

    key: str
    """Of the CSV; more numbers of a cell are ``key_SUFFIX``."""
    heading: str
    over: str = ""
    parts: tuple[str, ...] = ("",)
    """Suffixes of the numbers in a cell."""
    is_number: bool = True
    contestant: str = ""
    """Whom the column is about: its heading has their colour."""


@dataclass(frozen=True)
class Cell:
    """One value as people see it, with its numbers in the units of the results."""

    text: str
    numbers: tuple[float | str, ...] = ()
    note: str = ""
    link: str = ""
    """Address within the page or beside it."""

    @property
    def sorting(self) -> float | str:
        """What the column is sorted by."""
        return self.numbers[0] if self.numbers else self.text


@dataclass(frozen=True)
class Table:
    """One table of the report."""

    name: str
    """Of its files: letters, digits and hyphens."""
    title: str
    caption: str
    columns: list[Column]
    rows: list[list[Cell]] = field(default_factory=list)

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the columns, each with the number of columns it is over."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.over:
                found[-1] = (column.over, found[-1][1] + 1)
            else:
                found.append((column.over, 1))
        return found


def words(text: str, link: str = "") -> Cell:
    """A cell of text."""
    return Cell(text, (text,), link=link)


def number(value: float, text: str, *others: float, note: str = "", link: str = "") -> Cell:
    """A cell of a number and what belongs to it; a dash where there is none."""
    return Cell(ABSENT if math.isnan(value) else text, (value, *others), note=note, link=link)


def absent(parts: int = 1) -> Cell:
    """Nothing was to be expected here."""
    return Cell(ABSENT, (math.nan,) * parts)


FOLDER = "tables"
LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "°": r"\textdegree{}",
    "<": r"$<$",
    ">": r"$>$",
    "\N{MINUS SIGN}": "$-$",
    "\N{EN DASH}": "--",
    "\N{NO-BREAK SPACE}": "~",
    "²": r"$^2$",
    "\N{DOWNWARDS ARROW}": r"$\downarrow$",
    "\N{UPWARDS ARROW}": r"$\uparrow$",
    "\N{NOT EQUAL TO}": r"$\neq$",
    "χ": r"$\chi$",
}


def write_tables(tables: list[Table], folder: Path) -> list[Path]:
    """Write each table as ``tables/NAME.csv`` and ``tables/NAME.tex`` in a folder; earlier ones are replaced."""
    written = []
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    for table in tables:
        for suffix, text in (("csv", as_csv(table)), ("tex", as_latex(table))):
            path = folder / FOLDER / f"{table.name}.{suffix}"
            with replacing(path) as partial:
                partial.write_text(text, "utf-8")
            written.append(path)
    return written


def as_csv(table: Table) -> str:
    """Numbers in full and in the units of the results; empty where there is none."""
    headings = [_joined(column.key, part) for column in table.columns for part in column.parts]
    rows = [
        [_plain(value) for pair in zip(table.columns, row, strict=True) for value in _values(*pair)]
        for row in table.rows
    ]
    return csv_text([headings, *rows])


def csv_text(rows: list[list[str]]) -> str:
    """Rows of texts as CSV (RFC 4180, with line feeds alone)."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


def as_latex(table: Table) -> str:
    """A ``table`` with the digits that people are shown; it needs the packages booktabs and textcomp."""
    columns = "".join("r" if column.is_number else "l" for column in table.columns)
    lines = [
        r"% \usepackage{booktabs,textcomp}",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{latex_text(table.title)}. {latex_text(table.caption)}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *_group_lines(table),
        " & ".join(latex_text(column.heading) for column in table.columns) + r" \\",
        r"\midrule",
        *(" & ".join(_latex_cell(cell) for cell in row) + r" \\" for row in table.rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX would take for a command."""
    return "".join(LATEX_SPECIAL.get(character, character) for character in text)


def _group_lines(table: Table) -> list[str]:
    if all(not heading for heading, _ in table.groups):
        return []
    cells, rules, first = [], [], 1
    for heading, width in table.groups:
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{latex_text(heading)}}}")
        if heading:
            rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}")
        first += width
    return [" & ".join(cells) + r" \\", "".join(rules)]


def _latex_cell(cell: Cell) -> str:
    return latex_text(f"{cell.text} ({cell.note})" if cell.note else cell.text)


def _joined(key: str, part: str) -> str:
    return f"{key}_{part}" if part else key


def _values(column: Column, cell: Cell) -> list[float | str]:
    return [*cell.numbers, *[math.nan] * (len(column.parts) - len(cell.numbers))]


def _plain(value: float | str) -> str:
    if isinstance(value, str):
        return value
    if math.isnan(value):
        return ""
    return str(value) if isinstance(value, int) else repr(float(value))
