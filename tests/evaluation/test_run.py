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

    def run(sequence=None, settings=None, *, options=None, **methods):
        class Own(Offset):
            def __init__(self, *arguments):
                super().__init__(*arguments)
                self.seen = []
                run.made.append(self)

            def process(self, measurements):
                self.seen.append(measurements)
                return methods.get("process", Offset.process)(self, measurements)

        others = {key: own for key, own in methods.items() if key != "process"}
        install(own=type("Changed", (Own,), others))
        sequence = sequence or straight_sequence()
        return run_estimator(sequence, "own", settings, **(options or {}))

    run.made = []
    return run


def changing(name="process", **change):
    """A method of `Offset` that alters what it returns, of estimates all but the first."""
    method = getattr(Offset, name)

    def changed(self, *arguments):
        found = method(self, *arguments)
        is_first = name == "process" and len(self.estimates) == 1
        return found if is_first else replace(found, **change)

    return {name: changed}


def slow(method, seconds: float):
    def slowed(self, *arguments):
        time.sleep(seconds)
        return method(self, *arguments)

    return slowed


def map_of(positions: list[list[float]]) -> LandmarkMap:
    n = len(positions)
    unknown = np.full((n, 3, 3), np.nan)
    return LandmarkMap(np.arange(7, 7 + n), np.reshape(positions, (n, 3)), unknown)


def of_map(landmarks: LandmarkMap):
    return {"landmarks": lambda _: landmarks}


def of_rows(rows: slice):
    return {"trajectory": lambda self: Offset.trajectory(self).rows(rows)}


def test_every_row_reaches_the_estimator_once_and_in_order(ran):
    sequence = straight_sequence()
    assert ran(sequence).status == "ok"
    seen = ran.made[-1].seen
    stamps_ns = np.concatenate([step.imu.stamps_ns for step in seen if step.imu])
    np.testing.assert_array_equal(stamps_ns, sequence.imu.stamps_ns)
    ends_ns = [step.end_ns for step in seen]
    np.testing.assert_array_equal(ends_ns, sequence.instants(2.0))


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

    sequence = straight_sequence(5.0)
    options = {"progress": lambda *call: calls.append(call)}
    result = ran(sequence, options=options, process=process)
    assert len(ran.made) == 2
    assert (result.status, result.reason) == ("ok", "")
    paths = (result.causal, ran(sequence).causal)
    np.testing.assert_array_equal(*(path.positions for path in paths))
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
        landmarks=slow(Offset.landmarks, 0.1),
    )
    whole_s = time.perf_counter() - before
    assert len(result.update_s) == 10
    assert np.all(result.update_s >= 0.01)
    assert result.finish_s >= 0.03
    assert result.update_s.sum() + result.finish_s < whole_s - 10 * 0.02
    # asking for the map on the way is not timed
    assert len(result.maps) > 3
    assert result.update_s.max() < 0.08


NAN_POSE = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
IMPOSSIBLE = "causal covariance is impossible"


NO_POSES = of_rows(slice(0)) | {"withheld": lambda _: ["not located"]}


ZERO = map_of([[0.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("methods", "reason"),
    [
        (
            changing(world_T_body=NAN_POSE),
            "causal pose is not finite in 39 of 40 rows, first at ns",
        ),
        (
            changing("trajectory", positions=np.full((40, 3), np.nan)),
            "smoothed pose is not finite in 40 of",
        ),
        (of_map(replace(ZERO, covariances=-np.eye(3)[None])), "at landmark 7"),
        (
            changing(covariance=np.diag([1.0] * 5 + [-1e-3])),
            f"{IMPOSSIBLE} in 39 of 40 rows",
        ),
        (changing(covariance=np.eye(6) + 0.5 * np.eye(6, k=1)), IMPOSSIBLE),
        (changing(covariance=np.where(np.eye(6) > 0, np.nan, 0.0)), IMPOSSIBLE),
        (
            changing(stamp_ns=17),
            "returned an estimate for 17 ns when asked for 2000000000 ns",
        ),
        ({"process": lambda *_: None}, "never returned an estimate"),
        (of_rows(slice(1, None)), "trajectory() lacks 1 of the 40 instants"),
        (NO_POSES, "it took all its poses back: not located"),
        (
            of_map(map_of([[np.inf, 0.0, 0.0]])),
            "is not finite in 1 of 1 rows, first at landmark 7",
        ),
        # unknown covariances are allowed, rounding below zero, and an empty map
        (changing("beside", covariance=np.full((6, 6), np.nan)), ""),
        (changing("beside", covariance=np.diag([1.0] * 5 + [-1e-12])), ""),
        (of_map(map_of([])), ""),
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

    def interrupted(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ran(process=interrupted)

    def load(name):
        raise EstimatorError(f"{name} cannot be loaded: No module named 'torch'")

    monkeypatch.setattr(run_module, "load_estimator", load)
    result = run_estimator(straight_sequence(), "neural")
    assert result.status == "failed"
    assert "No module named 'torch'" in result.reason


def test_the_map_is_kept_on_the_way_as_it_was_known_then(ran):
    """The estimator has as many landmarks as it took steps."""
    sequence = straight_sequence()
    result = ran(sequence, landmarks=lambda self: map_of([[0.0] * 3] * len(self.seen)))
    instants = sequence.instants(2.0)
    expected = kept_map_instants(instants, sequence.start_ns)
    # those of the paper, and the last one once
    assert MAPS_KEPT < len(expected) <= MAPS_KEPT + 2
    steps = np.searchsorted(instants, expected) + 1
    found = [(known.stamp_ns, len(known.landmarks)) for known in result.maps]
    assert found == list(zip(expected.tolist(), steps.tolist(), strict=True))
    assert result.landmarks is result.maps[-1].landmarks
    (last,) = ran(sequence, options={"interim_maps": False}).maps
    assert last.stamp_ns == instants[-1]


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


@pytest.mark.skipif(
    np.isnan(PeakMemory().rise_mb()),
    reason="this system does not tell a process's peak memory",
)
def test_peak_memory_sees_what_was_freed_again_and_forgets_what_was_before(
    monkeypatch, tmp_path
):
    np.ones(MEGABYTES * 125_000)
    quiet = PeakMemory()
    assert quiet.rise_mb() < MEGABYTES / 2
    loud = PeakMemory()
    np.ones(MEGABYTES * 125_000)
    assert loud.rise_mb() > 0.8 * MEGABYTES
    monkeypatch.setattr(run_module, "CLEAR_REFS", tmp_path / "absent" / "clear_refs")
    assert np.isnan(PeakMemory().rise_mb()), "unknown where the system does not tell"
