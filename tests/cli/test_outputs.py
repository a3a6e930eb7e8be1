"""What a command reads, and what another program wrote, is never overwritten."""

import re
from pathlib import Path

import pytest
from mcap.writer import Writer

from sonar_graph.cli.compare import names_written
from sonar_graph.files import LOCK, MANIFEST

QUICK = ("--estimators", "dead-reckoning")


def foreign_log(path: Path) -> bytes:
    """A log that another program wrote."""
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="a recorder")
        writer.finish()
    return path.read_bytes()


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
    command, flags, dive, tmp_path, reply
):
    before = dive.read_bytes()
    for output in (dive, tmp_path / "." / dive.name, *links(dive, tmp_path)):
        assert re.fullmatch(
            r"sonar-graph: \S+: is what is read, .*choose another name.*\n",
            reply(2, *command.split(), dive, "-o", output, *flags).err,
        )
    assert dive.read_bytes() == before


def test_a_part_of_a_bag_or_a_log_of_another_ending_is_not_overwritten(
    dive, tmp_path, reply
):
    part = tmp_path / "bag" / "bag_0.mcap"
    model = tmp_path / "log.json"
    contents = foreign_log(part), dive.read_bytes()
    model.hardlink_to(dive)
    rosbag = ("convert", "rosbag", part.parent, "-o", part, "--overwrite")
    for command in (
        rosbag,
        ("calibrate", dive, "-o", model),
        ("label", dive, "-o", model),
    ):
        assert "is what is read" in reply(2, *command).err
    assert (part.read_bytes(), dive.read_bytes()) == contents


@pytest.mark.parametrize(
    "name",
    [
        "result.mcap",
        "comparison.json",
        "report.html",
        "runs/dead-reckoning/trajectory.tum",
    ],
)
def test_results_never_overwrite_the_log(name, dive, run, tmp_path, reply):
    log = tmp_path / "results" / name
    log.parent.mkdir(parents=True)
    before = dive.read_bytes()
    dive.rename(log)
    for given in (log, *links(log, tmp_path)):
        for command, options in (
            ("compare", QUICK),
            ("run", ("--estimator", "dead-reckoning")),
        ):
            assert re.fullmatch(
                rf"sonar-graph: .*{name}: is what is read, .*\n",
                reply(2, command, given, "-o", tmp_path / "results", *options).err,
            )
            assert log.read_bytes() == before


def test_results_never_overwrite_settings_or_a_log_of_another_program(
    dive, run, tmp_path
):
    settings = tmp_path / "comparison.json"
    settings.write_text("{}")
    for option in ("--calibration", "--log-config"):
        assert run("compare", dive, "-o", tmp_path, option, settings, *QUICK) == 2
    assert settings.read_text() == "{}"
    for path, command in (
        ("a/result.mcap", ("compare", dive, *QUICK)),
        ("b/basin.mcap", ("demo",)),
    ):
        before = foreign_log(tmp_path / path)
        assert run(*command, "-o", (tmp_path / path).parent) == 2
        assert (tmp_path / path).read_bytes() == before


@pytest.mark.usefixtures("unrendered")
def test_a_comparison_beside_the_log_can_be_repeated(dive, run, tmp_path):
    before = dive.read_bytes()
    for _ in range(2):
        assert run("compare", dive, "-o", tmp_path, *QUICK) == 0
    assert dive.read_bytes() == before
    written = {path for path in tmp_path.rglob("*") if path.is_file()} - {
        dive,
        tmp_path / LOCK,
        tmp_path / MANIFEST,
    }
    names = names_written(tmp_path, ["dead-reckoning"])
    assert {path.relative_to(tmp_path).as_posix() for path in written} <= set(names)
    assert len(written) > 8


@pytest.mark.parametrize("content", ["another program's", "a text", "cut off"])
def test_what_another_program_wrote_is_replaced_only_when_asked_for(
    content, run, tmp_path, reply
):
    log = tmp_path / "log.mcap"
    before = (
        foreign_log(log)
        if content == "another program's"
        else b"words"
        if content == "a text"
        else b"\x89MCAP0"
    )
    log.write_bytes(before)
    for command in (
        ("convert", "dataset", "victoria-park"),
        ("simulate", "basin", "--duration-s", "120", "--laps", "1"),
    ):
        assert re.fullmatch(
            r"sonar-graph: .*did not write it; .*--overwrite\n",
            reply(2, *command, "-o", log).err,
        )
        assert log.read_bytes() == before
    assert run("convert", "dataset", "victoria-park", "-o", log, "--overwrite") == 0
    assert log.read_bytes() != before


def test_commands_can_be_repeated_over_what_they_wrote(run, tmp_path, capsys, reply):
    log = tmp_path / "log.mcap"
    log.touch()  # an empty file holds nothing to lose
    for told in ("", f"Replaces {log}\n"):
        capsys.readouterr()
        assert reply(0, "convert", "dataset", "victoria-park", "-o", log).err == told
        assert (
            run("simulate", "basin", "--duration-s", "120", "--laps", "1", "-o", log)
            == 0
        )
    (tmp_path / "link.mcap").symlink_to(tmp_path / "missing.mcap")
    assert run("convert", "dataset", "victoria-park", "-o", tmp_path / "link.mcap") == 0
    assert (tmp_path / "link.mcap").stat().st_size > 0


@pytest.mark.usefixtures("unrendered")
def test_a_refused_command_leaves_no_new_folder(run, dive, tmp_path):
    unreadable = tmp_path / "words.mcap"
    there = tmp_path / "there"
    unreadable.write_text("words")
    there.mkdir()
    for place in (tmp_path / "made" / "below", there, there / "below"):
        assert run("compare", unreadable, "-o", place, *QUICK) == 2
        assert (
            run(
                "run",
                dive,
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
        assert {dive, unreadable, there} == set(tmp_path.iterdir())
        assert not list(there.iterdir())
    assert run("compare", dive, "-o", tmp_path / "made" / "below", *QUICK) == 0
