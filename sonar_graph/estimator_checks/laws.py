"""The laws of the contract, one function each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.estimator_checks.outcome import (
    ContractError,
    MakeEstimator,
    deviation,
    difference,
    require,
    require_covariance,
    run,
    unlike,
)
from sonar_graph.estimator_checks.world import (
    DURATION_S,
    LANDMARKS_M,
    START_NS,
    STILL_START,
    blocks,
    every_stamp,
    misnamed_world,
    small_world,
    still_world,
)
from sonar_graph.sequence import NS_PER_S
from sonar_graph.states import Estimate

Check = Callable[[MakeEstimator], None]

STILL_DRIFT_M = 0.02
STILL_TURN_RAD = 2e-3
SAME = 1e-6
LIVE_SIGMAS = 1.0
LIVE_COVARIANCE = 0.25


def settings_have_defaults(make: MakeEstimator) -> None:
    """``Params()`` can be made without arguments."""
    try:
        make(small_world().calibration).Params()
    except Exception as error:
        raise ContractError(f"Params() fails: {error}") from error


def knows_nothing_before_the_first_measurement(make: MakeEstimator) -> None:
    """A fresh estimator has no pose, no landmark and no detection."""
    estimator = make(small_world().calibration)
    sizes = len(estimator.trajectory()), len(estimator.landmarks()), len(estimator.detections())
    require(sizes == (0, 0, 0), f"a fresh estimator has {sizes} poses, landmarks, detections")


def answers_from_the_first_imu_and_dvl_on(make: MakeEstimator) -> None:
    """`process` returns None before there is an IMU and a DVL sample, and afterwards an estimate at ``end_ns``."""
    world = small_world(dvl_delay_s=1.0)
    estimator = make(world.calibration)
    instants = np.arange(START_NS + NS_PER_S // 4, world.end_ns, NS_PER_S // 4)
    for step in world.replay(instants):
        estimate = estimator.process(step)
        if step.end_ns < world.start_ns:
            require(estimate is None, "an estimate is returned before the first DVL sample")
        elif step.end_ns > world.start_ns:
            _require_answer(estimate, step.end_ns)


def _require_answer(estimate: Estimate | None, end_ns: int) -> None:
    if estimate is None:
        raise ContractError("nothing is returned although there are IMU and DVL")
    require(isinstance(estimate, Estimate), f"{type(estimate).__name__} is returned, not an Estimate")
    require(estimate.stamp_ns == end_ns, f"asked for {end_ns}, answered for {estimate.stamp_ns}")


def covariances_are_covariances(make: MakeEstimator) -> None:
    """Covariances of poses and landmarks are finite, symmetric, positive semi-definite, 6 × 6 and 3 × 3."""
    outcome = run(make, small_world())
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
    require(outcome.trajectory.stamps_ns.tolist() == asked, "the stamps of trajectory() are not those of the estimates")


def frames_and_signs_are_those_of_the_vocabulary(make: MakeEstimator) -> None:
    """In a world with little noise the estimate stays with the truth, and so do the landmarks.

    Their height is left out: elevation is not measured.
    """
    world = small_world()
    outcome = run(make, world)
    assert world.truth is not None
    assert world.true_landmarks is not None
    off_m = np.linalg.norm(
        outcome.trajectory.positions - world.truth.at(outcome.trajectory.stamps_ns).positions, axis=1
    )
    require(off_m.max() < 0.3, f"the trajectory leaves the truth by {off_m.max():.2f} m in {DURATION_S} s")
    known = np.isin(world.true_landmarks.ids, outcome.landmarks.ids)
    if not known.any():
        return
    off_m = np.linalg.norm((outcome.landmarks.positions - world.true_landmarks.positions[known])[:, :2], axis=1)
    require(off_m.max() < 0.5, f"a landmark is {off_m.max():.2f} m from the truth, horizontally")


def landmarks_are_sorted_and_unique(make: MakeEstimator) -> None:
    """Identities in `landmarks` ascend, and are among those that were detected."""
    found = run(make, small_world()).landmarks
    require(bool(np.all(np.diff(found.ids) > 0)), f"landmark ids do not ascend strictly: {found.ids.tolist()}")
    strangers = set(found.ids.tolist()) - set(LANDMARKS_M)
    require(not strangers, f"landmarks that nobody detected: {sorted(strangers)}")
    require(found.positions.shape == (len(found), 3), f"positions of landmarks have shape {found.positions.shape}")


def every_detection_has_an_outcome(make: MakeEstimator) -> None:
    """`detections` has one row for each detection that was handed in, at its stamp."""
    world = small_world()
    assert world.detections is not None
    log = run(make, world).detections
    given, told = world.detections.stamps_ns.tolist(), sorted(log.stamps_ns.tolist())
    require(told == given, f"{len(given)} detections were given, {len(told)} are accounted for")
    rows = {len(log.outcomes), len(log.landmark_ids), len(log.innovations), len(log.innovation_covs)}
    require(rows == {len(given)}, f"the columns of detections() have {sorted(rows)} rows")


def same_input_gives_same_output(make: MakeEstimator) -> None:
    """Two estimators that are fed alike agree to the last bit."""
    first, second = run(make, small_world()), run(make, small_world())
    require(difference(first, second) == 0.0, "two runs on the same measurements differ")


def asking_changes_nothing(make: MakeEstimator) -> None:
    """Trajectory, landmarks and detections may be asked for at any time, and twice: not a bit of anything changes.

    Also where identities are wrong, or missing, and an estimator may think better of them when it is asked.
    """
    for world, every in ((small_world(), 1), (misnamed_world(), 3), (misnamed_world(is_tracked=True), 7)):
        differing = unlike(run(make, world), run(make, world, ask_every=every))
        require(not differing, f"asking after every {every} steps changes {', '.join(differing)}")


def live_agrees_with_replay(make: MakeEstimator) -> None:
    """Rows that arrive one by one and rows that arrive in windows lead to estimates within each other's doubt.

    An estimator that iterates may linearise elsewhere when it is called more often. It may not count anything twice,
    nor lose it: a deviation beyond its standard deviation, or another covariance, comes from that.
    """
    world = small_world()
    windows, live = run(make, world), run(make, world, every_stamp(world))
    mean, covariance = deviation(windows, live)
    require(mean < LIVE_SIGMAS, f"cut row by row the estimate moves by {mean:.2f} of its standard deviation")
    require(covariance < LIVE_COVARIANCE, f"cut row by row the covariance changes by {covariance:.0%}")


def live_equals_replay(make: MakeEstimator) -> None:
    """The same to rounding: for estimators that never iterate, such as filters."""
    world = small_world()
    differ = difference(run(make, world), run(make, world, every_stamp(world)))
    require(differ < SAME, f"cut row by row the outcome differs by {differ:.1e}")


def input_stays_as_it_was(make: MakeEstimator) -> None:
    """No array of the measurements is written to."""
    world, untouched = small_world(), small_world()
    run(make, world)
    for block, before in zip(blocks(world), blocks(untouched), strict=True):
        for field in fields(block):
            same = np.array_equal(getattr(block, field.name), getattr(before, field.name), equal_nan=True)
            require(same, f"{type(block).__name__}.{field.name} was changed")


def still_vehicle_stays_still(make: MakeEstimator) -> None:
    """A tilted vehicle at rest, its IMU feeling nothing but gravity, is where it was after 60 s."""
    estimates = run(make, still_world()).estimates
    start = STILL_START.pose()
    for estimate in estimates:
        moved = start.between(estimate.world_T_body)
        drift_m = float(np.linalg.norm(moved.translation()))
        turn_rad = float(np.linalg.norm(Rotation.from_matrix(moved.rotation().matrix()).as_rotvec()))
        require(drift_m < STILL_DRIFT_M, f"a still vehicle drifts by {drift_m:.3f} m")
        require(turn_rad < STILL_TURN_RAD, f"a still vehicle turns by {turn_rad:.4f} rad")


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
