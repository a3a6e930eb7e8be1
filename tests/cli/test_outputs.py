from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from mcap.writer import Writer

from sonar_graph.cli.main import app
from sonar_graph.cli.outputs import writable_folder
from sonar_graph.errors import EvaluationError

QUICK = ("--estimators", "dead-reckoning")


def foreign_log(path: Path) -> bytes:
    """A log that another program wrote."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="a recorder")
        writer.finish()
    return path.read_bytes()


def links(target: Path, folder: Path) -> list[Path]:
    """Other names of a file."""
    symbolic, hard = folder / "symbolic.mcap", folder / "hard.mcap"
    symbolic.symlink_to(target)
    hard.hardlink_to(target)
    return [symbolic, hard]


@pytest.mark.parametrize("flags", [(), ("--overwrite",)])
@pytest.mark.parametrize("command", [("rosbag",), ("didson",), ("aris",), ("oculus",), ("victoria-park", "--file")])
def test_a_conversion_never_overwrites_what_it_reads(command, flags, basin, run, tmp_path, capsys):
    before = basin.read_bytes()
    for output in (basin, tmp_path / "." / basin.name, *links(basin, tmp_path)):
        assert run("convert", *command, basin, "-o", output, *flags) == 2
        assert re.fullmatch(r"sonar-graph: \S+: is what is read, .*choose another name.*\n", capsys.readouterr().err)
    assert basin.read_bytes() == before


def test_a_conversion_never_overwrites_a_part_of_the_bag_that_it_reads(run, tmp_path, capsys):
    bag = tmp_path / "bag"
    bag.mkdir()
    before = foreign_log(bag / "bag_0.mcap")
    assert run("convert", "rosbag", bag, "-o", bag / "bag_0.mcap", "--overwrite") == 2
    assert "is what is read" in capsys.readouterr().err
    assert (bag / "bag_0.mcap").read_bytes() == before


@pytest.mark.parametrize("name", ["result.mcap", "comparison.json", "report.html", "runs/isam2/trajectory.tum"])
def test_results_never_overwrite_the_log(name, basin, run, tmp_path, capsys):
    log = tmp_path / "results" / name
    log.parent.mkdir(parents=True)
    before = basin.read_bytes()
    basin.rename(log)
    for given in (log, *links(log, tmp_path)):
        for command, options in (("compare", QUICK), ("run", ("--estimator", "dead-reckoning"))):
            assert run(command, given, "-o", tmp_path / "results", *options) == 2
            assert re.fullmatch(rf"sonar-graph: .*{name}: is what is read, .*\n", capsys.readouterr().err)
            assert log.read_bytes() == before


@pytest.mark.parametrize("option", ["--calibration", "--log-config"])
def test_results_never_overwrite_settings(option, basin, run, tmp_path):
    (tmp_path / "comparison.json").write_text("{}")
    assert run("compare", basin, "-o", tmp_path, option, tmp_path / "comparison.json", *QUICK) == 2
    assert (tmp_path / "comparison.json").read_text() == "{}"


def test_every_file_of_a_comparison_is_kept_from_being_read_and_written(basin, run, tmp_path):
    folder = tmp_path / "results"
    assert run("compare", basin, "-o", folder, *QUICK) == 0
    written = [path for path in folder.rglob("*") if path.is_file()]
    assert len(written) > 8
    for path in written:
        with pytest.raises(EvaluationError, match="is what is read"):
            writable_folder(folder, [path])


def test_a_log_beside_results_is_read_and_a_comparison_can_be_repeated(basin, run, tmp_path):
    before = basin.read_bytes()
    for _ in range(2):
        assert run("compare", basin, "-o", tmp_path, *QUICK) == 0
    assert basin.read_bytes() == before


def test_results_never_replace_a_log_of_another_program(basin, run, tmp_path):
    folder = tmp_path / "results"
    folder.mkdir()
    before = foreign_log(folder / "result.mcap")
    assert run("compare", basin, "-o", folder, *QUICK) == 2
    assert (folder / "result.mcap").read_bytes() == before


@pytest.mark.parametrize("content", ["another program's", "a text", "cut off"])
def test_what_another_program_wrote_is_replaced_only_when_asked_for(content, run, tmp_path, capsys):
    log = tmp_path / "log.mcap"
    before = foreign_log(log) if content == "another program's" else b"words" if content == "a text" else b"\x89MCAP0"
    log.write_bytes(before)
    for command in (("convert", "victoria-park"), ("simulate", "basin", "--duration-s", "120", "--laps", "1")):
        assert run(*command, "-o", log) == 2
        assert re.fullmatch(r"sonar-graph: .*did not write it; .*--overwrite\n", capsys.readouterr().err)
        assert log.read_bytes() == before
    assert run("convert", "victoria-park", "-o", log, "--overwrite") == 0
    assert log.read_bytes() != before


def test_commands_can_be_repeated_over_what_they_wrote(run, tmp_path):
    log = tmp_path / "log.mcap"
    log.touch()  # an empty file holds nothing to lose
    for _ in range(2):
        assert run("convert", "victoria-park", "-o", log) == 0
        assert run("simulate", "basin", "--duration-s", "120", "--laps", "1", "-o", log) == 0


def test_demo_never_replaces_a_log_of_another_program(run, tmp_path):
    before = foreign_log(tmp_path / "basin.mcap")
    assert run("demo", "-o", tmp_path) == 2
    assert (tmp_path / "basin.mcap").read_bytes() == before


def test_a_link_to_nowhere_is_no_obstacle(run, tmp_path):
    (tmp_path / "log.mcap").symlink_to(tmp_path / "missing.mcap")
    assert run("convert", "victoria-park", "-o", tmp_path / "log.mcap") == 0
    assert (tmp_path / "log.mcap").stat().st_size > 0


@pytest.mark.parametrize("command", [("recognise",), ("simulate", "landmarks", "--on")], ids=" ".join)
def test_a_log_made_from_a_log_never_replaces_it(command, basin, run, tmp_path):
    before = basin.read_bytes()
    for output in (basin, *links(basin, tmp_path)):
        assert run(*command, basin, "-o", output, "--overwrite") == 2
        assert basin.read_bytes() == before


def test_a_model_never_replaces_a_log(basin, run, tmp_path, capsys):
    before = basin.read_bytes()
    assert run("calibrate", basin, "-o", basin) == 2
    assert "ends in .json" in capsys.readouterr().err
    link = tmp_path / "log.json"
    link.hardlink_to(basin)
    assert run("calibrate", basin, "-o", link) == 2
    assert "is what is read" in capsys.readouterr().err
    assert basin.read_bytes() == before


def test_every_command_that_writes_from_a_file_is_tried_here():
    """A command that joins later must not be forgotten."""

    def commands(group: Any) -> Iterator[Any]:
        for command in group.commands.values():
            yield from commands(command) if hasattr(command, "commands") else [command]

    writing = {c.name for c in commands(typer.main.get_command(app)) if any(p.name == "output" for p in c.params)}
    of_folders, of_nothing = {"mrclam", "dlr", "akit"}, {"basin", "demo"}
    tried = {"rosbag", "didson", "aris", "oculus", "victoria-park", "compare", "recognise", "landmarks", "calibrate"}
    assert writing == tried | of_folders | of_nothing | {"run"}
