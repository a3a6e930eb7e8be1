"""What a run left behind, and what was made of several: the data that metrics fill and reports show."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Literal

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.recognition import Recognition
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, LandmarkMap, Refusal, RefusedRow, Trajectory

Kind = Literal["causal", "smoothed"]


@dataclass(frozen=True, eq=False)
class MapSoFar:
    """The map as an estimator knew it at an instant of its run."""

    stamp_ns: int
    landmarks: LandmarkMap


@dataclass(frozen=True, eq=False)
class RunResult:
    """One estimator's run over one sequence. A failed run is a result too, with its reason."""

    estimator: str
    """Entry-point name; also the run's name in tables and folders."""
    params: dict[str, Any]
    status: Literal["ok", "failed"]
    reason: str = ""
    """Why it failed, in one line; empty when it did not."""
    causal: Trajectory | None = None
    """What `process` returned at each instant."""
    smoothed: Trajectory | None = None
    """What `trajectory` returned at the end: the same instants. A filter's is its causal one."""
    landmarks: LandmarkMap | None = None
    detections: DetectionLog | None = None
    refused: list[RefusedRow] = field(default_factory=list)
    """Rows of IMU and Doppler log that it names as not used."""
    withheld: list[str] = field(default_factory=list)
    """What it says that it could not use for want of something else, a line each."""
    maps: list[MapSoFar] = field(default_factory=list)
    """The map at `map_instants`, in order; the last one is `landmarks`."""
    update_s: Floats = field(default_factory=lambda: np.empty(0))
    """Duration of each call of `process`, shape (n,)."""
    finish_s: float = 0.0
    """Duration of asking for the trajectory and the map at the end."""
    peak_memory_mb: float = float("nan")
    """Highest resident memory of the process while it ran, less what it was before."""


@dataclass(frozen=True)
class Score:
    """A number with everything that is needed to read it."""

    value: float
    unit: str
    protocol: str
    """How it was got, in one sentence: which estimate, aligned how, over which instants, against which truth."""
    interval: tuple[float, float] | None = None
    """Where the value should lie if the estimator is consistent; None where no such interval exists."""
    better: Literal["lower", "higher", "inside", "none"] = "lower"


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """Errors of one estimate against the truth, raw (not aligned), at each scored instant."""

    stamps_ns: Ints
    """Shape (n,)."""
    position_m: Floats
    """Estimate minus truth in the world frame, shape (n, 3)."""
    position_sigma_m: Floats
    """Reported standard deviations of the same, shape (n, 3); NaN where not reported."""
    yaw_rad: Floats
    """Estimate minus truth, wrapped, shape (n,)."""
    yaw_sigma_rad: Floats
    """Shape (n,)."""
    nees_position: Floats
    """Normalised squared error of x, y (planar run) or x, y, z, shape (n,)."""
    nees_yaw: Floats
    """Shape (n,)."""
    position_dof: int
    """2 for a planar run, else 3."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several runs on one sequence, with scores: the content of comparison.json and of the report."""

    sequence: Sequence
    instants_ns: Ints
    runs: list[RunResult]
    scores: dict[str, dict[str, Score]]
    """By run name, then by key such as ``causal.ate_se2_m``; empty for a failed run."""
    errors: dict[str, dict[Kind, ErrorSeries]]
    """By run name; empty where there is no truth."""
    environment: dict[str, str]
    """Versions, machine, date, and the command that made it."""
    recognition: Recognition | None = None
    """How the detections came from sonar images; None where the log had detections or no images."""


ABSENT = "\N{EN DASH}"


def format_value(value: float) -> str:
    """A number with three significant digits; whole numbers and thousands in full; a dash where there is none."""
    if math.isnan(value):
        return ABSENT
    if math.isinf(value):
        return "∞" if value > 0 else "\N{MINUS SIGN}∞"
    if float(value).is_integer() or abs(value) >= 1000:
        text = f"{value:.0f}"
    elif abs(value) < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        text = f"{mantissa}e{int(exponent)}"
    else:
        rounded = float(f"{value:.3g}")
        text = f"{rounded:.{max(0, 2 - math.floor(math.log10(abs(rounded))))}f}"
    return text.replace("-", "\N{MINUS SIGN}")


MOST_ROWS_NAMED = 5
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
        found += (
            [RefusedRows.of(several)] if len(several) > MOST_ROWS_NAMED else [RefusedRows.of([row]) for row in several]
        )
    return found


LABELS = {
    "ate_raw_m": "Position error, not aligned (ATE, RMS)",
    "ate_yaw_m": "Position error, yaw and translation aligned (ATE, RMS)",
    "ate_se2_m": "Horizontal position error, SE(2) aligned (ATE, RMS)",
    "ate_se3_m": "Position error, SE(3) aligned (ATE, RMS)",
    "rpe_1s_m": "Drift over 1 s (RPE, RMS)",
    "rpe_10s_m": "Drift over 10 s (RPE, RMS)",
    "rpe_1s_rad": "Yaw drift over 1 s (RPE, RMS)",
    "rpe_10s_rad": "Yaw drift over 10 s (RPE, RMS)",
    "yaw_rmse_rad": "Yaw error (RMS)",
    "return_error_m": "Return error: last position",
    "nees_position": "Position NEES per degree of freedom",
    "nees_yaw": "Yaw NEES",
    "raw_m": "Horizontal landmark error, not aligned (RMS)",
    "se2_m": "Horizontal landmark error, SE(2) aligned (RMS)",
    "count": "Landmarks mapped",
    "nees": "Landmark NEES per degree of freedom",
    "used": "Detections used",
    "refused": "Detections refused",
    "unnamed": "Detections of no landmark that is probable enough",
    "nis": "NIS per degree of freedom",
    "update_median_ms": "Per update, median",
    "update_p99_ms": "Per update, 99th percentile",
    "update_max_ms": "Per update, longest",
    "total_s": "Whole run",
    "real_time_factor": "Real-time factor: log duration over run time",
    "peak_mb": "Peak memory added by the run",
}
