"""A plain dead reckoning keeps the contract; each way of breaking it is caught by the check that is meant for it."""

from copy import copy
from itertools import count
from typing import Any

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration, Section
from sonar_graph.estimator import load_estimator
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections, Measurements
from sonar_graph.states import (
    DetectionJournal,
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    Trajectory,
)
from sonar_graph.testing import (
    CHECKS,
    FILTER_CHECKS,
    Check,
    ContractError,
    check_estimator,
    laws,
)


class PlainDeadReckoning:
    """Holds the last rate and velocity; remembers landmarks where they were first seen."""

    class Params(Section):
        pass

    def __init__(
        self, calibration: Calibration, _odometry: Any = None, params: Any = None
    ) -> None:
        self.params = params
        self.pose = calibration.start.pose()
        self.stamp_ns: int | None = None
        self.rate: Any = None
        self.velocity: Any = None
        self.estimates: list[Estimate] = []
        self.map: dict[int, Any] = {}
        self.journal = DetectionJournal()

    def process(self, measurements: Measurements) -> Estimate | None:
        blocks = (measurements.imu, measurements.dvl, measurements.detections)
        rows = [
            (int(block.stamps_ns[i]), k, block, i)
            for k, block in enumerate(blocks)
            if block
            for i in range(len(block))
        ]
        for stamp_ns, _, block, i in sorted(rows, key=lambda row: row[:2]):
            self._advance(stamp_ns)
            self._take(block, i, stamp_ns)
        if self.stamp_ns is None:
            return None
        self.estimates.append(self._estimate(measurements.end_ns))
        return self.estimates[-1]

    def trajectory(self) -> Trajectory:
        return Trajectory.from_estimates(self.estimates)

    def landmarks(self) -> LandmarkMap:
        ids = sorted(self.map)
        places = np.array([self.map[i] for i in ids]).reshape(-1, 3)
        return LandmarkMap(
            np.array(ids, dtype=np.int64), places, np.tile(np.eye(3), (len(ids), 1, 1))
        )

    def detections(self) -> DetectionLog:
        return self.journal.log()

    def _take(self, block: object, i: int, stamp_ns: int) -> None:
        if isinstance(block, Imu):
            self.rate = block.angular_velocity[i]
        elif isinstance(block, Dvl):
            self.velocity = block.velocity[i]
        elif isinstance(block, LandmarkDetections):
            self._see(block, i)
        if (
            self.stamp_ns is None
            and self.rate is not None
            and self.velocity is not None
        ):
            self.stamp_ns = stamp_ns

    def _see(self, block: LandmarkDetections, i: int) -> None:
        identity, probability = (column[i] for column in block.most_probable())
        if probability > 0.5:
            ray = np.array(
                [np.cos(block.azimuth_rad[i]), np.sin(block.azimuth_rad[i]), 0.0]
            )
            self.map.setdefault(
                int(identity), self.pose.transformFrom(block.range_m[i] * ray)
            )
        outcome = Outcome.USED if probability > 0.5 else Outcome.NO_IDENTITY
        self.journal.record(int(block.stamps_ns[i]), int(identity), outcome)

    def _advance(self, stamp_ns: int) -> None:
        if self.stamp_ns is not None:
            self.pose = self._carried(stamp_ns)
            self.stamp_ns = stamp_ns

    def _carried(self, stamp_ns: int) -> gtsam.Pose3:
        assert self.stamp_ns is not None
        dt_s = (stamp_ns - self.stamp_ns) * 1e-9
        return self.pose.compose(
            gtsam.Pose3.Expmap(np.concatenate([self.rate, self.velocity]) * dt_s)
        )

    def _estimate(self, stamp_ns: int) -> Estimate:
        return Estimate(stamp_ns, self._carried(stamp_ns), 1e-4 * np.eye(6))


def shifted(pose: gtsam.Pose3, step_m: float) -> gtsam.Pose3:
    return pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([step_m, 0.0, 0.0])))


def moving_at_each(method: str, step_m: float) -> dict[str, Any]:
    def moving(self: PlainDeadReckoning, *arguments: Any) -> Any:
        self.pose = shifted(self.pose, step_m)
        return getattr(PlainDeadReckoning, method)(self, *arguments)

    return {method: moving}


def driving(turn: float = 1.0, creep_m_s: float = 0.0) -> dict[str, Any]:
    """Another rate about the vertical, or another speed, than was measured."""

    def carried(self: PlainDeadReckoning, stamp_ns: int) -> gtsam.Pose3:
        other = copy(self)
        other.rate = self.rate * [1, 1, turn]
        other.velocity = self.velocity + np.array([creep_m_s, 0.0, 0.0])
        return PlainDeadReckoning._carried(other, stamp_ns)

    return {"_carried": carried}


def answering(covariance: Any, late_ns: int = 0) -> dict[str, Any]:
    """Another covariance, by the number of estimates before, or another stamp."""

    def estimate(self: PlainDeadReckoning, stamp_ns: int) -> Estimate:
        return Estimate(
            stamp_ns + late_ns, self._carried(stamp_ns), covariance(len(self.estimates))
        )

    return {"_estimate": estimate}


class NeedsASetting(Section):
    gain: float


def see_to_the_right(
    self: PlainDeadReckoning, block: LandmarkDetections, i: int
) -> None:
    block.azimuth_rad[i] *= -1
    PlainDeadReckoning._see(self, block, i)
    block.azimuth_rad[i] *= -1


def heading_to_the_right(
    self: PlainDeadReckoning, measurements: Measurements
) -> Estimate | None:
    """The vehicle is turned about its own place to minus the newest heading."""
    if measurements.heading is not None and self.stamp_ns is not None:
        yaw_rad = -measurements.heading.yaw_rad[-1]
        self.pose = gtsam.Pose3(gtsam.Rot3.Yaw(yaw_rad), self.pose.translation())
    return PlainDeadReckoning.process(self, measurements)


def antenna_as_body(
    self: PlainDeadReckoning, measurements: Measurements
) -> Estimate | None:
    """The newest fix is the body's place, as if there were no lever arm."""
    if measurements.positions is not None and self.stamp_ns is not None:
        self.pose = gtsam.Pose3(
            self.pose.rotation(), measurements.positions.position_m[-1]
        )
    return PlainDeadReckoning.process(self, measurements)


def unsorted_map(self: PlainDeadReckoning) -> LandmarkMap:
    found = PlainDeadReckoning.landmarks(self)
    return LandmarkMap(found.ids[::-1], found.positions[::-1], found.covariances[::-1])


def write_into_input(
    self: PlainDeadReckoning, measurements: Measurements
) -> Estimate | None:
    if measurements.dvl:
        measurements.dvl.velocity[0, 0] += 1e-9
    return PlainDeadReckoning.process(self, measurements)


def begin_anew(**values: Any) -> dict[str, Any]:
    """Another state at the beginning; ``pose`` by the number of instances before."""
    made = count()

    def init(self: PlainDeadReckoning, *arguments: Any) -> None:
        PlainDeadReckoning.__init__(self, *arguments)
        vars(self).update(values)
        self.pose = shifted(self.pose, values.get("step_m", 0.0) * next(made))

    return {"__init__": init}


def known_too_early(_: object) -> LandmarkMap:
    return LandmarkMap(np.array([4]), np.zeros((1, 3)), np.eye(3)[None])


STILL_CREEPS = driving(creep_m_s=1e-3)
BROKEN: list[tuple[str, Check, dict[str, Any]]] = [
    ("needs a setting", laws.settings_have_defaults, {"Params": NeedsASetting}),
    (
        "knows too early",
        laws.knows_nothing_before_the_first_measurement,
        {"landmarks": known_too_early},
    ),
    (
        "answers for another instant",
        laws.answers_from_the_first_imu_and_dvl_on,
        answering(lambda _: np.eye(6), -1),
    ),
    (
        "never answers",
        laws.answers_from_the_first_imu_and_dvl_on,
        {"process": lambda *_: None},
    ),
    (
        "answers without DVL",
        laws.answers_from_the_first_imu_and_dvl_on,
        begin_anew(velocity=np.zeros(3)),
    ),
    (
        "skew covariance",
        laws.covariances_are_covariances,
        answering(lambda _: np.eye(6) + 0.1 * np.eye(6, k=1)),
    ),
    (
        "forgets its first pose",
        laws.trajectory_has_the_instants_of_the_estimates,
        {"trajectory": lambda self: Trajectory.from_estimates(self.estimates[1:])},
    ),
    (
        "turns right",
        laws.frames_and_signs_are_those_of_the_vocabulary,
        driving(turn=-1.0),
    ),
    (
        "azimuth to the right",
        laws.frames_and_signs_are_those_of_the_vocabulary,
        {"_see": see_to_the_right},
    ),
    (
        "heading to the right",
        laws.frames_and_signs_are_those_of_the_vocabulary,
        {"process": heading_to_the_right},
    ),
    (
        "no lever arm",
        laws.frames_and_signs_are_those_of_the_vocabulary,
        {"process": antenna_as_body},
    ),
    ("unsorted map", laws.landmarks_are_sorted_and_unique, {"landmarks": unsorted_map}),
    (
        "silent about refusals",
        laws.every_detection_has_an_outcome,
        {"detections": lambda _: DetectionLog.empty()},
    ),
    (
        "differs from run to run",
        laws.same_input_gives_same_output,
        begin_anew(step_m=1e-12),
    ),
    (
        "moves when asked",
        laws.asking_changes_nothing,
        moving_at_each("trajectory", 1e-4),
    ),
    (
        "moves with each call",
        laws.live_agrees_with_replay,
        moving_at_each("process", 1e-4),
    ),
    (
        "surer with each call",
        laws.live_agrees_with_replay,
        answering(lambda n: 1e-4 * np.eye(6) / (1 + n)),
    ),
    (
        "moves a little with each call",
        laws.live_equals_replay,
        moving_at_each("process", 1e-8),
    ),
    (
        "writes into its input",
        laws.input_stays_as_it_was,
        {"process": write_into_input},
    ),
    ("creeps forward", laws.still_vehicle_stays_still, STILL_CREEPS),
]


def but(methods: dict[str, Any]) -> type[PlainDeadReckoning]:
    """Plain dead reckoning, but for some methods."""
    return type("But", (PlainDeadReckoning,), methods)


ALL_CHECKS = (*CHECKS, *FILTER_CHECKS)


@pytest.mark.parametrize("check", FILTER_CHECKS, ids=lambda check: check.__name__)
def test_an_estimator_that_keeps_the_laws_of_filters_passes(check):
    check(PlainDeadReckoning)


@pytest.mark.parametrize(
    ("check", "methods"), [row[1:] for row in BROKEN], ids=[row[0] for row in BROKEN]
)
def test_broken_estimator_fails_the_check_meant_for_it(check, methods):
    with pytest.raises(ContractError):
        check(but(methods))
    assert {check for _, check, _ in BROKEN} == set(ALL_CHECKS)


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
    check_estimator(PlainDeadReckoning)
    with pytest.raises(
        ContractError, match="still_vehicle_stays_still: a still vehicle drifts by"
    ):
        check_estimator(but(STILL_CREEPS))
    with pytest.raises(
        ContractError, match=r"\w+: the estimator raised TypeError: .*may be None"
    ):
        check_estimator(but({"process": lambda _, measurements: len(measurements.dvl)}))
