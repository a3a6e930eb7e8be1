"""Estimators that come along keep the contract; each way of breaking it is caught by the check that is meant for it."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import gtsam
import numpy as np
import pytest

from baselines.ekf_slam import EkfSlam
from sonar_graph.calibration import Calibration, Section
from sonar_graph.estimator import load_estimator
from sonar_graph.measurements import Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Trajectory
from sonar_graph.testing import (
    CHECKS,
    FILTER_CHECKS,
    Check,
    ContractError,
    check_estimator,
    laws,
)


def but(methods: dict[str, Any]) -> type[EkfSlam]:
    """An estimator that keeps the contract, but for some methods."""
    return type("But", (EkfSlam,), methods)


def answering(change: Callable[[Estimate, int], Estimate]) -> dict[str, Any]:
    """Other estimates, by the right ones and the number of calls until then."""

    def process(self: EkfSlam, measurements: Measurements) -> Estimate | None:
        self.calls = getattr(self, "calls", 0) + 1
        estimate = EkfSlam.process(self, measurements)
        return estimate and change(estimate, self.calls)

    return {"process": process}


def shifted(estimate: Estimate, step_m: float) -> Estimate:
    step = gtsam.Pose3(gtsam.Rot3(), np.array([step_m, 0.0, 0.0]))
    return replace(estimate, world_T_body=estimate.world_T_body.compose(step))


def moving_at_each_call(step_m: float) -> dict[str, Any]:
    return answering(lambda estimate, calls: shifted(estimate, step_m * calls))


def taking(name: str, column: str, factor: Any) -> dict[str, Any]:
    """A column of the measurements times a factor, as by a wrong sign."""

    def process(self: EkfSlam, measurements: Measurements) -> Estimate | None:
        block = getattr(measurements, name)
        if block is not None:
            wrong = replace(block, **{column: getattr(block, column) * factor})
            measurements = replace(measurements, **{name: wrong})
        return EkfSlam.process(self, measurements)

    return {"process": process}


class NeedsASetting(Section):
    gain: float


def answers_at_once(self: EkfSlam, measurements: Measurements) -> Estimate:
    without = Estimate(measurements.end_ns, gtsam.Pose3(), np.eye(6))
    return EkfSlam.process(self, measurements) or without


UNSURE_OF_HEADING = {"rpy_sigma_rad": (0.1, 0.1, 1.0)}
UNSURE_OF_PLACE = {"position_sigma_m": (0.15, 0.15, 0.15)}
"""Starts from which headings and fixes are believed."""


def knowing(**sections: dict[str, Any]) -> dict[str, Any]:
    """With other values in sections of the calibration."""

    def init(self: EkfSlam, calibration: Calibration, *_: Any) -> None:
        changed = {
            name: getattr(calibration, name).model_copy(update=values)
            for name, values in sections.items()
        }
        other = calibration.model_copy(update=changed)
        EkfSlam.__init__(self, other, Odometry(other))

    return {"__init__": init}


def forgets_the_first_pose(self: EkfSlam) -> Trajectory:
    found = EkfSlam.trajectory(self)
    return Trajectory(
        found.stamps_ns[1:],
        found.positions[1:],
        found.quaternions_xyzw[1:],
        found.covariances[1:],
    )


def unsorted_map(self: EkfSlam) -> LandmarkMap:
    found = EkfSlam.landmarks(self)
    return LandmarkMap(found.ids[::-1], found.positions[::-1], found.covariances[::-1])


def write_into_input(self: EkfSlam, measurements: Measurements) -> Estimate | None:
    if measurements.dvl:
        measurements.dvl.velocity[0, 0] += 1e-9
    return EkfSlam.process(self, measurements)


RUNS = count()


def differing_from_run_to_run() -> dict[str, Any]:
    def init(self: EkfSlam, *arguments: Any) -> None:
        EkfSlam.__init__(self, *arguments)
        self.step_m = 1e-12 * next(RUNS)

    def process(self: EkfSlam, measurements: Measurements) -> Estimate | None:
        estimate = EkfSlam.process(self, measurements)
        return estimate and shifted(estimate, self.step_m)

    return {"__init__": init, "process": process}


def moving_when_asked() -> dict[str, Any]:
    def trajectory(self: EkfSlam) -> Trajectory:
        self.calls += 1
        return EkfSlam.trajectory(self)

    return moving_at_each_call(1e-4) | {"trajectory": trajectory}


def known_too_early(_: object) -> LandmarkMap:
    return LandmarkMap(np.array([4]), np.zeros((1, 3)), np.eye(3)[None])


def crept(estimate: Estimate, _: int) -> Estimate:
    return shifted(estimate, 1e-3 * 1e-9 * (estimate.stamp_ns - laws.START_NS))


FRAMES = laws.frames_and_signs_are_those_of_the_vocabulary
BROKEN: dict[str, tuple[Check, dict[str, Any]]] = {
    "needs a setting": (laws.settings_have_defaults, {"Params": NeedsASetting}),
    "knows too early": (
        laws.knows_nothing_before_the_first_measurement,
        {"landmarks": known_too_early},
    ),
    "answers for another instant": (
        laws.answers_from_the_first_imu_and_dvl_on,
        answering(lambda one, _: replace(one, stamp_ns=one.stamp_ns - 1)),
    ),
    "never answers": (
        laws.answers_from_the_first_imu_and_dvl_on,
        answering(lambda *_: None),
    ),
    "answers without DVL": (
        laws.answers_from_the_first_imu_and_dvl_on,
        {"process": answers_at_once},
    ),
    "skew covariance": (
        laws.covariances_are_covariances,
        answering(
            lambda one, _: replace(one, covariance=np.eye(6) + 0.1 * np.eye(6, k=1))
        ),
    ),
    "forgets its first pose": (
        laws.trajectory_has_the_instants_of_the_estimates,
        {"trajectory": forgets_the_first_pose},
    ),
    "turns right": (FRAMES, taking("imu", "angular_velocity", [1, 1, -1])),
    "azimuth to the right": (FRAMES, taking("detections", "azimuth_rad", -1)),
    "heading to the right": (
        FRAMES,
        knowing(start=UNSURE_OF_HEADING) | taking("heading", "yaw_rad", -1),
    ),
    "no lever arm": (
        FRAMES,
        knowing(start=UNSURE_OF_PLACE, positions={"antenna_m": (0.0, 0.0, 0.0)}),
    ),
    "unsorted map": (laws.landmarks_are_sorted_and_unique, {"landmarks": unsorted_map}),
    "silent about refusals": (
        laws.every_detection_has_an_outcome,
        {"detections": lambda _: DetectionLog.empty()},
    ),
    "differs from run to run": (
        laws.same_input_gives_same_output,
        differing_from_run_to_run(),
    ),
    "moves when asked": (laws.asking_changes_nothing, moving_when_asked()),
    "moves with each call": (laws.live_agrees_with_replay, moving_at_each_call(1e-4)),
    "surer with each call": (
        laws.live_agrees_with_replay,
        answering(lambda one, n: replace(one, covariance=one.covariance / n)),
    ),
    "moves a little with each call": (
        laws.live_equals_replay,
        moving_at_each_call(1e-8),
    ),
    "writes into its input": (
        laws.input_stays_as_it_was,
        {"process": write_into_input},
    ),
    "creeps forward": (laws.still_vehicle_stays_still, answering(crept)),
}
ALL_CHECKS = (*CHECKS, *FILTER_CHECKS)


@pytest.mark.parametrize(("check", "methods"), BROKEN.values(), ids=BROKEN)
def test_broken_estimator_fails_the_check_meant_for_it(check, methods):
    with pytest.raises(ContractError):
        check(but(methods))
    assert {check for check, _ in BROKEN.values()} == set(ALL_CHECKS)


@pytest.mark.parametrize("start", [UNSURE_OF_HEADING, UNSURE_OF_PLACE])
def test_an_unsure_start_alone_breaks_no_law_of_frames(start):
    FRAMES(but(knowing(start=start)))


FILTERS = "dead-reckoning", "ekf-slam", "invariant-ekf"
CASES = [
    *((name, check) for name in FILTERS for check in ALL_CHECKS),
    *(("isam2", check) for check in CHECKS),
]


@pytest.mark.parametrize(
    ("name", "check"), CASES, ids=lambda part: getattr(part, "__name__", part)
)
def test_estimators_that_come_along_keep_the_contract(name, check):
    check(load_estimator(name))


def test_the_first_violation_is_named_and_so_is_an_estimator_that_raises():
    check_estimator(EkfSlam)
    with pytest.raises(
        ContractError, match="still_vehicle_stays_still: a still vehicle drifts by"
    ):
        check_estimator(but(answering(crept)))
    with pytest.raises(
        ContractError, match=r"\w+: the estimator raised TypeError: .*may be None"
    ):
        check_estimator(but({"process": lambda _, measurements: len(measurements.dvl)}))
