"""Rendering: HTML pages from templates, and tables as CSV.

Everything that comes from a suite, a log or an estimator is escaped.
"""

import base64
import csv
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from sonar_graph.evaluation import format_value
from sonar_graph.files import replacing, spelt
from sonar_graph.states import counted
from sonar_graph.table import Table, as_html

FOLDER = "tables"


def render(template: str, content: dict[str, Any]) -> str:
    """The page as text: a template in ``templates/``, filled with content by the names that it uses."""
    environment = Environment(
        loader=PackageLoader("sonar_graph.report", "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"counted": counted, "format_value": format_value}
    environment.filters |= {"svg": Markup, "address": data_address, "json": _as_json}
    environment.filters["html"] = lambda table, is_sortable: Markup(
        as_html(table, is_sortable=is_sortable)
    )
    return spelt(environment.get_template(template).render(**content))


@dataclass(frozen=True)
class PageSection:
    """A section of a page; the template of the page's kind has a macro of its name."""

    anchor: str
    title: str
    is_folded: bool = False


def write_html(
    path: Path, kind: str, sections: list[PageSection], content: dict[str, Any]
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


def html_of(kind: str, sections: list[PageSection], content: dict[str, Any]) -> str:
    """The text of a page, as of `write_html`."""
    return render("page.html", content | {"kind": kind, "sections": sections})


def data_address(content: bytes, kind: str) -> str:
    """Content as an address within the page itself: ``data:KIND;base64,...``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _as_json(values: Any) -> str:
    return json.dumps(values, indent=2, default=str, ensure_ascii=False)


def write_tables(tables: list[Table], folder: Path) -> None:
    """Write each table as ``tables/NAME.csv`` in a folder; earlier ones are replaced."""
    for table in tables:
        with replacing(folder / FOLDER / f"{table.name}.csv") as partial:
            partial.write_text(as_csv(table), "utf-8")


def as_csv(table: Table) -> str:
    """Numbers in full and in the units of the results; empty cells without a number. Sections are a first column."""
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
            for value in cell.numbers:
                text = str(value)
                if isinstance(value, float):
                    # numpy's own text of a number has its type
                    text = "" if math.isnan(value) else repr(float(value))
                texts.append(text)
            texts += [""] * (len(column.parts) - len(cell.numbers))
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
