"""The page of a batch: figures with their data, explanations, the runs that are missing, and panels for each log."""

import csv
import io
import re
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.batch import RecordedBatch, read_batch
from sonar_graph.errors import EvaluationError
from sonar_graph.report import lost_told, missing_told, write_batch_report
from sonar_graph.report.batch_figures import log_panels
from sonar_graph.report.batch_page import render_batch
from sonar_graph.report.batch_summary import absent_told, marked, withheld_told
from sonar_graph.report.batch_tables import failure_table
from sonar_graph.report.figure_style import PAGE_WIDTH_IN, colour, sized
from tests.recorded_batches import (
    ESTIMATORS,
    LOGS,
    drawn_batch,
    failed,
    with_failures,
    with_missing,
    write_batch,
)


@pytest.fixture(scope="module")
def batch() -> RecordedBatch:
    return with_failures(drawn_batch(), "ekf-slam", LOGS[1], 2)


@pytest.fixture(scope="module")
def html(batch) -> str:
    return render_batch(batch)


@pytest.mark.parametrize("count", [1, 3])
def test_few_runs_and_runs_that_all_failed_make_a_page(count):
    batch = drawn_batch(count, logs=LOGS[:1])
    html = render_batch(batch)
    assert "Every run ended well." in html
    assert "not complete" not in html.lower()
    html = render_batch(replace(batch, runs=[failed(run) for run in batch.runs]))
    assert "No run has an error to compare" in html
    assert (
        "nan"
        not in re.sub(r"<svg.*?</svg>|base64,[^\"]*", "", html, flags=re.DOTALL)
        .lower()
        .split()
    )


@pytest.fixture
def incomplete() -> RecordedBatch:
    """Of 60 runs four of isam2 and all ten of ekf-slam on one log are not done; one more run failed."""
    batch = with_failures(drawn_batch(10), "isam2", LOGS[0], 1)
    return with_missing(
        with_missing(batch, "isam2", LOGS[0], 4), "ekf-slam", LOGS[0], 10
    )


def rows(batch: RecordedBatch) -> dict[tuple[str, str], dict[str, object]]:
    table = failure_table(batch)
    keys = [column.key for column in table.columns]
    cells = [
        dict(zip(keys, [cell.numbers[0] for cell in row], strict=True))
        for row in table.rows
    ]
    return {(str(row["log"]), str(row["contestant"])): row for row in cells}


def test_missing_runs_are_counted_and_are_no_failures(incomplete):
    counted = rows(incomplete)
    assert len(counted) == 6
    some = counted[LOGS[0], "isam2"]
    none = counted[LOGS[0], "ekf-slam"]
    assert (some["runs"], some["ended"], some["failure_rate"], some["not_run"]) == (
        6,
        5,
        1 / 6,
        4,
    )
    assert (none["runs"], none["not_run"]) == (0, 10)
    assert np.isnan(none["failure_rate"])
    assert counted[LOGS[1], "isam2"]["not_run"] == 0
    complete = drawn_batch(2)
    assert "not_run" not in rows(complete)[LOGS[0], "isam2"]
    assert marked(complete, table := failure_table(complete)) is table
    assert missing_told(complete) == []


def test_logs_whose_data_was_absent_are_named_with_their_source():
    suite = "".join(
        f'[[logs]]\nname = "{name}"\nobtain = "the source"\n'
        for name in (LOGS[0], "elsewhere")
    )
    batch = replace(drawn_batch(1), suite=suite)
    assert absent_told(batch) == [
        "Left out, because its data was not there: elsewhere. Get the source."
    ]
    assert (
        absent_told(replace(batch, suite=""))
        == absent_told(replace(batch, suite="no toml ["))
        == []
    )


def test_what_estimators_withheld_is_told_once_for_each_log():
    moved = "moved since the map was made: landmark 3"
    grave = "beyond doubt"
    drawn = drawn_batch(2)
    runs = [
        replace(run, texts=run.texts | {"withheld": grave if run.seed else moved})
        if run.log == LOGS[0] and run.estimator == "isam2"
        else run
        for run in drawn.runs
    ]
    batch = replace(drawn, runs=runs)
    assert withheld_told(batch) == [
        f"Doubtful: {LOGS[0]}: isam2: {grave}",
        f"Warning: {LOGS[0]}: isam2: {moved}",
    ]
    assert f"{LOGS[0]}: isam2: {moved}" in render_batch(batch)
    assert withheld_told(drawn) == []


def test_a_table_with_missing_runs_is_read_as_one_in_the_order_of_the_plan(
    incomplete, tmp_path
):
    lacks_first = with_missing(incomplete, "dead-reckoning", LOGS[0], 10)
    assert lacks_first.contestants == list(ESTIMATORS)
    back = read_batch(write_batch(lacks_first, tmp_path))
    assert back.contestants == list(ESTIMATORS)
    assert [run.key for run in back.runs] == [run.key for run in lacks_first.runs]
    assert {run.key for run in back.missing} == {run.key for run in lacks_first.missing}
    none = drawn_batch(1, logs=LOGS[:1])
    for name in ESTIMATORS:
        none = with_missing(none, name, LOGS[0], 1)
    write_batch(none, tmp_path)
    with pytest.raises(
        EvaluationError,
        match=r"none of its 3 runs has been done yet; give the bench command",
    ):
        read_batch(tmp_path)


def test_page_and_tables_count_missing_runs(incomplete, tmp_path):
    (told,) = missing_told(incomplete)
    assert told.startswith(
        "This batch is not complete: 14 of 60 runs have not been done (isam2 4 of 20, ekf-slam"
    )
    assert "on basin. All numbers are of the other runs" in told
    assert "give the bench command that began it again" in told
    # from results alone
    page = write_batch_report(read_batch(write_batch(incomplete, tmp_path)), tmp_path)
    assert page == tmp_path / "report.html"
    html = page.read_text("utf-8")
    assert html.startswith("<!DOCTYPE html>")
    first = html.index('<p class="warning">')
    assert html[first:].startswith(
        '<p class="warning">This batch is not complete: 14 of 60 runs'
    )
    assert first < html.index("<table")
    assert "that was done ended well" not in html, "one did not"
    assert {path.suffix for path in (tmp_path / "tables").iterdir()} == {".csv"}
    for path in (tmp_path / "tables").glob("*.tex"):
        assert "Not complete: 14 of 60 runs have not been done." in path.read_text(
            "utf-8"
        ), path
    counted = list(
        csv.DictReader(
            io.StringIO((tmp_path / "tables" / "failures.csv").read_text("utf-8"))
        )
    )
    assert sum(int(row["not_run"]) for row in counted) == 14


@pytest.mark.parametrize("gone", ["isam2"])
def test_a_contestant_without_any_run_leaves_a_page_of_the_others(gone):
    batch = drawn_batch(3)
    for log in LOGS:
        batch = with_missing(batch, gone, log, 3)
    html = render_batch(batch)
    assert "Every run that was done ended well." in html
    assert f"({gone} 6 of 6)" in html


def test_rows_whose_runs_are_not_here_are_told_and_lead_nowhere(tmp_path):
    batch = drawn_batch(2)
    write_batch(batch, tmp_path)
    for run in batch.runs[1:]:
        (tmp_path / run.log_file).parent.mkdir(parents=True)
        (tmp_path / run.log_file).write_text("")
    back = read_batch(tmp_path)
    assert [run.log_file for run in back.runs] == [
        "",
        *(run.log_file for run in batch.runs[1:]),
    ]
    (sentence,) = lost_told(back)
    assert sentence.startswith(
        f"The table has 1 run whose folder is not here, first {batch.runs[0].key}"
    )
    assert lost_told(batch) == []


def test_logs_stand_below_each_other_with_contestants_at_the_left():
    names = tuple(f"tracks, wrong_id_rate=0.0{index}" for index in range(4))
    with sized(PAGE_WIDTH_IN):
        figure, panels = log_panels(
            drawn_batch(1, logs=names), list(names), "error (m)"
        )
    assert [panel.get_title(loc="left") for panel in panels] == list(names)
    for panel in panels:
        labels = panel.get_yticklabels()
        assert [label.get_text() for label in labels] == list(ESTIMATORS)
        assert [label.get_color() for label in labels] == [colour(k) for k in range(3)]
    figure.draw_without_rendering()
    lows = [panel.get_tightbbox().y0 for panel in panels]
    highs = [panel.get_tightbbox().y1 for panel in panels]
    assert all(low >= high for low, high in zip(lows, highs[1:], strict=False))
