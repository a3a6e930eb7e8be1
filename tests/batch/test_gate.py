from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch.gate import FAR, bless, gate, gated_keys, log_ratios
from sonar_graph.batch.recorded import RecordedBatch
from sonar_graph.errors import EvaluationError

from .recorded_batches import LOGS, changed, drawn_batch, failed, with_failures

ATE = "causal.ate_se2_m"


@pytest.fixture
def batch() -> RecordedBatch:
    return drawn_batch(12)


@pytest.fixture
def reference(batch, tmp_path):
    path = tmp_path / "reference.json"
    bless(batch, path)
    return path


def noise(seed: int, mean: float, runs: int = 24) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(np.log(mean), 0.1, runs)


def test_a_batch_passes_by_its_own_reference(batch, reference):
    verdict = gate(batch, reference)
    assert verdict.passed
    assert verdict.compared == len(batch.runs)


def test_a_larger_error_is_told_by_log_estimator_and_column(batch, reference):
    worse = gate(changed(batch, "isam2", ATE, noise(0, 1.3)), reference).worsenings
    assert {(one.log, one.contestant, one.column) for one in worse} == {(log, "isam2", ATE) for log in LOGS}
    assert "(Holm)" in str(worse[0])


def test_a_smaller_error_passes(batch, reference):
    assert gate(changed(batch, "isam2", ATE, noise(0, 0.7)), reference).passed


def test_noise_about_the_same_error_passes_as_often_as_promised(batch, reference):
    columns = [key for key in gated_keys(batch) if "landmarks" not in key and "nees" not in key]
    refused = []
    for seed in range(60):
        noisy = batch
        for number, (name, column) in enumerate(itertools.product(batch.contestants, columns)):
            noisy = changed(noisy, name, column, noise(100 * seed + number, 1.0))
        refused.append(not gate(noisy, reference).passed)
    assert len(columns) == 4
    assert np.mean(refused) <= 0.1


def test_a_change_too_small_to_mind_passes_though_no_chance(batch, reference):
    assert gate(changed(batch, "isam2", ATE, 1.01), reference).passed
    worse = gate(changed(batch, "isam2", ATE, 1.03), reference).worsenings
    assert {one.explanation for one in worse} == {"+3.0% in the mean of 12 pairs, alike in all of them"}


@pytest.mark.parametrize("factor", [5.0, 0.1])
def test_covariances_that_fit_worse_do_not_pass_on_either_side(batch, reference, factor):
    worse = gate(changed(batch, "isam2", "causal.nees_position", factor), reference).worsenings
    assert {one.column for one in worse} == {"causal.nees_position"}
    assert all("% farther from 1 in the mean" in one.explanation for one in worse)


def test_covariances_that_fit_better_pass(batch, reference):
    assert gate(changed(batch, "ekf-slam", "causal.nees_position", 0.25), reference).passed
    assert log_ratios(np.array([4.0]), np.array([1.0]), "causal.nees_position")[0] < 0


def test_a_run_that_fails_now_does_not_pass_and_says_why(batch, reference):
    (worsening,) = gate(with_failures(batch, "isam2", LOGS[0], 1), reference).worsenings
    assert worsening.column == "status"
    assert worsening.explanation == "seed 0: timeout, took longer than 60 s"


def test_a_run_that_failed_before_may_fail_or_end(batch, tmp_path):
    before = with_failures(batch, "isam2", LOGS[0], 1)
    bless(before, tmp_path / "reference.json")
    assert gate(before, tmp_path / "reference.json").passed
    assert gate(batch, tmp_path / "reference.json").passed


def test_a_lost_score_does_not_pass(batch, reference):
    runs = [replace(run, values={k: v for k, v in run.values.items() if k != ATE}) for run in batch.runs[:1]]
    (worsening,) = gate(replace(batch, runs=[*runs, *batch.runs[1:]]), reference).worsenings
    assert worsening.column == ATE


def test_one_run_that_lost_its_way_is_not_hidden_by_many_that_did_not(batch, reference):
    factors = np.full(24, 0.9)
    factors[7] = 100.0
    (worsening,) = gate(changed(batch, "isam2", ATE, factors), reference).worsenings
    assert "in a run" in worsening.explanation
    assert FAR > 1


def test_single_runs_are_judged_by_a_wide_limit(tmp_path):
    batch = drawn_batch(1, logs=LOGS[:1])
    bless(batch, tmp_path / "reference.json")
    assert gate(changed(batch, "isam2", ATE, 1.2), tmp_path / "reference.json").passed
    assert not gate(changed(batch, "isam2", ATE, 1.3), tmp_path / "reference.json").passed


def slower(batch: RecordedBatch, factor: float) -> RecordedBatch:
    """The batch, on a machine that takes so many times as long."""
    runs = [replace(run, values=run.values | {"time.total_s": factor * (3 + 0.1 * run.seed)}) for run in batch.runs]
    return replace(batch, runs=runs, metrics=[ATE, "time.total_s"])


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


@pytest.mark.parametrize(("factor", "passes"), [(1.09, True), (1.11, False)])
def test_consistency_may_move_by_a_tenth(batch, tmp_path, factor, passes):
    level = replace(batch, runs=[replace(r, values=r.values | {"causal.nees_position": 1.5}) for r in batch.runs])
    bless(level, tmp_path / "level.json")
    assert gate(changed(level, "isam2", "causal.nees_position", factor), tmp_path / "level.json").passed is passes


@pytest.mark.parametrize(("factor", "passes"), [(1.95, True), (2.05, False)])
def test_a_run_twice_as_bad_as_the_worst_is_lost(batch, tmp_path, factor, passes):
    level = replace(batch, runs=[replace(r, values=r.values | {ATE: 0.5}) for r in batch.runs])
    bless(level, tmp_path / "level.json")
    factors = np.full(24, 0.8)
    factors[7] = factor
    assert gate(changed(level, "isam2", ATE, factors), tmp_path / "level.json").passed is passes


def test_missing_runs_are_refused_and_new_ones_named(batch, reference, tmp_path):
    with pytest.raises(
        EvaluationError, match="1 of its runs are not in the batch, first basin, dead-reckoning, seed 0"
    ):
        gate(replace(batch, runs=batch.runs[1:]), reference)
    bless(replace(batch, runs=batch.runs[1:]), tmp_path / "fewer.json")
    assert gate(batch, tmp_path / "fewer.json").new == ["basin, dead-reckoning, seed 0"]


def test_what_is_no_reference_is_refused(batch, tmp_path):
    (tmp_path / "other.json").write_text('{"format": "something else"}')
    with pytest.raises(EvaluationError, match=r"other\.json: format is 'something else'"):
        gate(batch, tmp_path / "other.json")


def test_a_batch_in_which_all_failed_does_not_pass(batch, reference):
    verdict = gate(replace(batch, runs=[failed(run) for run in batch.runs]), reference)
    assert len(verdict.worsenings) == len(batch.runs)
