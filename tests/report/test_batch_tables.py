from __future__ import annotations

import csv
import io
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch.recorded import ALL_LOGS, RecordedBatch
from sonar_graph.batch.result_table import KINDS, Metric, metrics_of
from sonar_graph.batch.statistics import paired, quantile_error
from sonar_graph.evaluation.digits import quantile_text
from sonar_graph.evaluation.tables import Cell, Column, Table
from sonar_graph.report.batch_figures import consistency_drawing, difference_drawing
from sonar_graph.report.batch_summary import (
    errors_told,
    failures_told,
    head_metric,
    instants_told,
    power_told,
    reference_told,
)
from sonar_graph.report.batch_tables import (
    SAME_EVIDENCE,
    accuracy_table,
    all_tests,
    consistency_table,
    cost_table,
    difference_table,
    failure_table,
    p_text,
    run_lists,
)
from sonar_graph.report.rendering import as_csv, as_latex, latex_text, write_tables
from tests.recorded_batches import LOGS, METRICS, changed, drawn_batch, updated, with_failures, without

ATE = metrics_of(["causal.ate_se2_m"])[0]


def rows_of(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(as_csv(table))))


def row_of(table: Table, contestant: str, log: str = LOGS[0]) -> dict[str, str]:
    return next(row for row in rows_of(table) if (row["log"], row["contestant"]) == (log, contestant))


def test_causal_and_smoothed_have_columns_of_their_own():
    batch = drawn_batch()
    row = row_of(accuracy_table(batch, ATE), "isam2")
    for kind in ("causal", "smoothed"):
        values = batch.values(LOGS[0], "isam2", f"{kind}.ate_se2_m")
        assert float(row[f"{kind}.ate_se2_m_mean"]) == pytest.approx(values.mean())
        assert float(row[f"{kind}.ate_se2_m_mean_se"]) == pytest.approx(values.std(ddof=1) / np.sqrt(10))
        assert float(row[f"{kind}.ate_se2_m_median"]) == pytest.approx(np.median(values))
        assert float(row[f"{kind}.ate_se2_m_10_percent"]) == pytest.approx(np.quantile(values, 0.1))
        assert float(row[f"{kind}.ate_se2_m_90_percent"]) == pytest.approx(np.quantile(values, 0.9))


def test_no_mean_is_given_over_survivors_and_the_table_says_why():
    batch = with_failures(drawn_batch(), "isam2", LOGS[0], 2)
    table = accuracy_table(batch, ATE)
    row = row_of(table, "isam2")
    assert row["causal.ate_se2_m_mean"] == ""
    assert row["runs"] == "10"
    notes = [cell.note for line in table.rows for cell in line if cell.note]
    assert notes.count("2 of 10 without a value") == 2
    assert row_of(table, "ekf-slam")["causal.ate_se2_m_mean"] != ""


def test_a_column_that_a_contestant_cannot_have_is_a_dash_without_a_complaint():
    table = accuracy_table(drawn_batch(), metrics_of(["landmarks.se2_m"])[0])
    cells = next(line for line in table.rows if line[1].text == "dead-reckoning")
    assert [cell.text for cell in cells[3:]] == ["\N{EN DASH}"] * 3
    assert all(not cell.note for cell in cells)


def test_differences_are_paired_and_their_tests_corrected_within_a_metric():
    batch = drawn_batch()
    metrics = metrics_of(METRICS)
    tests = all_tests(batch, metrics)
    own, reference = batch.pairs(LOGS[0], "isam2", "causal.ate_se2_m")
    row = row_of(difference_table(batch, ATE, tests), "isam2")
    assert float(row["causal.ate_se2_m_difference"]) == pytest.approx((own - reference).mean())
    assert float(row["causal.ate_se2_m_difference_low"]) < float(row["causal.ate_se2_m_difference"])
    single, corrected = float(row["causal.ate_se2_m_p_holm_single"]), float(row["causal.ate_se2_m_p_holm"])
    assert single == pytest.approx(2**-9)
    assert single < corrected <= 12 * single + 1e-12
    assert {log for _, log, _ in tests} == {*LOGS, ALL_LOGS}


def test_of_all_logs_together_seeds_are_counted():
    batch = drawn_batch(8)
    tests = all_tests(batch, [ATE])
    table = difference_table(batch, ATE, tests)
    shown = {row[0].text: (row[2].text, row[5].text) for row in table.rows if row[1].text == "isam2"}
    assert shown == {
        LOGS[0]: ("8 pairs", "8 of 8 pairs"),
        LOGS[1]: ("8 pairs", "8 of 8 pairs"),
        ALL_LOGS: ("8 seeds", "8 of 8 seeds"),
    }
    assert [column.heading for column in table.columns[2:6]] == ["Compared", "Mean difference", "Median", "Smaller in"]
    row = row_of(table, "isam2", ALL_LOGS)
    assert (row["pairs"], row["pairs_of"], row["causal.ate_se2_m_smaller"]) == ("8", "seed", "8")
    drawing = difference_drawing(batch, ATE, tests)
    counted = {(row["log"], row["pairs"], row["pairs_of"]) for row in csv.DictReader(io.StringIO(drawing.data))}
    assert counted == {(LOGS[0], "8", "pair"), (LOGS[1], "8", "pair"), (ALL_LOGS, "8", "seed")}
    unseeded = replace(batch, runs=[replace(run, seed=None) for run in batch.runs if run.seed == 0])
    rows = difference_table(unseeded, ATE, all_tests(unseeded, [ATE])).rows
    assert [row[2].text for row in rows if row[1].text == "isam2"] == ["1 pair", "1 pair", "2 logs"]


@pytest.mark.parametrize(
    ("p_value", "text"),
    [
        (0.0496, "0.0496"),
        (0.04996, "0.04996"),
        (0.0504, "0.0504"),
        (0.05, "0.05"),
        (0.0512, "0.051"),
        (0.0488, "0.049"),
        (0.123, "0.12"),
        (0.00099, "< 0.001"),
        (0.9999, "1.0"),
        (np.nextafter(0.05, 0.0), "0.049999999999999996"),
    ],
)
def test_a_p_value_shows_its_side_of_five_percent(p_value, text):
    assert p_text(p_value) == text


def test_a_filters_two_estimates_are_one_test():
    batch = drawn_batch()
    alone = all_tests(batch, [Metric("ate_se2_m", {"Causal": "causal.ate_se2_m"})])
    doubled = all_tests(batch, [Metric("ate_se2_m", {"Causal": "causal.ate_se2_m", "Smoothed": "causal.ate_se2_m"})])
    assert {place: p for place, (_, p) in doubled.items()} == {place: p for place, (_, p) in alone.items()}


def test_failures_are_counted_by_kind_with_their_interval():
    row = row_of(failure_table(with_failures(drawn_batch(), "isam2", LOGS[0], 2)), "isam2")
    assert (row["ended"], row["timeout"], row["memory"]) == ("8", "2", "0")
    assert float(row["failure_rate"]) == 0.2
    assert float(row["failure_rate_low"]) < 0.2 < float(row["failure_rate_high"])


def test_consistency_is_judged_over_runs_by_the_chi_square_band():
    table = consistency_table(drawn_batch(40))
    verdicts = {(row["log"], row["contestant"], row["of"]): row["causal_verdict"] for row in rows_of(table)}
    assert verdicts[LOGS[0], "ekf-slam", "position"] == "over-confident"
    assert verdicts[LOGS[0], "isam2", "position"] == "consistent"
    failed = consistency_table(with_failures(drawn_batch(40), "isam2", LOGS[0], 1))
    row = next(row for row in rows_of(failed) if row["contestant"] == "isam2")
    assert (row["causal_anees"], row["causal_verdict"]) == ("", "")


def with_one_end(batch: RecordedBatch, contestants: tuple[str, ...], factor: float = 1.0) -> RecordedBatch:
    """The batch, were the smoothed error at the end of contestants the causal one times a factor."""
    ends = [f"nees_{what}_end" for what in ("position", "yaw")]
    return updated(
        batch, lambda run: {f"smoothed.{end}": factor * run.values[f"causal.{end}"] for end in ends}, contestants
    )


@pytest.mark.parametrize(("factor", "shown"), [(1.0, False), (1.09, False), (0.91, False), (1.11, True), (0.89, True)])
def test_a_smoothed_error_at_the_end_is_no_second_evidence(factor, shown):
    batch = with_one_end(drawn_batch(logs=LOGS[:1]), ("dead-reckoning", "isam2", "ekf-slam"))
    table = consistency_table(batch)
    assert SAME_EVIDENCE in table.caption
    assert [name for name, _ in table.groups] == ["", "Causal"]
    mixed = with_one_end(batch, ("isam2",), factor)
    assert ("Smoothed" in [name for name, _ in consistency_table(mixed).groups]) is shown
    points = [one.svg.count("<use ") for drawn in (batch, mixed) if (one := consistency_drawing(drawn, "position"))]
    assert (points[1] > points[0]) is shown
    for row in consistency_table(mixed).rows if shown else []:
        is_told = row[1].text == "isam2"
        assert (row[-2].text != "as causal") is is_told
        assert bool(row[-1].text) is is_told
        assert row[-2].numbers[0] == pytest.approx(row[-4].numbers[0] * (factor if is_told else 1.0))


def test_who_has_but_a_smoothed_covariance_is_judged_by_it():
    rows = rows_of(consistency_table(without(drawn_batch(logs=LOGS[:1]), "causal.nees")))
    assert all(row["smoothed_verdict"] for row in rows)
    assert "causal_anees" not in rows[0]


def test_every_run_is_listed_once_and_leads_to_its_log():
    batch = drawn_batch(4)
    lists = run_lists(batch, metrics_of(METRICS))
    links = [cell.link for one in lists for line in one.table.rows for cell in line if cell.link]
    assert sorted(links) == sorted(run.log_file for run in batch.runs)
    anchors = {one.anchor for one in lists}
    targets = {cell.link.removeprefix("#") for line in accuracy_table(batch, ATE).rows for cell in line if cell.link}
    assert targets == anchors


def test_costs_are_medians():
    row = row_of(cost_table(drawn_batch()), "isam2")
    assert 1 < float(row["update_p50_ms_median"]) < 2


def test_latex_has_as_many_cells_as_columns_in_every_row():
    table = accuracy_table(with_failures(drawn_batch(), "isam2", LOGS[0], 2), metrics_of(["causal.yaw_rmse_rad"])[0])
    text = as_latex(table)
    body = text[text.index(r"\midrule") : text.index(r"\bottomrule")]
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert len(lines) == len(table.rows)
    assert {len(re.findall(r"(?<!\\)&", line)) + 1 for line in lines} == {len(table.columns)}
    assert r"\multicolumn{3}{c}{Causal}" in text
    assert r"\cmidrule(lr){4-6}\cmidrule(lr){7-9}" in text
    assert re.search(r"[±°]", text) is None


def test_latex_takes_no_commands_from_names():
    table = Table("t", "100 % of $x_1$", "", [Column("a", r"\input{x}")], [[Cell("a&b#c")]])
    text = as_latex(table)
    assert r"100 \% of \$x\_1\$" in text
    assert r"\input" not in text
    assert r"a\&b\#c" in text
    assert latex_text("±") == r"$\pm$"


def test_csv_has_full_precision_in_the_units_of_the_results():
    batch = drawn_batch()
    row = row_of(accuracy_table(batch, metrics_of(["causal.yaw_rmse_rad"])[0]), "isam2")
    values = batch.values(LOGS[0], "isam2", "causal.yaw_rmse_rad")
    assert float(row["causal.yaw_rmse_rad_mean"]) == float(values.mean())


def test_tables_are_written_under_their_names(tmp_path):
    written = write_tables([accuracy_table(drawn_batch(2), ATE)], tmp_path)
    assert [path.name for path in written] == ["accuracy-ate-se2-m.csv", "accuracy-ate-se2-m.tex"]
    assert all(path.stat().st_size for path in written)


def test_the_finding_names_failures_and_only_differences_beyond_chance():
    batch = with_failures(drawn_batch(), "ekf-slam", LOGS[1], 3)
    metrics = metrics_of(METRICS)
    assert failures_told(batch) == [f"ekf-slam: 3 of 20 runs did not end ({LOGS[1]})."]
    told = errors_told(batch, metrics, all_tests(batch, metrics))
    assert "isam2 is below dead-reckoning by " in told[0]
    assert "below dead-reckoning" in told[0]
    alike = changed(batch, "isam2", "causal.ate_se2_m", 4.0)
    assert "Not told apart from dead-reckoning: isam2" in errors_told(alike, metrics, all_tests(alike, metrics))[0]


def test_the_finding_gives_no_mean_over_survivors():
    batch = with_failures(drawn_batch(18), "isam2", LOGS[0], 1)
    metrics = metrics_of(METRICS)
    told = errors_told(batch, metrics, all_tests(batch, metrics))[0]
    differences = np.subtract(*batch.pairs(LOGS[0], "isam2", "causal.ate_se2_m"))
    found = re.search(r"isam2 is below dead-reckoning by (\S+) in the median, smaller in 17 of 18 pairs \(p ", told)
    assert float(found[1]) == pytest.approx(-np.median(differences), rel=0.1)


def test_the_finding_tells_the_side_of_the_test_and_not_of_a_mean_that_one_run_turned():
    lost = np.append(np.ones(17), 1e4)
    batch = changed(drawn_batch(18, logs=LOGS[:1]), "isam2", "causal.ate_se2_m", lost)
    metrics = metrics_of(METRICS)
    tests = all_tests(batch, metrics)
    test, p_value = tests["causal.ate_se2_m", LOGS[0], "isam2"]
    assert test.mean > 0 > test.median
    assert p_value < 0.05
    assert "isam2 is below dead-reckoning by 0." in errors_told(batch, metrics, tests)[0]


def test_the_finding_of_who_never_ended_has_a_side_and_no_size():
    batch = with_failures(drawn_batch(18, logs=LOGS[:1]), "isam2", LOGS[0], 18)
    metrics = metrics_of(METRICS)
    told = errors_told(batch, metrics, all_tests(batch, metrics))[0]
    assert "isam2 is above dead-reckoning, smaller in 0 of 18 pairs (p " in told


def test_angles_are_degrees_for_people_and_radians_in_files():
    batch = drawn_batch()
    table = accuracy_table(batch, metrics_of(["causal.yaw_rmse_rad"])[0])
    mean = batch.values(LOGS[0], "isam2", "causal.yaw_rmse_rad").mean()
    cell = next(line[3] for line in table.rows if line[1].text == "isam2")
    assert cell.numbers[0] == mean
    assert float(cell.text.split(" ± ")[0]) == pytest.approx(np.degrees(mean), rel=0.1)
    assert table.title.endswith("°")


def test_sentences_on_angles_are_in_degrees():
    batch = changed(drawn_batch(12, logs=LOGS[:1]), "isam2", "causal.yaw_rmse_rad", 0.5)
    (metric,) = metrics_of(["causal.yaw_rmse_rad"])
    (told,) = errors_told(batch, [metric], all_tests(batch, [metric]))
    own, reference = np.degrees(batch.pairs(LOGS[0], "isam2", "causal.yaw_rmse_rad"))
    size = quantile_text(-np.median(own - reference), quantile_error(own - reference, 0.5))
    assert f"isam2 {quantile_text(np.median(own), quantile_error(own, 0.5))}, " in told
    assert f"isam2 is below dead-reckoning by {size} in the median, smaller in 12 of 12 pairs" in told
    assert " in °" in told
    assert float(size) == pytest.approx(57.3 * -np.median(np.radians(own - reference)), rel=0.1)


def test_too_few_seeds_are_warned_of():
    few, many = drawn_batch(4, logs=LOGS[:1]), drawn_batch(12, logs=LOGS[:1])
    metrics = metrics_of(METRICS)
    assert "4 pairs" in power_told(all_tests(few, metrics))[0]
    assert power_told(all_tests(many, metrics)) == []
    assert f"{ALL_LOGS} (4 seeds)" in power_told(all_tests(drawn_batch(4), metrics))[0]


def test_what_has_too_few_pairs_for_a_test_costs_others_nothing():
    tests = {
        ("causal.ate_se2_m", f"{pairs} of them", "isam2"): (paired(np.arange(pairs) + 1.0, np.zeros(pairs)), 1.0)
        for pairs in (5, 6)
    }
    assert power_told(tests) == [
        "Too few pairs for any corrected p value to fall below 0.05: 5 of them (5 pairs). Add seeds."
    ]


@pytest.mark.parametrize(("fewest", "blind"), [(8, False), (7, True), (5, True)])
def test_seeds_are_called_too_few_only_where_the_best_differences_find_nothing(fewest, blind):
    batch = drawn_batch(20)
    batch = replace(batch, runs=[run for run in batch.runs if run.log == LOGS[0] or run.seed < fewest])
    for name, kind in itertools.product(("isam2", "ekf-slam"), KINDS):
        batch = changed(batch, name, f"{kind}.ate_se2_m", 1e-3)
    tests = all_tests(batch, [ATE])
    assert len(tests) == 12
    assert (tests["causal.ate_se2_m", LOGS[1], "isam2"][1] < 0.05) is not blind
    told = power_told(tests)
    assert bool(told) is blind
    assert not any(LOGS[0] + " (" in one for one in told)


def test_a_filters_two_estimates_do_not_ask_for_more_seeds():
    batch = drawn_batch(7, logs=LOGS[:1])
    same = updated(batch, lambda run: {"smoothed.ate_se2_m": run.values["causal.ate_se2_m"]})
    assert "7 pairs" in power_told(all_tests(batch, [ATE]))[0], "four tests: 4 / 2**6 is above 5 %"
    assert power_told(all_tests(same, [ATE])) == [], "two tests"


@pytest.mark.parametrize("key", ["time.total_s", "memory.peak_mb", "wall_s", "peak_memory_mb"])
def test_time_and_memory_are_shown_and_not_tested(key):
    batch = updated(drawn_batch(12, logs=LOGS[:1]), lambda run: {key: len(run.estimator) + 0.01 * run.seed})
    (metric,) = metrics_of([key])
    assert all_tests(batch, [metric]) == {}
    assert accuracy_table(batch, metric).rows
    assert head_metric(batch, [metric]) is None


def test_a_reference_that_never_ended_is_warned_of():
    batch = drawn_batch(8)
    assert reference_told(with_failures(batch, "dead-reckoning", LOGS[0], 7)) == []
    lost = with_failures(batch, "dead-reckoning", LOGS[0], 8)
    assert reference_told(lost) == [
        "The reference dead-reckoning never ended on basin: whoever ended is better there, by no known amount."
    ]
    (told,) = difference_table(lost, ATE, all_tests(lost, [ATE])).rows[:1]
    assert told[4].text == "better: reference has no value"


def test_a_warning_names_few_logs():
    batch = drawn_batch(1, logs=tuple("abcdefg"))
    for log in batch.logs:
        batch = with_failures(batch, "isam2", log, 1)
    assert failures_told(batch) == ["isam2: 7 of 7 runs did not end (a, b, c and 4 more)."]


def test_runs_that_were_scored_at_other_instants_are_warned_of():
    even = updated(drawn_batch(2), lambda _: {"scored_instants": 50.0})
    fewer = replace(even.runs[0], values=even.runs[0].values | {"scored_instants": 40.0})
    assert instants_told(even) == []
    assert LOGS[0] in instants_told(replace(even, runs=[fewer, *even.runs[1:]]))[0]
