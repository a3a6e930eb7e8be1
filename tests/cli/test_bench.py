"""``bench`` and ``report`` of batches from the command line."""

import sys

from sonar_graph.cli.arguments import printable
from sonar_graph.cli.bench import MOST_REASONS, reasons_told
from tests.recorded_batches import drawn_batch, failed, written_batch


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


def test_reasons_why_runs_did_not_end_well_are_counted():
    good, *others = drawn_batch(seeds=4).runs
    slow = [failed(run) for run in others[:3]]
    lost = [failed(run, "failed", f"reason {k}") for k, run in enumerate(others[3:9])]
    lines = reasons_told([good, *slow, *lost])
    assert lines[0] == "  3 timeout: took longer than 60 s"
    assert lines[1] == "  1 failed: reason 0"
    assert len(lines) == MOST_REASONS + 1
    assert lines[-1] == "  and 2 other reasons, in the report"
    assert reasons_told([good]) == []
