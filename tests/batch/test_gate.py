import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from regression_gate import GateVerdict, bless, gate, log_ratios, worse_groups

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


@pytest.mark.parametrize(
    ("column", "before", "after", "stands_out"),
    [
        (ATE, 1.0, factor_of(7, 1.95, 0.8), False),
        (ATE, 1.0, factor_of(7, 2.05, 0.8), True),
        (ATE, 1.0, factor_of(7, 6.0), True),
        (
            ATE,
            factor_of(3, 4.0),
            factor_of(7, 6.0),
            False,
        ),  # held against the worst of its group, not against itself
        (
            POSITION,
            1.0,
            factor_of(7, 50.0),
            False,
        ),  # a covariance that is far off is no error
    ],
)
def test_a_run_twice_as_bad_as_the_worst_is_told_by_its_seed_and_fails_nothing(
    batch, tmp_path, column, before, after, stands_out
):
    even = level(batch, column, 0.5)
    verdict = judged(
        changed(even, "isam2", column, before),
        changed(even, "isam2", column, after),
        tmp_path,
    )
    assert verdict.passed
    start = f"{LOGS[0]}, isam2, seed 7: {column} is "
    assert [line.startswith(start) for line in verdict.look_at] == [True] * stands_out


@pytest.mark.parametrize(("factor", "passes"), [(1.09, True), (1.11, False)])
def test_consistency_may_move_by_a_tenth(batch, tmp_path, factor, passes):
    even = level(batch, POSITION, 1.5)
    assert (
        judged(even, changed(even, "isam2", POSITION, factor), tmp_path).passed
        is passes
    )


@pytest.mark.parametrize(("seeds", "has_test"), [(2, False), (3, True)])
def test_three_cases_have_a_test_and_two_are_neither_tested_nor_unmoved(
    tmp_path, seeds, has_test
):
    batch = drawn_batch(seeds)
    verdict = judged(batch, batch, tmp_path)
    assert verdict.untested == ([] if has_test else batch.contestants)
    assert verdict.has_test is has_test
    assert verdict.unmoved == (batch.contestants if has_test else [])


def test_without_a_test_logs_are_told_from_a_quarter_on_once_by_what_is_up_most(
    tmp_path,
):
    batch = drawn_batch(2)
    assert not judged(batch, changed(batch, "isam2", ATE, 1.24), tmp_path).look_at
    for ate, yaw in ((1.26, 1.0), (1.3, 1.5), (1.5, 1.3)):
        column, share = (ATE, ate) if ate > yaw else (YAW, yaw)
        verdict = judged(
            batch,
            changed(changed(batch, "isam2", ATE, ate), "isam2", YAW, yaw),
            tmp_path,
        )
        assert verdict.passed
        told = f"isam2: {column} is {share - 1:.0%} worse; 2 cases here, which no test judges"
        assert verdict.look_at == [f"{log}, {told}" for log in LOGS]
    single = drawn_batch(2, logs=LOGS[:1])
    assert (
        len(judged(single, changed(single, "isam2", ATE, [1.0, 9.0]), tmp_path).look_at)
        == 1
    )


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
    worse = changed(
        changed(filters, "ekf-slam", ATE, factors), "ekf-slam", smoothed, factors
    )
    found = [
        (one.log, one.column) for one in judged(filters, worse, tmp_path).worsenings
    ]
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


@pytest.mark.parametrize(
    ("seeds", "told"), [(1, "1 case here"), (2, "2 cases here"), (4, "4 cases here")]
)
def test_a_log_with_few_seeds_beside_one_with_many_is_told(tmp_path, seeds, told):
    many = drawn_batch(10)
    batch = replace(
        many, runs=[run for run in many.runs if run.log == LOGS[0] or run.seed < seeds]
    )
    verdict = judged(
        batch, changed(batch, "isam2", ATE, [1.0] * 10 + [1.9] * seeds), tmp_path
    )
    assert verdict.passed
    assert not verdict.untested
    assert verdict.look_at == [
        f"{LOGS[1]}, isam2: {ATE} is 90% worse; {told}, which no test judges"
    ]


def test_five_per_cent_fails_and_anything_more_passes_and_an_error_of_nothing_has_a_ratio():
    groups = [("basin", "isam2", ATE), ("basin", "ekf-slam", ATE)]
    family = SimpleNamespace(
        groups=groups, p_values=np.array([0.05, np.nextafter(0.05, 1)])
    )
    (worse,) = worse_groups({group: {0: 1.0} for group in groups}, [family])
    assert worse.contestant == "isam2"
    equal, better, worse = log_ratios(
        np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), ATE
    )
    assert -np.inf < better < equal == 0 < worse < np.inf


def test_the_farthest_run_is_told_first_and_by_its_farthest_column(batch, tmp_path):
    even = level(level(batch, ATE, 0.5), YAW, 0.01)
    factors = factor_of(2, 3.0) * factor_of(9, 8.0)
    far = changed(changed(even, "isam2", ATE, factors), "isam2", YAW, factors**2)
    told = [line.split(" is ")[0] for line in judged(even, far, tmp_path).look_at]
    assert told == [f"{LOGS[0]}, isam2, seed {seed}: {YAW}" for seed in (9, 2)]
