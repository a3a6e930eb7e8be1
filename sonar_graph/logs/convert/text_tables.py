"""Text files of numbers, and folders of numbered runs, read with errors that name file and line."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_graph.errors import DatasetError
from sonar_graph.files import text_of
from sonar_graph.logs.trajectory_files import decimal_ns
from sonar_graph.measurements import Floats, Ints


@dataclass(frozen=True, eq=False)
class NumberTable:
    """Rows of numbers in a text file."""

    path: Path
    first: list[str]
    """First field of every row, as written; length n."""
    values: Floats
    """All fields of every row, shape (n, number of columns)."""

    def stamps_ns(self) -> Ints:
        """The first field as integer nanoseconds, shape (n,)."""
        return np.array([decimal_ns(text) for text in self.first], dtype=np.int64)


def read_table(
    path: Path,
    columns: tuple[str, ...],
    *,
    delimiter: str | None = None,
    header_lines: int = 0,
    comment: str = "#",
    encoding: str = "utf-8",
) -> NumberTable:
    """Read a table whose every field is a finite number.

    Blank lines and lines that begin with ``comment`` are skipped, and so many ``header_lines``; ``columns`` are for the
    error and for their number; ``delimiter``: white space by default.

    Raises `DatasetError` when the file is missing, has no row, or a row does not hold as many numbers as there are
    columns.
    """
    first: list[str] = []
    rows: list[list[float]] = []
    expected = f"rows of {', '.join(columns)}"
    for number, fields in read_lines(
        path, expected, delimiter, header_lines, comment, encoding
    ):
        rows.append(numbers(path, number, fields, columns))
        first.append(fields[0])
    return NumberTable(path, first, np.array(rows))


def read_lines(
    path: Path,
    expected: str,
    delimiter: str | None = None,
    header_lines: int = 0,
    comment: str = "#",
    encoding: str = "utf-8",
) -> Iterator[tuple[int, list[str]]]:
    """Line number (from 1) and fields of every line with content.

    Raises `DatasetError` when the file cannot be read or holds no such line; ``expected`` describes what should have
    been there.
    """
    try:
        lines = text_of(path, encoding).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(
            f"{path}: cannot be read as text ({getattr(error, 'strerror', None) or error}); expected {expected}"
        ) from error
    # a header alone is no data
    empty = True
    for number, line in enumerate(lines[header_lines:], start=header_lines + 1):
        if line.strip() and not line.lstrip().startswith(comment):
            empty = False
            yield number, line.split(delimiter)
    if empty:
        raise DatasetError(f"{path}: holds no data; expected {expected}")


def numbers(
    path: Path, number: int, fields: list[str], columns: tuple[str, ...]
) -> list[float]:
    """Fields of one line as finite numbers; an error names the line and the columns expected."""
    expected = f"expected {len(columns)} numbers: {', '.join(columns)}"
    if len(fields) != len(columns):
        raise DatasetError(f"{path}, line {number}: {len(fields)} fields; {expected}")
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise DatasetError(f"{path}, line {number}: {error}; {expected}") from error
    # "nan" is a number to Python, and no measurement in these data sets
    if not np.isfinite(values).all():
        raise DatasetError(f"{path}, line {number}: a number is not finite; {expected}")
    return values


def numbered_run(
    folder: Path, entry: str, number: int, kind: str, expected: str
) -> Path:
    """Path of a run in a data set's folder, where the runs are numbered.

    ``folder``: folder of the data set; ``entry``: name of a run's file or folder, with ``N`` for the number;
    ``number``: the wanted run; ``kind``, ``expected``: names of a run and of the content of the folder, for the errors
    where one does not exist.
    """
    if not folder.is_dir():
        raise DatasetError(
            f"{folder}: is not a folder; give the folder that holds {expected}"
        )
    # the runs that there are belong into the error about one that is not
    pattern = re.escape(entry).replace("N", r"(\d+)")
    found = sorted(
        int(match[1])
        for path in folder.iterdir()
        if (match := re.fullmatch(pattern, path.name))
    )
    if not found:
        raise DatasetError(
            f"{folder}: holds no {entry}; give the folder that holds {expected}"
        )
    if number not in found:
        raise DatasetError(
            f"{folder}: has no {kind} {number}; it has {', '.join(map(str, found))}"
        )
    return folder / entry.replace("N", str(number))
