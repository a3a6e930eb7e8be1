"""A plain dead reckoning keeps the contract; each way of breaking it is caught by the check that is meant for it."""

from __future__ import annotations

from itertools import count
from typing import Any

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration, Section
from sonar_graph.estimator import load_estimator
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections, Measurements
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Outcome, Trajectory
from sonar_graph.testing import laws
from sonar_graph.testing.laws import CHECKS, FILTER_CHECKS, Check, ContractError, check_estimator, require_covariance


class PlainDeadReckoning:
    """Holds the last rate and velocity; remembers landmarks where they were first seen."""

    class Params(Section):
        pass

    def __init__(self, calibration: Calibration, params: Any = None) -> None:
        self.params = params
        self.pose = calibration.start.pose()
        self.stamp_ns: int | None = None
        self.rate: Any = None
        self.velocity: Any = None
        self.estimates: list[Estimate] = []
        self.map: dict[int, Any] = {}
        self.log: list[tuple[int, int, Outcome]] = []

    def process(self, measurements: Measurements) -> Estimate | None:
        blocks = (measurements.imu, measurements.dvl, measurements.detections)
        rows = [
            (int(block.stamps_ns[i]), k, block, i) for k, block in enumerate(blocks) if block for i in range(len(block))
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
        return LandmarkMap(np.array(ids, dtype=np.int64), places, np.tile(np.eye(3), (len(ids), 1, 1)))

    def detections(self) -> DetectionLog:
        n = len(self.log)
        stamps, ids = (np.array([row[k] for row in self.log], dtype=np.int64) for k in (0, 1))
        return DetectionLog(stamps, ids, np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), [r[2] for r in self.log])

    def _take(self, block: object, i: int, stamp_ns: int) -> None:
        if isinstance(block, Imu):
            self.rate = block.angular_velocity[i]
        elif isinstance(block, Dvl):
            self.velocity = block.velocity[i]
        elif isinstance(block, LandmarkDetections):
            self._see(block, i)
        if self.stamp_ns is None and self.rate is not None and self.velocity is not None:
            self.stamp_ns = stamp_ns

    def _see(self, block: LandmarkDetections, i: int) -> None:
        identity, probability = (column[i] for column in block.most_probable())
        if probability > 0.5:
            ray = np.array([np.cos(block.azimuth_rad[i]), np.sin(block.azimuth_rad[i]), 0.0])
            self.map.setdefault(int(identity), self.pose.transformFrom(block.range_m[i] * ray))
        outcome = Outcome.USED if probability > 0.5 else Outcome.NO_IDENTITY
        self.log.append((int(block.stamps_ns[i]), int(identity), outcome))

    def _advance(self, stamp_ns: int) -> None:
        if self.stamp_ns is not None:
            self.pose = self._carried(stamp_ns)
            self.stamp_ns = stamp_ns

    def _carried(self, stamp_ns: int) -> gtsam.Pose3:
        assert self.stamp_ns is not None
        dt_s = (stamp_ns - self.stamp_ns) * 1e-9
        return self.pose.compose(gtsam.Pose3.Expmap(np.concatenate([self.rate, self.velocity]) * dt_s))

    def _estimate(self, stamp_ns: int) -> Estimate:
        return Estimate(stamp_ns, self._carried(stamp_ns), 1e-4 * np.eye(6))


class NeedsASetting(PlainDeadReckoning):
    class Params(Section):
        gain: float


class KnowsTooEarly(PlainDeadReckoning):
    def landmarks(self) -> LandmarkMap:
        return LandmarkMap(np.array([4]), np.zeros((1, 3)), np.eye(3)[None])


class AnswersForAnotherInstant(PlainDeadReckoning):
    def _estimate(self, stamp_ns: int) -> Estimate:
        return super()._estimate(stamp_ns - 1)


class NeverAnswers(PlainDeadReckoning):
    def process(self, measurements: Measurements) -> None:
        super().process(measurements)


class AnswersWithoutDvl(PlainDeadReckoning):
    def __init__(self, calibration: Calibration, params: Any = None) -> None:
        super().__init__(calibration, params)
        self.velocity = np.zeros(3)


class SkewCovariance(PlainDeadReckoning):
    def _estimate(self, stamp_ns: int) -> Estimate:
        skew = np.eye(6)
        skew[0, 1] = 0.1
        return Estimate(stamp_ns, super()._estimate(stamp_ns).world_T_body, skew)


class ForgetsItsFirstPose(PlainDeadReckoning):
    def trajectory(self) -> Trajectory:
        return Trajectory.from_estimates(self.estimates[1:])


class TurnsRight(PlainDeadReckoning):
    def _carried(self, stamp_ns: int) -> gtsam.Pose3:
        rate, self.rate = self.rate, self.rate * [1, 1, -1]
        pose = super()._carried(stamp_ns)
        self.rate = rate
        return pose


class AzimuthToTheRight(PlainDeadReckoning):
    def _see(self, block: LandmarkDetections, i: int) -> None:
        block.azimuth_rad[i] *= -1
        super()._see(block, i)
        block.azimuth_rad[i] *= -1


class UnsortedMap(PlainDeadReckoning):
    def landmarks(self) -> LandmarkMap:
        sorted_map = super().landmarks()
        return LandmarkMap(sorted_map.ids[::-1], sorted_map.positions[::-1], sorted_map.covariances[::-1])


class SilentAboutRefusals(PlainDeadReckoning):
    def detections(self) -> DetectionLog:
        self.log = [row for row in self.log if row[2] is Outcome.USED]
        return super().detections()


class DiffersFromRunToRun(PlainDeadReckoning):
    runs = count()

    def __init__(self, calibration: Calibration, params: Any = None) -> None:
        super().__init__(calibration, params)
        self.pose = self.pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([1e-12 * next(self.runs), 0.0, 0.0])))


class MovesWhenAsked(PlainDeadReckoning):
    def trajectory(self) -> Trajectory:
        path = super().trajectory()
        self.pose = self.pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([1e-4, 0.0, 0.0])))
        return path


class MovesWithEachCall(PlainDeadReckoning):
    step_m = 1e-4

    def process(self, measurements: Measurements) -> Estimate | None:
        self.pose = self.pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([self.step_m, 0.0, 0.0])))
        return super().process(measurements)


class MovesALittleWithEachCall(MovesWithEachCall):
    step_m = 1e-8


class SurerWithEachCall(PlainDeadReckoning):
    def _estimate(self, stamp_ns: int) -> Estimate:
        return Estimate(stamp_ns, self._carried(stamp_ns), 1e-4 * np.eye(6) / (1 + len(self.estimates)))


class WritesIntoItsInput(PlainDeadReckoning):
    def process(self, measurements: Measurements) -> Estimate | None:
        if measurements.dvl:
            measurements.dvl.velocity[0, 0] += 1e-9
        return super().process(measurements)


class CreepsForward(PlainDeadReckoning):
    def _carried(self, stamp_ns: int) -> gtsam.Pose3:
        velocity, self.velocity = self.velocity, self.velocity + np.array([1e-3, 0.0, 0.0])
        pose = super()._carried(stamp_ns)
        self.velocity = velocity
        return pose


BROKEN: list[tuple[type[PlainDeadReckoning], Check]] = [
    (NeedsASetting, laws.settings_have_defaults),
    (KnowsTooEarly, laws.knows_nothing_before_the_first_measurement),
    (AnswersForAnotherInstant, laws.answers_from_the_first_imu_and_dvl_on),
    (NeverAnswers, laws.answers_from_the_first_imu_and_dvl_on),
    (AnswersWithoutDvl, laws.answers_from_the_first_imu_and_dvl_on),
    (SkewCovariance, laws.covariances_are_covariances),
    (ForgetsItsFirstPose, laws.trajectory_has_the_instants_of_the_estimates),
    (TurnsRight, laws.frames_and_signs_are_those_of_the_vocabulary),
    (AzimuthToTheRight, laws.frames_and_signs_are_those_of_the_vocabulary),
    (UnsortedMap, laws.landmarks_are_sorted_and_unique),
    (SilentAboutRefusals, laws.every_detection_has_an_outcome),
    (DiffersFromRunToRun, laws.same_input_gives_same_output),
    (MovesWhenAsked, laws.asking_changes_nothing),
    (MovesWithEachCall, laws.live_agrees_with_replay),
    (SurerWithEachCall, laws.live_agrees_with_replay),
    (MovesALittleWithEachCall, laws.live_equals_replay),
    (WritesIntoItsInput, laws.input_stays_as_it_was),
    (CreepsForward, laws.still_vehicle_stays_still),
]


ALL_CHECKS = (*CHECKS, *FILTER_CHECKS)


@pytest.mark.parametrize("check", ALL_CHECKS, ids=lambda check: check.__name__)
def test_estimator_that_keeps_the_contract_passes(check):
    check(PlainDeadReckoning)


@pytest.mark.parametrize(("broken", "check"), BROKEN, ids=lambda part: part.__name__)
def test_broken_estimator_fails_the_check_meant_for_it(broken, check):
    with pytest.raises(ContractError):
        check(broken)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", ["dead-reckoning", "ekf-slam", "invariant-ekf", "isam2"])
def test_estimators_that_come_along_keep_the_contract(name, check):
    check(load_estimator(name))


@pytest.mark.parametrize("check", FILTER_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", ["dead-reckoning", "ekf-slam", "invariant-ekf"])
def test_filters_that_come_along_do_not_care_how_rows_are_cut(name, check):
    check(load_estimator(name))


def test_every_check_has_an_estimator_that_fails_it():
    assert {check for _, check in BROKEN} == set(ALL_CHECKS)


def test_first_violation_is_named():
    check_estimator(PlainDeadReckoning)
    with pytest.raises(ContractError, match="still_vehicle_stays_still: a still vehicle drifts by"):
        check_estimator(CreepsForward)


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda p: p[:5], "shape"),
        (lambda p: p * np.nan, "not finite"),
        (lambda p: p + np.triu(np.ones((6, 6)), 1), "not symmetric"),
        (lambda p: -p, "negative eigenvalue"),
    ],
)
def test_what_is_no_covariance_is_refused(spoil, complaint):
    require_covariance(np.eye(6), 6, "P")
    require_covariance(np.zeros((6, 6)), 6, "P")
    with pytest.raises(ContractError, match=complaint):
        require_covariance(spoil(np.eye(6)), 6, "P")


class Careless(PlainDeadReckoning):
    """Takes every block for present."""

    def process(self, measurements: Measurements) -> Estimate | None:
        len(measurements.dvl)  # type: ignore[arg-type]
        return super().process(measurements)


def test_an_estimator_that_raises_is_named_with_the_check():
    with pytest.raises(ContractError, match=r"\w+: the estimator raised TypeError: .*may be None"):
        check_estimator(Careless)
