"""What runs did not use: rows of IMU and Doppler log, gathered where they are many, and what was withheld; in words."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.wording import format_value
from sonar_graph.states import Refusal, RefusedRow

MOST_NAMED = 5
"""Rows of one sensor and reason that are named one by one, more are gathered; of what was withheld the first ones."""


@dataclass(frozen=True)
class RefusedRows:
    """One row, or several of one sensor that were refused for one reason."""

    sensor: str
    reason: Refusal
    count: int
    first_ns: int
    last_ns: int
    least_and_largest_distance: tuple[float, float] | None
    """Squared Mahalanobis distances; None where the reason has none."""

    @classmethod
    def of(cls, rows: list[RefusedRow]) -> RefusedRows:
        """From rows with the same sensor and reason."""
        stamps_ns = [row.stamp_ns for row in rows]
        distances = [row.distance for row in rows if not math.isnan(row.distance)]
        ends = (min(distances), max(distances)) if distances else None
        return cls(rows[0].sensor, rows[0].reason, len(rows), min(stamps_ns), max(stamps_ns), ends)

    def times(self, start_ns: int) -> str:
        """In seconds after the start, from the first to the last."""
        return " to ".join(f"{(stamp_ns - start_ns) * 1e-9:.3f}" for stamp_ns in sorted({self.first_ns, self.last_ns}))

    def distances(self) -> str:
        """From the least to the largest; empty where the reason has none."""
        return " to ".join(format_value(distance) for distance in sorted(set(self.least_and_largest_distance or ())))


def gathered(rows: Iterable[RefusedRow]) -> list[RefusedRows]:
    """Each row where a sensor has few for a reason, else all in one; in order of sensors, reasons and stamps."""
    ordered = sorted(rows, key=lambda row: (row.sensor, row.reason, row.stamp_ns))
    found: list[RefusedRows] = []
    for _, alike in groupby(ordered, key=lambda row: (row.sensor, row.reason)):
        several = list(alike)
        found += [RefusedRows.of(several)] if len(several) > MOST_NAMED else [RefusedRows.of([row]) for row in several]
    return found


def by_runs(comparison: Comparison) -> dict[RefusedRows, list[str]]:
    """What was refused, with the names of the runs that refused it; alike in all whose odometry is the same."""
    names: dict[RefusedRows, list[str]] = {}
    for run in comparison.runs:
        for refused in gathered(run.refused):
            names.setdefault(refused, []).append(run.estimator)
    return names


def refusal_lines(comparison: Comparison) -> list[str]:
    """A line for each row, or for many at once: sensor, time, reason, distance, and the runs."""
    start_ns = comparison.sequence.start_ns
    lines = []
    for refused, names in by_runs(comparison).items():
        count = "" if refused.count == 1 else f"{refused.count} rows, "
        distance = f" (squared distance {refused.distances()})" if refused.distances() else ""
        at = f"{count}{refused.times(start_ns)} s"
        lines.append(f"Warning: {refused.sensor}, {at}: {refused.reason}{distance}; {', '.join(names)}")
    return lines


def withheld_lines(comparison: Comparison) -> list[str]:
    """What runs could not use for want of something else, in their own words: the first ones, and how many more."""
    lines = []
    for run in comparison.runs:
        lines += [f"Warning: {run.estimator}: {message}" for message in run.withheld[:MOST_NAMED]]
        more = len(run.withheld) - MOST_NAMED
        if more > 0:
            lines.append(f"Warning: {run.estimator} withheld {more} more: runs/{run.estimator}/result.json has all")
    return lines
