"""Public data sets: what is known of them, tables of numbers, and the numbered runs in their folders."""

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_graph.errors import DatasetError, LogError
from sonar_graph.logs.convert.csv_table import CsvFile, CsvForm, CsvTable
from sonar_graph.measurements import Floats, Ints

DATA_SETS = tomllib.loads(
    files("sonar_graph.logs.convert").joinpath("data_sets.toml").read_text("utf-8")
)
"""Calibrations and columns of public data sets."""


class NumberTable(NamedTuple):
    """Rows of numbers in a text file."""

    stamps_ns: Ints
    """The first column as a time, shape (n,)."""
    values: Floats
    """All columns, shape (n, number of columns)."""


def read_table(
    path: Path, columns: tuple[str, ...], delimiter: str = "space"
) -> NumberTable:
    """Read a table of some columns, the first of them a time in seconds or a number.

    Raises `DatasetError` when the file is missing, has no row, or a row does not hold a finite number for each column.
    """
    try:
        file = CsvFile(path, CsvForm(columns=columns, delimiter=delimiter))
        table = CsvTable(file, path.stem, columns, columns[0])
        values = table.beside(columns)
    except LogError as error:
        raise DatasetError(f"{error}; expected rows of {', '.join(columns)}") from error
    # an empty cell is a measurement that was not made, and these data sets have none
    row, column = np.argwhere(~np.isfinite(values))[:1].T
    if row.size:
        raise DatasetError(
            f"{path}, line {table.lines[row[0]]}: {columns[column[0]]} is no finite number"
        )
    return NumberTable(table.stamps_ns, values)


def numbered_run(folder: Path, entry: str, number: int, expected: str) -> Path:
    """Path of a run in a data set's folder, where the runs are numbered.

    ``entry`` is the name of a run's file or folder, with ``N`` for the number; ``expected`` describes the folder.
    """
    run = folder / entry.replace("N", str(number))
    if not run.exists():
        found = [path.name for path in folder.glob(entry.replace("N", "[0-9]*"))]
        raise DatasetError(
            f"{run}: does not exist; {folder} has {', '.join(sorted(found)) or 'no such run'}; "
            f"give the folder that holds {expected}, and one of its runs"
        )
    return run
