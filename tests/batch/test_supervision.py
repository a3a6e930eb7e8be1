import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator

import psutil
import pytest

from sonar_graph.batch import Limits, supervision
from sonar_graph.batch.supervision import Runner, perform_watched
from sonar_graph.errors import BatchError

AMPLE = Limits(600.0)
SMALL = Limits(120.0, memory_mb=700.0)
KILLED = "its process was ended by SIGKILL, 2 times"
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def no_process_left() -> Iterator[None]:
    yield
    supervision._runners.end()
    supervision._runners = supervision.Runners()
    time.sleep(0.1)  # the thread that listens to it ends


def runners() -> list[psutil.Process]:
    return [
        p
        for p in psutil.Process().children()
        if "sonar_graph.batch.one_run" in p.cmdline()
    ]


@pytest.mark.parametrize(
    ("estimator", "limits", "status", "reason"),
    [
        ("hungry", SMALL, "memory", "its processes needed more than 700 MB"),
        ("hungry-child", SMALL, "memory", "its processes needed more than 700 MB"),
        ("forks", Limits(5.0), "timeout", "took longer than 5 s"),
        ("dies-after-forking", AMPLE, "killed", KILLED),
        ("dies", AMPLE, "killed", KILLED),
        ("dies-once", AMPLE, "ok", ""),
    ],
)
def test_a_run_ends_with_its_child_processes(
    planned, misbehaving, estimator, limits, status, reason
):
    row = perform_watched(planned(estimator), limits).row
    assert (row["status"], row["reason"]) == (status, reason)
    assert status == "ok" or not any(map(is_of_this_test, psutil.process_iter()))


def is_of_this_test(process: psutil.Process) -> bool:
    """A runner or a child of one, which has its command and environment."""
    mark = "SONAR_GRAPH_TEST_MARK"
    with contextlib.suppress(psutil.Error):
        is_runner = "sonar_graph.batch.one_run" in process.cmdline()
        return is_runner and process.environ().get(mark) == os.environ[mark]
    return False


def is_runner_of_this_test(process: psutil.Process) -> bool:
    """Children of a runner have its command and environment."""
    with contextlib.suppress(psutil.Error):
        is_runner = "sonar_graph.batch.one_run" in process.cmdline()
        return (
            is_runner
            and process.environ().get("SONAR_GRAPH_TEST_MARK")
            == os.environ["SONAR_GRAPH_TEST_MARK"]
        )
    return False


def test_the_log_has_the_traceback_and_native_output_of_its_run_alone(
    planned, misbehaving
):
    runner = Runner()
    outcome = runner.perform(planned("prints"), AMPLE)
    assert outcome.row["status"] == "failed"
    for text in ("written by native code", "RuntimeError: diverged", "Traceback"):
        assert text in outcome.log
    assert "runs/prints/series.npz" in outcome.files
    assert "diverged" not in runner.perform(planned(), AMPLE).log
    runner.end()


def test_a_process_is_reused_within_a_package(planned, misbehaving):
    perform_watched(planned(), AMPLE)
    (kept,) = runners()
    perform_watched(planned(), AMPLE)
    assert runners() == [kept]
    perform_watched(planned("prints"), AMPLE)
    assert not runners()


def test_order_of_sets_does_not_hang_on_who_started_the_process(
    planned, misbehaving, monkeypatch
):
    reasons = set()
    for seed in ("1", "2"):
        monkeypatch.setenv("PYTHONHASHSEED", seed)
        runner = Runner()
        reasons.add(runner.perform(planned("sums-over-a-set"), AMPLE).row["reason"])
        runner.end()
    (reason,) = reasons
    assert "mine 7" in str(reason)


def test_first_run_of_an_estimator_is_warmed_up_before_its_clock_starts(
    planned, misbehaving, monkeypatch
):
    asked: list[str] = []
    ask = Runner._ask

    def told(self, request, limits):
        asked.append(f"{type(request).__name__} {limits.timeout_s:g}")
        return ask(self, request, limits)

    monkeypatch.setattr(Runner, "_ask", told)
    names = "dead-reckoning", "dead-reckoning", "prints"
    first, again, _ = (perform_watched(planned(name), AMPLE).row for name in names)
    assert asked == ["Preparation 3600", *["PlannedRun 600"] * 3]
    assert first["causal.ate_raw_m"] == again["causal.ate_raw_m"]


def test_a_warm_up_or_start_that_does_not_end_in_time_is_ended_and_named(
    planned, monkeypatch
):
    run = planned()
    with monkeypatch.context() as patch:
        patch.setattr(supervision, "WARM_UP_S", 0.0)
        row = perform_watched(run, AMPLE).row
    assert (row["status"], row["reason"]) == ("timeout", "took longer than 0 s")
    assert not runners()
    monkeypatch.setattr(supervision, "START_S", 0.0)
    told = r"no process for runs on .*: it was not ready after 0 s"
    with pytest.raises(BatchError, match=told):
        Runner()
    assert not runners()


def test_process_of_runs_does_not_outlive_who_started_it():
    code = (
        "from sonar_graph.batch.supervision import Runner; import time;"
        "print(Runner().pid, flush=True); time.sleep(1000)"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as starter:
        runner = psutil.Process(int(starter.stdout.readline()))
        starter.kill()
    assert runner.wait(timeout=30) is None
