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
    return next(
        row
        for row in rows_of(table)
        if (row["log"], row["contestant"]) == (log, contestant)
    )


def cells_of(table: Table, contestant: str) -> list[Cell]:
    return next(row for row in table.rows if row[1].text == contestant)


def compared_runs(batch: RecordedBatch) -> tables.Tests:
    return tables.all_tests(batch, [ATE])


def overview_of(batch: RecordedBatch) -> Table:
    return summary.overview_table(batch, ATE, compared_runs(batch))


@pytest.mark.parametrize("seeds", [4, 6, 8, 9, 12])
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


def cell_of(table: Table, log: str, over: str, contestant: str) -> Cell:
    heads = [
        (column.over, column.heading.removesuffix(" (reference)"))
        for column in table.columns
    ]
    return next(
        row[heads.index((over, contestant))] for row in table.rows if row[0].text == log
    )


def test_causal_and_smoothed_errors_have_their_own_columns():
    row = row_of(tables.accuracy_table(BATCH, ATE), "isam2")
    for kind in KINDS:
        key = f"{kind}.ate_se2_m"
        values = BATCH.values(LOGS[0], "isam2", key)
        assert float(row[f"{key}_mean"]) == float(values.mean())
        assert float(row[f"{key}_mean_se"]) == pytest.approx(
            values.std(ddof=1) / np.sqrt(10)
        )
        assert float(row[f"{key}_median"]) == pytest.approx(np.median(values))
        assert float(row[f"{key}_10_percent"]) == pytest.approx(
            np.quantile(values, 0.1)
        )
        assert float(row[f"{key}_90_percent"]) == pytest.approx(
            np.quantile(values, 0.9)
        )
        overview = next(csv.DictReader(io.StringIO(as_csv(overview_of(BATCH)))))
        for contestant in BATCH.contestants:
            assert float(overview[f"{key} {contestant}"]) == np.median(
                BATCH.values(LOGS[0], contestant, key)
            )


def test_no_mean_is_given_over_survivors_and_the_tables_say_why():
    batch = with_failures(BATCH, "isam2", LOGS[0], 2)
    table = tables.accuracy_table(batch, ATE)
    row = row_of(table, "isam2")
    assert (row[f"{KEY}_mean"], row["runs"]) == ("", "10")
    notes = [cell.note for line in table.rows for cell in line if cell.note]
    assert notes.count("2 of 10 without a value") == 2
    assert row_of(table, "ekf-slam")[f"{KEY}_mean"] != ""
    row = row_of(tables.failure_table(batch), "isam2")
    assert (row["ended"], row["timeout"], row["memory"], row["failure_rate"]) == (
        "8",
        "2",
        "0",
        "0.2",
    )
    assert float(row["failure_rate_low"]) < 0.2 < float(row["failure_rate_high"])
    cell = cell_of(
        overview_of(with_failures(BATCH, "isam2", LOGS[0], 6)),
        LOGS[0],
        "Causal",
        "isam2",
    )
    assert cell.text.startswith("no value")
    assert cell.note == "6 of 10 without a value"


def test_differences_are_paired_and_their_tests_corrected_within_a_metric():
    tests = tables.all_tests(BATCH, EVERY_METRIC)
    own, reference = BATCH.pairs(LOGS[0], "isam2", KEY)
    row = row_of(tables.difference_table(BATCH, ATE, tests), "isam2")
    assert float(row[f"{KEY}_difference"]) == pytest.approx((own - reference).mean())
    assert float(row[f"{KEY}_difference_low"]) < float(row[f"{KEY}_difference"])
    single = float(row[f"{KEY}_p_holm_single"])
    corrected = float(row[f"{KEY}_p_holm"])
    assert single == pytest.approx(2**-9)
    assert single < corrected <= 12 * single + 1e-12
    assert {log for _, log, _ in tests} == {*LOGS, ALL_LOGS}
    alone = tables.all_tests(BATCH, [Metric("ate_se2_m", {"Causal": KEY})])
    # as of a filter
    doubled = tables.all_tests(
        BATCH, [Metric("ate_se2_m", {"Causal": KEY, "Smoothed": KEY})]
    )
    assert {place: p for place, (_, p) in doubled.items()} == {
        place: p for place, (_, p) in alone.items()
    }


def test_of_all_logs_together_seeds_are_counted():
    batch = drawn_batch(8)
    tests = compared_runs(batch)
    table = tables.difference_table(batch, ATE, tests)
    shown = {
        row[0].text: (row[2].text, row[5].text)
        for row in table.rows
        if row[1].text == "isam2"
    }
    assert shown == dict.fromkeys(LOGS, ("8 pairs", "8 of 8 pairs")) | {
        ALL_LOGS: ("8 seeds", "8 of 8 seeds")
    }
    assert [column.heading for column in table.columns[2:6]] == [
        "Compared",
        "Mean difference",
        "Median",
        "Smaller in",
    ]
    row = row_of(table, "isam2", ALL_LOGS)
    assert (row["pairs"], row["pairs_of"], row[f"{KEY}_smaller"]) == ("8", "seed", "8")
    unseeded = replace(
        batch, runs=[replace(run, seed=None) for run in batch.runs if run.seed == 0]
    )
    rows = tables.difference_table(unseeded, ATE, compared_runs(unseeded)).rows
    assert [row[2].text for row in rows if row[1].text == "isam2"] == [
        "1 pair",
        "1 pair",
        "2 logs",
    ]


# fmt: off
# fmt: on


def test_consistency_is_judged_over_runs_by_the_chi_square_band():
    batch = drawn_batch(40)
    verdicts = {}
    for row in rows_of(tables.consistency_table(batch)):
        verdicts[row["log"], row["contestant"], row["of"]] = row["verdict"]
    assert verdicts[LOGS[0], "ekf-slam", "position"] == "over-confident"
    assert verdicts[LOGS[0], "isam2", "position"] == "consistent"
    row = row_of(
        tables.consistency_table(with_failures(batch, "isam2", LOGS[0], 1)), "isam2"
    )
    assert (row["anees"], row["verdict"]) == ("", "")


def test_a_missing_number_is_empty_in_the_csv_and_a_log_called_nan_is_not():
    columns = [Column("log", "log", is_number=False), Column("error_m", "error")]
    table = Table("errors", "", "", columns)
    table.rows.append([Cell("nan", ("nan",)), Cell("-", (math.nan,))])
    assert rows_of(table) == [{"log": "nan", "error_m": ""}]


def test_sections_of_a_table_stand_in_its_csv():
    """Of two scores of one name a paper must mark the causal one."""
    rows = [[Cell("RMSE"), Cell("1.0", (1.0,))], [Cell("RMSE"), Cell("0.5", (0.5,))]]
    columns = [Column("metric", "Metric", is_number=False), Column("a", "a")]
    table = Table("t", "Scores", "", columns, rows, {0: "Causal", 1: "Smoothed"})
    assert [row["section"] for row in rows_of(table)] == ["Causal", "Smoothed"]


def test_angles_are_degrees_for_people_and_radians_in_files():
    own = BATCH.values(LOGS[0], "isam2", YAW_KEY)
    table = tables.accuracy_table(BATCH, YAW)
    cell = cells_of(table, "isam2")[3]
    assert (
        cell.numbers[0]
        == own.mean()
        == float(row_of(table, "isam2")[f"{YAW_KEY}_mean"])
    )
    assert float(cell.text.split(" ± ")[0]) == pytest.approx(
        np.degrees(own.mean()), rel=0.1
    )
    assert table.title.endswith("°")
    expected = format_value(math.degrees(np.median(own)))
    assert (
        cell_of(summary.overview_table(BATCH, YAW, {}), LOGS[0], "Causal", "isam2").text
        == expected
    )


@pytest.mark.parametrize("key", ["time.total_s", "memory.peak_mb", "wall_s"])
def test_time_and_memory_are_shown_and_not_tested(key):
    batch = updated(
        drawn_batch(12, logs=LOGS[:1]),
        lambda run: {key: len(run.estimator) + 0.01 * run.seed},
    )
    (metric,) = metrics_of([key])
    assert tables.all_tests(batch, [metric]) == {}
    assert tables.accuracy_table(batch, metric).rows
    assert summary.head_metric(batch, [metric]) is None


def test_a_reference_that_never_ended_raises_a_warning():
    batch = drawn_batch(8)
    assert (
        summary.reference_told(with_failures(batch, "dead-reckoning", LOGS[0], 7)) == []
    )
    lost = with_failures(batch, "dead-reckoning", LOGS[0], 8)
    assert summary.reference_told(lost) == [
        "The reference dead-reckoning never ended on basin: whoever ended is better there, by no known amount."
    ]
    (told,) = tables.difference_table(lost, ATE, compared_runs(lost)).rows[:1]
    assert told[4].text == "better: reference has no value"
    even = updated(drawn_batch(2), lambda _: {"scored_instants": 50.0})
    fewer = replace(
        even.runs[0], values=even.runs[0].values | {"scored_instants": 40.0}
    )
    assert summary.instants_told(even) == []
    assert (
        LOGS[0] in summary.instants_told(replace(even, runs=[fewer, *even.runs[1:]]))[0]
    )


def test_arrows_show_the_side_of_significant_differences():
    batch = replace(
        changed(drawn_batch(), "dead-reckoning", "causal.ate_se2_m", 3.0),
        reference="ekf-slam",
    )
    batch = changed(batch, "isam2", "causal.ate_se2_m", 0.2)
    table = overview_of(batch)
    assert cell_of(table, LOGS[0], "Causal", "isam2").text.endswith(summary.LOWER)
    assert cell_of(table, LOGS[0], "Causal", "dead-reckoning").text.endswith(
        summary.HIGHER
    )
    assert summary.LOWER not in cell_of(table, LOGS[0], "Causal", "ekf-slam").text
    few = overview_of(
        replace(batch, runs=[run for run in batch.runs if run.seed in (0, 1, 2)])
    )
    assert not any(
        arrow in cell.text
        for row in few.rows
        for cell in row
        for arrow in (summary.LOWER, summary.HIGHER)
    )
    batch = with_failures(drawn_batch(logs=LOGS[:1]), "isam2", LOGS[0], 10)
    assert (
        cell_of(overview_of(batch), LOGS[0], "Causal", "isam2").text
        == f"no value {summary.HIGHER}"
    )


def test_the_head_shows_the_first_error_that_most_logs_have():
    assert summary.head_metric(BATCH, EVERY_METRIC) == EVERY_METRIC[0]
    assert (
        summary.head_metric(without(BATCH, "ate", LOGS[0]), EVERY_METRIC)
        == EVERY_METRIC[1]
    )
    assert (
        summary.head_metric(
            replace(BATCH, runs=[failed(run) for run in BATCH.runs]), EVERY_METRIC
        )
        is None
    )
    assert summary.head_metric(BATCH, metrics_of(["causal.nees_position"])) is None
    assert (
        summary.head_metric(BATCH, metrics_of(["causal.nees_position", KEY])).name
        == ATE.name
    )


def test_no_cell_of_a_table_is_a_formula_and_numbers_stay():
    cells = [
        "=1+1",
        "+a",
        "-a",
        "@SUM(A1)",
        "\t=1",
        "-1.5",
        "+2",
        "1e-3",
        "isam2",
        "",
        "a=b",
    ]
    assert csv_text([[cell] for cell in cells]).replace('"', "").splitlines() == [
        *(
            "'=1+1",
            "'+a",
            "'-a",
            "'@SUM(A1)",
            "'\t=1",
            "-1.5",
            "+2",
            "1e-3",
            "isam2",
            "",
            "a=b",
        )
    ]
