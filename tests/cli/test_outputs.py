"""What a command reads, and what another program wrote, is never overwritten."""

import re
from pathlib import Path

import pytest

from sonar_graph.cli.compare import names_written
from sonar_graph.cli.outputs import writable_folder
from sonar_graph.errors import EvaluationError
from sonar_graph.files import LOCK, MANIFEST

QUICK = ("--estimators", "dead-reckoning")


def links(target: Path, folder: Path) -> list[Path]:
    """Other names of a file."""
    symbolic = folder / "symbolic.mcap"
    hard = folder / "hard.mcap"
    symbolic.symlink_to(target)
    hard.hardlink_to(target)
    return [symbolic, hard]


CONVERSIONS = [f"convert {kind}" for kind in ("rosbag", "didson", "aris", "oculus")]


@pytest.mark.parametrize("flags", [(), ("--overwrite",)])
@pytest.mark.parametrize(
    "command", [*CONVERSIONS, "recognise", "simulate landmarks --on"]
)
def test_a_log_made_from_a_file_never_replaces_it(
    command, flags, basin, run, tmp_path, capsys
):
    before = basin.read_bytes()
    for output in (basin, tmp_path / "." / basin.name, *links(basin, tmp_path)):
        assert run(*command.split(), basin, "-o", output, *flags) == 2
        assert re.fullmatch(
            r"sonar-graph: \S+: is what is read, .*choose another name.*\n",
            capsys.readouterr().err,
        )
    assert basin.read_bytes() == before


@pytest.mark.parametrize(
    "name",
    [
        "result.mcap",
        "comparison.json",
        "report.html",
        "runs/dead-reckoning/trajectory.tum",
    ],
)
def test_results_never_overwrite_the_log(name, basin, run, tmp_path, capsys):
    log = tmp_path / "results" / name
    log.parent.mkdir(parents=True)
    before = basin.read_bytes()
    basin.rename(log)
    for given in (log, *links(log, tmp_path)):
        for command, options in (
            ("compare", QUICK),
            ("run", ("--estimator", "dead-reckoning")),
        ):
            assert run(command, given, "-o", tmp_path / "results", *options) == 2
            assert re.fullmatch(
                rf"sonar-graph: .*{name}: is what is read, .*\n",
                capsys.readouterr().err,
            )
            assert log.read_bytes() == before


def test_a_comparison_beside_its_log_can_be_repeated(basin, run, tmp_path):
    before = basin.read_bytes()
    for _ in range(2):
        assert run("compare", basin, "-o", tmp_path, *QUICK) == 0
    assert basin.read_bytes() == before
    written = {path for path in tmp_path.rglob("*") if path.is_file()} - {
        basin,
        tmp_path / LOCK,
        tmp_path / MANIFEST,
    }
    names = names_written(tmp_path, ["dead-reckoning"])
    assert {path.relative_to(tmp_path).as_posix() for path in written} <= set(names)
    assert len(written) > 8
    for path in written:
        with (
            pytest.raises(EvaluationError, match="is what is read"),
            writable_folder(tmp_path, names, [path]),
        ):
            pass


def test_commands_can_be_repeated_over_their_results(run, tmp_path, capsys):
    log = tmp_path / "log.mcap"
    log.touch()  # an empty file holds nothing to lose
    for told in ("", f"Replaces {log}\n"):
        capsys.readouterr()
        assert run("convert", "dataset", "victoria-park", "-o", log) == 0
        assert capsys.readouterr().err == told
        assert (
            run("simulate", "basin", "--duration-s", "120", "--laps", "1", "-o", log)
            == 0
        )
    (tmp_path / "link.mcap").symlink_to(tmp_path / "missing.mcap")
    assert run("convert", "dataset", "victoria-park", "-o", tmp_path / "link.mcap") == 0
    assert (tmp_path / "link.mcap").stat().st_size > 0


def test_a_refused_command_leaves_no_new_folder(run, basin, tmp_path):
    unreadable = tmp_path / "words.mcap"
    there = tmp_path / "there"
    unreadable.write_text("words")
    there.mkdir()
    for place in (tmp_path / "made" / "below", there, there / "below"):
        assert run("compare", unreadable, "-o", place, *QUICK) == 2
        assert (
            run(
                "run",
                basin,
                "-o",
                place,
                "--estimator",
                "dead-reckoning",
                "--rate-hz",
                "1e6",
            )
            == 2
        )
        assert (
            run("convert", "mrclam", tmp_path, "--robot", "1", "-o", place / "log.mcap")
            == 2
        )
        assert {basin, unreadable, there} == set(tmp_path.iterdir())
        assert not list(there.iterdir())
    assert run("compare", basin, "-o", tmp_path / "made" / "below", *QUICK) == 0
