"""The messages of a topic as one table: columns over all rows, stamps, and which rows are fit for use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.container import Topic
from sonar_graph.measurements import Ints

NS_PER_S = 1_000_000_000


def header_stamps_ns(group: Messages, log_times_ns: Ints, prefix: str = "header.stamp.") -> Ints:
    """Stamps of messages from their headers, shape (n,); the log's time where a header's stamp is zero.

    Parameters
    ----------
    group
        n messages.
    log_times_ns
        Of all messages of the topic.
    prefix
        Of the stamp's two fields.
    """
    stamps_ns = group[f"{prefix}sec"].astype(np.int64) * NS_PER_S + group[f"{prefix}nanosec"]
    return np.where(stamps_ns == 0, log_times_ns[group.rows], stamps_ns)


class Table:
    """All messages of a topic whose fields of interest have the same size in each.

    Raises
    ------
    LogError
        Naming file, topic and field where the messages are not what their definition says.
    """

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.groups = topic.messages()
        self.stamps_ns = np.empty(len(topic), np.int64)
        self._require("header.stamp.sec")
        log_times_ns = topic.log_times_ns
        for group in self.groups:
            self.stamps_ns[group.rows] = header_stamps_ns(group, log_times_ns)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def column(self, path: str) -> NDArray[Any]:
        """A field over all rows, shape (n,) or (n, m)."""
        self._require(path)
        parts = [group[path] for group in self.groups]
        values = np.empty((len(self), *parts[0].shape[1:]), parts[0].dtype.newbyteorder("="))
        for group, part in zip(self.groups, parts, strict=True):
            values[group.rows] = part
        return values

    def columns(self, prefix: str, names: str) -> NDArray[Any]:
        """Fields side by side, shape (n, m): ``columns("velocity", "xyz")``."""
        return np.column_stack([self.column(f"{prefix}.{name}") for name in names])

    def frame_id(self) -> str:
        """The frame of the first message."""
        return self.groups[0].first_string("header.frame_id")

    def _require(self, path: str) -> None:
        if any(path not in group.layout.columns for group in self.groups):
            topic = self.topic
            raise LogError(f"{topic.file}: topic {topic.name}: its {topic.type_name} has no field {path}")


def fit_rows(stamps_ns: Ints, faults: Mapping[str, NDArray[np.bool_]], *, unique: bool) -> tuple[Ints, dict[str, int]]:
    """The rows fit for use in the order of their stamps, and how many are not, by fault.

    Parameters
    ----------
    stamps_ns
        Shape (n,).
    faults
        Which rows have it, shape (n,), by the fault's name; a row counts for the first only.
    unique
        Refuse all but the first of rows with the same stamp.
    """
    fit = np.ones(len(stamps_ns), bool)
    counts = {}
    for fault, has_it in faults.items():
        counts[fault] = int(np.count_nonzero(fit & has_it))
        fit &= ~has_it
    rows: Ints = np.flatnonzero(fit).astype(np.int64)
    rows = rows[np.argsort(stamps_ns[rows], kind="stable")]
    if unique and rows.size:
        again = np.diff(stamps_ns[rows], prepend=stamps_ns[rows[0]] - 1) == 0
        counts["with the stamp of another"] = int(np.count_nonzero(again))
        rows = rows[~again]
    return rows, {fault: count for fault, count in counts.items() if count}
