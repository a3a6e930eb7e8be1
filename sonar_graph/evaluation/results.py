"""Results as data: a run, its scores and errors, and a comparison of several runs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from importlib import import_module
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeVar

import numpy as np

from sonar_graph.calibration import KnownMap
from sonar_graph.evaluation.digits import format_value
from sonar_graph.evaluation.tables import compact_table, score_table
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence
from sonar_graph.settings import flattened, suggestion
from sonar_graph.states import (
    DetectionLog,
    LandmarkMap,
    Refusal,
    RefusedRow,
    Trajectory,
    counted,
)
from sonar_graph.table import as_html

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sonar_graph.recognition import Recognition

Kind = Literal["causal", "smoothed"]
# an interval that reaches beyond this factor of 1 is too wide to call a value inside it consistent
TOLERATED_FACTOR = 2.0
MOST_ROWS_NAMED = 5
"""Refused rows of one sensor and reason that are named one by one, and messages of one run that are shown."""


Named = TypeVar("Named")


class ByName(dict[str, Named]):
    """Values by name, in which a name that is missing is answered with those that exist, or why there are none."""

    failure = ""

    @classmethod
    def of_failed(cls, reason: str) -> ByName[Named]:
        """Nothing, for a reason."""
        empty: ByName[Named] = cls()
        empty.failure = reason
        return empty

    def __missing__(self, name: str) -> NoReturn:
        if self.failure:
            raise KeyError(f"{name!r}: the run failed: {self.failure}")
        raise KeyError(
            f"{name!r}{suggestion(str(name), self)} there are: {', '.join(self) or 'none'}"
        )


@dataclass(frozen=True, eq=False)
class MapSoFar:
    """The map as an estimator knew it at an instant of its run."""

    stamp_ns: int
    landmarks: LandmarkMap


@dataclass(frozen=True, eq=False, repr=False)
class RunResult:
    """One estimator's run over one sequence; a failed run is a result too, with its reason.

    Examples
    --------
    >>> from sonar_graph import run_estimator
    >>> from sonar_graph.testing import small_world
    >>> result = run_estimator(small_world(), "dead-reckoning")
    >>> result
    RunResult('dead-reckoning': ok, 40 estimates, 0 landmarks)
    >>> len(result.causal) == len(result.smoothed)
    True
    """

    estimator: str
    """Entry-point name; also the run's name in tables and folders."""
    params: dict[str, Any]
    status: Literal["ok", "failed"]
    reason: str = ""
    """Why it failed, in one line; empty when it did not."""
    causal: Trajectory | None = None
    """Estimates that `process` returned at each instant."""
    smoothed: Trajectory | None = None
    """The `trajectory` at the end, at the same instants. A filter's is its causal one."""
    landmarks: LandmarkMap | None = None
    known_map: KnownMap | None = None
    """The landmarks with their joint covariance, for another run; None where an estimator gives none, or of many."""
    detections: DetectionLog | None = None
    refused: list[RefusedRow] = field(default_factory=list)
    """Rows of IMU and Doppler log that it names as not used."""
    withheld: list[str] = field(default_factory=list)
    """Measurements that it could not use because something else is missing, in its own words, a line each."""
    maps: list[MapSoFar] = field(default_factory=list)
    """The map at `kept_map_instants`, in order; the last one is `landmarks`."""
    update_s: Floats = field(default_factory=lambda: np.empty(0))
    """Duration of each call of `process`, shape (n,)."""
    finish_s: float = 0.0
    """Duration of asking for the trajectory and the map at the end."""
    peak_memory_mb: float = float("nan")
    """Highest resident memory of the process while it ran, less what it was before."""

    @property
    def is_as_published(self) -> bool:
        """True for a filter without gate and robust kernel, as the papers of 2014 and before have it."""
        params = flattened(self.params)
        return params.get("gate_probability") == 1.0 and params.get("kernel_width") == 0

    def __repr__(self) -> str:
        counts = f"{counted(len(self.causal or ()), 'estimate')}, {counted(len(self.landmarks or ()), 'landmark')}"
        first = "".join(f"; {message}" for message in self.withheld[:1])
        more = len(self.withheld) - 1
        others = f" ({more} more in withheld)" * (more > 0)
        return f"RunResult({self.estimator!r}: {self.status}, {self.reason or counts}{first}{others})"


@dataclass(frozen=True)
class Score:
    """A number with everything that is needed to read it.

    Examples
    --------
    >>> from sonar_graph import compare
    >>> from sonar_graph.testing import small_world
    >>> score = compare(small_world(), ["dead-reckoning"]).scores["dead-reckoning"]["causal.ate_raw_m"]
    >>> score.unit, score.better
    ('m', 'lower')
    """

    value: float
    unit: str
    protocol: str
    """The measuring rule in one sentence: which estimate, aligned how, over which instants, against which truth."""
    interval: tuple[float, float] | None = None
    """Interval in which the value of a consistent estimator lies; None where none is known."""
    better: Literal["lower", "higher", "inside", "none"] = "lower"

    @property
    def shown_unit(self) -> str:
        """The unit in which people see the score: degrees for radians, none for "1"."""
        return {"rad": "°", "1": "", "-": ""}.get(self.unit, self.unit)

    def text(self, value: float | None = None) -> str:
        """The score's value, or another value in its unit, as people see it in `shown_unit`."""
        number = self.value if value is None else value
        return format_value(math.degrees(number) if self.unit == "rad" else number)

    @property
    def with_unit(self) -> str:
        """The value as people see it, with its unit."""
        unit = self.shown_unit
        return self.text() + ("" if unit in ("", "°") else "\N{NO-BREAK SPACE}") + unit

    @property
    def verdict(self) -> str:
        """The verdict of a normalised squared error on the reported covariances; empty for other scores.

        Above the score's interval the estimator is over-confident, below it over-cautious. Inside it is consistent,
        unless the interval is wider than `TOLERATED_FACTOR`: then, and without an interval, the verdict is empty.
        """
        if self.better != "inside" or math.isnan(self.value) or self.interval is None:
            return ""
        lowest, highest = self.interval
        if self.value > highest:
            return "over-confident"
        if self.value < lowest:
            return "over-cautious"
        return "consistent" if highest <= TOLERATED_FACTOR else ""


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """Errors of one estimate against the truth, raw (not aligned), at each scored instant.

    Examples
    --------
    >>> from sonar_graph import compare
    >>> from sonar_graph.testing import small_world
    >>> errors = compare(small_world(), ["dead-reckoning"]).errors["dead-reckoning"]["causal"]
    >>> errors.position_m.shape[1] == errors.position_dof
    True
    """

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
    position_samples: int
    """Number of independent samples that the mean of ``nees_position`` is worth."""
    yaw_samples: int
    """The same of ``nees_yaw``."""


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Several runs on one sequence, with scores: the content of comparison.json and of the report.

    Examples
    --------
    >>> from sonar_graph import compare
    >>> from sonar_graph.testing import small_world
    >>> comparison = compare(small_world(), ["dead-reckoning"])
    >>> comparison.scores["dead-reckoning"]["causal.ate_raw_m"].unit
    'm'
    """

    sequence: Sequence
    instants_ns: Ints
    runs: list[RunResult]
    scores: dict[str, dict[str, Score]]
    """By run name, then by key such as ``causal.ate_se2_m``; empty for a failed run. A `KeyError` names those there are."""
    errors: dict[str, dict[Kind, ErrorSeries]]
    """By run name; empty where there is no truth."""
    environment: dict[str, str]
    """Versions, machine, date, and the command that made it."""
    recognition: Recognition | None = None
    """The recognition of landmarks in sonar images; None where the log had detections or no images."""
    is_aligned: bool = False
    """Paths, maps and errors are those of `aligned_to_truth`."""

    def __repr__(self) -> str:
        runs = ", ".join(f"{run.estimator} {run.status}" for run in self.runs)
        keys = len(next(iter(self.scores.values()), {}))
        return f"Comparison({self.sequence.name!r}: {runs}; {keys} scores of each in .scores)"

    def score_of(self, name: str, key: str) -> Score | None:
        """The score of a run; None where it is missing or not a number."""
        score = self.scores.get(name, {}).get(key)
        return None if score is None or math.isnan(score.value) else score

    def errors_of(self, run: RunResult, kind: Kind = "causal") -> ErrorSeries | None:
        """The errors of a run; None where it has none."""
        return self.errors.get(run.estimator, {}).get(kind)

    @property
    def maps(self) -> list[LandmarkMap]:
        """The final maps of the runs that have landmarks."""
        return [run.landmarks for run in self.runs if run.landmarks]

    @property
    def failed_runs(self) -> list[RunResult]:
        """Runs that did not come to an end."""
        return [run for run in self.runs if run.status == "failed"]

    def plot_map(self, *, aligned: bool = False) -> Axes:
        """Draw truth, paths and landmarks with their 95 % ellipses, for a notebook or a paper.

        Parameters
        ----------
        aligned
            Align each path and map to the truth, by `aligned_to_truth`.

        Returns
        -------
        matplotlib axes in world metres. Its ``figure`` has a ``savefig``; its size follows matplotlib's settings.

        Raises
        ------
        EvaluationError
            When no run has a path, or with `aligned` no run has errors against a truth.

        Examples
        --------
        >>> from sonar_graph import compare
        >>> from sonar_graph.testing import small_world
        >>> compare(small_world(), ["dead-reckoning"]).plot_map(aligned=True).get_xlabel()
        'world x (m)'
        """
        panels: list[Axes] = _figures().panels_of(self, "map", aligned=aligned)
        return panels[0]

    def plot_errors(self, *, aligned: bool = False) -> list[Axes]:
        """Draw the causal errors of position and heading over time and over the distance travelled.

        Parameters
        ----------
        aligned
            Errors after alignment of each path to the truth, by `aligned_to_truth`.

        Returns
        -------
        matplotlib axes: position error in metres over time and over distance, then the same of yaw in degrees.

        Raises
        ------
        EvaluationError
            When no run has errors against a truth.

        Examples
        --------
        >>> from sonar_graph import compare
        >>> from sonar_graph.testing import small_world
        >>> axes = compare(small_world(), ["dead-reckoning"]).plot_errors(aligned=True)
        >>> [panel.get_ylabel() for panel in axes]
        ['position error (m)', '', 'yaw error (°)', '']
        """
        panels: list[Axes] = _figures().panels_of(self, "errors", aligned=aligned)
        return panels

    def _repr_html_(self) -> str:
        """The scores that are read first, for a notebook; folded below them all others, and why runs failed."""
        failed = (
            f"<p>{escape(run.estimator)} failed: {escape(run.reason)}</p>"
            for run in self.failed_runs
        )
        every = f"<details><summary>All scores</summary>\n{as_html(score_table(self))}\n</details>"
        name = f"<p><strong>{escape(self.sequence.name)}</strong></p>"
        return "\n".join([name, *failed, as_html(compact_table(self)), every])


def _figures() -> Any:
    """The figures of reports, loaded where one is drawn: reports are built on results, so results cannot import them."""
    return import_module("sonar_graph.report.figures")


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
        """One summary of rows with the same sensor and reason."""
        first = rows[0]
        stamps_ns = [row.stamp_ns for row in rows]
        known = [row.distance for row in rows if not math.isnan(row.distance)]
        ends = (min(known), max(known)) if known else None
        times_ns = min(stamps_ns), max(stamps_ns)
        return cls(first.sensor, first.reason, len(rows), *times_ns, ends)

    def times(self, start_ns: int) -> str:
        """First and last stamp in seconds after the start."""
        ends_ns = sorted({self.first_ns, self.last_ns})
        return " to ".join(f"{(at_ns - start_ns) * 1e-9:.3f}" for at_ns in ends_ns)

    def distances(self) -> str:
        """Least and largest squared distance; empty where the reason has none."""
        ends = sorted(set(self.least_and_largest_distance or ()))
        return " to ".join(map(format_value, ends))


def gathered(rows: Iterable[RefusedRow]) -> list[RefusedRows]:
    """Refused rows by sensor and reason, in this order.

    Up to `MOST_ROWS_NAMED` that have a distance are named one by one. More, and rows that differ only in their time, are
    one summary.
    """
    ordered = sorted(rows, key=lambda row: (row.sensor, row.reason, row.stamp_ns))
    found: list[RefusedRows] = []
    for _, alike in groupby(ordered, key=lambda row: (row.sensor, row.reason)):
        several = list(alike)
        # rows that differ in their time alone are one line
        summary = RefusedRows.of(several)
        if summary.count > MOST_ROWS_NAMED or not summary.least_and_largest_distance:
            found.append(summary)
        else:
            found += [RefusedRows.of([row]) for row in several]
    return found
