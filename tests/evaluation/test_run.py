"""One estimator over one sequence: fed in order, timed, checked; whatever it does wrong is a result with a reason."""

import time
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sonar_graph.errors import EstimatorError, UnknownEstimatorError
from sonar_graph.evaluation import RunResult, run_estimator
from sonar_graph.evaluation import run as run_module
from sonar_graph.evaluation.run import PeakMemory
from sonar_graph.evaluation.scored_instants import MAPS_KEPT, kept_map_instants
from sonar_graph.states import LandmarkMap

from .conftest import Offset, straight_sequence

MEGABYTES = 80


@pytest.fixture
def ran(install) -> Callable[..., RunResult]:
    """Run an estimator that is `Offset` but for some methods; ``ran.made`` has its instances, the first warmed up."""

    def run(sequence=None, settings=None, *, options=None, **methods) -> RunResult:
        def init(self, *arguments):
            Offset.__init__(self, *arguments)
            self.seen = []
            run.made.append(self)

        def process(self, measurements):
            self.seen.append(measurements)
            return methods.get("process", Offset.process)(self, measurements)

        install(
            own=type("Own", (Offset,), methods | {"__init__": init, "process": process})
        )
        return run_estimator(
            sequence or straight_sequence(), "own", settings, **(options or {})
        )

    run.made = []
    return run


def changing(**change):
    """A method that alters every estimate but the first."""

    def process(self, measurements):
        estimate = Offset.process(self, measurements)
        return estimate if len(self.estimates) == 1 else replace(estimate, **change)

    return process


def with_covariance(covariance):
    return lambda self, stamp_ns, offset_m: replace(
        Offset.beside(self, stamp_ns, offset_m), covariance=covariance
    )


def failing_after(steps: int, error: BaseException):
    def process(self, measurements):
        if len(self.estimates) == steps:
            raise error
        return Offset.process(self, measurements)

    return process


def slow(method, seconds: float):
    def slowed(self, *arguments):
        time.sleep(seconds)
        return method(self, *arguments)

    return slowed


def off_by(path, offset):
    return replace(path, positions=path.positions + offset)


def map_of(positions: list[list[float]]) -> LandmarkMap:
    n = len(positions)
    return LandmarkMap(
        np.arange(7, 7 + n), np.reshape(positions, (n, 3)), np.full((n, 3, 3), np.nan)
    )


def test_every_row_reaches_the_estimator_once_and_in_order(ran):
    sequence = straight_sequence()
    assert ran(sequence).status == "ok"
    seen = ran.made[-1].seen
    np.testing.assert_array_equal(
        np.concatenate([s.imu.stamps_ns for s in seen if s.imu]), sequence.imu.stamps_ns
    )
    np.testing.assert_array_equal(
        [step.end_ns for step in seen], sequence.instants(2.0)
    )


@pytest.mark.parametrize("fails", [False, True])
def test_nothing_of_the_instance_that_warms_up_reaches_the_result(ran, fails):
    calls: list[tuple[int, int]] = []

    def process(self, measurements):
        if self is not ran.made[0]:
            return Offset.process(self, measurements)
        if fails:
            raise ZeroDivisionError
        time.sleep(0.05)
        return self.beside(measurements.end_ns, 99.0)

    result = ran(
        straight_sequence(5.0),
        options={"progress": lambda *call: calls.append(call)},
        process=process,
    )
    assert len(ran.made) == 2
    assert (result.status, result.reason) == ("ok", "")
    np.testing.assert_array_equal(
        result.causal.positions, ran(straight_sequence(5.0)).causal.positions
    )
    assert len(result.update_s) == 10
    assert result.update_s.min() < 0.05
    assert calls == [(i, 10) for i in range(1, 11)]


def test_only_calls_of_the_estimator_are_timed(ran):
    before = time.perf_counter()
    result = ran(
        straight_sequence(5.0),
        options={"progress": lambda *_: time.sleep(0.02)},
        process=slow(Offset.process, 0.01),
        trajectory=slow(Offset.trajectory, 0.03),
    )
    whole_s = time.perf_counter() - before
    assert len(result.update_s) == 10
    assert np.all(result.update_s >= 0.01)
    assert result.finish_s >= 0.03
    assert result.update_s.sum() + result.finish_s < whole_s - 10 * 0.02
    told = ran(landmarks=slow(Offset.landmarks, 0.1))
    assert len(told.maps) > 3
    assert told.update_s.max() < 0.08, "asking for the map on the way is not timed"


NAN_POSE = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
IMPOSSIBLE = "causal covariance is impossible"


@pytest.mark.parametrize(
    ("methods", "reason"),
    [
        (
            {"process": changing(world_T_body=NAN_POSE)},
            "causal pose is not finite in 39 of 40 rows, first at ns",
        ),
        (
            {"trajectory": lambda self: off_by(Offset.trajectory(self), np.nan)},
            "smoothed pose is not finite in 40 of",
        ),
        (
            {
                "landmarks": lambda _: replace(
                    map_of([[0.0] * 3]), covariances=-np.eye(3)[None]
                )
            },
            "at landmark 7",
        ),
        (
            {"process": changing(covariance=np.diag([1.0] * 5 + [-1e-3]))},
            f"{IMPOSSIBLE} in 39 of 40 rows",
        ),
        (
            {"process": changing(covariance=np.eye(6) + 0.5 * np.eye(6, k=1))},
            IMPOSSIBLE,
        ),
        (
            {"process": changing(covariance=np.where(np.eye(6) > 0, np.nan, 0.0))},
            IMPOSSIBLE,
        ),
        (
            {"process": changing(stamp_ns=17)},
            "returned an estimate for 17 ns when asked for 2000000000 ns",
        ),
        ({"process": lambda *_: None}, "never returned an estimate"),
        (
            {"trajectory": lambda self: Offset.trajectory(self).rows(slice(1, None))},
            "trajectory() lacks 1 of the 40 instants",
        ),
        (
            {
                "trajectory": lambda self: Offset.trajectory(self).rows(slice(0)),
                "withheld": lambda _: ["not located"],
            },
            "it took all its poses back: not located",
        ),
        (
            {"landmarks": lambda _: map_of([[np.inf, 0.0, 0.0]])},
            "is not finite in 1 of 1 rows, first at landmark 7",
        ),
        (
            {"beside": with_covariance(np.full((6, 6), np.nan))},
            "",
        ),  # unknown covariances are allowed,
        (
            {"beside": with_covariance(np.diag([1.0] * 5 + [-1e-12]))},
            "",
        ),  # rounding below zero,
        ({"landmarks": lambda _: map_of([])}, ""),  # and an empty map
    ],
)
def test_results_that_cannot_be_scored_fail_the_run(ran, methods, reason):
    result = ran(**methods)
    assert result.status == ("failed" if reason else "ok")
    assert reason in result.reason
    assert bool(result.reason) == bool(reason)


def test_mistakes_of_the_user_are_raised(ran, monkeypatch):
    with pytest.raises(EstimatorError, match="offset_cm"):
        ran(settings={"offset_cm": 3})
    with pytest.raises(UnknownEstimatorError):
        run_estimator(straight_sequence(), "ofset")
    with pytest.raises(KeyboardInterrupt):
        ran(process=failing_after(0, KeyboardInterrupt()))

    def load(name: str):
        raise EstimatorError(f"{name} cannot be loaded: No module named 'torch'")

    monkeypatch.setattr(run_module, "load_estimator", load)
    result = run_estimator(straight_sequence(), "neural")
    assert result.status == "failed"
    assert "No module named 'torch'" in result.reason


def test_the_map_is_kept_on_the_way_as_it_was_known_then(ran):
    """The estimator has as many landmarks as it took steps."""
    sequence = straight_sequence()
    result = ran(
        sequence, landmarks=lambda self: map_of([[0.0] * 3] * len(self.estimates))
    )
    instants = sequence.instants(2.0)
    expected = kept_map_instants(instants, sequence.start_ns)
    assert MAPS_KEPT < len(expected) <= MAPS_KEPT + 2, (
        "those of the paper, and the last one once"
    )
    assert [known.stamp_ns for known in result.maps] == expected.tolist()
    assert [len(known.landmarks) for known in result.maps] == (
        np.searchsorted(instants, expected) + 1
    ).tolist()
    assert result.landmarks is result.maps[-1].landmarks
    only_last = ran(sequence, options={"interim_maps": False})
    assert [known.stamp_ns for known in only_last.maps] == [
        only_last.causal.stamps_ns[-1]
    ]


def test_what_an_estimator_does_to_its_measurements_no_other_sees(ran):
    given: list[float] = []

    def process(self, measurements):
        given.append(float(np.abs(measurements.imu.specific_force).sum()))
        measurements.imu.specific_force[:] *= 2
        return Offset.process(self, measurements)

    sequence = straight_sequence()
    before = sequence.imu.specific_force.copy()
    ran(sequence, process=process)
    np.testing.assert_array_equal(sequence.imu.specific_force, before)
    steps = len(sequence.instants(2.0))
    warmed_up = len(given) - steps
    assert warmed_up > 0
    assert given[:warmed_up] == given[-steps:][:warmed_up]


def touch() -> float:
    return float(np.ones(MEGABYTES * 125_000).sum())


@pytest.mark.skipif(
    np.isnan(PeakMemory().rise_mb()),
    reason="this system does not tell a process's peak memory",
)
def test_peak_memory_sees_what_was_freed_again_and_forgets_what_was_before(
    monkeypatch, tmp_path
):
    touch()
    quiet = PeakMemory()
    assert quiet.rise_mb() < MEGABYTES / 2
    loud = PeakMemory()
    touch()
    assert loud.rise_mb() > 0.8 * MEGABYTES
    monkeypatch.setattr(run_module, "CLEAR_REFS", tmp_path / "absent" / "clear_refs")
    assert np.isnan(PeakMemory().rise_mb()), "unknown where the system does not tell"
