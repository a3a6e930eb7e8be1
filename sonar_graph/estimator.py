"""Contract of an estimator, and discovery of installed estimators.

An estimator is any class with the methods of `Estimator`, announced by its package under the entry-point group
``sonar_graph.estimators``::

    [project.entry-points."sonar_graph.estimators"]
    my-filter = "my_package.my_module:MyFilter"

It then takes part in ``sonar-graph compare`` under that name. `sonar_graph.testing.check_estimator` tests the contract.
"""

from importlib.metadata import EntryPoint, entry_points
from typing import Any, ClassVar, Protocol, runtime_checkable

from sonar_graph.calibration import Calibration, KnownMap, Section
from sonar_graph.errors import EstimatorError, UnknownEstimatorError
from sonar_graph.measurements import Measurements
from sonar_graph.motion import MotionSource
from sonar_graph.settings import nested, parse, suggestion
from sonar_graph.states import (
    DetectionLog,
    Estimate,
    LandmarkMap,
    RefusedRow,
    Trajectory,
)

ENTRY_POINT_GROUP = "sonar_graph.estimators"
DISTRIBUTION = "sonar-graph"
"""Name of this package among those that are installed."""


@runtime_checkable
class Estimator(Protocol):
    """Protocol of a class that turns measurements into poses and landmarks.

    Results must not depend on how the measurements are cut into calls.

    Examples
    --------
    Run an estimator by hand, as `sonar_graph.run_estimator` does:

    >>> from sonar_graph import Odometry, load_estimator
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> estimator = load_estimator("dead-reckoning")(world.calibration, Odometry(world.calibration))
    >>> for step in world.replay(world.instants(rate_hz=1.0)):
    ...     estimate = estimator.process(step)
    >>> len(estimator.trajectory())
    20
    """

    Params: ClassVar[type[Section]]
    """Settings of this estimator; each has a default."""

    def __init__(
        self, calibration: Calibration, odometry: MotionSource, params: Any = None
    ) -> None:
        """Make an estimator that has seen nothing.

        ``odometry``: its own source of motion, to which `process` gives the rows of IMU and Doppler log. An estimator
        that makes its own motion of these rows ignores it.
        """
        ...

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements; causal estimate at ``end_ns``, None before the first instant with IMU and DVL."""
        ...

    def trajectory(self) -> Trajectory:
        """Best present estimate of the pose at every instant at which `process` returned an estimate."""
        ...

    def landmarks(self) -> LandmarkMap:
        """Best present estimate of every landmark."""
        ...

    def detections(self) -> DetectionLog:
        """Outcome of every detection so far."""
        ...


@runtime_checkable
class TellsRefusedRows(Protocol):
    """Optional part of the contract: an estimator that names the rows of IMU, Doppler log and depth not used."""

    def refused_rows(self) -> list[RefusedRow]:
        """Refused rows so far."""
        ...


def refused_rows_of(estimator: Estimator) -> list[RefusedRow]:
    """Rows that an estimator names as not used; empty where it does not implement `TellsRefusedRows`."""
    return (
        list(estimator.refused_rows())
        if isinstance(estimator, TellsRefusedRows)
        else []
    )


@runtime_checkable
class TellsWithheld(Protocol):
    """Optional part of the contract: an estimator that names measurements which it could not use, or contradicts."""

    def withheld(self) -> list[str]:
        """Messages, a line each: what is withheld, and what is missing; what contradicts the estimate."""
        ...


def withheld_of(estimator: Estimator) -> list[str]:
    """Messages about withheld measurements; empty where an estimator does not implement `TellsWithheld`."""
    return list(estimator.withheld()) if isinstance(estimator, TellsWithheld) else []


@runtime_checkable
class HasNewestLandmarks(Protocol):
    """Optional part of the contract: an estimator whose `Estimator.landmarks` takes longer the longer a run is."""

    def newest_landmarks(self) -> LandmarkMap:
        """Landmarks as of the last update, in the time of an update."""
        ...


def newest_landmarks_of(estimator: Estimator) -> LandmarkMap:
    """Landmarks for who cannot wait, of a live run: all there are where it does not implement `HasNewestLandmarks`."""
    return (
        estimator.newest_landmarks()
        if isinstance(estimator, HasNewestLandmarks)
        else estimator.landmarks()
    )


@runtime_checkable
class HasKnownMap(Protocol):
    """Optional part of the contract: an estimator whose map can be given to another run."""

    def known_map(self) -> KnownMap:
        """Landmarks with their joint covariance."""
        ...


def known_map_of(estimator: Estimator) -> KnownMap:
    """Map for another run; an `EstimatorError` where an estimator has no landmark, or does not give its map."""
    if not isinstance(estimator, HasKnownMap):
        raise EstimatorError(
            f"{type(estimator).__name__} has no known_map(): it cannot save a map; isam2 and both filters can"
        )
    if not len(estimator.landmarks()):
        raise EstimatorError("no landmark was seen: there is no map to save")
    return estimator.known_map()


def installed_estimators() -> dict[str, EntryPoint]:
    """Entry points by name; nothing is imported. Of two with one name the first found wins."""
    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        found.setdefault(point.name, point)
    return dict(sorted(found.items()))


def is_foreign(name: str) -> bool:
    """Tell whether another package brings an estimator, whose code may change the process that loads it."""
    point = installed_estimators().get(name)
    return (
        point is not None and point.dist is not None and point.dist.name != DISTRIBUTION
    )


def load_estimator(name: str) -> type[Estimator]:
    """Class of an installed estimator.

    Raises
    ------
    UnknownEstimatorError
        Listing the names that exist.
    EstimatorError
        When its package cannot be imported or does not keep the contract.

    Examples
    --------
    >>> from sonar_graph import load_estimator
    >>> load_estimator("ekf-slam").__name__
    'EkfSlam'
    """
    installed = installed_estimators()
    asked: Any = name
    if not isinstance(asked, str):
        kind = asked if isinstance(asked, type) else type(asked)
        same = [
            own
            for own, point in installed.items()
            if point.value == f"{kind.__module__}:{kind.__name__}"
        ]
        given = f"the class {kind.__name__}" if kind is asked else f"{asked!r:.60}"
        raise UnknownEstimatorError(
            f"expected the name of an installed estimator, not {given}; give"
            f" {' or '.join(map(repr, same or installed))}, or announce your own as sonar_graph.estimator says"
        )
    if name not in installed:
        known = ", ".join(installed) or "none; reinstall the package"
        raise UnknownEstimatorError(
            f"no estimator is called {name!r}{suggestion(name, installed)} installed: {known}"
        )
    try:
        loaded: Any = installed[name].load()
    except (
        Exception,
        SystemExit,
    ) as error:  # a third party's import may fail in any way
        said = (
            f"it calls sys.exit({error})"
            if isinstance(error, SystemExit)
            else str(error)
        )
        raise EstimatorError(
            f"{name} ({installed[name].value}) cannot be loaded: {said}"
        ) from error
    missing = [
        m
        for m in ("Params", "process", "trajectory", "landmarks", "detections")
        if not hasattr(loaded, m)
    ]
    if missing:
        raise EstimatorError(
            f"{name} ({installed[name].value}) lacks {', '.join(missing)} of the estimator contract"
        )
    return loaded


def make_params(
    estimator: type[Estimator], overrides: dict[str, Any], name: str
) -> Section:
    """An estimator's settings with some replaced.

    ``overrides``: values by name; of a setting in a section by its dotted name, ``{"identity.policy": "gate"}``, or
    nested, ``{"identity": {"policy": "gate"}}``. Raises `EstimatorError` naming the setting that does not exist or does
    not fit, and those that exist.
    """
    given: Any = overrides
    if not isinstance(given, dict):
        advice = (
            "params.model_dump()" if isinstance(given, Section) else '{"name": value}'
        )
        raise EstimatorError(
            f"settings of {name}: expected a dict, not {type(given).__name__}; give {advice}"
        )
    return parse(
        estimator.Params, nested(overrides), f"settings of {name}", EstimatorError
    )
