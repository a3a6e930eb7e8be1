import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from regression_gate import GateVerdict, bless, gate

from sonar_graph.batch.recorded import RecordedBatch
from sonar_graph.errors import EvaluationError
from tests.recorded_batches import (
    ASKED,
    LOGS,
    changed,
    drawn_batch,
    failed,
    updated,
    with_failures,
    without,
)

ATE = "causal.ate_se2_m"
YAW = "causal.yaw_rmse_rad"


@pytest.fixture
def batch() -> RecordedBatch:
    return drawn_batch(12)


@pytest.fixture
def reference(batch, tmp_path):
    path = tmp_path / "reference.json"
    bless(batch, path)
    return path


def judged(before: RecordedBatch, after: RecordedBatch, folder: Path) -> GateVerdict:
    """A batch, held against an earlier one."""
    bless(before, folder / "before.json")
    return gate(after, folder / "before.json")


def level(batch: RecordedBatch, column: str, value: float) -> RecordedBatch:
    """The batch, had a column the same value in every run."""
    return updated(batch, lambda _: {column: value})


def factor_of(row: int, factor: float, others: float = 1.0) -> np.ndarray:
    """Factors of the 24 runs of a contestant, of which one stands out."""
    return np.where(np.arange(24) == row, factor, others)


def noise(seed: int, mean: float, runs: int = 24) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(np.log(mean), 0.1, runs)


EVERYWHERE = {*LOGS, "all logs"}
POSITION = "causal.nees_position"


@pytest.mark.parametrize(
    ("contestant", "column", "factors", "told"),
    [
        ("isam2", ATE, 1.0, ""),
        ("isam2", ATE, noise(0, 0.7), ""),
        (
            "isam2",
            ATE,
            noise(0, 1.3),
            r"\+\d+\.\d% in the mean of \d+ cases, p = \S+ \(of the whole batch\)",
        ),
        ("isam2", ATE, 1.01, ""),  # no chance, but too small to mind
        ("isam2", ATE, 1.03, r"\+3\.0% in the mean of 12 cases, p = 0\.00\d* "),
        ("isam2", POSITION, 5.0, r"\d+\.\d% farther from 1 in the mean"),
        ("isam2", POSITION, 0.1, r"\d+\.\d% farther from 1 in the mean"),
        ("ekf-slam", POSITION, 0.25, ""),  # 4 before, which fits better now
    ],
)
def test_a_batch_passes_unless_an_error_or_a_consistency_is_worse_beyond_noise(
    batch, reference, contestant, column, factors, told
):
    verdict = gate(changed(batch, contestant, column, factors), reference)
    assert verdict.compared == len(batch.runs)
    found = {(one.log, one.contestant, one.column) for one in verdict.worsenings}
    assert found == (
        {(log, contestant, column) for log in EVERYWHERE} if told else set()
    )
    assert all(re.match(told, one.explanation) for one in verdict.worsenings)
    assert verdict.passed is not bool(told)


def test_a_run_that_fails_now_or_lost_a_score_does_not_pass_and_says_why(
    batch, reference, tmp_path
):
    failing = with_failures(batch, "isam2", LOGS[0], 1)
    (worsening,) = gate(failing, reference).worsenings
    assert worsening.column == "status"
    assert worsening.explanation == "seed 0: timeout, took longer than 60 s"
    lost = without(batch, ATE)
    (worsening,) = gate(
        replace(batch, runs=[lost.runs[0], *batch.runs[1:]]), reference
    ).worsenings
    assert worsening.column == ATE
    all_failed = replace(batch, runs=[failed(run) for run in batch.runs])
    assert len(gate(all_failed, reference).worsenings) == len(batch.runs)
    for before, after in (
        (failing, failing),
        (failing, batch),
        (lost, batch),
    ):  # the reference has nothing better
        verdict = judged(before, after, tmp_path)
        assert verdict.passed
        assert not verdict.look_at


@pytest.mark.parametrize(("seeds", "has_test"), [(2, False), (3, True)])
def test_three_cases_have_a_test_and_two_are_neither_tested_nor_unmoved(
    tmp_path, seeds, has_test
):
    batch = drawn_batch(seeds)
    verdict = judged(batch, batch, tmp_path)
    assert verdict.untested == ([] if has_test else batch.contestants)
    assert verdict.has_test is has_test
    assert verdict.unmoved == (batch.contestants if has_test else [])


@pytest.mark.parametrize(("logs", "passes"), [(2, True), (3, False), (9, False)])
def test_recorded_logs_are_cases_of_one_test(tmp_path, logs, passes):
    batch = drawn_batch(1, logs=tuple(f"dive {n}" for n in range(logs)))
    batch = replace(batch, runs=[replace(run, seed=None) for run in batch.runs])
    verdict = judged(batch, changed(batch, "isam2", ATE, noise(1, 1.5, logs)), tmp_path)
    assert verdict.passed is passes
    found = {(one.log, one.contestant, one.column) for one in verdict.worsenings}
    assert found == (set() if passes else {("all logs", "isam2", ATE)})


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("rate_hz", 4.0, "rate_hz is 4.0, in the reference 2.0"),
        ("options", {"laps": 2}, "options.laps is 2, in the reference 1"),
        ("options", {}, "options.laps is not given, in the reference 1"),
        ("settings", {"lag_s": 5}, "settings.lag_s is 5, in the reference not given"),
        (
            "landmarks",
            {"spacing_m": 25},
            "landmarks.spacing_m is 25, in the reference not given",
        ),
        ("landmarks", {}, "landmarks is {}, in the reference not given"),
        (
            "settings",
            {"lag_s": None},
            "settings.lag_s is null, in the reference not given",
        ),
        ("files", {"log": "abc"}, 'files.log is "abc", in the reference not given'),
    ],
)
def test_other_experiments_under_the_same_names_are_refused(
    batch, reference, field, value, said
):
    asked = json.dumps(ASKED | {field: value})
    other = [
        *batch.runs[:4],
        replace(batch.runs[4], texts={"asked": asked}),
        *batch.runs[5:],
    ]
    with pytest.raises(
        EvaluationError,
        match=re.escape(f"basin, isam2, seed 1: {said}; these are different"),
    ):
        gate(replace(batch, runs=other), reference)


def test_what_is_no_reference_is_refused(batch, reference, tmp_path):
    for runs, told in (
        (
            [replace(run, texts={}) for run in batch.runs],
            "basin, dead-reckoning, seed 0: the results have no column",
        ),
        ([failed(run) for run in batch.runs], "none of its 72 runs ended"),
    ):
        with pytest.raises(EvaluationError, match=told):
            bless(replace(batch, runs=runs), tmp_path / "none.json")
    fewer, other = replace(batch, runs=batch.runs[1:]), tmp_path / "other.json"
    with pytest.raises(
        EvaluationError,
        match="1 of its runs are not in the batch, first basin, dead-reckoning, seed",
    ):
        gate(fewer, reference)
    assert judged(fewer, batch, tmp_path).new == ["basin, dead-reckoning, seed 0"]
    for content, told in (
        ('{"format": "something else"}', r"other\.json: format is 'something else'"),
        (
            '{"format": "sonar_graph batch reference 1", "runs": []}',
            "make it again with bless",
        ),
    ):
        other.write_text(content)
        with pytest.raises(EvaluationError, match=told):
            gate(batch, other)


def test_a_run_that_did_not_end_leaves_no_score_in_a_reference(batch, tmp_path):
    ended_late = [replace(batch.runs[0], status="timeout"), *batch.runs[1:]]
    bless(replace(batch, runs=ended_late), tmp_path / "reference.json")
    content = json.loads((tmp_path / "reference.json").read_text())
    assert content["runs"][0]["scores"] == {}
    assert content["versions"] == batch.runs[0].texts


def slower(batch: RecordedBatch, factor: float) -> RecordedBatch:
    """The batch, on a machine that takes so many times as long."""
    timed = updated(batch, lambda run: {"time.total_s": factor * (3 + 0.1 * run.seed)})
    return replace(timed, metrics=[ATE, "time.total_s"])


def test_a_slower_machine_passes_also_by_a_reference_that_has_times(batch, tmp_path):
    path = tmp_path / "reference.json"
    bless(slower(batch, 1.0), path)
    assert "time.total_s" not in path.read_text()
    content = json.loads(path.read_text())
    content["metrics"].append("time.total_s")
    for entry, run in zip(content["runs"], slower(batch, 1.0).runs, strict=True):
        entry["scores"]["time.total_s"] = run.values["time.total_s"]
    path.write_text(json.dumps(content))
    assert gate(slower(batch, 4.0), path).passed
