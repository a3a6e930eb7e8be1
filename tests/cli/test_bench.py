"""``bench`` and ``report`` of batches from the command line."""

import sys
from dataclasses import replace

import pytest

from sonar_graph.cli.arguments import printable
from sonar_graph.cli.bench import MOST_REASONS
from tests.recorded_batches import drawn_batch, failed, write_batch, written_batch


def test_missing_packages_are_named_with_how_to_get_them(tmp_path, monkeypatch, reply):
    (tmp_path / "suite.toml").touch()
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert (
        "pip install 'sonar-graph[bench]'"
        in reply(2, "bench", tmp_path / "suite.toml", "-o", tmp_path / "out").err
    )


def test_report_rebuilds_the_page_of_a_batch(tmp_path, reply):
    for folder, warned in (
        (written_batch(tmp_path / "\udcff"), ""),
        (written_batch(tmp_path / "part", not_run=3), "3 of 16 runs"),
    ):
        said = reply(0, "report", folder)
        assert said.out == f"Report: {printable(str(folder / 'report.html'))}\n"
        assert (folder / "tables" / "difference-ate-se2-m.csv").is_file()
        assert warned in (folder / "report.html").read_text("utf-8")
    assert (
        "Warning: This batch is not complete: 3 of 16 runs have not been done (dead-reckoning 1 of 8"
        in said.err
    )


@pytest.mark.usefixtures("unrendered")
def test_reasons_why_runs_did_not_end_well_are_counted(tmp_path, monkeypatch, reply):
    suite = tmp_path / "suite.toml"
    suite.touch()
    batch = drawn_batch(seeds=4)
    good, *others = batch.runs
    slow = [failed(run) for run in others[:3]]
    lost = [failed(run, "failed", f"reason {k}") for k, run in enumerate(others[3:9])]
    for code, runs in ((0, [good]), (1, [good, *slow, *lost])):
        ended = replace(batch, runs=runs)
        write_batch(ended, tmp_path)
        monkeypatch.setattr(
            "sonar_graph.batch.run_suite", lambda *_, done=ended, **__: done
        )
        said = reply(code, "bench", suite, "-o", tmp_path, "--overwrite")
    assert said.out.startswith("Runs: 1 ok, 6 failed, 3 timeout\n")
    lines = said.err.splitlines()[: MOST_REASONS + 1]
    assert lines[:2] == ["  3 timeout: took longer than 60 s", "  1 failed: reason 0"]
    assert lines[-1] == "  and 2 other reasons, in the report"
