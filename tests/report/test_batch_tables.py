"""Tables and sentences of a batch: pairs, no mean over survivors, one family a metric, digits, and the warnings."""

import csv
import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch.recorded import ALL_LOGS, RecordedBatch
from sonar_graph.batch.result_table import KINDS, Metric, metrics_of
from sonar_graph.batch.statistics import quantile_error
from sonar_graph.evaluation.digits import quantile_text
from sonar_graph.report import batch_summary as summary
from sonar_graph.report import batch_tables as tables
from sonar_graph.report.batch_figures import consistency_drawing, difference_drawing
from sonar_graph.report.rendering import (
    as_csv,
    as_latex,
    csv_text,
    latex_text,
    write_tables,
)
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
KEY, YAW_KEY = "causal.ate_se2_m", "causal.yaw_rmse_rad"
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


def heads_of(batch: RecordedBatch) -> list[str]:
    return summary.headlines(batch, ATE, compared_runs(batch))


def overview_of(batch: RecordedBatch) -> Table:
    return summary.overview_table(batch, ATE, compared_runs(batch))


def cell_of(table: Table, log: str, over: str, contestant: str) -> Cell:
    heads = [
        (column.over, column.heading.removesuffix(" (reference)"))
        for column in table.columns
    ]
    return next(
        row[heads.index((over, contestant))] for row in table.rows if row[0].text == log
    )


def test_causal_and_smoothed_have_columns_of_their_own_with_full_precision_in_files():
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
    assert (
        1 < float(row_of(tables.cost_table(BATCH), "isam2")["update_p50_ms_median"]) < 2
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
    single, corrected = float(row[f"{KEY}_p_holm_single"]), float(row[f"{KEY}_p_holm"])
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
    drawing = difference_drawing(batch, ATE, tests)
    counted = {
        (row["log"], row["pairs"], row["pairs_of"])
        for row in csv.DictReader(io.StringIO(drawing.data))
    }
    assert counted == {
        (LOGS[0], "8", "pair"),
        (LOGS[1], "8", "pair"),
        (ALL_LOGS, "8", "seed"),
    }
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
P_TEXTS = {
    0.0496: "0.0496", 0.04996: "0.04996", 0.0504: "0.0504", 0.05: "0.05", 0.0512: "0.051", 0.0488: "0.049",
    0.123: "0.12", 0.00099: "< 0.001", 0.9999: "1.0", float(np.nextafter(0.05, 0.0)): "0.049999999999999996",
}
# fmt: on


def test_a_p_value_shows_its_side_of_five_percent():
    assert {p_value: tables.p_text(p_value) for p_value in P_TEXTS} == P_TEXTS


def test_consistency_is_judged_over_runs_by_the_chi_square_band():
    batch = drawn_batch(40)
    verdicts = {}
    for row in rows_of(tables.consistency_table(batch)):
        verdicts[row["log"], row["contestant"], row["of"]] = row["causal_verdict"]
    assert verdicts[LOGS[0], "ekf-slam", "position"] == "over-confident"
    assert verdicts[LOGS[0], "isam2", "position"] == "consistent"
    row = row_of(
        tables.consistency_table(with_failures(batch, "isam2", LOGS[0], 1)), "isam2"
    )
    assert (row["causal_anees"], row["causal_verdict"]) == ("", "")
    rows = rows_of(
        tables.consistency_table(without(drawn_batch(logs=LOGS[:1]), "causal.nees"))
    )
    assert all(row["smoothed_verdict"] for row in rows), (
        "who has but a smoothed covariance is judged by it"
    )
    assert "causal_anees" not in rows[0]


def with_one_end(
    batch: RecordedBatch, contestants: tuple[str, ...], factor: float = 1.0
) -> RecordedBatch:
    """The batch, were the smoothed error at the end of contestants the causal one times a factor."""
    ends = [f"nees_{what}_end" for what in ("position", "yaw")]
    return updated(
        batch,
        lambda run: {
            f"smoothed.{end}": factor * run.values[f"causal.{end}"] for end in ends
        },
        contestants,
    )


@pytest.mark.parametrize(
    ("factor", "shown"),
    [(1.0, False), (1.09, False), (0.91, False), (1.11, True), (0.89, True)],
)
def test_a_smoothed_error_at_the_end_is_no_second_evidence(factor, shown):
    batch = with_one_end(
        drawn_batch(logs=LOGS[:1]), ("dead-reckoning", "isam2", "ekf-slam")
    )
    table = tables.consistency_table(batch)
    assert tables.SAME_EVIDENCE in table.caption
    assert [name for name, _ in table.groups] == ["", "Causal"]
    mixed = with_one_end(batch, ("isam2",), factor)
    assert (
        "Smoothed" in [name for name, _ in tables.consistency_table(mixed).groups]
    ) is shown
    points = [
        one.svg.count("<use ")
        for drawn in (batch, mixed)
        if (one := consistency_drawing(drawn, "position"))
    ]
    assert (points[1] > points[0]) is shown
    for row in tables.consistency_table(mixed).rows if shown else []:
        is_told = row[1].text == "isam2"
        assert (row[-2].text != "as causal") is is_told
        assert bool(row[-1].text) is is_told
        assert row[-2].numbers[0] == pytest.approx(
            row[-4].numbers[0] * (factor if is_told else 1.0)
        )


def test_latex_has_as_many_cells_as_columns_in_every_row_and_takes_no_commands_from_names(
    tmp_path,
):
    table = tables.accuracy_table(with_failures(BATCH, "isam2", LOGS[0], 2), YAW)
    text = as_latex(table)
    body = text[text.index(r"\midrule") : text.index(r"\bottomrule")]
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert len(lines) == len(table.rows)
    assert {len(re.findall(r"(?<!\\)&", line)) + 1 for line in lines} == {
        len(table.columns)
    }
    assert r"\multicolumn{3}{c}{Causal}" in text
    assert r"\cmidrule(lr){4-6}\cmidrule(lr){7-9}" in text
    assert re.search(r"[±°]", text) is None
    text = as_latex(overview_of(BATCH))
    assert r"$\downarrow$" in text
    assert summary.LOWER not in text
    text = as_latex(
        Table("t", "100 % of $x_1$", "", [Column("a", r"\input{x}")], [[Cell("a&b#c")]])
    )
    assert r"100 \% of \$x\_1\$" in text
    assert r"\input" not in text
    assert r"a\&b\#c" in text
    assert latex_text("±") == r"$\pm$"
    csv_file, tex_file = write_tables([table], tmp_path)
    assert (csv_file.name, tex_file.name) == (
        "accuracy-yaw-rmse-rad.csv",
        "accuracy-yaw-rmse-rad.tex",
    )
    assert csv_file.read_text("utf-8") == as_csv(table)
    assert tex_file.read_text("utf-8") == as_latex(table)


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
    expected = quantile_text(
        math.degrees(np.median(own)), math.degrees(quantile_error(own, 0.5))
    )
    assert (
        cell_of(summary.overview_table(BATCH, YAW, {}), LOGS[0], "Causal", "isam2").text
        == expected
    )


@pytest.mark.parametrize(
    "key", ["time.total_s", "memory.peak_mb", "wall_s", "peak_memory_mb"]
)
def test_time_and_memory_are_shown_and_not_tested(key):
    batch = updated(
        drawn_batch(12, logs=LOGS[:1]),
        lambda run: {key: len(run.estimator) + 0.01 * run.seed},
    )
    (metric,) = metrics_of([key])
    assert tables.all_tests(batch, [metric]) == {}
    assert tables.accuracy_table(batch, metric).rows
    assert summary.head_metric(batch, [metric]) is None


def test_a_reference_that_never_ended_and_runs_that_were_scored_at_other_instants_are_warned_of():
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


def test_arrows_point_to_the_side_of_the_difference_and_only_where_it_is_no_chance():
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
    assert "higher with isam2" in heads_of(batch)[0], "who never ended is not left out"


def test_the_sentence_counts_logs_where_somebody_is_told_apart():
    beside, batch = (
        "error beside that of dead-reckoning",
        drawn_batch(logs=("one", "two", "three")),
    )
    causal, smoothed = heads_of(batch)
    assert (
        causal
        == f"Causal {beside} (on how many of 3 logs): lower with isam2 (3), ekf-slam (3)."
    )
    assert smoothed.startswith(f"Smoothed {beside}")
    mixed = updated(
        batch, lambda run: {KEY: 9.0} if run.log == "two" else {}, ("isam2",)
    )
    told = heads_of(mixed)[0]
    assert "lower with isam2 (2), ekf-slam (3); higher with isam2 (1)" in told
    rng = np.random.default_rng(16)
    batch = updated(BATCH, lambda _: {"smoothed.ate_se2_m": rng.lognormal()})
    causal, smoothed = heads_of(batch)
    assert causal.startswith(f"Causal {beside} (on how many of 2 logs): lower with")
    assert smoothed == f"Smoothed {beside}: never told apart: isam2, ekf-slam."
    one, few = drawn_batch(logs=LOGS[:1]), drawn_batch(3, logs=LOGS[:1])
    assert heads_of(one)[0] == f"Causal {beside}: lower with isam2, ekf-slam."
    (told,) = heads_of(few)
    assert told.endswith("no estimator is told apart from dead-reckoning.")


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
