import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import regression_gate
from regression_gate import GateVerdict, bless, gate

from sonar_graph.batch import RecordedBatch
from tests.recorded_batches import (
    LOGS,
    changed,
    drawn_batch,
    failed,
    updated,
    with_failures,
    without,
    written_batch,
)

ATE = "causal.ate_se2_m"


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


def noise(seed: int, mean: float, runs: int = 24) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(np.log(mean), 0.1, runs)


EVERYWHERE = {*LOGS, "all logs"}
POSITION = "causal.nees_position"
TIME = "time.total_s"


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
def test_a_batch_fails_if_an_error_is_worse_beyond_noise(
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
    one_lost = replace(batch, runs=[lost.runs[0], *batch.runs[1:]])
    (worsening,) = gate(one_lost, reference).worsenings
    assert worsening.column == ATE
    all_failed = replace(batch, runs=[failed(run) for run in batch.runs])
    assert len(gate(all_failed, reference).worsenings) == len(batch.runs)
    # the reference has nothing better
    for before, after in ((failing, failing), (failing, batch), (lost, batch)):
        verdict = judged(before, after, tmp_path)
        assert verdict.passed
        assert not verdict.look_at


def test_a_slower_machine_passes_also_by_a_reference_that_has_times(batch, tmp_path):
    def timed(factor):
        slow = updated(batch, lambda run: {TIME: factor * (3 + 0.1 * run.seed)})
        return replace(slow, metrics=[ATE, TIME])

    path = tmp_path / "reference.json"
    bless(timed(1.0), path)
    content = json.loads(path.read_text())
    assert TIME not in path.read_text()
    content["metrics"].append(TIME)
    for entry, run in zip(content["runs"], timed(1.0).runs, strict=True):
        entry["scores"][TIME] = run.values[TIME]
    path.write_text(json.dumps(content))
    assert gate(timed(4.0), path).passed


def script(*words: object) -> int:
    return regression_gate.main([str(word) for word in words])


def test_the_script_passes_a_batch_by_its_own_reference(tmp_path, capsys):
    reference = tmp_path / "reference.json"
    folder = written_batch(tmp_path / "batch")
    assert script("bless", folder, reference) == 0
    content = json.loads(reference.read_text("utf-8"))
    assert content["format"] == "sonar_graph batch reference 2"
    assert script("judge", folder, reference) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Reference: {reference} (16 runs, 0 of which did not end)",
        "Hardly different from the reference: dead-reckoning, isam2",
        f"Gate: passed, 16 runs held against {reference}",
    ]
    assert script("judge", written_batch(tmp_path / "worse", 1.5), reference) == 1
    said = capsys.readouterr().out
    for line in (
        "Worse: basin, isam2, causal.ate_se2_m: +50.0% in the mean of 8 cases, p = 0.0039 (of the whole batch)",
        "Gate: failed",
        "Would have been found in four of five batches: one error larger on all logs by about",
        "Hardly different from the reference: dead-reckoning",
    ):
        assert line in said
    content["runs"][0]["asked"]["settings"] = {"lag_s": 1.0}
    reference.write_text(json.dumps(content))
    assert script("judge", folder, reference) == 2
    told = "seed 0: settings.lag_s is not given, in the reference 1.0; these are"
    assert told in capsys.readouterr().err
