"""Tables as files for others: CSV for machines, LaTeX with booktabs for papers."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from sonar_graph.batch.tables import Cell, Column, Table
from sonar_graph.evaluation.atomic import replacing

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
