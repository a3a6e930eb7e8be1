"""``bench`` and ``report`` of batches from the command line."""

import sys

import sonar_graph
from sonar_graph.cli.arguments import printable
from tests.recorded_batches import written_batch


def test_missing_packages_are_named_with_how_to_get_them(
    run, tmp_path, capsys, monkeypatch
):
    (tmp_path / "suite.toml").touch()
    for name in [name for name in sys.modules if name.startswith("sonar_graph.batch")]:
        monkeypatch.delitem(sys.modules, name)
    # back to the modules that are known by now
    monkeypatch.setattr(sonar_graph, "batch", sonar_graph.batch)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run("bench", tmp_path / "suite.toml", "-o", tmp_path / "out") == 2
    assert "pip install 'sonar-graph[bench]'" in capsys.readouterr().err


def test_report_rebuilds_page_and_tables_of_a_batch_and_warns_of_an_incomplete_one(
    run, tmp_path, capsys
):
    for folder, warned in (
        (written_batch(tmp_path / "\udcff"), ""),
        (written_batch(tmp_path / "part", not_run=3), "3 of 16 runs"),
    ):
        assert run("report", folder) == 0
        said = capsys.readouterr()
        assert said.out == f"Report: {printable(str(folder / 'report.html'))}\n"
        assert (folder / "tables" / "difference-ate-se2-m.tex").is_file()
        assert warned in (folder / "report.html").read_text("utf-8")
    assert (
        "Warning: This batch is not complete: 3 of 16 runs have not been done (dead-reckoning 1 of 8"
        in said.err
    )
