from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sonar_graph.batch.gate import GateVerdict, bless, gate, log_ratios, worse_groups
from sonar_graph.batch.recorded import RecordedBatch
from sonar_graph.errors import EvaluationError
from tests.recorded_batches import ASKED, LOGS, changed, drawn_batch, failed, updated, with_failures, without

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


def test_a_batch_passes_by_its_own_reference(batch, reference):
    verdict = gate(batch, reference)
    assert verdict.passed
    assert verdict.compared == len(batch.runs)


def test_a_larger_error_is_told_by_log_estimator_and_column(batch, reference):
    worse = gate(changed(batch, "isam2", ATE, noise(0, 1.3)), reference).worsenings
    found = {(one.log, one.contestant, one.column) for one in worse}
    assert found == {(log, "isam2", ATE) for log in (*LOGS, "all logs")}
    assert "(of the whole batch)" in str(worse[0])


def test_a_smaller_error_passes(batch, reference):
    assert gate(changed(batch, "isam2", ATE, noise(0, 0.7)), reference).passed


def test_a_change_too_small_to_mind_passes_though_no_chance(batch, reference):
    assert gate(changed(batch, "isam2", ATE, 1.01), reference).passed
    worse = gate(changed(batch, "isam2", ATE, 1.03), reference).worsenings
    assert all(one.explanation.startswith("+3.0% in the mean of 12 cases, p = 0.00") for one in worse)
    assert {one.log for one in worse} == {*LOGS, "all logs"}


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
    assert judged(before, before, tmp_path).passed
    assert judged(before, batch, tmp_path).passed


def test_a_lost_score_does_not_pass(batch, reference):
    lost = without(batch, ATE).runs[0]
    (worsening,) = gate(replace(batch, runs=[lost, *batch.runs[1:]]), reference).worsenings
    assert worsening.column == ATE


def test_one_run_that_lost_its_way_is_told_by_its_seed_and_fails_nothing(batch, reference):
    verdict = gate(changed(batch, "isam2", ATE, factor_of(7, 100.0, 0.9)), reference)
    assert verdict.passed
    (line,) = verdict.look_at
    assert line.startswith(f"{LOGS[0]}, isam2, seed 7: {ATE} is ")


def test_single_runs_have_no_test_and_are_told_from_a_quarter_on(tmp_path):
    batch = drawn_batch(2, logs=LOGS)
    assert not judged(batch, changed(batch, "isam2", ATE, 1.24), tmp_path).look_at
    verdict = judged(batch, changed(batch, "isam2", ATE, 1.26), tmp_path)
    assert verdict.passed
    assert verdict.look_at == [f"{log}, isam2: {ATE} is 26% worse; 2 cases here, which no test judges" for log in LOGS]
    assert verdict.untested == ["dead-reckoning", "isam2", "ekf-slam"]


@pytest.mark.parametrize(("logs", "passes"), [(2, True), (3, False), (9, False)])
def test_recorded_logs_are_cases_of_one_test(tmp_path, logs, passes):
    batch = drawn_batch(1, logs=tuple(f"dive {n}" for n in range(logs)))
    batch = replace(batch, runs=[replace(run, seed=None) for run in batch.runs])
    verdict = judged(batch, changed(batch, "isam2", ATE, noise(1, 1.5, logs)), tmp_path)
    assert verdict.passed is passes
    found = {(one.log, one.contestant, one.column) for one in verdict.worsenings}
    assert found == (set() if passes else {("all logs", "isam2", ATE)})


def test_equal_numbers_of_both_estimates_are_one_worsening(batch, tmp_path):
    smoothed, factors = "smoothed.ate_se2_m", noise(0, 1.5)
    filters = updated(batch, lambda run: {smoothed: run.values[ATE]})
    worse = changed(changed(filters, "ekf-slam", ATE, factors), "ekf-slam", smoothed, factors)
    found = [(one.log, one.column) for one in judged(filters, worse, tmp_path).worsenings]
    assert {column for _, column in found} == {f"{ATE}, {smoothed}"}
    assert len(found) == len(set(found)) == 3


def test_the_verdict_tells_what_it_would_have_found(batch, reference):
    small = gate(changed(batch, "isam2", ATE, noise(2, 1.0)), reference)
    large = gate(changed(batch, "isam2", ATE, noise(2, 1.0) ** 5), reference)
    assert set(small.detectable) == {"isam2"}
    assert small.unmoved == ["dead-reckoning", "ekf-slam"]
    assert 0.03 < small.detectable["isam2"] < 0.3 < large.detectable["isam2"]


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("rate_hz", 4.0, "rate_hz is 4.0, in the reference 2.0"),
        ("options", {"laps": 2}, "options.laps is 2, in the reference 1"),
        ("options", {}, "options.laps is not given, in the reference 1"),
        ("settings", {"lag_s": 5}, "settings.lag_s is 5, in the reference not given"),
        ("landmarks", {"spacing_m": 25}, "landmarks.spacing_m is 25, in the reference not given"),
        ("landmarks", {}, "landmarks is {}, in the reference not given"),
        ("settings", {"lag_s": None}, "settings.lag_s is null, in the reference not given"),
        ("files", {"log": "abc"}, 'files.log is "abc", in the reference not given'),
    ],
)
def test_other_experiments_under_the_same_names_are_refused(batch, reference, field, value, said):
    asked = json.dumps(ASKED | {field: value})
    other = [*batch.runs[:4], replace(batch.runs[4], texts={"asked": asked}), *batch.runs[5:]]
    with pytest.raises(EvaluationError, match=re.escape(f"basin, isam2, seed 1: {said}; these are different")):
        gate(replace(batch, runs=other), reference)


def test_results_that_do_not_say_what_was_asked_are_refused(batch, tmp_path):
    with pytest.raises(EvaluationError, match="basin, dead-reckoning, seed 0: the results have no column asked"):
        bless(replace(batch, runs=[replace(run, texts={}) for run in batch.runs]), tmp_path / "reference.json")


def test_a_batch_of_which_no_run_ended_is_no_reference(batch, tmp_path):
    with pytest.raises(EvaluationError, match="none of its 72 runs ended"):
        bless(replace(batch, runs=[failed(run) for run in batch.runs]), tmp_path / "reference.json")


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


@pytest.mark.parametrize(("factor", "passes"), [(1.09, True), (1.11, False)])
def test_consistency_may_move_by_a_tenth(batch, tmp_path, factor, passes):
    even = level(batch, "causal.nees_position", 1.5)
    assert judged(even, changed(even, "isam2", "causal.nees_position", factor), tmp_path).passed is passes


@pytest.mark.parametrize(("factor", "is_told"), [(1.95, False), (2.05, True)])
def test_a_run_twice_as_bad_as_the_worst_stands_out(batch, tmp_path, factor, is_told):
    even = level(batch, ATE, 0.5)
    assert bool(judged(even, changed(even, "isam2", ATE, factor_of(7, factor, 0.8)), tmp_path).look_at) is is_told


def test_missing_runs_are_refused_and_new_ones_named(batch, reference, tmp_path):
    fewer = replace(batch, runs=batch.runs[1:])
    with pytest.raises(EvaluationError, match="1 of its runs are not in the batch, first basin, dead-reckoning, seed"):
        gate(fewer, reference)
    assert judged(fewer, batch, tmp_path).new == ["basin, dead-reckoning, seed 0"]


def test_what_is_no_reference_is_refused(batch, tmp_path):
    (tmp_path / "other.json").write_text('{"format": "something else"}')
    with pytest.raises(EvaluationError, match=r"other\.json: format is 'something else'"):
        gate(batch, tmp_path / "other.json")
    (tmp_path / "first.json").write_text('{"format": "sonar_graph batch reference 1", "runs": []}')
    with pytest.raises(EvaluationError, match="make it again with bench bless"):
        gate(batch, tmp_path / "first.json")


def test_a_batch_in_which_all_failed_does_not_pass(batch, reference):
    verdict = gate(replace(batch, runs=[failed(run) for run in batch.runs]), reference)
    assert len(verdict.worsenings) == len(batch.runs)


@pytest.mark.parametrize(("seeds", "told"), [(1, "1 case here"), (2, "2 cases here"), (4, "4 cases here")])
def test_a_log_with_few_seeds_beside_one_with_many_is_told(tmp_path, seeds, told):
    many = drawn_batch(10)
    batch = replace(many, runs=[run for run in many.runs if run.log == LOGS[0] or run.seed < seeds])
    verdict = judged(batch, changed(batch, "isam2", ATE, [1.0] * 10 + [1.9] * seeds), tmp_path)
    assert verdict.passed
    assert not verdict.untested
    assert verdict.look_at == [f"{LOGS[1]}, isam2: {ATE} is 90% worse; {told}, which no test judges"]


def test_five_per_cent_fails_and_anything_more_passes():
    groups = [("basin", "isam2", ATE), ("basin", "ekf-slam", ATE)]
    family = SimpleNamespace(groups=groups, p_values=np.array([0.05, np.nextafter(0.05, 1)]))
    (worse,) = worse_groups({group: {0: 1.0} for group in groups}, [family])
    assert worse.contestant == "isam2"


def test_an_error_of_nothing_has_a_ratio():
    ratios = log_ratios(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), ATE)
    assert np.isfinite(ratios).all()
    assert ratios[0] == 0
    assert ratios[1] < 0 < ratios[2]


@pytest.mark.parametrize(("seeds", "has_test"), [(2, False), (3, True)])
def test_three_cases_have_a_test_and_two_are_neither_tested_nor_unmoved(tmp_path, seeds, has_test):
    batch = drawn_batch(seeds)
    verdict = judged(batch, batch, tmp_path)
    assert verdict.untested == ([] if has_test else batch.contestants)
    assert verdict.has_test is has_test
    assert verdict.unmoved == (batch.contestants if has_test else [])


def test_a_score_that_the_reference_lacks_is_not_judged(batch, tmp_path):
    verdict = judged(without(batch, ATE), batch, tmp_path)
    assert verdict.passed
    assert not verdict.look_at


def test_a_run_that_did_not_end_leaves_no_score_in_a_reference(batch, tmp_path):
    ended_late = [replace(batch.runs[0], status="timeout"), *batch.runs[1:]]
    bless(replace(batch, runs=ended_late), tmp_path / "reference.json")
    content = json.loads((tmp_path / "reference.json").read_text())
    assert content["runs"][0]["scores"] == {}
    assert content["versions"] == batch.runs[0].texts


def test_a_run_is_held_against_the_worst_of_its_group_and_not_against_itself(batch, tmp_path):
    even = level(batch, ATE, 0.5)
    hard = changed(even, "isam2", ATE, factor_of(3, 4.0))
    other = changed(even, "isam2", ATE, factor_of(7, 6.0))
    assert not judged(hard, other, tmp_path).look_at
    assert len(judged(even, other, tmp_path).look_at) == 1


def test_the_farthest_run_is_told_first_and_by_its_farthest_column(batch, tmp_path):
    even = level(level(batch, ATE, 0.5), YAW, 0.01)
    factors = factor_of(2, 3.0) * factor_of(9, 8.0)
    far = changed(changed(even, "isam2", ATE, factors), "isam2", YAW, factors**2)
    told = [line.split(" is ")[0] for line in judged(even, far, tmp_path).look_at]
    assert told == [f"{LOGS[0]}, isam2, seed {seed}: {YAW}" for seed in (9, 2)]


def test_a_covariance_that_is_far_off_is_no_error_that_stands_out(batch, reference):
    assert not gate(changed(batch, "isam2", "causal.nees_position", factor_of(7, 50.0)), reference).look_at


def test_without_a_test_a_log_is_told_once_by_what_is_up_most(tmp_path):
    batch = drawn_batch(2, logs=LOGS[:1])
    for first, second in ((1.3, 1.5), (1.5, 1.3)):
        up = changed(changed(batch, "isam2", ATE, first), "isam2", YAW, second)
        (line,) = judged(batch, up, tmp_path).look_at
        assert line.startswith(f"{LOGS[0]}, isam2: {ATE if first > second else YAW} is 50% worse")
    assert len(judged(batch, changed(batch, "isam2", ATE, [1.0, 9.0]), tmp_path).look_at) == 1
