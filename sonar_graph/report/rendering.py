"""Rendering: HTML pages from templates, and tables as CSV (for machines) and LaTeX (booktabs, for papers).

Everything that comes from a suite, a log or an estimator is escaped.
"""

import base64
import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from sonar_graph.files import replacing, spelt
from sonar_graph.table import Table, as_html

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


def render(template: str, content: dict[str, Any]) -> str:
    """The page as text: a template in ``templates/``, filled with content by the names that it uses."""
    environment = Environment(
        loader=PackageLoader("sonar_graph.report", "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "svg": Markup,
        "csv": as_csv,
        "latex": as_latex,
        "address": data_address,
    }
    environment.filters["html"] = lambda table, is_sortable: Markup(
        as_html(table, is_sortable=is_sortable)
    )
    return spelt(environment.get_template(template).render(**content))


@dataclass(frozen=True)
class Section:
    """A section of a page; the template of the page's kind has a macro of its name."""

    anchor: str
    title: str
    is_folded: bool = False


def write_html(
    path: Path, kind: str, sections: list[Section], content: dict[str, Any]
) -> Path:
    """Write a page from its sections, whole or not at all, and return its path.

    The page needs nothing but itself: figures are inline SVG in the page's colours, and style is inline.

    Parameters
    ----------
    path
        Path of the page, which is replaced.
    kind
        ``comparison``, ``batch`` or ``recognition``: the template with the macros of the sections.
    sections
        Sections in their order; links to them stand above.
    content
        Values by the names that the macros use; ``name`` and ``names`` make the title.
    """
    with replacing(path) as partial:
        partial.write_text(html_of(kind, sections, content), "utf-8")
    return path


def html_of(kind: str, sections: list[Section], content: dict[str, Any]) -> str:
    """The text of a page, as of `write_html`."""
    return render("page.html", content | {"kind": kind, "sections": sections})


def data_address(text: str | bytes, kind: str) -> str:
    """Content as an address within the page itself: ``data:KIND;base64,...``."""
    content = text if isinstance(text, bytes) else text.encode()
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def write_tables(tables: list[Table], folder: Path) -> list[Path]:
    """Write each table as ``tables/NAME.csv`` and ``tables/NAME.tex`` in a folder; earlier ones are replaced."""
    written = []
    for table in tables:
        for suffix, text in (("csv", as_csv(table)), ("tex", as_latex(table))):
            path = folder / FOLDER / f"{table.name}.{suffix}"
            with replacing(path) as partial:
                partial.write_text(text, "utf-8")
            written.append(path)
    return written


def as_csv(table: Table) -> str:
    """Numbers in full and in the units of the results; empty where there is none. Sections are a first column."""
    head = [
        f"{column.key}_{part}" if part else column.key
        for column in table.columns
        for part in column.parts
    ]
    rows = [["section", *head] if table.sections else head]
    section = ""
    # a section is a heading between rows on a page, and a column in a file
    for place, row in enumerate(table.rows):
        section = table.sections.get(place, section)
        texts = [section] if table.sections else []
        for column, cell in zip(table.columns, row, strict=True):
            for value in [
                *cell.numbers,
                *[math.nan] * (len(column.parts) - len(cell.numbers)),
            ]:
                if isinstance(value, float):
                    texts.append("" if math.isnan(value) else repr(float(value)))
                else:
                    texts.append(str(value))
        rows.append(texts)
    return csv_text(rows)


def csv_text(rows: list[list[str]]) -> str:
    """Rows of texts as CSV (RFC 4180, with line feeds alone), without formulas for spreadsheets."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(
        [map(_plain_cell, row) for row in rows]
    )
    return buffer.getvalue()


def _plain_cell(text: str) -> str:
    """A cell that no spreadsheet calculates: what could be a formula gets an apostrophe; numbers stay."""
    if not text.startswith(("=", "+", "-", "@", "\t", "\r")):
        return text
    try:
        # a negative number also begins with a minus
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def as_latex(table: Table) -> str:
    """A ``table`` with the digits that people are shown; it needs the packages booktabs and textcomp."""
    above: list[str] = []
    if any(heading for heading, _ in table.groups):
        cells = []
        rules = []
        first = 1
        for heading, width in table.groups:
            cells.append(rf"\multicolumn{{{width}}}{{c}}{{{latex_text(heading)}}}")
            if heading:
                rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}")
            first += width
        above = [" & ".join(cells) + r" \\", "".join(rules)]
    rows = []
    for place, row in enumerate(table.rows):
        if place in table.sections:
            rows.append(
                rf"\multicolumn{{{len(row)}}}{{l}}{{\textit{{{latex_text(table.sections[place])}}}}} \\"
            )
        texts = [
            f"{cell.text} ({cell.note})" if cell.note else cell.text for cell in row
        ]
        rows.append(" & ".join(map(latex_text, texts)) + r" \\")
    lines = [
        r"% \usepackage{booktabs,textcomp}",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{latex_text(table.title)}. {latex_text(table.caption)}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\begin{{tabular}}{{{''.join('r' if column.is_number else 'l' for column in table.columns)}}}",
        r"\toprule",
        *above,
        " & ".join(latex_text(column.heading) for column in table.columns) + r" \\",
        r"\midrule",
        *rows,
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def latex_text(text: str) -> str:
    """Text with everything escaped that LaTeX would take for a command."""
    return "".join(LATEX_SPECIAL.get(character, character) for character in text)
