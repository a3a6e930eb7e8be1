from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch.gate import bless, gate
from sonar_graph.batch.recorded import RecordedBatch, read_batch
from sonar_graph.batch.result_table import metrics_of
from sonar_graph.errors import EvaluationError
from sonar_graph.report.batch_page import render_batch, write_batch_report
from sonar_graph.report.batch_summary import lost_told, marked, missing_told
from sonar_graph.report.batch_tables import all_tests, failure_table
from tests.recorded_batches import ESTIMATORS, LOGS, drawn_batch, with_failures, with_missing, write_batch

ATE = "causal.ate_se2_m"


@pytest.fixture
def incomplete() -> RecordedBatch:
    """Of 60 runs four of isam2 and all ten of ekf-slam on one log are not done; one more run failed."""
    batch = with_failures(drawn_batch(10), "isam2", LOGS[0], 1)
    return with_missing(with_missing(batch, "isam2", LOGS[0], 4), "ekf-slam", LOGS[0], 10)


def rows(batch: RecordedBatch) -> dict[tuple[str, str], dict[str, object]]:
    table = failure_table(batch)
    keys = [column.key for column in table.columns]
    cells = [dict(zip(keys, [cell.numbers[0] for cell in row], strict=True)) for row in table.rows]
    return {(str(row["log"]), str(row["contestant"])): row for row in cells}


def test_missing_runs_are_counted_and_are_no_failures(incomplete):
    counted = rows(incomplete)
    assert len(counted) == 6
    some, none = counted[LOGS[0], "isam2"], counted[LOGS[0], "ekf-slam"]
    assert (some["runs"], some["ended"], some["failure_rate"], some["not_run"]) == (6, 5, 1 / 6, 4)
    assert (none["runs"], none["not_run"]) == (0, 10)
    assert np.isnan(none["failure_rate"])
    assert counted[LOGS[1], "isam2"]["not_run"] == 0
    assert "not_run" not in rows(drawn_batch(2))[LOGS[0], "isam2"]


def test_missing_runs_make_no_pairs_and_no_values(incomplete):
    assert len(incomplete.values(LOGS[0], "isam2", ATE)) == 6
    assert len(incomplete.pairs(LOGS[0], "isam2", ATE)[0]) == 6
    assert not incomplete.is_asked(LOGS[0], "ekf-slam", ATE)
    complete = with_failures(drawn_batch(10), "isam2", LOGS[0], 1)
    dropped = replace(incomplete, missing=[])
    metrics = metrics_of(complete.metrics)
    assert str(all_tests(incomplete, metrics)) == str(all_tests(dropped, metrics)) != str(all_tests(complete, metrics))


def test_contestants_and_logs_keep_the_order_of_the_plan(incomplete, tmp_path):
    lacks_first = with_missing(incomplete, "dead-reckoning", LOGS[0], 10)
    assert lacks_first.contestants == drawn_batch(1).contestants
    assert read_batch(write_batch(lacks_first, tmp_path)).contestants == list(ESTIMATORS)


def test_a_table_with_missing_runs_is_read_as_one(incomplete, tmp_path):
    back = read_batch(write_batch(incomplete, tmp_path))
    assert [run.key for run in back.runs] == [run.key for run in incomplete.runs]
    assert {run.key for run in back.missing} == {run.key for run in incomplete.missing}


def test_a_batch_of_which_nothing_is_done_is_refused(tmp_path):
    batch = drawn_batch(1, logs=LOGS[:1])
    for name in ESTIMATORS:
        batch = with_missing(batch, name, LOGS[0], 1)
    write_batch(replace(batch, runs=[]), tmp_path)
    with pytest.raises(EvaluationError, match=r"none of its 3 runs has been done yet; give the bench command"):
        read_batch(tmp_path)


def test_the_warning_says_how_many_whose_where_and_how_to_go_on(incomplete):
    (told,) = missing_told(incomplete)
    assert told.startswith("This batch is not complete: 14 of 60 runs have not been done (isam2 4 of 20, ekf-slam")
    assert "on basin. All numbers are of the other runs" in told
    assert "give the bench command that began it again" in told
    assert missing_told(drawn_batch(2)) == []


def test_page_and_tables_say_that_runs_are_missing(incomplete, tmp_path):
    write_batch_report(incomplete, tmp_path)
    html = (tmp_path / "report.html").read_text("utf-8")
    first = html.index('<p class="warning">')
    assert html[first:].startswith('<p class="warning">This batch is not complete: 14 of 60 runs')
    assert first < html.index("<table")
    assert "that was done ended well" not in html, "one did not"
    for path in (tmp_path / "tables").glob("*.tex"):
        assert "Not complete: 14 of 60 runs have not been done." in path.read_text("utf-8"), path
    counted = list(csv.DictReader(io.StringIO((tmp_path / "tables" / "failures.csv").read_text("utf-8"))))
    assert sum(int(row["not_run"]) for row in counted) == 14


def test_a_complete_page_says_nothing_of_it():
    html = render_batch(drawn_batch(2))
    assert "not complete" not in html.lower()
    assert "Every run ended well." in html
    table = failure_table(drawn_batch(2))
    assert marked(drawn_batch(2), table) is table


@pytest.mark.parametrize("gone", ["dead-reckoning", "isam2"])
def test_a_contestant_without_any_run_leaves_a_page_of_the_others(gone):
    batch = drawn_batch(3)
    for log in LOGS:
        batch = with_missing(batch, gone, log, 3)
    html = render_batch(batch)
    assert "Every run that was done ended well." in html
    assert f"({gone} 6 of 6)" in html


def test_an_incomplete_batch_is_no_reference_and_passes_no_gate(incomplete, tmp_path):
    reference = tmp_path / "reference.json"
    with pytest.raises(EvaluationError, match=r"the batch 'drawn' cannot become a reference, 14 of 60 runs"):
        bless(incomplete, reference)
    assert not reference.exists()
    bless(drawn_batch(9), reference)
    extended = with_missing(drawn_batch(10), "isam2", LOGS[0], 1)
    with pytest.raises(EvaluationError, match="1 of 60 runs has not been done"):
        gate(extended, reference)


@pytest.mark.parametrize(("count", "named"), [(3, "log 0; log 1; log 2."), (5, "log 0; log 1; log 2 and 2 more.")])
def test_the_warning_names_three_logs_and_counts_the_others(count, named):
    logs = tuple(f"log {place}" for place in range(count))
    batch = drawn_batch(2, logs=logs)
    for log in logs:
        batch = with_missing(batch, "isam2", log, 1)
    (told,) = missing_told(batch)
    assert f", on {named} All numbers" in told


def test_rows_whose_runs_are_not_here_are_told_and_lead_nowhere(tmp_path):
    batch = drawn_batch(2)
    write_batch(batch, tmp_path)
    for run in batch.runs[1:]:
        (tmp_path / run.log_file).parent.mkdir(parents=True)
        (tmp_path / run.log_file).write_text("")
    back = read_batch(tmp_path)
    assert [run.log_file for run in back.runs] == ["", *(run.log_file for run in batch.runs[1:])]
    (sentence,) = lost_told(back)
    assert sentence.startswith(f"The table has 1 run whose folder is not here, first {batch.runs[0].key}")
    assert lost_told(batch) == []
