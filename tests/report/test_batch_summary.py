from __future__ import annotations

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch.recorded import ALL_LOGS, RecordedBatch
from sonar_graph.batch.result_table import metrics_of
from sonar_graph.batch.statistics import paired, quantile_error
from sonar_graph.evaluation.digits import quantile_text
from sonar_graph.evaluation.tables import Cell, Table
from sonar_graph.report.batch_summary import DIFFERENT, HIGHER, LOWER, head_metric, headlines, mark_of, overview_table
from sonar_graph.report.batch_tables import accuracy_table, all_tests
from sonar_graph.report.rendering import as_csv, as_latex
from tests.recorded_batches import LOGS, METRICS, changed, drawn_batch, failed, updated, with_failures, without

ATE = metrics_of(["causal.ate_se2_m"])[0]


def overview_of(batch: RecordedBatch) -> Table:
    return overview_table(batch, ATE, all_tests(batch, [ATE]))


def cell_of(table: Table, log: str, over: str, contestant: str) -> Cell:
    place = next(
        i for i, c in enumerate(table.columns) if (c.over, c.heading.removesuffix(" (reference)")) == (over, contestant)
    )
    return next(row[place] for row in table.rows if row[0].text == log)


def test_overview_has_the_median_of_every_log_and_contestant():
    batch = drawn_batch()
    row = next(csv.DictReader(io.StringIO(as_csv(overview_of(batch)))))
    for contestant in batch.contestants:
        for kind in ("causal", "smoothed"):
            key = f"{kind}.ate_se2_m"
            assert float(row[f"{key} {contestant}"]) == np.median(batch.values(LOGS[0], contestant, key))


def test_arrows_point_to_the_side_of_the_difference_and_only_where_it_is_no_chance():
    batch = replace(changed(drawn_batch(), "dead-reckoning", "causal.ate_se2_m", 3.0), reference="ekf-slam")
    batch = changed(batch, "isam2", "causal.ate_se2_m", 0.2)
    table = overview_of(batch)
    assert cell_of(table, LOGS[0], "Causal", "isam2").text.endswith(LOWER)
    assert cell_of(table, LOGS[0], "Causal", "dead-reckoning").text.endswith(HIGHER)
    assert LOWER not in cell_of(table, LOGS[0], "Causal", "ekf-slam").text
    few = overview_of(replace(batch, runs=[run for run in batch.runs if run.seed in (0, 1, 2)]))
    assert not any(arrow in cell.text for row in few.rows for cell in row for arrow in (LOWER, HIGHER))


@pytest.mark.parametrize(
    ("median", "mark"), [(-0.1, LOWER), (0.1, HIGHER), (-math.inf, LOWER), (math.inf, HIGHER), (0.0, DIFFERENT)]
)
def test_the_mark_is_of_the_median_and_only_below_five_percent(median, mark):
    test = replace(paired(np.arange(8.0), np.zeros(8)), mean=-7.0 * median, median=median)
    assert mark_of((test, 0.049)) == mark
    assert mark_of((replace(test, median=math.nan), 0.049)) == DIFFERENT
    assert mark_of((test, 0.05)) == mark_of((test, math.nan)) == mark_of(None) == ""


def test_a_filter_has_no_smoothed_column_and_the_reference_is_named():
    same = updated(drawn_batch(), lambda run: {"smoothed.ate_se2_m": run.values["causal.ate_se2_m"]}, ("ekf-slam",))
    table = overview_of(same)
    smoothed = [column.heading.removesuffix(" (reference)") for column in table.columns if column.over == "Smoothed"]
    assert smoothed == ["dead-reckoning", "isam2"]
    assert next(column.heading for column in table.columns if column.over == "Causal") == "dead-reckoning (reference)"


def test_a_median_over_failed_runs_says_so():
    cell = cell_of(overview_of(with_failures(drawn_batch(), "isam2", LOGS[0], 6)), LOGS[0], "Causal", "isam2")
    assert cell.text.startswith("no value")
    assert cell.note == "6 of 10 without a value"


def test_a_median_keeps_its_digits_beside_a_run_that_lost_its_way():
    batch = changed(drawn_batch(logs=LOGS[:1]), "isam2", "causal.ate_se2_m", np.append(np.ones(9), 1e5))
    shown = float(cell_of(overview_of(batch), LOGS[0], "Causal", "isam2").text.split()[0])
    assert shown == pytest.approx(np.median(batch.values(LOGS[0], "isam2", "causal.ate_se2_m")), rel=0.1)
    row = next(row for row in accuracy_table(batch, ATE).rows if row[1].text == "isam2")
    assert float(row[4].text) == shown
    assert 0 < float(row[5].text.partition(" to ")[0]) <= shown


def test_who_never_ended_is_higher_than_the_reference_and_not_left_out():
    batch = with_failures(drawn_batch(logs=LOGS[:1]), "isam2", LOGS[0], 10)
    assert cell_of(overview_of(batch), LOGS[0], "Causal", "isam2").text == f"no value {HIGHER}"
    assert "higher with isam2" in headlines(batch, ATE, all_tests(batch, [ATE]))[0]


def test_the_sentence_counts_logs():
    batch = drawn_batch(logs=("one", "two", "three"))
    causal, smoothed = headlines(batch, ATE, all_tests(batch, [ATE]))
    beside = "error beside that of dead-reckoning"
    assert causal == f"Causal {beside} (on how many of 3 logs): lower with isam2 (3), ekf-slam (3)."
    assert smoothed.startswith(f"Smoothed {beside}")
    worse = {"causal.ate_se2_m": 9.0}
    mixed = updated(batch, lambda run: worse if run.log == "two" else {}, ("isam2",))
    told = headlines(mixed, ATE, all_tests(mixed, [ATE]))[0]
    assert "lower with isam2 (2), ekf-slam (3); higher with isam2 (1)" in told


def test_one_log_is_not_counted_and_few_seeds_tell_nothing():
    batch = drawn_batch(logs=LOGS[:1])
    assert headlines(batch, ATE, all_tests(batch, [ATE]))[0] == (
        "Causal error beside that of dead-reckoning: lower with isam2, ekf-slam."
    )
    few = drawn_batch(3, logs=LOGS[:1])
    (told,) = headlines(few, ATE, all_tests(few, [ATE]))
    assert told.endswith("no estimator is told apart from dead-reckoning.")


def test_what_only_all_logs_together_tell_is_no_count_of_logs():
    batch = drawn_batch(1, logs=tuple("abcdefgh"))
    assert math.isnan(all_tests(batch, [ATE])["causal.ate_se2_m", ALL_LOGS, "isam2"][1]), "one seed is one case"
    batch = replace(batch, runs=[replace(run, seed=None) for run in batch.runs])
    tests = all_tests(batch, [ATE])
    assert tests["causal.ate_se2_m", ALL_LOGS, "isam2"][0].pairs == 8
    assert mark_of(tests["causal.ate_se2_m", ALL_LOGS, "isam2"]) == LOWER
    (told,) = headlines(batch, ATE, tests)
    assert told.endswith("no estimator is told apart from dead-reckoning on any one log.")


def test_the_head_shows_the_first_error_that_most_logs_have():
    batch, metrics = drawn_batch(), metrics_of(METRICS)
    assert head_metric(batch, metrics) == metrics[0]
    assert head_metric(without(batch, "ate", LOGS[0]), metrics) == metrics[1]
    assert head_metric(replace(batch, runs=[failed(run) for run in batch.runs]), metrics) is None


def test_latex_has_arrows_as_commands():
    text = as_latex(overview_of(drawn_batch()))
    assert r"$\downarrow$" in text
    assert LOWER not in text


def test_what_is_no_error_is_no_head():
    assert head_metric(drawn_batch(1), metrics_of(["causal.nees_position"])) is None
    assert head_metric(drawn_batch(1), metrics_of(["causal.nees_position", "causal.ate_se2_m"])).name == ATE.name


def test_logs_are_counted_only_where_somebody_is_told_apart():
    rng = np.random.default_rng(16)
    batch = updated(drawn_batch(), lambda _: {"smoothed.ate_se2_m": rng.lognormal()})
    causal, smoothed = headlines(batch, ATE, all_tests(batch, [ATE]))
    assert causal.startswith("Causal error beside that of dead-reckoning (on how many of 2 logs): lower with")
    assert smoothed == "Smoothed error beside that of dead-reckoning: never told apart: isam2, ekf-slam."


def test_an_angle_has_the_digits_of_its_error_in_degrees():
    batch, yaw = drawn_batch(), metrics_of(["causal.yaw_rmse_rad"])[0]
    values = batch.values(LOGS[0], "isam2", "causal.yaw_rmse_rad")
    expected = quantile_text(math.degrees(np.median(values)), math.degrees(quantile_error(values, 0.5)))
    cell = cell_of(overview_table(batch, yaw, {}), LOGS[0], "Causal", "isam2")
    assert cell.text == expected
