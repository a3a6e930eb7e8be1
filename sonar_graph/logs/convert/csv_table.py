"""Delimited text files as tables: delimiter, names of columns, numbers and times, with errors that name the line.

A column is named as the header names it, or by its number, counted from 1. The header is what stands before the first
line with a number: its own lines, or else the last comment, where that names as many columns as the lines have.
"""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.errors import LogError
from sonar_graph.files import regular
from sonar_graph.logs.adapters import FieldTable
from sonar_graph.logs.foreign_files import START_BYTES, foreign_kind
from sonar_graph.measurements import NS_PER_S, Floats, Ints

_DELIMITERS = {"tab": "\t", "space": " "}
_EMPTY = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})
"""Cells without a value, in small letters."""
_MOST_NAMED = 40
SAMPLE_ROWS = 2000
"""Rows from which the kind of a column is guessed."""


class CsvForm(Section):
    """Form of a text file that holds a table; what is not said is found from its first lines."""

    file: str | None = None
    """Name of the file among those that are given; may be left out where there is one."""
    delimiter: str | None = Field(None, min_length=1, max_length=5)
    """"," or ";" or "tab" or "space" (any white space)."""
    comment: tuple[str, ...] | str = ("#", "%")
    """Beginning of the lines that are no rows."""
    columns: tuple[str, ...] | None = None
    """Names of the columns, instead of those of the header."""
    decimal: str = Field(".", min_length=1, max_length=1)
    """"," where numbers are written like 1,5."""
    encoding: str = "utf-8"


@dataclass(frozen=True)
class CsvLayout:
    """Delimiter and columns of a text file, from its first lines."""

    delimiter: str
    names: tuple[str, ...]
    """Names of all columns; numbers from 1 where nothing names them."""
    first_line: int
    """Number of the first line with values."""
    first: tuple[str, ...]
    """Cells of that line."""
    remark: str = ""
    """Names that do not fit, and so do not count."""

    @property
    def is_named(self) -> bool:
        """True where a header names the columns."""
        return self.names[:1] != ("1",)


class CsvFile:
    """A text file that holds a table.

    Raises LogError where it cannot be read, or has no line with numbers.
    """

    def __init__(self, path: Path, form: CsvForm | None = None) -> None:
        self.path, self.form = path, form or CsvForm()
        self.layout = self._find_layout()

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Number and text of each line with content, without its end."""
        if self.path.is_dir():
            raise LogError(
                f"{self.path}: is a folder; expected a text file with a table"
            )
        try:
            with regular(self.path).open(
                encoding=self.form.encoding, errors="replace", newline=None
            ) as stream:
                for number, line in enumerate(stream, 1):
                    if "\0" in line or (number == 1 and "\ufffd" in line[:START_BYTES]):
                        raise LogError(
                            f"{self.path}, line {number}: {self._kind() or 'is no text'}; expected a table"
                        )
                    if line.strip():
                        yield number, line.rstrip("\r\n").lstrip("\ufeff")
        except (OSError, LookupError) as error:
            reason = getattr(error, "strerror", None) or error
            raise LogError(
                f"{self.path}: cannot be read: {reason}; expected a text file with a table"
            ) from error

    def _kind(self) -> str | None:
        """Kind of a file that holds no text, where its first bytes are known."""
        with self.path.open("rb") as stream:
            kind = foreign_kind(self.path, stream.read(START_BYTES))
        return f"is no text but {kind}" if kind else None

    def _find_layout(self) -> CsvLayout:
        heads: list[str] = []
        comments: list[str] = []
        for number, line in self._lines():
            if line.lstrip().startswith(self.form.comment):
                comments.append(
                    line.lstrip().lstrip("".join(self.form.comment)).strip()
                )
                continue
            delimiter = _DELIMITERS.get(
                self.form.delimiter or "", self.form.delimiter
            ) or _delimiter_of(line, self.form.decimal)
            cells = split(
                line,
                delimiter,
                len(split(heads[-1], delimiter))
                if heads
                else len(self.form.columns or ()),
            )
            if any(is_value(cell, self.form.decimal) for cell in cells):
                return self._named(delimiter, number, cells, heads, comments)
            heads.append(line)
        if heads and any(
            is_value(cell, ",")
            for cell in split(heads[-1], _delimiter_of(heads[-1], ","))
        ):
            raise LogError(
                f'{self.path}: has no line with numbers like 1.5; numbers like 1,5 need decimal = ","'
            )
        if heads:
            raise LogError(
                f"{self.path}: has no line with numbers after the header {heads[0]!r:.80}: it is empty"
            )
        raise LogError(
            f"{self.path}: has no line with numbers; expected a table, one row a line"
        )

    def _named(
        self,
        delimiter: str,
        number: int,
        cells: list[str],
        heads: list[str],
        comments: list[str],
    ) -> CsvLayout:
        """Layout with the names that fit the number of cells."""
        numbers, count = tuple(str(k + 1) for k in range(len(cells))), len(cells)
        if self.form.columns is not None:
            if len(self.form.columns) != count:
                raise LogError(
                    f"{self.path}, line {number}: has {count} cells, and `columns` names {len(self.form.columns)}"
                )
            return CsvLayout(delimiter, self.form.columns, number, tuple(cells))
        if heads:
            found = [split(head, delimiter) for head in heads]
            names = [
                " ".join(filter(None, parts)) for parts in zip(*found, strict=False)
            ]
            if len(names) != count:
                raise LogError(
                    f"{self.path}, line {number}: has {count} cells, and the header names {len(names)} columns; "
                    f"put the header right, or leave it out and name the columns by number"
                )
            return CsvLayout(delimiter, _told_apart(names), number, tuple(cells))
        for comment in reversed(
            [
                comment
                for comment in comments
                if len(split(comment, _delimiter_of(comment))) > 1
            ]
        ):
            names = split(comment, _delimiter_of(comment))
            # "[idSensor]": may be absent
            without = [name for name in names if not name.startswith("[")]
            if fitting := next(
                (some for some in (names, without) if len(some) == count), None
            ):
                return CsvLayout(delimiter, _told_apart(fitting), number, tuple(cells))
            said = f"its comment names {len(names)} columns, the lines have {count}: {comment}"
            return CsvLayout(delimiter, numbers, number, tuple(cells), said)
        return CsvLayout(delimiter, numbers, number, tuple(cells))

    def index(self, name: str, key: str) -> int:
        """Place of a column by its name or its number from 1; a LogError that names the ``key`` and those there are."""
        names = self.layout.names
        if name in names:
            return names.index(name)
        without_units = [plain_name(known) for known in names]
        if without_units.count(name) == 1:
            return without_units.index(name)
        if name.isdecimal() and 1 <= int(name) <= len(names):
            return int(name) - 1
        if name.isdecimal():
            raise LogError(
                f"{self.path}: has no column {name} ({key}); it has {len(names)}, numbered from 1"
            )
        close = get_close_matches(name, names, 1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        more = (
            f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
        )
        raise LogError(
            f"{self.path}: has no column {name!r} ({key}); {hint}it has {', '.join(names[:_MOST_NAMED])}{more}"
            + (
                ""
                if self.layout.is_named
                else ": without a header they are numbered from 1"
            )
        )

    def numbers(self, name: str, most: int | None = SAMPLE_ROWS) -> Floats:
        """Numbers of a column in its first rows, shape (n,); NaN for cells that hold none."""
        _, (cells,) = self.columns([self.layout.names.index(name)], most)
        plain = [
            _TRUTHS.get(cell.lower(), cell.replace(self.form.decimal, "."))
            for cell in cells
        ]
        return np.array([float(cell) if _is_number(cell) else np.nan for cell in plain])

    def columns(
        self, indices: list[int], most: int | None = None
    ) -> tuple[Ints, list[list[str]]]:
        """Line numbers, shape (n,), and the cells of some columns, of at most ``most`` rows.

        A LogError names the first line with another number of cells.
        """
        layout, count = self.layout, len(self.layout.names)
        lines: list[int] = []
        found: list[list[str]] = [[] for _ in indices]
        for number, line in self._lines():
            if number < layout.first_line or line.lstrip().startswith(
                self.form.comment
            ):
                continue
            cells = split(line, layout.delimiter, count)
            if len(cells) != count:
                raise LogError(
                    f"{self.path}, line {number}: has {len(cells)} cells; expected {count}, as the first row"
                )
            if most is not None and len(lines) == most:
                break
            lines.append(number)
            for column, index in zip(found, indices, strict=True):
                column.append(cells[index])
        return np.array(lines, np.int64), found


class CsvTable(FieldTable):
    """Rows of a text file with the columns that an adapter reads, and stamps in nanoseconds."""

    def __init__(
        self,
        file: CsvFile,
        role: str,
        paths: dict[str, str],
        stamp: str | None,
        unit_s: float = 1.0,
        offset_s: float = 0.0,
    ) -> None:
        """``paths``: key of the configuration by column; ``stamp``: None where rows have no time."""
        self.file, self._role, self.source = file, role, file.path.name
        wanted = {
            path: file.index(path, f"[{role}] {key}") for path, key in paths.items()
        }
        at = [file.index(stamp, f"[{role}] stamp")] if stamp is not None else []
        self._lines, cells = file.columns([*wanted.values(), *at])
        self._cells = dict(zip(wanted, cells, strict=False))
        self._values: dict[str, Floats] = {}
        self.stamps_ns = np.zeros(len(self._lines), np.int64)
        if stamp is not None:
            self.stamps_ns = self._stamps(stamp, cells[-1], unit_s) + round(
                offset_s * NS_PER_S
            )

    def column(self, path: str) -> Floats:
        """A column of numbers, shape (n,); NaN for empty cells. A LogError names the line of any other."""
        if path not in self._values:
            cells = self._cells[path]
            if self.file.form.decimal != ".":
                cells = [cell.replace(self.file.form.decimal, ".") for cell in cells]
            plain = [
                "nan" if cell.lower() in _EMPTY else _TRUTHS.get(cell.lower(), cell)
                for cell in cells
            ]
            try:
                self._values[path] = np.array(plain, dtype=np.float64)
            except ValueError:
                row = next(k for k, cell in enumerate(plain) if not _is_number(cell))
                decimal = (
                    '; decimal = "," where numbers are written so'
                    if "," in plain[row]
                    else ""
                )
                raise LogError(
                    f"{self.file.path}, line {self._lines[row]}: column {path}: {self._cells[path][row]!r} is no "
                    f"number; expected one, or nothing where it was not measured{decimal}"
                ) from None
        return self._values[path]

    def refuse(self, path: str, fault: str) -> NoReturn:
        """Raise a `LogError` about a column."""
        raise LogError(f"{self.file.path}: [{self._role}] column {path} {fault}")

    def _stamps(self, name: str, cells: list[str], unit_s: float) -> Ints:
        """Nanoseconds of decimal numbers, rounded once, or of dates with times; a LogError names the first other."""
        unit_ns = Decimal(repr(unit_s)) * NS_PER_S
        is_date = bool(cells) and not _is_number(
            cells[0].replace(self.file.form.decimal, ".")
        )
        stamps = np.empty(len(cells), np.int64)
        for row, cell in enumerate(cells):
            try:
                if is_date:
                    stamps[row] = date_ns(cell)
                else:
                    number = (
                        cell
                        if self.file.form.decimal == "."
                        else cell.replace(self.file.form.decimal, ".")
                    )
                    stamps[row] = int((Decimal(number) * unit_ns).to_integral_value())
            except (InvalidOperation, ValueError, OverflowError):
                raise LogError(
                    f"{self.file.path}, line {self._lines[row]}: column {name}: {cell!r} is no time; expected a number "
                    "(unit: stamp_unit_s) or a date such as 2026-05-01T12:30:00.25Z"
                ) from None
        return stamps


_TRUTHS = {"true": "1", "false": "0"}


def split(line: str, delimiter: str, count: int | None = None) -> list[str]:
    """Cells of a line without the space around them; an empty one at its end counts only as the last of ``count``."""
    if delimiter == " ":
        return line.split()
    cells = (
        next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
        if '"' in line
        else line.split(delimiter)
    )
    cells = [cell.strip() for cell in cells]
    return (
        cells[:-1]
        if len(cells) > 1 and not cells[-1] and len(cells) != count
        else cells
    )


def _delimiter_of(line: str, decimal: str = ".") -> str:
    """The first of tab, semicolon and comma that a line has, else white space."""
    return next(
        (
            delimiter
            for delimiter in "\t;,"
            if delimiter in line and delimiter != decimal
        ),
        " ",
    )


def is_value(cell: str, decimal: str = ".") -> bool:
    """True for a cell of a row, not of a header: a number, or a date."""
    if _is_number(cell.replace(decimal, ".")):
        return True
    try:
        date_ns(cell)
    except ValueError:
        return False
    return True


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def date_ns(text: str) -> int:
    """Nanoseconds since 1970 of a date with a time as ISO 8601 has it, in UTC without a zone; else a ValueError."""
    parts = re.fullmatch(r"(\d{4}-.*\d\d:\d\d:\d\d)(\.\d+)?(\D.*)?", text.strip())
    if parts is None:
        raise ValueError(f"{text!r} is no date with a time")
    whole, fraction, zone = parts.groups()
    when = datetime.fromisoformat(whole + (zone or ""))
    since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - datetime(
        1970, 1, 1, tzinfo=UTC
    )
    seconds = since.days * 86_400 + since.seconds
    return seconds * NS_PER_S + int(
        (Decimal(fraction or 0) * NS_PER_S).to_integral_value()
    )


def plain_name(name: str) -> str:
    """Name of a column without its unit: ``gyro_x`` of ``gyro_x [deg/s]``."""
    return re.sub(r"\s*[\[(][^\[\]()]*[\])]\s*$", "", name)


def _told_apart(names: list[str]) -> tuple[str, ...]:
    """Names of which each occurs once: a repeated or empty one is replaced by its number."""
    return tuple(
        name if name and names.count(name) == 1 else str(k + 1)
        for k, name in enumerate(names)
    )
