"""Delimited text files as tables: delimiter, names of columns, numbers and times, with errors that name the line.

A column is named as the header names it, or by its number, counted from 1. The header is what stands before the first
line with a number: its own lines, or else the last comment, where that names as many columns as the lines have.
"""

import csv
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from datetime import UTC, date, datetime, timedelta
from decimal import Decimal, InvalidOperation
from functools import lru_cache
from pathlib import Path
from typing import NoReturn

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.errors import LogError
from sonar_graph.files import regular
from sonar_graph.logs.adapters import FieldTable, did_you_mean
from sonar_graph.logs.mcap import START_BYTES, foreign_kind
from sonar_graph.measurements import NS_PER_S, Floats, Ints

_DELIMITERS = {"tab": "\t", "space": " "}
_WORDS = {
    **dict.fromkeys(("", "nan", "na", "n/a", "null", "none", "-", "nat"), "nan"),
    "true": "1",
    "false": "0",
}
"""Numbers of the cells that are words, in small letters."""
_MOST_NAMED = 40
_DATE = re.compile(r"(\d+[-./]\w+[-./]\d+)[T ]+(\d\d:\d\d:\d\d)([.,]\d+)?\s*(\D.*)?")
_DATE_FORMS = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d-%b-%Y")
"""Dates, of ISO 8601 and others whose day cannot be taken for the month: of loggers, of Excel in German, of MATLAB."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class CsvForm(Section):
    """Form of a text file that holds a table; what is not stated is found from its first lines."""

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

    def plain(self, cell: str) -> str:
        """A cell as a number of Python: with a decimal point, ``nan`` where it is empty, 1 and 0 for true and false."""
        return _WORDS.get(cell.lower()) or cell.replace(self.decimal, ".")

    def is_value(self, cell: str) -> bool:
        """True for a cell of a row, not of a header: a number, or a date."""
        return reads_as(float, cell.replace(self.decimal, ".")) or reads_as(
            date_ns, cell
        )


class CsvFile:
    """A text file that holds a table.

    Raises LogError where it cannot be read, or has no line with numbers.
    """

    delimiter: str
    first_line: int
    """Number of the first line with values."""
    first: list[str]
    """Cells of that line."""
    names: list[str]
    """Names of all columns; numbers from 1 where nothing names them."""

    def __init__(self, path: Path, form: CsvForm | None = None) -> None:
        self.path = path
        self.form = form or CsvForm()
        self._find_layout()

    @property
    def is_named(self) -> bool:
        """True where a header names the columns."""
        return self.names[:1] != ["1"]

    def _fault(self, text: str, line: int | None = None) -> LogError:
        place = "" if line is None else f", line {line}"
        return LogError(f"{self.path}{place}: {text}")

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Number and text of each line with content, without its end."""
        # a folder inside the folder of the tables
        if self.path.is_dir():
            raise self._fault("is a folder; expected a text file with a table")
        form = self.form
        try:
            # "replace": a degree sign of another encoding in a comment does no harm
            with regular(self.path).open(
                encoding=form.encoding, errors="replace"
            ) as stream:
                for number, line in enumerate(stream, 1):
                    # only the first line: later ones may hold a comment in any encoding
                    is_strange = number == 1 and "\ufffd" in line[:START_BYTES]
                    if "\0" in line or is_strange:
                        raise self._fault(f"{self._kind()}; expected a table", number)
                    if line.strip():
                        yield number, line.rstrip("\r\n").lstrip("\ufeff")
        except (OSError, LookupError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise self._fault(
                f"cannot be read: {reason}; expected a text file with a table"
            ) from error

    def _kind(self) -> str:
        """Kind of a file that holds no text in this encoding."""
        with self.path.open("rb") as stream:
            start = stream.read(START_BYTES)
        if kind := foreign_kind(self.path, start):
            return f"is no text but {kind}"
        return f'is no text in {self.form.encoding}, perhaps encoding = "cp1252" or "utf-16"'

    def is_comment(self, line: str) -> bool:
        """True for a line that is no row."""
        return line.lstrip().startswith(self.form.comment)

    def _find_layout(self) -> None:
        """Find delimiter and names from the lines up to the first with values."""
        form = self.form
        heads: list[list[str]] = []
        comments: list[list[str]] = []
        for number, line in self._lines():
            # each line by itself: a title above the table may have other marks
            stated = _DELIMITERS.get(form.delimiter or "", form.delimiter)
            delimiter = stated or _delimiter_of(line, form.decimal)
            if self.is_comment(line):
                text = line.strip().lstrip("".join(form.comment)).strip()
                comments.append(split(text, _delimiter_of(text)))
                continue
            count = len(heads[-1] if heads else form.columns or ())
            cells = split(line, delimiter, count)
            if any(map(form.is_value, cells)):
                self.delimiter = delimiter
                self.first_line = number
                self.first = cells
                self.names = self._names(heads, comments)
                return
            heads.append(cells)
        raise self._fault(
            "has no line with numbers like 1.5; expected a table, one row a line; numbers like 1,5 need "
            'decimal = ","'
        )

    def _names(self, heads: list[list[str]], comments: list[list[str]]) -> list[str]:
        """Names of all columns, as many as the first line has cells."""
        count = len(self.first)
        stated = self.form.columns
        names = list(stated or ())
        if heads and not names:
            # a second line of the header holds the units
            names = [
                " ".join(filter(None, parts)) for parts in zip(*heads, strict=False)
            ]
        if names and len(names) != count:
            which = "`columns`" if stated else "the header"
            raise self._fault(
                f"has {count} cells, and {which} names {len(names)} columns; put the names right, or leave them out "
                "and give the columns by number",
                self.first_line,
            )
        if not names and comments:
            found = next((cells for cells in comments[::-1] if len(cells) > 1), [])
            # "[idSensor]": may be absent
            without = [name for name in found if not name.startswith("[")]
            names = next((some for some in (found, without) if len(some) == count), [])
        # a repeated or empty name is replaced by the column's number
        return [
            name if stated or (name and names.count(name) == 1) else str(k)
            for k, name in enumerate(names or [""] * count, 1)
        ]

    def index(self, name: str, use: str) -> int:
        """Place of a column by its name or its number from 1; a LogError that names its ``use`` and those there are."""
        names = self.names
        # the whole name first: two columns may differ in their units alone
        for known in (names, [plain_name(other) for other in names]):
            if known.count(name) == 1:
                return known.index(name)
        if name.isdecimal() and 1 <= int(name) <= len(names):
            return int(name) - 1
        # wide tables have hundreds of columns: the message names the first of them
        rest = len(names) - _MOST_NAMED
        more = f" and {rest} more" if rest > 0 else ""
        raise self._fault(
            f"has no column {name!r} ({use}); {did_you_mean(name, names, '{!r}')}it has "
            f"{', '.join(names[:_MOST_NAMED])}{more}, by name or numbered from 1"
        )

    def numbers(self, *names: str) -> list[Floats]:
        """Numbers of columns, shape (n,) each, without broken rows; NaN for cells that hold none."""
        indices = [self.index(name, "") for name in names]
        _, columns = self.columns(indices, skip_broken=True)
        return [np.array(list(map(self._number, cells)), float) for cells in columns]

    def _number(self, cell: str) -> float:
        try:
            return float(self.form.plain(cell))
        except ValueError:
            return np.nan

    def columns(
        self, indices: list[int], *, skip_broken: bool = False
    ) -> tuple[Ints, list[list[str]]]:
        """Line numbers, shape (n,), and the cells of some columns.

        A LogError names the first line with another number of cells; with ``skip_broken`` such lines are left out.
        """
        count = len(self.names)
        lines: list[int] = []
        found: list[list[str]] = [[] for _ in indices]
        for number, line in self._lines():
            if number < self.first_line or self.is_comment(line):
                continue
            cells = split(line, self.delimiter, count)
            if len(cells) != count:
                if skip_broken:
                    continue
                raise self._fault(
                    f"has {len(cells)} cells; expected {count}, as the first row",
                    number,
                )
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
        paths: Iterable[str],
        stamp: str | None,
        unit_s: float = 1.0,
        offset_s: float = 0.0,
    ) -> None:
        """``paths``: columns; ``stamp``: that of the time, None where rows have none."""
        self.file = file
        self._role = role
        wanted = {path: file.index(path, f"[{role}]") for path in paths}
        at = [] if stamp is None else [file.index(stamp, f"[{role}] stamp")]
        self.lines, cells = file.columns([*wanted.values(), *at])
        self._cells = dict(zip(wanted, cells, strict=False))
        # converted when an adapter reads them
        self._values: dict[str, Floats] = {}
        self.stamps_ns = np.zeros(len(self.lines), np.int64)
        self.has_dates = False
        if stamp is not None:
            offset_ns = round(offset_s * NS_PER_S)
            self.stamps_ns = self._stamps(stamp, cells[-1], unit_s) + offset_ns

    def column(self, path: str) -> Floats:
        """A column of numbers, shape (n,); NaN for empty cells. A LogError names the line of any other."""
        if path not in self._values:
            cells = self._cells[path]
            plain = [self.file.form.plain(cell) for cell in cells]
            try:
                self._values[path] = np.array(plain, dtype=np.float64)
            except ValueError:
                row = next(
                    k for k, cell in enumerate(plain) if not reads_as(float, cell)
                )
                is_comma = "," in plain[row]
                decimal = '; decimal = "," where numbers are written so' * is_comma
                raise LogError(
                    f"{self.file.path}, line {self.lines[row]}: column {path}: "
                    f"{cells[row]!r} is no number; expected one, or nothing where it was "
                    f"not measured{decimal}"
                ) from None
        return self._values[path]

    def refuse(self, path: str, fault: str) -> NoReturn:
        """Raise a `LogError` about a column."""
        raise LogError(f"{self.file.path}: [{self._role}] column {path} {fault}")

    def _stamps(self, name: str, cells: list[str], unit_s: float) -> Ints:
        """Nanoseconds of decimal numbers, rounded once, or of dates with times; a LogError names the first other."""
        # decimals: a double keeps only a quarter of a microsecond of a time since 1970
        unit_ns = Decimal(repr(unit_s)) * NS_PER_S
        decimal = self.file.form.decimal
        self.has_dates = bool(cells) and reads_as(date_ns, cells[0])
        stamps = np.empty(len(cells), np.int64)
        for row, cell in enumerate(cells):
            try:
                if self.has_dates:
                    stamps[row] = date_ns(cell)
                else:
                    number = Decimal(cell.replace(decimal, "."))
                    stamps[row] = int((number * unit_ns).to_integral_value())
            except (InvalidOperation, ValueError, OverflowError):
                raise LogError(
                    f"{self.file.path}, line {self.lines[row]}: column {name}: {cell!r} "
                    "is no time; expected a number (unit: stamp_unit_s) or a date such "
                    "as 2026-05-01T12:30:00.25Z"
                ) from None
        return stamps


def split(line: str, delimiter: str, count: int | None = None) -> list[str]:
    """Cells of a line without the space around them; an empty one at its end counts only as the last of ``count``."""
    if delimiter == " ":
        return line.split()
    # the plain way is five times as fast
    cells = line.split(delimiter)
    if '"' in line:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    cells = [cell.strip() for cell in cells]
    # some loggers end each line with a delimiter, spreadsheets with several
    most = count or max(len(cells) - 1, 1)
    while len(cells) > most and not cells[-1]:
        cells.pop()
    return cells


def _delimiter_of(line: str, decimal: str = ".") -> str:
    """The first of tab, semicolon and comma that a line has outside quotes, else white space."""
    # a comma inside a quoted header is part of a name
    bare = re.sub(r'"[^"]*"', "", line)
    return next((d for d in "\t;," if d in bare and d != decimal), " ")


def reads_as(kind: Callable[[str], object], cell: str) -> bool:
    """True for a cell that ``float`` or `date_ns` reads."""
    try:
        kind(cell)
    except ValueError:
        return False
    return True


def date_ns(text: str) -> int:
    """Nanoseconds since 1970 of a date with a time, ISO 8601 or one of `_DATE_FORMS`, in UTC without a zone.

    A ValueError for any other text.
    """
    parts = _DATE.fullmatch(text.strip())
    if parts is None:
        raise ValueError(f"{text!r} is no date with a time")
    day, clock, fraction, zone = parts.groups(default="")
    when = datetime.fromisoformat(
        f"{_day(day)}T{clock}{zone.replace('UTC', '') or '+00:00'}"
    )
    # datetime itself has microseconds only
    fraction_ns = Decimal(f"0{fraction.replace(',', '.')}") * NS_PER_S
    return (when - _EPOCH) // timedelta(seconds=1) * NS_PER_S + round(fraction_ns)


@lru_cache
def _day(text: str) -> date:
    """Date in one of `_DATE_FORMS`; the days of one dive are few."""
    for form in _DATE_FORMS:
        with suppress(ValueError):
            return datetime.strptime(text, form).date()
    raise ValueError(f"{text!r} is no date whose order of day and month is known")


def plain_name(name: str) -> str:
    """Name of a column without its unit: ``gyro_x`` of ``gyro_x [deg/s]``."""
    return re.sub(r"\s*[\[(][^\[\]()]*[\])]\s*$", "", name)
