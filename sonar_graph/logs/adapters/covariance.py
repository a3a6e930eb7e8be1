"""What drivers mean by a covariance: variances or standard deviations, and which numbers say that it is not known."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.logs.table import Table
from sonar_graph.measurements import Floats

Reading = Literal["unknown", "invalid"]
ROUNDING = 1e-6
"""Of the largest eigenvalue: single precision may leave the smallest this far below zero."""


class CovarianceFields(Section):
    """Where a covariance is, and how to read it."""

    fields: tuple[str, ...] = Field(min_length=1, max_length=3)
    """One field: a row-major matrix (3x3, or 6x6 of which the first three rows count), or one number for all axes.
    Three fields: one an axis, each a number or a row."""
    meaning: Literal["variance", "standard deviation"] = "variance"
    """Where drivers put standard deviations, only the diagonal is used, squared."""
    negative: Reading = "unknown"
    """What a negative first element says: the covariance is unknown, or the whole message is invalid."""
    zero: Reading = "unknown"
    """What zeros say."""

    def read(self, table: Table) -> tuple[Floats, NDArray[np.bool_]]:
        """Covariances, shape (n, 3, 3) with NaN: unknown, and which rows they say are invalid, shape (n,)."""
        matrices = self._matrices(table)
        negative = matrices[:, 0, 0] < 0
        zero = ~matrices.any(axis=(1, 2))
        invalid = (negative & (self.negative == "invalid")) | (zero & (self.zero == "invalid"))
        if self.meaning == "standard deviation":
            matrices = matrices**2 * np.eye(3)
        unknown = negative | zero | ~np.isfinite(matrices).all(axis=(1, 2)) | _is_indefinite(matrices)
        return np.where(unknown[:, None, None], np.nan, matrices), invalid

    def warnings(self, table: Table) -> Iterator[str]:
        """How many messages have what no errors can have."""
        if self.meaning == "standard deviation":
            return
        matrices = self._matrices(table)
        indefinite: NDArray[np.bool_] = _is_indefinite(matrices) & (matrices[:, 0, 0] >= 0)
        count = np.count_nonzero(indefinite)
        if count:
            yield (
                f"{', '.join(self.fields)}: no covariance in {count} of {len(table)} messages, since some direction's "
                f"variance is negative: the calibration's noise is taken there"
            )

    def read_variance(self, table: Table) -> Floats:
        """One variance a row from one field, shape (n,); NaN: unknown (zero, negative, not finite)."""
        value = table.column(self.fields[0]).astype(float)
        known = np.isfinite(value) & (value > 0)
        return np.where(known, value**2 if self.meaning == "standard deviation" else value, np.nan)

    def _matrices(self, table: Table) -> Floats:
        columns = [table.column(path).astype(float) for path in self.fields]
        if len(columns) > 1:
            stacked = np.stack(columns, axis=-1)
            if stacked.ndim == 2:
                return _diagonal(stacked)
            return stacked if stacked.shape[1:] == (3, 3) else np.full((len(stacked), 3, 3), np.nan)
        (column,) = columns
        if column.ndim == 1:
            return _diagonal(np.repeat(column[:, None], 3, axis=1))
        if column.shape[1] not in (9, 36):
            table.refuse(self.fields[0], f"has {column.shape[1]} numbers; a covariance has 1, 9 or 36")
        side = 3 if column.shape[1] == 9 else 6
        return column.reshape(-1, side, side)[:, :3, :3]


def _is_indefinite(matrices: Floats) -> NDArray[np.bool_]:
    """Matrices with a negative eigenvalue beyond rounding, shape (n,); none where a number is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    symmetric = np.where(np.asarray(finite)[:, None, None], matrices + np.swapaxes(matrices, 1, 2), 0.0)
    variances: Floats = np.linalg.eigvalsh(symmetric)
    return np.asarray(variances[:, 0] < -ROUNDING * np.abs(variances).max(axis=1))


def _diagonal(values: Floats) -> Floats:
    return values[:, :, None] * np.eye(3)
