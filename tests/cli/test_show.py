"""``sonar-graph figures`` and ``view``: for a paper, and in the viewer that is there, without waiting for it."""

import webbrowser
from pathlib import Path

import pytest

from sonar_graph.cli import show
from sonar_graph.report import write_report
from tests.synthetic import basin_comparison


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> Path:
    return write_report(basin_comparison(60), tmp_path_factory.mktemp("result")).parent


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    """Addresses that are given to a browser, on a machine with a screen and no viewer."""
    addresses: list[str] = []
    monkeypatch.setattr(
        webbrowser, "open", lambda address: addresses.append(address) or True
    )
    monkeypatch.setattr(show, "has_screen", lambda: True)
    monkeypatch.setattr(show, "command_of", lambda _: [])
    return addresses


def test_figures_go_into_a_folder_beside_the_result_or_elsewhere(
    result, run, tmp_path, capsys
):
    assert run("figures", result) == 0
    assert (
        capsys.readouterr().out
        == f"Figures and tables: {result / 'paper' / 'paper.tex'}\n"
    )
    assert (result / "paper" / "figures" / "map.pdf").is_file()
    assert run("figures", tmp_path) == 2
    assert "no comparison.json in it" in capsys.readouterr().err
    assert run("figures", result, "-o", result) == 2
    assert "holds a comparison, and would become a paper" in capsys.readouterr().err


def test_without_a_viewer_the_page_opens_and_what_to_install_is_said(
    result, run, opened, capsys
):
    for given in (result, result / "result.mcap"):
        assert run("view", given) == 0
        said = capsys.readouterr()
        assert said.out == f"Opened {result / 'report.html'}\n"
        assert all(name in said.err for name in show.VIEWERS)
        assert "pip install rerun-sdk" in said.err
    assert opened == [(result / "report.html").as_uri()] * 2


def test_without_a_screen_nothing_is_started(result, run, opened, monkeypatch, capsys):
    monkeypatch.setattr(show, "has_screen", lambda: False)
    assert run("view", result) == 0
    assert capsys.readouterr().out == f"No screen here; open {result / 'report.html'}\n"
    monkeypatch.setattr(show, "command_of", lambda _: ["/no/such/viewer"])
    assert run("view", result) == 0
    assert capsys.readouterr().out.startswith(
        f"No screen here; open {result / 'result.mcap'} with lichtblick"
    )
    assert opened == []


def test_a_viewer_gets_the_log_and_is_not_waited_for(
    result, run, opened, monkeypatch, tmp_path, capsys
):
    viewer = tmp_path / "lichtblick"
    viewer.write_text(f'#!/bin/sh\necho "$1" > {tmp_path}/given\nsleep 60\n')
    viewer.chmod(0o755)
    started = []
    monkeypatch.setattr(
        show.subprocess,
        "Popen",
        lambda words, **options: started.append((words, options)),
    )
    monkeypatch.setattr(
        show,
        "command_of",
        lambda one: [str(viewer)] if one is show.VIEWERS["lichtblick"] else [],
    )
    assert run("view", result) == 0
    ((words, options),) = started
    assert words == [str(viewer), str(result / "result.mcap")]
    assert options["start_new_session"]
    assert (
        f"import {result / 'result.foxglove.json'} as its layout"
        in capsys.readouterr().out
    )
    assert opened == []


def test_wrong_uses_of_view_are_told_in_one_line(result, run, opened, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    for words, said in {
        (
            tmp_path,
        ): "holds neither result.mcap nor report.html; give the folder that compare wrote",
        (
            tmp_path / "notes.txt",
        ): "expected the folder of a result, or its result.mcap",
        (
            result,
            "--viewer",
            "paraview",
        ): "--viewer paraview: expected lichtblick, foxglove, rerun or browser",
        (
            result,
            "--viewer",
            "rerun",
        ): "--viewer rerun: is not installed: pip install rerun-sdk",
    }.items():
        assert run("view", *words) == 2
        told = capsys.readouterr().err
        assert said in told
        assert told.count("\n") == 1
