"""The contract of an estimator, and how estimators are found.

An estimator is any class with the methods of `Estimator`, announced by its package under the entry-point group
``sonar_graph.estimators``::

    [project.entry-points."sonar_graph.estimators"]
    my-filter = "my_package.my_module:MyFilter"

It then takes part in ``sonar-graph compare`` under that name. `sonar_graph.testing.laws` tests the contract.

What a filter has said so far: one estimate for each instant that was asked for.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any, ClassVar, Protocol, runtime_checkable

from pydantic import ValidationError

from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import EstimatorError, UnknownEstimatorError
from sonar_graph.measurements import Measurements
from sonar_graph.settings import faults_in
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, RefusedRow, Trajectory

ENTRY_POINT_GROUP = "sonar_graph.estimators"


@runtime_checkable
class Estimator(Protocol):
    """Turns measurements into poses and landmarks.

    The outcome must not depend on how the measurements are cut into calls, only on the instants ``end_ns`` at which
    estimates are asked for being returned.
    """

    Params: ClassVar[type[Section]]
    """Settings of this estimator; all have defaults."""

    def __init__(self, calibration: Calibration, params: Any = None) -> None: ...

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in what was measured and return the causal estimate at ``measurements.end_ns``.

        None before the first instant with IMU and DVL.
        """
        ...

    def trajectory(self) -> Trajectory:
        """The best that is known now about every instant at which `process` returned an estimate."""
        ...

    def landmarks(self) -> LandmarkMap:
        """The best that is known now about every landmark."""
        ...

    def detections(self) -> DetectionLog:
        """What became of each detection so far."""
        ...


@runtime_checkable
class TellsRefusedRows(Protocol):
    """What an estimator may have beside the contract: it names the rows of IMU and Doppler log that it does not use."""

    def refused_rows(self) -> list[RefusedRow]:
        """All so far."""
        ...


def refused_rows_of(estimator: Estimator) -> list[RefusedRow]:
    """Rows that an estimator names as not used; none where it does not tell."""
    return list(estimator.refused_rows()) if isinstance(estimator, TellsRefusedRows) else []


@runtime_checkable
class TellsWithheld(Protocol):
    """What an estimator may have beside the contract: it says what it could not use for want of something else."""

    def withheld(self) -> list[str]:
        """All so far, or the newest of it: what, and what was missing, in one line each."""
        ...


def withheld_of(estimator: Estimator) -> list[str]:
    """What an estimator says that it could not use; nothing where it does not tell."""
    return list(estimator.withheld()) if isinstance(estimator, TellsWithheld) else []


def installed_estimators() -> dict[str, EntryPoint]:
    """Entry points by name; nothing is imported. Of two with one name the first found wins."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        found.setdefault(point.name, point)
    return dict(sorted(found.items()))


def load_estimator(name: str) -> type[Estimator]:
    """The class behind an estimator's name.

    Raises
    ------
    UnknownEstimatorError
        Listing the names that exist.
    EstimatorError
        When its package cannot be imported or does not keep the contract.
    """
    installed = installed_estimators()
    if name not in installed:
        known = ", ".join(installed) or "none; reinstall the package"
        raise UnknownEstimatorError(f"no estimator is called {name!r}; installed: {known}")
    try:
        loaded: Any = installed[name].load()
    except Exception as error:  # a third party's import may fail in any way
        raise EstimatorError(f"{name} ({installed[name].value}) cannot be loaded: {error}") from error
    missing = [m for m in ("Params", "process", "trajectory", "landmarks", "detections") if not hasattr(loaded, m)]
    if missing:
        raise EstimatorError(f"{name} ({installed[name].value}) lacks {', '.join(missing)} of the estimator contract")
    return loaded


def make_params(estimator: type[Estimator], overrides: dict[str, Any], name: str) -> Section:
    """An estimator's settings with some replaced.

    Raises
    ------
    EstimatorError
        Naming the setting that does not exist or does not fit, and those that exist.
    """
    try:
        return estimator.Params.model_validate(overrides)
    except ValidationError as error:
        raise EstimatorError(f"settings of {name}: {faults_in(error, estimator.Params)}") from error


class CausalEstimates:
    """Estimates in the order of their instants."""

    def __init__(self) -> None:
        self._estimates: list[Estimate] = []

    def keep(self, estimate: Estimate) -> None:
        """Append; an estimate for the instant of the last one takes its place, an earlier one is passed over."""
        last_ns = self._estimates[-1].stamp_ns if self._estimates else None
        if last_ns is None or estimate.stamp_ns > last_ns:
            self._estimates.append(estimate)
        elif estimate.stamp_ns == last_ns:
            self._estimates[-1] = estimate

    def trajectory(self) -> Trajectory:
        """All of them."""
        return Trajectory.from_estimates(self._estimates)
