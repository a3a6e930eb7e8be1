"""A run of one estimator over one sequence: replayed, timed, checked. A failure is a result with a reason.

Only calls of the estimator are timed. Results are checked before they are scored. See docs/design/0007.
"""

import contextlib
import copy
import logging
import math
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import KnownMap
from sonar_graph.errors import (
    EstimatorError,
    EvaluationError,
    SonarGraphError,
    UnknownEstimatorError,
)
from sonar_graph.estimator import (
    Candidate,
    Estimator,
    EstimatorChoice,
    is_foreign,
    known_map_of,
    load_estimator,
    make_candidate,
    name_of,
    refused_rows_of,
    returned,
    returned_estimate,
    withheld_of,
)
from sonar_graph.evaluation.free_start import free_start
from sonar_graph.evaluation.results import MapSoFar, RunResult
from sonar_graph.evaluation.scored_instants import kept_map_instants
from sonar_graph.files import KilledError, OwnProcess, Tell, noticed_interrupts, serve
from sonar_graph.map_file import map_origin
from sonar_graph.measurements import Floats, Ints, Measurements
from sonar_graph.sequence import Sequence, require_sequence
from sonar_graph.states import (
    DetectionLog,
    Estimate,
    LandmarkMap,
    RefusedRow,
    Trajectory,
)

Flags = NDArray[np.bool_]
LOG = logging.getLogger(__name__)
STATUS = Path("/proc/self/status")
CLEAR_REFS = Path("/proc/self/clear_refs")
# written to `CLEAR_REFS` it resets Linux's high-water mark of resident memory
RESET_PEAK = "5"
# an eigenvalue may be this far below zero, as a fraction of the largest: rounding
NEGATIVE_TOLERANCE = 1e-9
# largest number of characters of a reason: one line that a table can hold
REASON_WIDTH = 400
WARM_UP_STEPS = 20
# steps given to the instance that warms up: without and with detections to wait for
MAX_WARM_UP_STEPS = 200
# landmarks up to which a run keeps their joint covariance: its size grows with their square
MOST_MAPPED = 100
# steps with a landmark that can be named: it is begun, waited for, and seen again
WARM_UP_FRAMES = 4


class PeakMemory:
    """Highest resident memory of this process from now on, above what is resident now.

    Known on Linux only, for the whole process: memory that an earlier run left free for reuse is not counted again, and
    caches that fill meanwhile are. It shows orders of magnitude, not kilobytes.
    """

    def __init__(self) -> None:
        self._start_mb = math.nan
        # a kernel without this file, or a container that forbids it, has no high-water mark to reset
        with contextlib.suppress(OSError):
            CLEAR_REFS.write_text(RESET_PEAK)
            self._start_mb = _status_mb("VmRSS")

    def rise_mb(self) -> float:
        """Megabytes (10⁶ bytes) at the peak above the start; NaN where the system does not measure it."""
        if math.isnan(self._start_mb):
            return math.nan
        # caches that the system took back make the difference negative
        return max(_status_mb("VmHWM") - self._start_mb, 0.0)


def _status_mb(field: str) -> float:
    """A field of the process's status, given there in kibibytes."""
    for line in STATUS.read_text().splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1]) * 1024 / 1e6
    return math.nan


def check_outcome(
    causal: Trajectory, smoothed: Trajectory, landmarks: LandmarkMap
) -> None:
    """Refuse results that cannot be scored.

    Raises `EvaluationError` when the smoothed trajectory lacks instants of the causal one; a pose or landmark is not finite;
    a covariance is neither unknown (all NaN) nor symmetric and positive semidefinite.
    """
    # scores compare both paths instant by instant; while a start is looked for, there are smoothed poses only
    missing = np.setdiff1d(causal.stamps_ns, smoothed.stamps_ns)
    if len(missing):
        raise EvaluationError(
            f"trajectory() lacks {len(missing)} of the {len(causal)} instants for which process returned estimates"
        )
    # one look at all numbers of a pose: a NaN in the rotation spoils every score too
    poses = [np.c_[one.positions, one.quaternions_xyzw] for one in (causal, smoothed)]
    for what, bad, unit, labels in (
        ("causal pose is not finite", _not_finite(poses[0]), "ns", causal.stamps_ns),
        ("causal covariance is impossible", _impossible(causal.covariances), "ns", causal.stamps_ns),
        ("smoothed pose is not finite", _not_finite(poses[1]), "ns", smoothed.stamps_ns),
        ("smoothed covariance is impossible", _impossible(smoothed.covariances), "ns", smoothed.stamps_ns),
        ("position is not finite", _not_finite(landmarks.positions), "landmark", landmarks.ids),
        ("covariance is impossible", _impossible(landmarks.covariances), "landmark", landmarks.ids),
    ):  # fmt: skip
        rows = np.flatnonzero(bad)
        if rows.size:
            raise EvaluationError(
                f"{what} in {rows.size} of {len(bad)} rows, first at {unit} {labels[rows[0]]}"
            )


def _not_finite(rows: Floats) -> Flags:
    return np.asarray(~np.all(np.isfinite(rows), axis=1))


def _impossible(covs: Floats) -> Flags:
    """Flags of covariances, shape (n, d, d), that are partly NaN, infinite, asymmetric or not positive semidefinite."""
    # NaN stands for an unreported covariance, which is no fault
    unknown = np.isnan(covs).all(axis=(1, 2))
    finite = np.asarray(np.isfinite(covs).all(axis=(1, 2)))
    # eigvalsh fails for NaN; rows that are not finite are refused all the same, by `finite` below
    filled = np.where(finite[:, None, None], covs, 0.0)
    # tolerances are relative: covariances of centimetres and of kilometres are judged alike
    size = np.abs(filled).max(axis=(1, 2), initial=0.0)
    asymmetry = np.abs(filled - filled.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    smallest = np.linalg.eigvalsh(filled)[:, 0]
    is_symmetric = asymmetry <= 1e-6 * size
    sound = finite & is_symmetric & (smallest >= -NEGATIVE_TOLERANCE * size)
    return np.asarray(~(unknown | sound))


def run_estimator(
    sequence: Sequence,
    estimator: EstimatorChoice,
    overrides: dict[str, Any] | None = None,
    *,
    instants_ns: Ints | None = None,
    rate_hz: float = 2.0,
    interim_maps: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> RunResult:
    """Replay a sequence into an estimator and keep its estimates, with the duration of each call.

    The log is cut into steps before the clock starts, and a second instance of the estimator takes the first of them,
    so that first calls are not counted; time in which numba compiles later is taken off. Only calls of the estimator
    are timed. The map is kept at `kept_map_instants`; asking for it before the end is not timed. The estimator gets a
    copy of the measurements, so that one that changes them does not change those of the next. One of another package
    runs in a process of its own: what it does to numpy, the working folder or the environment stays there. A class or
    function runs in this process.

    Parameters
    ----------
    estimator
        Name under which an estimator is installed; the class of one; or a function ``make(calibration, odometry)``
        that returns one, for settings that are no numbers. Results have the name of the class or function.
    overrides
        Settings that differ from the estimator's defaults, by dotted name: ``{"identity.policy": "gate"}``.
    instants_ns
        Stamps of the estimates, increasing; None: ``sequence.instants(rate_hz)``.
    interim_maps
        True to keep the map before the end too. For a smoother each costs a solution of the whole history.
    progress
        Called after each step with the number of steps done and their total.

    Returns
    -------
    A run whose status is ``failed`` when the estimator cannot be loaded, raises anything, or returns results that
    cannot be scored (see `check_outcome`).

    Raises
    ------
    UnknownEstimatorError
        When no estimator has that name, or two packages bring one.
    EstimatorError
        When a setting does not exist or does not fit, or a class does not keep the contract.
    ArgumentError
        When `sequence` is no `Sequence`, such as the path of a log.

    Examples
    --------
    >>> from sonar_graph.evaluation import run_estimator
    >>> from sonar_graph.simulation import MissionOptions, simulate_mission
    >>> run = run_estimator(simulate_mission(MissionOptions(duration_s=10.0)), "dead-reckoning")
    >>> run.status, len(run.causal), run.causal.positions.shape
    ('ok', 20, (20, 3))
    """
    require_sequence(sequence, "run_estimator(sequence, estimator)")
    name = name_of(estimator)
    # the caller gives instants where several estimators must have the same ones
    instants = sequence.instants(rate_hz) if instants_ns is None else instants_ns
    # code of another package may change numpy, the folder or the environment of this process
    if isinstance(estimator, str) and is_foreign(name):
        request = _Request(name, overrides or {}, sequence, instants, interim_maps)
        try:
            result: RunResult = _asked(request, progress)
        except KilledError as error:
            return _unrun(name, overrides, str(error))
        return result
    return run_here(
        sequence,
        estimator,
        overrides,
        instants,
        interim_maps=interim_maps,
        progress=progress,
    )


def run_here(
    sequence: Sequence,
    estimator: EstimatorChoice,
    overrides: dict[str, Any] | None,
    instants_ns: Ints,
    *,
    interim_maps: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> RunResult:
    """Do a run in this process, also of an estimator of another package; otherwise as `run_estimator`."""
    name = name_of(estimator)
    candidate = _candidate(estimator, overrides)
    if isinstance(candidate, EstimatorError):
        return _unrun(name, overrides, one_line(candidate))
    # an estimator may write into the arrays that it gets, which the next one needs unchanged
    steps = list(copy.deepcopy(sequence).replay(instants_ns))
    replay = _Replay(sequence, steps, name, candidate, interim_maps=interim_maps)
    return replay.run(progress)


def _unrun(name: str, overrides: dict[str, Any] | None, reason: str) -> RunResult:
    return RunResult(name, dict(overrides or {}), "failed", reason)


def _candidate(
    estimator: EstimatorChoice, overrides: dict[str, Any] | None
) -> Candidate | EstimatorError:
    """The estimator with its settings, or why an installed one cannot be loaded; raises for mistakes of the user."""
    try:
        kind = load_estimator(estimator) if isinstance(estimator, str) else estimator
    except UnknownEstimatorError:
        raise
    except EstimatorError as error:
        return error
    return make_candidate(kind, overrides or {}, name_of(estimator))


def check_request(
    estimator: EstimatorChoice,
    overrides: dict[str, Any] | None = None,
    *,
    is_apart: bool = False,
) -> dict[str, Any] | None:
    """All settings of an estimator with some replaced; None where it cannot be loaded, and its run will fail.

    Raises for a name or setting that does not exist, as `run_estimator` does, without running anything.
    """
    if not is_apart and isinstance(estimator, str) and is_foreign(estimator):
        try:
            return _asked(_Request(estimator, overrides or {}))
        except KilledError:
            return None
    candidate = _candidate(estimator, overrides)
    return None if isinstance(candidate, EstimatorError) else candidate.settings()


@dataclass(frozen=True)
class _Request:
    """Request to a process of its own: a run, or without a sequence only the settings."""

    name: str
    overrides: dict[str, Any]
    sequence: Sequence | None = None
    instants_ns: Ints | None = None
    interim_maps: bool = True
    path: list[str] = field(default_factory=lambda: list(sys.path))


def _asked(
    request: _Request, progress: Callable[[int, int], None] | None = None
) -> Any:
    """The answer of a process of its own; a `KilledError` where that ended without one."""
    process = OwnProcess(
        ("-c", "from sonar_graph.evaluation.run import serve_runs; serve_runs()")
    )
    try:
        process.answer()  # that it is ready
        process.send(request)
        while isinstance(answer := process.answer(), _StepsDone):
            if progress:
                progress(*answer)
        return None if answer == NOTHING else answer
    finally:
        process.end()


class _StepsDone(NamedTuple):
    done: int
    total: int


NOTHING = "nothing"


def serve_runs() -> None:
    """Answer requests for runs and settings until stdin ends."""
    serve(_answer)


def _answer(request: _Request, tell: Tell) -> object:
    """In a process of its own: do a run, or give the settings of one."""
    # the estimator may be importable only through the path of the calling process
    sys.path[:] = request.path
    if request.sequence is None:
        return check_request(request.name, request.overrides, is_apart=True) or NOTHING
    assert request.instants_ns is not None, "a run has instants"
    return run_here(
        request.sequence,
        request.name,
        request.overrides,
        request.instants_ns,
        interim_maps=request.interim_maps,
        progress=lambda done, total: tell(_StepsDone(done, total)),
    )


class _Replay:
    """A run in progress: estimates and maps until now, and the duration of each call."""

    def __init__(
        self,
        sequence: Sequence,
        steps: list[Measurements],
        name: str,
        candidate: Candidate,
        *,
        interim_maps: bool,
    ) -> None:
        self._sequence = sequence
        self._steps = steps
        self._name = name
        self._candidate = candidate
        self._estimates: list[Estimate] = []
        self._update_s: list[float] = []
        ends_ns = np.array([step.end_ns for step in steps], dtype=np.int64)
        # the last map is the one of `_finish`
        interim_ns = kept_map_instants(ends_ns, sequence.start_ns).tolist()[:-1]
        self._map_at_ns = set(interim_ns if interim_maps else [])
        self._maps: list[MapSoFar] = []
        # the reason of a failure names where the run was
        self._stage = "at the start"
        self._check_interrupt: Callable[[], None]

    def run(self, progress: Callable[[int, int], None] | None) -> RunResult:
        """Everything from construction to the final map."""
        with noticed_interrupts() as self._check_interrupt:
            result = self._run(progress)
            self._check_interrupt()
            return result

    def _run(self, progress: Callable[[int, int], None] | None) -> RunResult:
        self._warm_up()
        self._check_interrupt()
        memory = PeakMemory()
        estimator = None
        try:
            estimator = self._fresh()
            self._process(estimator, progress)
            return self._finish(estimator, memory)
        except (
            Exception,
            SystemExit,
        ) as error:  # an estimator may fail in any way, and the others still run
            # the table has one line; whoever mends the estimator needs the traceback
            LOG.info("%s failed %s", self._name, self._stage, exc_info=True)
            known: dict[str, Any] = {}  # rows refused before are often why it failed
            if estimator is not None:
                with contextlib.suppress(Exception):
                    known["refused"] = self._refused(estimator)
                with contextlib.suppress(Exception):
                    known["withheld"] = withheld_of(estimator)
            reason = f"{self._stage}: {one_line(error)}"
            return self._result(
                "failed", reason, **known, peak_memory_mb=memory.rise_mb()
            )

    def _fresh(self) -> Estimator:
        """The estimator, with an odometry of its own."""
        # loads numba, which a result does not need
        from sonar_graph.navigation import make_estimator

        # each estimator needs an odometry of its own, since an odometry has a state
        return make_estimator(self._candidate.fresh, self._sequence.calibration)

    def _warm_up(self) -> None:
        """Let an estimator that is thrown away compile its code, until landmarks were seen again."""
        # code for a landmark that is seen again runs only after a detection that names one; others are refused
        named = [
            i
            for i, step in enumerate(self._steps)
            if step.detections and step.detections.most_probable()[1].max() > 0.5
        ]
        last = named[min(len(named), WARM_UP_FRAMES) - 1] if named else WARM_UP_STEPS
        with contextlib.suppress(
            Exception, SystemExit
        ):  # what fails here fails again below, where it is reported
            estimator = self._fresh()
            for step in self._steps[: min(last, MAX_WARM_UP_STEPS) + 1]:
                # an estimator may change the step, which the run needs as it was
                estimator.process(copy.deepcopy(step))
                self._check_interrupt()

    def _process(
        self, estimator: Estimator, progress: Callable[[int, int], None] | None
    ) -> None:
        # loads numba, which an estimator needs and a result does not
        from sonar_graph.numerics import compiling_s

        for done, step in enumerate(self._steps, start=1):
            end_ns = step.end_ns
            self._stage = f"{(end_ns - self._sequence.start_ns) * 1e-9:.3f} s after the start ({end_ns} ns)"
            # the clock without the time that numba has compiled until now
            before = time.perf_counter() - compiling_s()
            estimate = estimator.process(step)
            # a loop that numba compiles on its first call is no time of the estimator
            self._update_s.append(time.perf_counter() - compiling_s() - before)
            self._check_interrupt()
            # None is allowed: a smoother may wait before its first estimate
            estimate = returned_estimate(estimate)
            if estimate is not None:
                if estimate.stamp_ns != end_ns:
                    raise EvaluationError(
                        f"process returned an estimate for {estimate.stamp_ns} ns when asked for {end_ns} ns"
                    )
                self._estimates.append(estimate)
                if end_ns in self._map_at_ns:
                    landmarks = estimator.landmarks()
                    returned(landmarks, LandmarkMap, "landmarks()")
                    self._maps.append(MapSoFar(end_ns, landmarks))
            if progress:
                progress(done, len(self._steps))

    def _finish(self, estimator: Estimator, memory: PeakMemory) -> RunResult:
        from sonar_graph.numerics import compiling_s

        self._stage = "at the end, asked for trajectory and map"
        before = time.perf_counter() - compiling_s()
        # timed together with the map: a smoother solves once for both
        smoothed = estimator.trajectory()
        landmarks = estimator.landmarks()
        finish_s = time.perf_counter() - compiling_s() - before
        peak_memory_mb = memory.rise_mb()
        detections = estimator.detections()
        self._stage = "at the end, outcome checked"
        known: dict[str, Any] = {
            "refused": self._refused(estimator),
            "peak_memory_mb": peak_memory_mb,
        }
        withheld = withheld_of(estimator)
        reasons = "; ".join(withheld)
        if not self._estimates and reasons:
            # no fault of the estimator: it says what it lacks
            return self._result("failed", reasons, **known)
        if not self._estimates:
            raise EvaluationError("process never returned an estimate")
        returned(smoothed, Trajectory, "trajectory()")
        if not len(smoothed) and reasons:
            raise EvaluationError(f"it took all its poses back: {reasons}")
        returned(landmarks, LandmarkMap, "landmarks()")
        returned(detections, DetectionLog, "detections()")
        causal = Trajectory.from_estimates(self._estimates)
        check_outcome(causal, smoothed, landmarks)
        # the last map is the final one, which costs nothing more
        self._maps.append(MapSoFar(int(causal.stamps_ns[-1]), landmarks))
        return self._result(
            "ok",
            causal=causal,
            smoothed=smoothed,
            landmarks=landmarks,
            known_map=self._known_map(estimator, landmarks),
            detections=detections,
            withheld=withheld,
            maps=self._maps,
            finish_s=finish_s,
            **known,
        )

    def _known_map(
        self, estimator: Estimator, landmarks: LandmarkMap
    ) -> KnownMap | None:
        """The landmarks with their joint covariance and their origin; None of too many."""
        if not 0 < len(landmarks) <= MOST_MAPPED:
            return None
        # a filter that diverged has a covariance that no map can hold; the run itself still counts
        with contextlib.suppress(SonarGraphError):
            known = known_map_of(estimator)
            source = f"{map_origin(self._sequence)}, {self._name}"
            calibration = self._sequence.calibration
            given = calibration.map
            has_own_world = free_start(calibration)[1]
            if given is not None:
                source += f", in the map of {given.source or 'no stated source'}"
                has_own_world = given.has_own_world
            origin = {"source": source, "has_own_world": has_own_world}
            return known.model_copy(update=origin)
        return None

    def _refused(self, estimator: Estimator) -> list[RefusedRow]:
        """Rows that the replay left out, and those that the estimator names."""
        return [*self._sequence.off_the_clock(), *refused_rows_of(estimator)]

    def _result(self, status: Any, reason: str = "", **outcome: Any) -> RunResult:
        return RunResult(
            self._name,
            self._candidate.settings(),
            status,
            reason,
            update_s=np.array(self._update_s),
            **outcome,
        )


def one_line(error: BaseException) -> str:
    """The exception's type and message without line breaks."""
    if isinstance(error, SystemExit):
        # the exception has no message of its own
        return f"it called sys.exit({error})"
    return textwrap.shorten(
        f"{type(error).__name__}: {error}", REASON_WIDTH, placeholder=" ..."
    )
