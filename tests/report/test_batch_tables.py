"""Tables and sentences of a batch: pairs, no mean over survivors, one family a metric, digits, and the warnings."""

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch import ALL_LOGS, KINDS, Metric, RecordedBatch, metrics_of
from sonar_graph.evaluation import format_value
from sonar_graph.report import batch_summary as summary
from sonar_graph.report import batch_tables as tables
from sonar_graph.report.rendering import as_csv, csv_text
from sonar_graph.table import Cell, Column, Table
from tests.recorded_batches import (
    LOGS,
    METRICS,
    changed,
    drawn_batch,
    failed,
    updated,
    with_failures,
    without,
)

ATE, YAW = metrics_of(["causal.ate_se2_m", "causal.yaw_rmse_rad"])
EVERY_METRIC = metrics_of(METRICS)
KEY = "causal.ate_se2_m"
YAW_KEY = "causal.yaw_rmse_rad"
BATCH = drawn_batch()


def rows_of(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(as_csv(table))))


def row_of(table: Table, contestant: str, log: str = LOGS[0]) -> dict[str, str]:
    place = {"log": log, "contestant": contestant}
    return next(row for row in rows_of(table) if row.items() >= place.items())


def median_of(table: Table, contestant: str, key: str = KEY) -> Cell:
    """Of an overview, on the first log."""
    keys = [column.key for column in table.columns]
    return table.rows[0][keys.index(f"{key} {contestant}")]


def compared_runs(batch: RecordedBatch) -> tables.Tests:
    return tables.all_tests(batch, [ATE])


def overview_of(batch: RecordedBatch) -> Table:
    return summary.overview_table(batch, ATE, compared_runs(batch))


@pytest.mark.parametrize("seeds", [4, 8, 9, 12])
def test_too_few_seeds_to_tell_anything_are_named_with_the_number_needed(seeds):
    """Holm's correction keeps every p above 5 % exactly as long as the page names more seeds."""
    tests = compared_runs(drawn_batch(seeds))
    caption = summary.overview_table(drawn_batch(seeds), ATE, tests).caption
    n = len({id(test) for test, _ in tests.values()})
    is_lacking = f"{seeds} seeds cannot tell any difference apart" in caption
    assert is_lacking == (n * 2.0 ** (1 - seeds) >= 0.05)
    if is_lacking:
        needed = int(caption.split()[-1].rstrip("."))
        assert n * 2.0 ** (1 - needed) < 0.05 <= n * 2.0 ** (2 - needed)


def test_causal_and_smoothed_errors_have_their_own_columns():
    row = row_of(tables.accuracy_table(BATCH, ATE), "isam2")
    overview = overview_of(BATCH)
    for kind in KINDS:
        key = f"{kind}.ate_se2_m"
        values = BATCH.values(LOGS[0], "isam2", key)
        expected = {
            f"{key}_mean": values.mean(),
            f"{key}_mean_se": values.std(ddof=1) / np.sqrt(10),
            f"{key}_median": np.median(values),
            f"{key}_10_percent": np.quantile(values, 0.1),
            f"{key}_90_percent": np.quantile(values, 0.9),
        }
        found = {name: float(row[name]) for name in expected}
        assert found == pytest.approx(expected, rel=1e-12)
        assert median_of(overview, "isam2", key).numbers[0] == np.median(values)


def test_no_mean_is_given_over_survivors_and_the_tables_say_why():
    batch = with_failures(BATCH, "isam2", LOGS[0], 2)
    table = tables.accuracy_table(batch, ATE)
    row = row_of(table, "isam2")
    assert (row[f"{KEY}_mean"], row["runs"]) == ("", "10")
    notes = [cell.note for line in table.rows for cell in line if cell.note]
    assert notes.count("2 of 10 without a value") == 2
    assert row_of(table, "ekf-slam")[f"{KEY}_mean"] != ""
    row = row_of(tables.failure_table(batch), "isam2")
    counts = {"ended": "8", "timeout": "2", "memory": "0", "failure_rate": "0.2"}
    assert row.items() >= counts.items()
    assert float(row["failure_rate_low"]) < 0.2 < float(row["failure_rate_high"])
    worse = with_failures(BATCH, "isam2", LOGS[0], 6)
    cell = median_of(overview_of(worse), "isam2")
    assert cell.text.startswith("no value")
    assert cell.note == "6 of 10 without a value"


def test_differences_are_paired_and_their_tests_corrected_within_a_metric():
    tests = tables.all_tests(BATCH, EVERY_METRIC)
    own, reference = BATCH.pairs(LOGS[0], "isam2", KEY)
    row = row_of(tables.difference_table(BATCH, ATE, tests), "isam2")
    mean = float(row[f"{KEY}_difference"])
    assert mean == pytest.approx((own - reference).mean())
    assert float(row[f"{KEY}_difference_low"]) < mean
    single = float(row[f"{KEY}_p_holm_single"])
    assert single == pytest.approx(2**-9)
    assert single < float(row[f"{KEY}_p_holm"]) <= 12 * single + 1e-12
    assert {log for _, log, _ in tests} == {*LOGS, ALL_LOGS}
    # two equal estimates, as of a filter, are one test
    alone, doubled = (
        tables.all_tests(BATCH, [Metric("ate_se2_m", dict.fromkeys(kinds, KEY))])
        for kinds in (["Causal"], ["Causal", "Smoothed"])
    )
    assert {at: p for at, (_, p) in doubled.items()} == {
        at: p for at, (_, p) in alone.items()
    }


def test_of_all_logs_together_seeds_are_counted():
    def compared(batch):
        rows = tables.difference_table(batch, ATE, compared_runs(batch)).rows
        own = [row for row in rows if row[1].text == "isam2"]
        return {row[0].text: (row[2].text, row[5].text) for row in own}

    batch = drawn_batch(8)
    of_each = dict.fromkeys(LOGS, ("8 pairs", "8 of 8 pairs"))
    assert compared(batch) == of_each | {ALL_LOGS: ("8 seeds", "8 of 8 seeds")}
    table = tables.difference_table(batch, ATE, compared_runs(batch))
    row = row_of(table, "isam2", ALL_LOGS)
    assert (row["pairs"], row["pairs_of"], row[f"{KEY}_smaller"]) == ("8", "seed", "8")
    first = [replace(run, seed=None) for run in batch.runs if run.seed == 0]
    counts = [counted for counted, _ in compared(replace(batch, runs=first)).values()]
    assert counts == ["1 pair", "1 pair", "2 logs"]


def test_consistency_is_judged_over_runs_by_the_chi_square_band():
    batch = drawn_batch(40)
    table = tables.consistency_table(batch)
    for contestant, verdict in (
        ("ekf-slam", "over-confident"),
        ("isam2", "consistent"),
    ):
        row = row_of(table, contestant)
        assert (row["of"], row["verdict"]) == ("position", verdict)
    lost = with_failures(batch, "isam2", LOGS[0], 1)
    row = row_of(tables.consistency_table(lost), "isam2")
    assert (row["anees"], row["verdict"]) == ("", "")


def test_a_csv_has_sections_and_no_text_for_a_missing_number():
    """Of two scores of one name a paper must mark the causal one; a log may be called nan."""
    columns = [Column("log", "log", is_number=False), Column("error_m", "error")]
    rows = [[Cell("nan", ("nan",)), Cell("-", (value,))] for value in (math.nan, 0.5)]
    table = Table("t", "", "", columns, rows, {0: "Causal", 1: "Smoothed"})
    assert rows_of(table) == [
        {"section": "Causal", "log": "nan", "error_m": ""},
        {"section": "Smoothed", "log": "nan", "error_m": "0.5"},
    ]


def test_angles_are_degrees_for_people_and_radians_in_files():
    own = BATCH.values(LOGS[0], "isam2", YAW_KEY)
    table = tables.accuracy_table(BATCH, YAW)
    cell = table.rows[1][3]
    in_file = float(row_of(table, "isam2")[f"{YAW_KEY}_mean"])
    assert cell.numbers[0] == own.mean() == in_file
    shown = float(cell.text.split(" ± ")[0])
    assert shown == pytest.approx(np.degrees(own.mean()), rel=0.1)
    assert table.title.endswith("°")
    median = median_of(summary.overview_table(BATCH, YAW, {}), "isam2", YAW_KEY)
    assert median.text == format_value(math.degrees(np.median(own)))


@pytest.mark.parametrize("key", ["time.total_s", "memory.peak_mb", "wall_s"])
def test_time_and_memory_are_shown_and_not_tested(key):
    batch = updated(drawn_batch(12, logs=LOGS[:1]), lambda run: {key: 0.01 * run.seed})
    (metric,) = metrics_of([key])
    assert tables.all_tests(batch, [metric]) == {}
    assert tables.accuracy_table(batch, metric).rows
    assert summary.head_metric(batch, [metric]) is None


def test_a_reference_that_never_ended_raises_a_warning():
    batch = drawn_batch(8)
    once = with_failures(batch, "dead-reckoning", LOGS[0], 7)
    assert summary.reference_told(once) == []
    lost = with_failures(batch, "dead-reckoning", LOGS[0], 8)
    assert summary.reference_told(lost) == [
        "The reference dead-reckoning never ended on basin: whoever ended is better there, by no known amount."
    ]
    first = tables.difference_table(lost, ATE, compared_runs(lost)).rows[0]
    assert first[4].text == "better: reference has no value"


def test_unequal_numbers_of_instants_raise_a_warning():
    even = updated(drawn_batch(2), lambda _: {"scored_instants": 50.0})
    assert summary.instants_told(even) == []
    even.runs[0].values["scored_instants"] = 40.0
    assert LOGS[0] in summary.instants_told(even)[0]


def test_arrows_show_the_side_of_significant_differences():
    batch = replace(changed(BATCH, "dead-reckoning", KEY, 3.0), reference="ekf-slam")
    batch = changed(batch, "isam2", KEY, 0.2)
    table = overview_of(batch)
    assert median_of(table, "isam2").text.endswith(summary.LOWER)
    assert median_of(table, "dead-reckoning").text.endswith(summary.HIGHER)
    assert summary.LOWER not in median_of(table, "ekf-slam").text
    few = overview_of(replace(batch, runs=[run for run in batch.runs if run.seed < 3]))
    texts = "".join(cell.text for row in few.rows for cell in row)
    assert not {summary.LOWER, summary.HIGHER} & set(texts)
    lost = with_failures(drawn_batch(logs=LOGS[:1]), "isam2", LOGS[0], 10)
    cell = median_of(overview_of(lost), "isam2")
    assert cell.text == f"no value {summary.HIGHER}"


def test_the_head_shows_the_first_error_that_most_logs_have():
    first, second, *_ = EVERY_METRIC
    lost = replace(BATCH, runs=[failed(run) for run in BATCH.runs])
    (nees,) = metrics_of(["causal.nees_position"])
    for batch, metrics, head in (
        (BATCH, EVERY_METRIC, first),
        (without(BATCH, "ate", LOGS[0]), EVERY_METRIC, second),
        (lost, EVERY_METRIC, None),
        (BATCH, [nees], None),
        (BATCH, [nees, first], first),
    ):
        assert summary.head_metric(batch, metrics) == head


def test_no_cell_of_a_table_is_a_formula_and_numbers_stay():
    formulas = ["=1+1", "+a", "-a", "@SUM(A1)", "\t=1"]
    others = ["-1.5", "+2", "1e-3", "isam2", "", "a=b"]
    text = csv_text([[cell] for cell in [*formulas, *others]])
    expected = [*(f"'{cell}" for cell in formulas), *others]
    assert text.replace('"', "").splitlines() == expected
