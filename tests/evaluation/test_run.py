from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import gtsam
import numpy as np
import pytest

from sonar_graph.errors import EstimatorError, UnknownEstimatorError
from sonar_graph.evaluation import run as run_module
from sonar_graph.evaluation.run import run_estimator
from sonar_graph.evaluation.scored_instants import map_instants
from sonar_graph.measurements import LandmarkDetections, Measurements
from sonar_graph.sequence import Sequence
from sonar_graph.states import Estimate, LandmarkMap, Refusal, RefusedRow, Trajectory

Make = Callable[..., Sequence]
Install = Callable[..., None]


def test_every_row_reaches_the_estimator_once_and_in_order(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    instances: list[list[Measurements]] = []

    class Recorder(offset_estimator):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            self.seen: list[Measurements] = []
            instances.append(self.seen)

        def process(self, measurements: Measurements) -> Estimate | None:
            self.seen.append(measurements)
            return super().process(measurements)

    install(recorder=Recorder)
    sequence = make_sequence()
    result = run_estimator(sequence, "recorder", rate_hz=2.0)
    assert result.status == "ok"
    seen = instances[-1]
    stamps = np.concatenate([step.imu.stamps_ns for step in seen if step.imu])
    np.testing.assert_array_equal(stamps, sequence.imu.stamps_ns)
    np.testing.assert_array_equal([step.end_ns for step in seen], sequence.instants(2.0))


@pytest.mark.parametrize("fails", [False, True])
def test_nothing_of_the_instance_that_warms_up_reaches_the_result(
    install: Install, make_sequence: Make, offset_estimator: Any, fails: bool
) -> None:
    instances: list[Any] = []
    calls: list[tuple[int, int]] = []

    class FirstIsOther(offset_estimator):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            instances.append(self)

        def process(self, measurements: Measurements) -> Estimate | None:
            if self is not instances[0]:
                return super().process(measurements)
            if fails:
                raise ZeroDivisionError
            time.sleep(0.05)
            return self.beside(measurements.end_ns, 99.0)

    install(first=FirstIsOther, offset=offset_estimator)
    result = run_estimator(make_sequence(5.0), "first", progress=lambda *call: calls.append(call))
    plain = run_estimator(make_sequence(5.0), "offset")
    assert len(instances) == 2
    assert (result.status, result.reason) == ("ok", "")
    assert result.causal is not None
    assert plain.causal is not None
    np.testing.assert_array_equal(result.causal.positions, plain.causal.positions)
    assert len(result.update_s) == 10
    assert result.update_s.min() < 0.05
    assert calls == [(i, 10) for i in range(1, 11)]


def test_causal_and_smoothed_are_what_the_estimator_said(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    install(offset=offset_estimator)
    result = run_estimator(make_sequence(), "offset", {"offset_m": 0.4})
    assert result.causal is not None
    assert result.smoothed is not None
    np.testing.assert_allclose(result.causal.positions[:, 1], 0.4)
    np.testing.assert_allclose(result.smoothed.positions[:, 1], 0.2)
    assert result.params == {"offset_m": 0.4, "sigma_m": 0.3}
    assert result.landmarks is not None
    assert result.detections is not None


def test_only_calls_of_the_estimator_are_timed(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    class Slow(offset_estimator):
        def process(self, measurements: Measurements) -> Estimate | None:
            time.sleep(0.01)
            return super().process(measurements)

        def trajectory(self) -> Trajectory:
            time.sleep(0.03)
            return super().trajectory()

    install(slow=Slow)
    before = time.perf_counter()
    result = run_estimator(make_sequence(5.0), "slow", progress=lambda *_: time.sleep(0.02))
    whole_s = time.perf_counter() - before
    assert len(result.update_s) == 10
    assert np.all(result.update_s >= 0.01)
    assert result.finish_s >= 0.03
    assert result.update_s.sum() + result.finish_s < whole_s - 10 * 0.02


def test_progress_counts_to_the_total(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    install(offset=offset_estimator)
    calls: list[tuple[int, int]] = []
    run_estimator(make_sequence(5.0), "offset", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 10) for i in range(1, 11)]


def test_an_exception_becomes_a_reason_of_one_line_with_type_and_time(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class Singular(offset_estimator):
        def process(self, measurements: Measurements) -> Estimate | None:
            if len(self.estimates) == 6:
                raise ZeroDivisionError("the matrix\n  is singular")
            return super().process(measurements)

    install(singular=Singular)
    result = run_estimator(make_sequence(), "singular")
    assert result.status == "failed"
    assert result.reason == "3.500 s after the start (4500000000 ns): ZeroDivisionError: the matrix is singular"
    assert result.causal is None
    assert len(result.update_s) == 6


@pytest.mark.parametrize("can_tell", [True, False])
def test_a_failed_run_names_the_rows_that_were_refused_before_it_failed(
    install: Install, make_sequence: Make, offset_estimator: Any, can_tell: bool
) -> None:
    row = RefusedRow("dvl", 2_000_000_000, Refusal.OUTLIER, 100.0)

    class Refuses(offset_estimator):
        def process(self, measurements: Measurements) -> Estimate | None:
            if len(self.estimates) == 6:
                raise ZeroDivisionError("singular")
            return super().process(measurements)

        def refused_rows(self) -> list[RefusedRow]:
            if not can_tell:
                raise ValueError("not even that")
            return [row]

    install(refuses=Refuses)
    result = run_estimator(make_sequence(), "refuses")
    assert result.status == "failed"
    assert "ZeroDivisionError: singular" in result.reason
    assert result.refused == ([row] if can_tell else [])


def estimate_with(estimate: Estimate, **change: Any) -> Estimate:
    return replace(estimate, **change)


NAN_POSE = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
NEGATIVE = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-3])
ASYMMETRIC = np.eye(6) + 0.5 * np.eye(6, k=1)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"world_T_body": NAN_POSE}, "causal pose is not finite in 39 of 40 rows, first at ns 2000000000"),
        ({"covariance": NEGATIVE}, "causal covariance is impossible in 39 of 40 rows"),
        ({"covariance": ASYMMETRIC}, "causal covariance is impossible"),
        ({"covariance": np.where(np.eye(6) > 0, np.nan, 0.0)}, "causal covariance is impossible"),
        ({"stamp_ns": 17}, "returned an estimate for 17 ns when asked for 2000000000 ns"),
    ],
)
def test_an_impossible_estimate_fails_the_run(
    install: Install, make_sequence: Make, offset_estimator: Any, change: dict[str, Any], reason: str
) -> None:
    class Wrong(offset_estimator):
        def process(self, measurements: Measurements) -> Estimate | None:
            estimate = super().process(measurements)
            return estimate if len(self.estimates) == 1 else estimate_with(estimate, **change)

    install(wrong=Wrong)
    result = run_estimator(make_sequence(), "wrong")
    assert result.status == "failed"
    assert reason in result.reason


def test_unknown_covariances_are_allowed(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    class Modest(offset_estimator):
        def beside(self, stamp_ns: int, offset_m: float) -> Estimate:
            return estimate_with(super().beside(stamp_ns, offset_m), covariance=np.full((6, 6), np.nan))

    install(modest=Modest)
    assert run_estimator(make_sequence(), "modest").status == "ok"


def test_rounding_below_zero_is_no_impossible_covariance(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class Rounded(offset_estimator):
        def beside(self, stamp_ns: int, offset_m: float) -> Estimate:
            return estimate_with(super().beside(stamp_ns, offset_m), covariance=np.diag([1.0] * 5 + [-1e-12]))

    install(rounded=Rounded)
    assert run_estimator(make_sequence(), "rounded").status == "ok"


def test_a_trajectory_at_other_instants_fails_the_run(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class Short(offset_estimator):
        def trajectory(self) -> Trajectory:
            return super().trajectory().rows(slice(1, None))

    install(short=Short)
    result = run_estimator(make_sequence(), "short")
    assert result.status == "failed"
    assert "trajectory() has 39 instants, not the 40" in result.reason


def test_a_map_that_is_not_finite_fails_the_run(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    class Lost(offset_estimator):
        def landmarks(self) -> LandmarkMap:
            return LandmarkMap(np.array([7]), np.array([[np.inf, 0.0, 0.0]]), np.full((1, 3, 3), np.nan))

    install(lost=Lost)
    result = run_estimator(make_sequence(), "lost")
    assert "position is not finite in 1 of 1 rows, first at landmark 7" in result.reason


def test_an_estimator_that_never_speaks_fails(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    class Mute(offset_estimator):
        def process(self, _measurements: Measurements) -> Estimate | None:
            return None

    install(mute=Mute)
    assert "never returned an estimate" in run_estimator(make_sequence(), "mute").reason


def test_an_empty_map_is_fine(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    class Blind(offset_estimator):
        def landmarks(self) -> LandmarkMap:
            return LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    install(blind=Blind)
    assert run_estimator(make_sequence(), "blind").status == "ok"


def test_mistakes_of_the_user_are_raised(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    install(offset=offset_estimator)
    with pytest.raises(UnknownEstimatorError):
        run_estimator(make_sequence(), "ofset")
    with pytest.raises(EstimatorError, match="offset_cm"):
        run_estimator(make_sequence(), "offset", {"offset_cm": 3})


def test_an_estimator_that_cannot_be_loaded_is_a_failed_run(
    monkeypatch: pytest.MonkeyPatch, make_sequence: Make
) -> None:
    def load(name: str) -> Any:
        raise EstimatorError(f"{name} cannot be loaded: No module named 'torch'")

    monkeypatch.setattr(run_module, "load_estimator", load)
    result = run_estimator(make_sequence(), "neural")
    assert result.status == "failed"
    assert "No module named 'torch'" in result.reason


def test_interruption_is_not_swallowed(install: Install, make_sequence: Make, offset_estimator: Any) -> None:
    class Interrupted(offset_estimator):
        def process(self, _measurements: Measurements) -> Estimate | None:
            raise KeyboardInterrupt

    install(interrupted=Interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_estimator(make_sequence(), "interrupted")


def test_the_map_is_kept_on_the_way_as_it_was_known_then(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class Counting(offset_estimator):
        """Has as many landmarks as it took steps."""

        def landmarks(self) -> LandmarkMap:
            n = len(self.estimates)
            return LandmarkMap(np.arange(n), np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))

    install(counting=Counting)
    sequence = make_sequence()
    result = run_estimator(sequence, "counting", rate_hz=2.0)
    instants = sequence.instants(2.0)
    expected = map_instants(instants, sequence.start_ns)
    assert [known.stamp_ns for known in result.maps] == expected.tolist()
    assert [len(known.landmarks) for known in result.maps] == (np.searchsorted(instants, expected) + 1).tolist()
    assert result.landmarks is result.maps[-1].landmarks


def test_without_interim_maps_only_the_last_is_asked_for(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    asked = []

    class Counting(offset_estimator):
        def landmarks(self) -> LandmarkMap:
            asked.append(len(self.estimates))
            return super().landmarks()

    install(counting=Counting)
    result = run_estimator(make_sequence(), "counting", rate_hz=2.0, interim_maps=False)
    assert asked == [len(result.causal)]
    assert [known.stamp_ns for known in result.maps] == [result.causal.stamps_ns[-1]]


def test_asking_for_the_map_on_the_way_is_not_timed(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class SlowToTell(offset_estimator):
        def landmarks(self) -> LandmarkMap:
            time.sleep(0.2)
            return super().landmarks()

    install(slow=SlowToTell)
    result = run_estimator(make_sequence(), "slow", rate_hz=2.0)
    assert len(result.maps) == 3
    assert result.update_s.max() < 0.15


def test_no_map_is_asked_for_before_the_first_estimate(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class Late(offset_estimator):
        def process(self, measurements: Measurements) -> Estimate | None:
            estimate = super().process(measurements)
            if len(self.estimates) < 30:
                return None
            return estimate

        def trajectory(self) -> Trajectory:
            return Trajectory.from_estimates(self.estimates[29:])

        def landmarks(self) -> LandmarkMap:
            if len(self.estimates) < 30:
                raise RuntimeError("nothing is known yet")
            return super().landmarks()

    install(late=Late)
    result = run_estimator(make_sequence(), "late", rate_hz=2.0)
    assert (result.status, result.reason) == ("ok", "")
    assert len(result.maps) == 1


def test_the_instance_that_warms_up_waits_for_landmarks_that_can_be_named(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    """Ten frames name nothing, then five name a landmark: it is still warming up when that is seen again."""
    instances: list[list[int]] = []

    class Recorder(offset_estimator):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            self.ends_ns: list[int] = []
            instances.append(self.ends_ns)

        def process(self, measurements: Measurements) -> Estimate | None:
            self.ends_ns.append(measurements.end_ns)
            return super().process(measurements)

    install(recorder=Recorder)
    sequence = make_sequence()
    stamps_ns = sequence.imu.stamps_ns[5:155:10]
    n = len(stamps_ns)
    probable = np.where(np.arange(n) < 10, 0.2, 0.9)[:, None]
    unsure = LandmarkDetections(
        stamps_ns, np.ones(n), np.zeros(n), np.full((n, 2, 2), np.nan), np.full((n, 1), 7), probable
    )
    assert run_estimator(replace(sequence, detections=unsure), "recorder", rate_hz=2.0).status == "ok"
    warmed_up, judged = instances
    assert warmed_up[-1] >= stamps_ns[11]
    assert len(warmed_up) < len(judged)


def test_what_an_estimator_does_to_its_measurements_no_other_sees(
    install: Install, make_sequence: Make, offset_estimator: Any
) -> None:
    class Correcting(offset_estimator):
        given: ClassVar[list[float]] = []

        def process(self, measurements: Measurements) -> Estimate | None:
            self.given.append(float(np.abs(measurements.imu.specific_force).sum()))
            measurements.imu.specific_force[:] *= 2
            return super().process(measurements)

    install(correcting=Correcting)
    sequence = make_sequence()
    before = sequence.imu.specific_force.copy()
    run_estimator(sequence, "correcting")
    np.testing.assert_array_equal(sequence.imu.specific_force, before)
    steps = len(sequence.instants(2.0))
    assert len(Correcting.given) > steps
    assert (
        Correcting.given[: len(Correcting.given) - steps] == Correcting.given[-steps:][: len(Correcting.given) - steps]
    )
