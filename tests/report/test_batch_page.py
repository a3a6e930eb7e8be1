from __future__ import annotations

import base64
import csv
import io
import re
from dataclasses import replace

import pytest

from sonar_graph.batch.recorded import read_batch
from sonar_graph.report.batch_page import render_batch, write_batch_report
from tests.recorded_batches import LOGS, drawn_batch, failed, with_failures, write_batch


@pytest.fixture(scope="module")
def batch():
    return with_failures(drawn_batch(), "ekf-slam", LOGS[1], 2)


@pytest.fixture(scope="module")
def html(batch):
    return render_batch(batch)


def test_every_figure_has_its_data(html, batch):
    figures = re.findall(r'<figure id="figure-([^"]+)"', html)
    addresses = dict(re.findall(r'href="(data:text/csv[^"]+)" download="([^"]+)\.csv"', html))
    by_name = {name: address for address, name in addresses.items()}
    assert {"failures", "spread-ate-se2-m", "difference-ate-se2-m", "anees-position", "costs"} <= set(figures)
    assert set(figures) <= set(by_name)
    text = base64.b64decode(by_name["spread-ate-se2-m"].partition("base64,")[2]).decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    recorded = {
        (run.key, key): run.value(key) for run in batch.runs for key in ("causal.ate_se2_m", "smoothed.ate_se2_m")
    }
    assert {(row["key"], row["column"]) for row in rows} == set(recorded)
    assert all(float(row["value"] or "inf") == recorded[row["key"], row["column"]] for row in rows)


def test_reading_comes_before_numbers_and_the_protocol_is_told(html):
    assert html.index("How to read this page") < html.index("<figure")
    for said in ("Wilcoxon", "Holm (1979)", "Hall 1992", "Wilson", "chi-square", "Lachin 1999", "causal.ate_se2_m"):
        assert said in html


def test_the_page_says_what_its_counts_are_of(html):
    text = " ".join(html.split())
    assert "from 6 pairs on, and only where both runs of every pair have a value" in text
    assert "No test of fewer than 6 pairs, or seeds." in text
    assert "All logs together have one difference a seed" in text
    assert "of all logs together they count seeds" in text
    assert "it is no second evidence" in text
    assert "60 runs of 3 estimators on 2 logs, up to 10 seeds each, compared with dead-reckoning." in text
    assert ">8 of 10 seeds<" in text or ">10 of 10 seeds<" in text


@pytest.mark.parametrize("count", [1, 3])
def test_few_runs_and_runs_that_all_failed_make_a_page(count):
    batch = drawn_batch(count, logs=LOGS[:1])
    assert "Every run ended well" in render_batch(batch)
    nothing = replace(batch, runs=[failed(run) for run in batch.runs])
    html = render_batch(nothing)
    assert "no run has an error to compare" in html
    assert "nan" not in re.sub(r"<svg.*?</svg>|base64,[^\"]*", "", html, flags=re.DOTALL).lower().split()


def test_the_report_is_rebuilt_from_results_alone(tmp_path, batch):
    write_batch(batch, tmp_path)
    page = write_batch_report(read_batch(tmp_path), tmp_path)
    assert page == tmp_path / "report.html"
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert {path.suffix for path in (tmp_path / "tables").iterdir()} == {".csv", ".tex"}
