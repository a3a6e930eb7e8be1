"""Tables of results: cells with a text for people and numbers for machines, and their HTML.

Scores in notebooks, pages, CSV and LaTeX show the same `Table`.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

from sonar_graph.states import ABSENT as ABSENT

RUN_COLOURS = 6
"""Colours that a page has for runs; the next run begins with the first again."""


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
        """The value by which rows are sorted; empty without one."""
        value = self.numbers[0] if self.numbers else self.text
        # NaN is not equal to itself
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


def text_table(
    name: str,
    title: str,
    headings: Sequence[str | Column],
    rows: list[list[str]],
    *,
    numbers: bool = True,
    sections: dict[int, str] | None = None,
) -> Table:
    """A table of texts: the first column of words, the others of numbers or of words too, unless a column is given."""
    columns = [
        Column(heading, heading, is_number=numbers and k > 0)
        if isinstance(heading, str)
        else heading
        for k, heading in enumerate(headings)
    ]
    cells = [[words(text) for text in row] for row in rows]
    return Table(name, title, "", columns, cells, sections or {})


def as_html(table: Table, *, is_sortable: bool = False) -> str:
    """The table as a ``<table>`` element, all texts escaped.

    In a sortable one headings are buttons and cells have their ``sorting``, for the script of a page.
    """

    def named(text: str, run: int | None) -> str:
        if run is None:
            return escape(text)
        # names of runs are long, and break at these marks only
        breakable = re.sub(r"([/=_,])", r"\1<wbr>", escape(text))
        return f'<span class="run run-{run % RUN_COLOURS}">{breakable}</span>'

    sortable = ' class="sortable"' if is_sortable else ""
    is_numeric = ' class="number"'
    lines = [f'<table{sortable} id="table-{escape(table.name)}">']
    caption = f"{table.title}. {table.caption}" if table.caption else table.title
    lines.append(f"<caption><span>{escape(caption)}</span></caption>")
    lines.append("<thead>")
    # one heading over all columns is the caption
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
        lines.append(
            f'<th scope="col"{is_numeric if column.is_number else ""}>{heading}</th>'
        )
    lines += ["</tr>", "</thead>", "<tbody>"]
    for index, row in enumerate(table.rows):
        if index in table.sections:
            title = f'<th scope="rowgroup" colspan="{len(row)}"><span>{escape(table.sections[index])}</span></th>'
            # each section is a body of its own, which sorts within itself
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
