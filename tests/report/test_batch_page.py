"""The page of a batch: figures with their data, explanations, the runs that are missing, and panels for each log."""

import re
from dataclasses import replace
from itertools import pairwise

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

from .test_batch_tables import row_of


@pytest.mark.parametrize("count", [1, 3])
def test_few_runs_and_runs_that_all_failed_make_a_page(count):
    batch = drawn_batch(count, logs=LOGS[:1])
    html = render_batch(batch)
    assert "Every run ended well." in html
    assert "not complete" not in html.lower()
    partial = with_missing(batch, "isam2", LOGS[0], count)
    html = render_batch(partial)
    assert "Every run that was done ended well." in html
    assert f"(isam2 {count} of {count})" in html
    html = render_batch(replace(batch, runs=[failed(run) for run in batch.runs]))
    assert "No run has an error to compare" in html
    words = re.sub(r"<svg.*?</svg>|base64,[^\"]*", "", html, flags=re.DOTALL)
    assert "nan" not in words.lower().split()


@pytest.fixture
def incomplete() -> RecordedBatch:
    """Of 60 runs four of isam2 and all ten of ekf-slam on one log are not done; one more run failed."""
    batch = with_failures(drawn_batch(10), "isam2", LOGS[0], 1)
    batch = with_missing(batch, "isam2", LOGS[0], 4)
    return with_missing(batch, "ekf-slam", LOGS[0], 10)


def test_missing_runs_are_counted_and_are_no_failures(incomplete):
    table = failure_table(incomplete)
    assert len(table.rows) == 6
    rate = str(1 / 6)
    some = {"runs": "6", "ended": "5", "failure_rate": rate, "not_run": "4"}
    assert row_of(table, "isam2").items() >= some.items()
    none = {"runs": "0", "failure_rate": "", "not_run": "10"}
    assert row_of(table, "ekf-slam").items() >= none.items()
    assert row_of(table, "isam2", LOGS[1])["not_run"] == "0"
    complete = drawn_batch(2)
    table = failure_table(complete)
    assert "not_run" not in row_of(table, "isam2")
    assert marked(complete, table) is table
    assert missing_told(complete) == []


def test_logs_whose_data_was_absent_are_named_with_their_source():
    entry = '[[logs]]\nname = "{}"\nobtain = "the source"\n'
    suite = entry.format(LOGS[0]) + entry.format("elsewhere")
    told = "Left out, because its data was not there: elsewhere. Get the source."
    for text, lines in ((suite, [told]), ("", []), ("no toml [", [])):
        assert absent_told(replace(drawn_batch(1), suite=text)) == lines


def test_what_estimators_withheld_is_told_once_for_each_log():
    moved = "moved since the map was made: landmark 3"
    grave = "beyond doubt"
    batch = drawn_batch(2)
    assert withheld_told(batch) == []
    for run in batch.group(LOGS[0], "isam2"):
        run.texts["withheld"] = grave if run.seed else moved
    lines = [f"{LOGS[0]}: isam2: {text}" for text in (grave, moved)]
    assert withheld_told(batch) == [f"Doubtful: {lines[0]}", f"Warning: {lines[1]}"]
    assert lines[1] in render_batch(batch)


def test_a_table_with_missing_runs_is_read_as_one_in_the_order_of_the_plan(
    incomplete, tmp_path
):
    lacks_first = with_missing(incomplete, "dead-reckoning", LOGS[0], 10)
    back = read_batch(write_batch(lacks_first, tmp_path))
    assert back.contestants == lacks_first.contestants == list(ESTIMATORS)
    assert [run.key for run in back.runs] == [run.key for run in lacks_first.runs]
    assert {run.key for run in back.missing} == {run.key for run in lacks_first.missing}
    none = drawn_batch(1, logs=LOGS[:1])
    for name in ESTIMATORS:
        none = with_missing(none, name, LOGS[0], 1)
    write_batch(none, tmp_path)
    told = "none of its 3 runs has been done yet; give the bench command"
    with pytest.raises(EvaluationError, match=told):
        read_batch(tmp_path)


def test_page_and_tables_count_missing_runs(incomplete, tmp_path):
    (told,) = missing_told(incomplete)
    start = "This batch is not complete: 14 of 60 runs"
    for part in (
        f"{start} have not been done (isam2 4 of 20, ekf-slam",
        "on basin. All numbers are of the other runs",
        "give the bench command that began it again",
    ):
        assert part in told
    # from results alone
    page = write_batch_report(read_batch(write_batch(incomplete, tmp_path)), tmp_path)
    assert page == tmp_path / "report.html"
    html = page.read_text("utf-8")
    first = html.index('<p class="warning">')
    assert html[first:].startswith(f'<p class="warning">{start}')
    assert first < html.index("<table")
    assert "that was done ended well" not in html, "one did not"
    files = sorted((tmp_path / "tables").iterdir())
    assert {path.suffix for path in files} == {".csv"}


def test_rows_whose_runs_are_not_here_are_told_and_lead_nowhere(tmp_path):
    batch = drawn_batch(2)
    write_batch(batch, tmp_path)
    lost, *here = batch.runs
    for run in here:
        (tmp_path / run.log_file).parent.mkdir(parents=True)
        (tmp_path / run.log_file).touch()
    back = read_batch(tmp_path)
    files = [run.log_file for run in back.runs]
    assert files == ["", *(run.log_file for run in here)]
    (sentence,) = lost_told(back)
    start = f"The table has 1 run whose folder is not here, first {lost.key}"
    assert sentence.startswith(start)
    assert lost_told(batch) == []


def test_logs_stand_below_each_other_with_contestants_at_the_left():
    names = [f"tracks, wrong_id_rate=0.0{index}" for index in range(4)]
    with sized(PAGE_WIDTH_IN):
        figure, panels = log_panels(drawn_batch(1, logs=tuple(names)), names, "x (m)")
    assert [panel.get_title(loc="left") for panel in panels] == names
    expected = [(name, colour(k)) for k, name in enumerate(ESTIMATORS)]
    for panel in panels:
        labels = panel.get_yticklabels()
        assert [(label.get_text(), label.get_color()) for label in labels] == expected
    figure.draw_without_rendering()
    boxes = [panel.get_tightbbox() for panel in panels]
    assert all(above.y0 >= below.y1 for above, below in pairwise(boxes))
