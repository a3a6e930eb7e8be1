"""What a command reads, and what another program wrote, is never overwritten."""

import re
from pathlib import Path

import pytest
from mcap.writer import Writer

from sonar_graph.cli.compare import names_written
from sonar_graph.files import LOCK, MANIFEST

QUICK = ("--estimators", "dead-reckoning")
PARK = ("convert", "dataset", "victoria-park")
SIMULATE = ("simulate", "basin", "--duration-s", "120", "--laps", "1")


CONVERSIONS = [f"convert {kind}" for kind in ("rosbag", "didson", "aris", "oculus")]


def by_another(path: Path) -> Path:
    """A log that another program wrote."""
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="a recorder")
        writer.finish()
    return path


def names_of(target: Path, folder: Path) -> list[Path]:
    """The file, and other names of it."""
    symbolic = folder / "symbolic.mcap"
    hard = folder / "hard.mcap"
    symbolic.symlink_to(target)
    hard.hardlink_to(target)
    return [target, symbolic, hard]


@pytest.mark.parametrize("flags", [(), ("--overwrite",)])
@pytest.mark.parametrize(
    "command", [*CONVERSIONS, "recognise", "simulate landmarks --on"]
)
def test_a_log_made_from_a_file_never_replaces_it(
    command, flags, dive, tmp_path, reply
):
    before = dive.read_bytes()
    told = r"sonar-graph: \S+: is what is read, .*choose another name.*\n"
    for output in (tmp_path / "." / dive.name, *names_of(dive, tmp_path)):
        words = *command.split(), dive, "-o", output, *flags
        assert re.fullmatch(told, reply(2, *words).err)
    assert dive.read_bytes() == before


def test_a_part_of_a_bag_or_a_log_of_another_ending_is_not_overwritten(
    dive, tmp_path, reply
):
    part = by_another(tmp_path / "bag" / "bag_0.mcap")
    model = tmp_path / "log.json"
    model.hardlink_to(dive)
    contents = part.read_bytes(), dive.read_bytes()
    for command in (
        ("convert", "rosbag", part.parent, "-o", part, "--overwrite"),
        ("calibrate", dive, "-o", model),
        ("label", dive, "-o", model),
    ):
        assert "is what is read" in reply(2, *command).err
    assert (part.read_bytes(), dive.read_bytes()) == contents


@pytest.mark.parametrize(
    "name",
    [
        *("result.mcap", "comparison.json", "report.html"),
        "runs/dead-reckoning/trajectory.tum",
    ],
)
def test_results_never_overwrite_the_log(name, dive, tmp_path, reply):
    results = tmp_path / "results"
    log = results / name
    log.parent.mkdir(parents=True)
    before = dive.read_bytes()
    dive.rename(log)
    told = rf"sonar-graph: .*{name}: is what is read, .*\n"
    for given in names_of(log, tmp_path):
        for command, option in (("compare", "--estimators"), ("run", "--estimator")):
            words = command, given, "-o", results, option, "dead-reckoning"
            assert re.fullmatch(told, reply(2, *words).err)
            assert log.read_bytes() == before


def test_results_never_overwrite_settings_or_a_log_of_another_program(
    dive, run, tmp_path
):
    settings = tmp_path / "comparison.json"
    settings.write_text("{}")
    for option in ("--calibration", "--log-config"):
        assert run("compare", dive, "-o", tmp_path, option, settings, *QUICK) == 2
    assert settings.read_text() == "{}"
    for name, command in (
        ("a/result.mcap", ("compare", dive, *QUICK)),
        ("b/basin.mcap", ("demo",)),
    ):
        path = by_another(tmp_path / name)
        before = path.read_bytes()
        assert run(*command, "-o", path.parent) == 2
        assert path.read_bytes() == before


@pytest.mark.usefixtures("unrendered")
def test_a_comparison_beside_the_log_can_be_repeated(dive, run, tmp_path):
    before = dive.read_bytes()
    for _ in range(2):
        assert run("compare", dive, "-o", tmp_path, *QUICK) == 0
    assert dive.read_bytes() == before
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    written = {path.relative_to(tmp_path).as_posix() for path in files}
    written -= {dive.name, LOCK, MANIFEST}
    assert written <= set(names_written(tmp_path, ["dead-reckoning"]))
    assert len(written) > 8


@pytest.mark.parametrize("content", [None, b"words", b"\x89MCAP0"])
def test_what_another_program_wrote_is_replaced_only_when_asked_for(
    content, run, tmp_path, reply
):
    """A log, a text, and a log that is cut off."""
    log = by_another(tmp_path / "log.mcap")
    if content:
        log.write_bytes(content)
    before = log.read_bytes()
    told = r"sonar-graph: .*did not write it; .*--overwrite\n"
    for command in (PARK, SIMULATE):
        assert re.fullmatch(told, reply(2, *command, "-o", log).err)
        assert log.read_bytes() == before
    assert run(*PARK, "-o", log, "--overwrite") == 0
    assert log.read_bytes() != before


def test_commands_can_be_repeated_over_what_they_wrote(run, tmp_path, capsys, reply):
    log = tmp_path / "log.mcap"
    log.touch()  # an empty file holds nothing to lose
    for told in ("", f"Replaces {log}\n"):
        capsys.readouterr()
        assert reply(0, *PARK, "-o", log).err == told
        assert run(*SIMULATE, "-o", log) == 0
    link = tmp_path / "link.mcap"
    link.symlink_to(tmp_path / "missing.mcap")
    assert run(*PARK, "-o", link) == 0
    assert link.stat().st_size > 0


@pytest.mark.usefixtures("unrendered")
def test_a_refused_command_leaves_no_new_folder(run, dive, tmp_path):
    unreadable = tmp_path / "words.mcap"
    there = tmp_path / "there"
    unreadable.write_text("words")
    there.mkdir()
    made = tmp_path / "made" / "below"
    for place in (made, there, there / "below"):
        for words in (
            ("compare", unreadable, "-o", place, *QUICK),
            ("compare", dive, "-o", place, *QUICK, "--rate-hz", "1e6"),
            ("convert", "dataset", "dlr", there, "-o", place / "log.mcap"),
        ):
            assert run(*words) == 2
        assert {dive, unreadable, there} == set(tmp_path.iterdir())
        assert not list(there.iterdir())
    assert run("compare", dive, "-o", made, *QUICK) == 0
