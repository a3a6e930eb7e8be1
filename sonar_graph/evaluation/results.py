"""What a run left behind, and what was made of several: the data that metrics fill and reports show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from sonar_graph.evaluation.recognition import Recognition
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, LandmarkMap, RefusedRow, Trajectory

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
