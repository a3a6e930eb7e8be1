"""Tables as data: columns with their headings, cells with the text for people and the numbers for machines."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sonar_graph.evaluation.wording import ABSENT


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
