"""Laws of the estimator contract as checks that an author can run on an estimator.

Each check takes something that makes an estimator from calibration and odometry, such as its class, and raises
`ContractError` where the law is broken. With pytest::

    import pytest
    from sonar_graph.testing import CHECKS

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_my_filter_keeps_the_contract(check):
        check(MyFilter)

and without: ``check_estimator(MyFilter)``. An estimator that never iterates, such as a filter, should pass
`FILTER_CHECKS` as well. The checks bring their own worlds (`sonar_graph.testing.drives`), so that they need neither
data nor simulator.
"""

import traceback
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import EstimatorError
from sonar_graph.estimator import (
    Estimator,
    MakeEstimator,
    returned,
    returned_estimate,
)
from sonar_graph.measurements import NS_PER_S, Floats, Ints
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Trajectory
from sonar_graph.testing.drives import (
    LANDMARKS_M,
    START_NS,
    STILL_START,
    aided_world,
    every_stamp,
    misnamed_world,
    small_world,
    still_world,
)

ASK_HZ = 1.0
SYMMETRY = 1e-9
"""Largest asymmetry or negative eigenvalue of a covariance, relative to its largest entry."""


class ContractError(AssertionError):
    """An estimator breaks the contract; the message names the law.

    Examples
    --------
    >>> from sonar_graph import load_estimator
    >>> from sonar_graph.testing import ContractError, check_estimator
    >>> class Forgetful(load_estimator("dead-reckoning")):
    ...     def process(self, measurements):
    ...         return None
    >>> try:
    ...     check_estimator(Forgetful)
    ... except ContractError as error:
    ...     print(error)
    answers_from_the_first_imu_and_dvl_on: nothing is returned although there are IMU and DVL
    """


@dataclass(frozen=True, eq=False)
class EstimatorRun:
    """Output of an estimator on one sequence."""

    estimates: list[Estimate]
    trajectory: Trajectory
    landmarks: LandmarkMap
    detections: DetectionLog

    def results(self) -> dict[str, Any]:
        """All results by their names."""
        return {
            "causal estimates": Trajectory.from_estimates(self.estimates),
            "trajectory()": self.trajectory,
            "landmarks()": self.landmarks,
            "detections()": self.detections,
        }


def fresh(make: MakeEstimator, calibration: Calibration) -> Estimator:
    """Estimator that has seen nothing, with an odometry of its own."""
    return make(calibration, Odometry(calibration))


def run(
    make: MakeEstimator,
    sequence: Sequence,
    instants_ns: Ints | None = None,
    *,
    ask_every: int = 0,
) -> EstimatorRun:
    """Run a fresh estimator over a sequence, cut at the instants, and request all results at the end.

    ``ask_every``: also request them twice after every so many steps, and again at the end; 0: only at the end.
    Raises `ContractError` when two requests of the same results differ.
    """
    estimator = fresh(make, sequence.calibration)
    estimates: list[Estimate] = []
    steps = sequence.replay(
        sequence.instants(ASK_HZ) if instants_ns is None else instants_ns
    )
    for number, step in enumerate(steps, start=1):
        estimate = returned_estimate(estimator.process(step))
        estimates += [] if estimate is None else [estimate]
        # results between the steps must not change the later ones
        if ask_every and number % ask_every == 0:
            _answer_twice(estimator, estimates)
    return (
        _answer_twice(estimator, estimates)
        if ask_every
        else _answer(estimator, estimates)
    )


def _answer(estimator: Estimator, estimates: list[Estimate]) -> EstimatorRun:
    return EstimatorRun(
        estimates,
        returned(estimator.trajectory(), Trajectory, "trajectory()"),
        returned(estimator.landmarks(), LandmarkMap, "landmarks()"),
        returned(estimator.detections(), DetectionLog, "detections()"),
    )


def _answer_twice(estimator: Estimator, estimates: list[Estimate]) -> EstimatorRun:
    # a request must not change the next one either
    first = _answer(estimator, estimates)
    second = _answer(estimator, estimates)
    differing = unlike(first, second)
    require(not differing, f"asked twice, {', '.join(differing)} differ")
    return second


def unlike(one: EstimatorRun, other: EstimatorRun) -> list[str]:
    """Names of the results that differ in any bit."""
    theirs = other.results()
    return [
        name for name, mine in one.results().items() if not _is_same(mine, theirs[name])
    ]


def _is_same(mine: Any, theirs: Any) -> bool:
    """Equality of all columns to the last bit."""
    return all(
        np.array_equal(column, other, equal_nan=column.dtype.kind == "f")
        if isinstance(column, np.ndarray)
        else column == other
        for column, other in (
            (getattr(mine, field.name), getattr(theirs, field.name))
            for field in fields(mine)
        )
    )


def difference(one: EstimatorRun, other: EstimatorRun) -> float:
    """Largest difference of causal estimates at the instants of ``one``, and of landmarks at the end.

    Infinite where an instant or a landmark is missing from ``other``.
    """
    mine, theirs = _at_same_instants(one, other)
    # a missing instant or landmark is no small difference
    if len(mine) != len(theirs) or not np.array_equal(
        one.landmarks.ids, other.landmarks.ids
    ):
        return float("inf")
    pairs = (
        (_perturbation(mine, theirs), 0.0),
        (mine.covariances, theirs.covariances),
        (one.landmarks.positions, other.landmarks.positions),
    )
    return max(float(np.max(np.abs(a - b), initial=0.0)) for a, b in pairs)


def deviation(one: EstimatorRun, other: EstimatorRun) -> tuple[float, float]:
    """Largest deviation of causal poses, and of their covariances, relative to the standard deviations of ``one``.

    Infinite where an instant is missing from ``other``.
    """
    mine, theirs = _at_same_instants(one, other)
    if len(mine) != len(theirs):
        return float("inf"), float("inf")
    # in units of standard deviations: metres and radians compare
    sigmas = np.sqrt(np.einsum("nii->ni", mine.covariances))
    products = np.einsum("ni,nj->nij", sigmas, sigmas)
    of_poses = np.abs(_perturbation(mine, theirs)) / sigmas
    of_covs = np.abs(mine.covariances - theirs.covariances) / products
    return float(np.max(of_poses, initial=0.0)), float(np.max(of_covs, initial=0.0))


def _at_same_instants(
    one: EstimatorRun, other: EstimatorRun
) -> tuple[Trajectory, Trajectory]:
    wanted = {estimate.stamp_ns for estimate in one.estimates}
    theirs = [estimate for estimate in other.estimates if estimate.stamp_ns in wanted]
    return Trajectory.from_estimates(one.estimates), Trajectory.from_estimates(theirs)


def _perturbation(mine: Trajectory, theirs: Trajectory) -> Floats:
    """[rotation, translation] from one trajectory to another in the body frame of the first, shape (n, 6)."""
    if not len(mine):
        return np.empty((0, 6))
    # perturbations are in the body frame, as covariances are
    into_body = mine.rotations().inv()
    turn = (into_body * theirs.rotations()).as_rotvec()
    return np.hstack([turn, into_body.apply(theirs.positions - mine.positions)])


def require(kept: bool, violation: str) -> None:
    """Raise `ContractError` unless ``kept``."""
    if not kept:
        raise ContractError(violation)


def require_covariance(matrix: Floats, size: int, name: str) -> None:
    """Raise `ContractError` unless finite, symmetric, positive semi-definite, shape (size, size)."""
    require(
        matrix.shape == (size, size),
        f"{name}: shape {matrix.shape}, not {(size, size)}",
    )
    require(bool(np.isfinite(matrix).all()), f"{name} is not finite")
    # rounding grows with the largest entry
    scale = float(np.abs(matrix).max())
    asymmetry = float(np.abs(matrix - matrix.T).max())
    require(asymmetry <= SYMMETRY * scale, f"{name} is not symmetric: {asymmetry:.1e}")
    least = float(np.linalg.eigvalsh(matrix).min())
    require(
        least >= -SYMMETRY * scale, f"{name} has a negative eigenvalue: {least:.1e}"
    )


Check = Callable[[MakeEstimator], None]
STILL_DRIFT_M = 0.02
STILL_TURN_RAD = 2e-3
SAME = 1e-6
LIVE_SIGMAS = 1.0
LIVE_COVARIANCE = 0.25


def settings_have_defaults(make: MakeEstimator) -> None:
    """``Params()`` can be made without arguments, and a class takes them after calibration and odometry."""
    calibration = small_world().calibration
    try:
        # by an instance: a function has no Params
        params = fresh(make, calibration).Params()
        if isinstance(make, type):
            make(calibration, Odometry(calibration), params)
    except Exception as error:
        raise ContractError(
            f"Params(), or make(calibration, odometry, params), fails: {error}"
        ) from error


def knows_nothing_before_the_first_measurement(make: MakeEstimator) -> None:
    """A fresh estimator has no pose, no landmark and no detection."""
    answer = _answer(fresh(make, small_world().calibration), [])
    sizes = (len(answer.trajectory), len(answer.landmarks), len(answer.detections))
    require(
        sizes == (0, 0, 0),
        f"a fresh estimator has {sizes} poses, landmarks, detections",
    )


def answers_from_the_first_imu_and_dvl_on(make: MakeEstimator) -> None:
    """`process` returns None before there is an IMU and a DVL sample, and afterwards an estimate at ``end_ns``."""
    # for the first second there is no velocity
    world = small_world(dvl_delay_s=1.0)
    estimator = fresh(make, world.calibration)
    instants = np.arange(START_NS + NS_PER_S // 4, world.end_ns, NS_PER_S // 4)
    for step in world.replay(instants):
        estimate = returned_estimate(estimator.process(step))
        # at the very start either is right
        if step.end_ns < world.start_ns:
            require(
                estimate is None, "an estimate is returned before the first DVL sample"
            )
        elif step.end_ns > world.start_ns:
            if estimate is None:
                raise ContractError(
                    "nothing is returned although there are IMU and DVL"
                )
            require(
                estimate.stamp_ns == step.end_ns,
                f"asked for {step.end_ns}, answered for {estimate.stamp_ns}",
            )


def covariances_are_covariances(make: MakeEstimator) -> None:
    """Covariances of poses and landmarks are finite, symmetric, positive semi-definite, 6 × 6 and 3 × 3."""
    outcome = run(make, aided_world())
    for estimate in outcome.estimates:
        require_covariance(estimate.covariance, 6, "covariance of an estimate")
    for covariance in outcome.trajectory.covariances:
        require_covariance(covariance, 6, "covariance in trajectory()")
    for covariance in outcome.landmarks.covariances:
        require_covariance(covariance, 3, "covariance in landmarks()")


def trajectory_has_the_instants_of_the_estimates(make: MakeEstimator) -> None:
    """`trajectory` has one pose for each instant at which `process` returned an estimate."""
    outcome = run(make, small_world())
    asked = [estimate.stamp_ns for estimate in outcome.estimates]
    require(
        outcome.trajectory.stamps_ns.tolist() == asked,
        "the stamps of trajectory() are not those of the estimates",
    )


def frames_and_signs_are_those_of_the_vocabulary(make: MakeEstimator) -> None:
    """In a world with little noise the estimate stays with the truth, and so do the landmarks.

    Their height is left out: elevation is not measured.
    """
    for world in (small_world(), aided_world()):
        outcome = run(make, world)
        assert world.truth is not None
        assert world.true_landmarks is not None
        # noise is small: a wrong sign or frame drives much farther away
        truth = world.truth.at(outcome.trajectory.stamps_ns)
        off_m = np.linalg.norm(outcome.trajectory.positions - truth.positions, axis=1)
        require(
            off_m.max() < 0.3,
            f"{world.name}: the trajectory leaves the truth by {off_m.max():.2f} m",
        )
        # an estimator may map none of them
        known = np.isin(world.true_landmarks.ids, outcome.landmarks.ids)
        if known.any():
            true = world.true_landmarks.positions[known]
            off_m = np.hypot(*(outcome.landmarks.positions - true)[:, :2].T)
            require(
                off_m.max() < 0.5,
                f"{world.name}: a landmark is {off_m.max():.2f} m from the truth, horizontally",
            )


def landmarks_are_sorted_and_unique(make: MakeEstimator) -> None:
    """Identities in `landmarks` ascend, and are among those that were detected."""
    found = run(make, small_world()).landmarks
    require(
        bool(np.all(np.diff(found.ids) > 0)),
        f"landmark ids do not ascend strictly: {found.ids.tolist()}",
    )
    # an identity that was never detected is invented
    strangers = set(found.ids.tolist()) - set(LANDMARKS_M)
    require(not strangers, f"landmarks that nobody detected: {sorted(strangers)}")
    require(
        found.positions.shape == (len(found), 3),
        f"positions of landmarks have shape {found.positions.shape}",
    )


def every_detection_has_an_outcome(make: MakeEstimator) -> None:
    """`detections` has one row for each detection that was handed in, at its stamp."""
    world = small_world()
    assert world.detections is not None
    log = run(make, world).detections
    given = world.detections.stamps_ns.tolist()
    told = sorted(log.stamps_ns.tolist())
    require(
        told == given,
        f"{len(given)} detections were given, {len(told)} are accounted for",
    )
    rows = {
        len(log.outcomes),
        len(log.landmark_ids),
        len(log.innovations),
        len(log.innovation_covs),
    }
    require(
        rows == {len(given)}, f"the columns of detections() have {sorted(rows)} rows"
    )


def same_input_gives_same_output(make: MakeEstimator) -> None:
    """Two estimators that are fed alike agree to the last bit."""
    first = run(make, small_world())
    second = run(make, small_world())
    require(
        difference(first, second) == 0.0, "two runs on the same measurements differ"
    )


def asking_changes_nothing(make: MakeEstimator) -> None:
    """Trajectory, landmarks and detections may be requested at any time, and twice: not a bit of anything changes.

    Also where identities are wrong or missing, and an estimator may revise them at a request.
    """
    # often and seldom, with right and wrong identities
    for world, every in (
        (aided_world(), 1),
        (misnamed_world(), 3),
        (misnamed_world(is_tracked=True), 7),
    ):
        differing = unlike(run(make, world), run(make, world, ask_every=every))
        require(
            not differing,
            f"asking after every {every} steps changes {', '.join(differing)}",
        )


def live_agrees_with_replay(make: MakeEstimator) -> None:
    """Rows that arrive one by one and rows that arrive in windows lead to estimates that agree within their sigmas.

    An estimator that iterates may linearise elsewhere when it is called more often. A deviation beyond a standard
    deviation, or another covariance, shows that something was counted twice or lost.
    """
    world = aided_world()
    windows = run(make, world)
    live = run(make, world, every_stamp(world))
    # where it linearises differs, what it counts must not
    mean, covariance = deviation(windows, live)
    require(
        mean < LIVE_SIGMAS,
        f"cut row by row the estimate moves by {mean:.2f} of its standard deviation",
    )
    require(
        covariance < LIVE_COVARIANCE,
        f"cut row by row the covariance changes by {covariance:.0%}",
    )


def live_equals_replay(make: MakeEstimator) -> None:
    """Rows that arrive one by one give the same result to rounding; for estimators that never iterate."""
    world = aided_world()
    differ = difference(run(make, world), run(make, world, every_stamp(world)))
    require(differ < SAME, f"cut row by row the outcome differs by {differ:.1e}")


def input_stays_as_it_was(make: MakeEstimator) -> None:
    """No array of the measurements is written to."""
    world = aided_world()
    # the same world, made again
    untouched = aided_world()
    run(make, world)
    for name, block in world.blocks().items():
        for column, before in vars(untouched.blocks()[name]).items():
            same = np.array_equal(getattr(block, column), before, equal_nan=True)
            require(same, f"{type(block).__name__}.{column} was changed")


def still_vehicle_stays_still(make: MakeEstimator) -> None:
    """A tilted vehicle at rest, whose IMU measures gravity alone, has not moved after 60 s."""
    estimates = run(make, still_world()).estimates
    start = STILL_START.pose()
    for estimate in estimates:
        # gravity and Earth's rate are the only motions that it could make up
        moved = start.between(estimate.world_T_body)
        drift_m = float(np.linalg.norm(moved.translation()))
        turn_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(moved.rotation())))
        require(drift_m < STILL_DRIFT_M, f"a still vehicle drifts by {drift_m:.3f} m")
        require(
            turn_rad < STILL_TURN_RAD, f"a still vehicle turns by {turn_rad:.4f} rad"
        )


FILTER_CHECKS: tuple[Check, ...] = (live_equals_replay,)
"""Further demands on estimators that never iterate."""
CHECKS: tuple[Check, ...] = (
    settings_have_defaults,
    knows_nothing_before_the_first_measurement,
    answers_from_the_first_imu_and_dvl_on,
    covariances_are_covariances,
    trajectory_has_the_instants_of_the_estimates,
    frames_and_signs_are_those_of_the_vocabulary,
    landmarks_are_sorted_and_unique,
    every_detection_has_an_outcome,
    same_input_gives_same_output,
    asking_changes_nothing,
    live_agrees_with_replay,
    input_stays_as_it_was,
    still_vehicle_stays_still,
)


def check_estimator(make: MakeEstimator) -> None:
    """Run every check of `CHECKS` on an estimator.

    Parameters
    ----------
    make
        Makes an estimator from a calibration and an odometry; the class of an estimator does.

    Raises
    ------
    ContractError
        At the first check that fails, with its name; also where the estimator itself raises.

    Examples
    --------
    >>> from sonar_graph import load_estimator
    >>> from sonar_graph.testing import check_estimator
    >>> check_estimator(load_estimator("dead-reckoning"))
    """
    for check in CHECKS:
        try:
            check(make)
        except (ContractError, EstimatorError) as violation:
            raise ContractError(f"{check.__name__}: {violation}") from violation
        except Exception as error:
            raise ContractError(f"{check.__name__}: {_cause(error)}") from error


def _cause(error: Exception) -> str:
    """What an estimator raised, and in which line."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}, line {place.lineno}"
    is_of_none = "NoneType" in str(error)
    advice = "; any block of Measurements may be None" if is_of_none else ""
    return f"the estimator raised {type(error).__name__}: {error} ({where}){advice}"
