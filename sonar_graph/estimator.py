"""Contract of an estimator, and discovery of installed estimators.

An estimator is any class with the methods of `Estimator`, announced by its package under the entry-point group
``sonar_graph.estimators``::

    [project.entry-points."sonar_graph.estimators"]
    my-filter = "my_package.my_module:MyFilter"

It then takes part in ``sonar-graph compare`` under that name. In a program the class itself may stand where a name does,
and so may a function that makes an estimator. `sonar_graph.testing.check_estimator` tests the contract.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from inspect import signature
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np

from sonar_graph.calibration import Calibration, KnownMap, Section
from sonar_graph.errors import EstimatorError, SonarGraphError, UnknownEstimatorError
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


def optional_method(estimator: Estimator, name: str) -> Callable[[], Any] | None:
    """An optional part of the contract: a method without arguments; None where it is missing, or set to None."""
    found: Callable[[], Any] | None = getattr(estimator, name, None)
    return found


def refused_rows_of(estimator: Estimator) -> list[RefusedRow]:
    """Rows of IMU, Doppler log and depth that an estimator names as not used: its ``refused_rows``; or none."""
    refused_rows = optional_method(estimator, "refused_rows")
    return list(refused_rows()) if refused_rows else []


def withheld_of(estimator: Estimator) -> list[str]:
    """Messages, a line each, about measurements that an estimator could not use or contradicts: its ``withheld``."""
    withheld = optional_method(estimator, "withheld")
    return list(withheld()) if withheld else []


def newest_landmarks_of(estimator: Estimator) -> LandmarkMap:
    """Landmarks as of the last update, in the time of an update: its ``newest_landmarks``; or all there are.

    For an estimator whose `Estimator.landmarks` takes longer the longer a run is.
    """
    newest_landmarks = optional_method(estimator, "newest_landmarks")
    found: LandmarkMap = (newest_landmarks or estimator.landmarks)()
    return found


def known_map_of(estimator: Estimator) -> KnownMap:
    """Landmarks with their joint covariance, for another run: its ``known_map``.

    An `EstimatorError` where an estimator has no landmark, or does not give its map.
    """
    known_map = optional_method(estimator, "known_map")
    if known_map is None:
        raise EstimatorError(
            f"{type(estimator).__name__} has no known_map(): it cannot save a map; isam2 and both filters can"
        )
    if not len(estimator.landmarks()):
        raise EstimatorError("no landmark was seen: there is no map to save")
    found: KnownMap = known_map()
    return found


MakeEstimator = Callable[[Calibration, MotionSource], Estimator]
EstimatorChoice = str | type[Estimator] | MakeEstimator
"""Name of an installed estimator, the class of an estimator, or a function that makes one."""
Returned = TypeVar("Returned")
METHODS = ("process", "trajectory", "landmarks", "detections")
"""Methods of the contract."""
INSTEAD = {
    Trajectory: "CausalEstimates keeps what process returned, and Trajectory.from_poses makes one of poses",
    LandmarkMap: "without landmarks return LandmarkMap.empty()",
    DetectionLog: "DetectionJournal keeps outcomes, and DetectionLog.empty() is one without rows",
}
"""Advice to an estimator that returns something else."""


@dataclass(frozen=True)
class Candidate:
    """An estimator that is to run, with all of its settings."""

    make: Callable[..., Estimator]
    params: Section | None
    """None of a function, which makes an estimator with settings of its own."""

    def fresh(self, calibration: Calibration, odometry: MotionSource) -> Estimator:
        """An estimator that has seen nothing."""
        # a function has its settings within
        settings = () if self.params is None else (self.params,)
        estimator = self.make(calibration, odometry, *settings)
        missing = missing_of(estimator, METHODS)
        if missing:
            raise EstimatorError(
                f"what was made is {article(estimator)}, which lacks {missing} of the estimator contract"
            )
        return estimator

    def settings(self) -> dict[str, Any]:
        """Settings as plain values; empty of a function."""
        return {} if self.params is None else self.params.model_dump(mode="json")


def article(value: object) -> str:
    """Kind of a value in words: ``None``, ``a Pose3``."""
    return "None" if value is None else f"a {type(value).__name__}"


def missing_of(value: object, names: tuple[str, ...]) -> str:
    """Those of some attributes that a value lacks, as a text."""
    return ", ".join(name for name in names if not hasattr(value, name))


def returned(value: object, kind: type[Returned], method: str) -> Returned:
    """A value that a method of an estimator returned; an `EstimatorError` where it is of another kind."""
    if isinstance(value, kind):
        return value
    raise EstimatorError(
        f"{method} returned {article(value)}, not a {kind.__name__}: {INSTEAD[kind]}"
    )


def returned_estimate(value: object) -> Estimate | None:
    """A value that `Estimator.process` returned; an `EstimatorError` where it is neither an estimate nor None."""
    if value is None:
        return None
    if not isinstance(value, Estimate):
        raise EstimatorError(
            f"process returned {article(value)}, not an Estimate(stamp_ns, world_T_body, covariance) or None"
        )
    if np.shape(value.covariance) != (6, 6):
        raise EstimatorError(
            f"process returned an Estimate with a covariance of shape {np.shape(value.covariance)}; expected (6, 6), of "
            "[rotation, translation] in the axes of the body"
        )
    return value


def require_call(make: Callable[..., object], words: tuple[str, ...]) -> None:
    """Raise an `EstimatorError` where a class or function does not take these arguments, in this order."""
    try:
        call = signature(make)
    # of classes written in C
    except ValueError:
        return
    try:
        call.bind(*words)
    except TypeError as error:
        raise EstimatorError(
            f"{getattr(make, '__name__', make)}{call} is called as ({', '.join(words)}): {error}"
        ) from error


@dataclass(frozen=True)
class PlugIns:
    """Plug-ins of one kind."""

    group: str
    """Entry-point group."""
    kind: str
    """Word for one of them, in messages."""
    unknown: type[SonarGraphError]
    """Error for a name that no package or two packages have."""
    broken: type[SonarGraphError]
    """Error for a plug-in that cannot be loaded."""
    built_in: tuple[str, ...] = ()
    """Names that need no plug-in, for messages."""

    def points(self) -> dict[str, list[EntryPoint]]:
        """Entry points by name, nothing imported; two where two packages use one name."""
        found: dict[str, list[EntryPoint]] = {}
        for point in sorted(entry_points(group=self.group), key=lambda one: one.name):
            # a package that is installed twice, as in an editable install, announces the same twice
            same = found.setdefault(point.name, [])
            if point.value not in [one.value for one in same]:
                same.append(point)
        return found

    def load(self, name: str) -> tuple[Any, str]:
        """Import a plug-in; what its entry point names, and words for it in messages.

        Raises
        ------
        SonarGraphError
            As ``unknown``, listing the names that exist, or the packages that share a name; as ``broken`` with the
            reason, when the import fails.
        """
        found = self.points()
        if name not in found:
            names = [*self.built_in, *found]
            known = ", ".join(names) or "none; reinstall the package"
            raise self.unknown(
                f"no {self.kind} is called {name!r}{suggestion(name, names)} installed: {known}"
            )
        if len(found[name]) > 1:
            places = " and ".join(
                f"{point.dist.name if point.dist else 'a package'} ({point.value})"
                for point in found[name]
            )
            raise self.unknown(
                f"two packages bring {self.kind}s called {name!r}: {places}; uninstall one, or rename its entry point"
            )
        # only now is the package imported: it may take seconds, or fail
        (point,) = found[name]
        words = f"{name} ({point.value})"
        try:
            return point.load(), words
        except SystemExit as error:
            raise self.broken(
                f"{words} cannot be loaded: it calls sys.exit({error})"
            ) from error
        except Exception as error:  # the import of another's package fails in any way
            raise self.broken(f"{words} cannot be loaded: {error}") from error


ESTIMATORS = PlugIns(
    ENTRY_POINT_GROUP, "estimator", UnknownEstimatorError, EstimatorError
)


def installed_estimators() -> dict[str, EntryPoint]:
    """Entry points by name; nothing is imported. `load_estimator` refuses a name that two packages use."""
    return {name: points[0] for name, points in ESTIMATORS.points().items()}


def is_foreign(name: str) -> bool:
    """True if another package brings an estimator, whose code may change the process that loads it."""
    point = installed_estimators().get(name)
    return (
        point is not None and point.dist is not None and point.dist.name != DISTRIBUTION
    )


def name_of(estimator: EstimatorChoice) -> str:
    """Name of an estimator in results: the one under which it is installed, else that of its class or function.

    Raises
    ------
    UnknownEstimatorError
        When it is neither a name nor a class nor a function, or has no name.
    EstimatorError
        When a class does not keep the contract.
    """
    if isinstance(estimator, str):
        return estimator
    # a lambda or a partial has no name for tables
    own = getattr(estimator, "__name__", "")
    if isinstance(estimator, type):
        missing = missing_of(estimator, ("Params", *METHODS))
        if missing:
            raise EstimatorError(
                f"the class {own} lacks {missing} of the estimator contract; see help(sonar_graph.Estimator)"
            )
        require_call(estimator, ("calibration", "odometry", "params"))
        place = f"{estimator.__module__}:{own}"
        installed = installed_estimators().items()
        return next((name for name, point in installed if point.value == place), own)
    if not callable(estimator):
        raise UnknownEstimatorError(
            f"expected the name of an installed estimator, the class of one or a function that makes one, not "
            f"{estimator!r:.60}; every run makes its own: {' or '.join(map(repr, installed_estimators()))}"
        )
    if not own.isidentifier():
        raise UnknownEstimatorError(
            "a function that makes an estimator needs a name for the results: "
            "def my_filter(calibration, odometry): return ..."
        )
    require_call(estimator, ("calibration", "odometry"))
    return own


def load_estimator(name: str) -> type[Estimator]:
    """Class of an installed estimator.

    Raises
    ------
    UnknownEstimatorError
        Listing the names that exist; or the packages, where two bring an estimator of that name.
    EstimatorError
        When its package cannot be imported or does not keep the contract.

    Examples
    --------
    >>> from sonar_graph import load_estimator
    >>> load_estimator("ekf-slam").__name__
    'EkfSlam'
    """
    given: object = name
    if not isinstance(given, str):
        raise UnknownEstimatorError(
            f"expected the name of an installed estimator, not {given!r:.60}"
        )
    loaded, place = ESTIMATORS.load(name)
    missing = missing_of(loaded, ("Params", *METHODS))
    if missing:
        raise EstimatorError(f"{place} lacks {missing} of the estimator contract")
    kind: type[Estimator] = loaded
    return kind


def make_candidate(
    kind: type[Estimator] | MakeEstimator, overrides: dict[str, Any], name: str
) -> Candidate:
    """An estimator of this name with some of its settings replaced; in the form of `make_params`. A function takes none."""
    if isinstance(kind, type):
        return Candidate(kind, make_params(kind, overrides, name))
    if overrides:
        raise EstimatorError(
            f"settings of {name}: a function takes none; make the estimator with them in it"
        )
    return Candidate(kind, None)


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
