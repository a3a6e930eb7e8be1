from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer.main
from hypothesis import given
from hypothesis import strategies as st

import sonar_graph
from sonar_graph.cli import app, main
from sonar_graph.cli.demonstrating import DEMO
from sonar_graph.cli.settings import estimator_settings, parse_setting, read_calibration, topic_choices
from sonar_graph.errors import CalibrationError, EstimatorError
from sonar_graph.evaluation.storage import read_comparison
from sonar_graph.logs.calibration_sources import PartialCalibration
from sonar_graph.logs.reading import read_sequence
from sonar_graph.simulation.basin import FASTEST_M_S, PAPER_LAPS, BasinOptions, cruise_speed


def run(*arguments: object) -> int:
    """Exit code of ``sonar-graph`` with these arguments."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


def commands(group: Any = None, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """Every command by its path, groups left out."""
    group = group or typer.main.get_command(app)
    found: dict[tuple[str, ...], Any] = {}
    for name, command in group.commands.items():
        deeper = hasattr(command, "commands")
        found |= commands(command, (*path, name)) if deeper else {(*path, name): command}
    return found


def examples_of(command: Any) -> list[list[str]]:
    return [line.split() for line in command.epilog.splitlines() if line.startswith("sonar-graph ")]


@pytest.fixture(scope="module")
def basin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a short run in the basin."""
    log = tmp_path_factory.mktemp("log") / "basin.mcap"
    assert run("simulate", "basin", "-o", log, "--duration-s", "120", "--laps", "1", "--seed", "3") == 0
    return log


@pytest.fixture(scope="module")
def compared(basin: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``compare`` writes for that log."""
    folder = tmp_path_factory.mktemp("compared")
    assert run("compare", basin, "-o", folder, "--rate-hz", "1") == 0
    return folder


# --- parts of logs, damaged logs -----------------------------------------------------------------------------------


def test_start_and_end_cut_the_log(basin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--estimator", "dead-reckoning", "--start", "30", "--end", "60")
    assert run("run", basin, "-o", tmp_path / "out", *options) == 0
    notes = json.loads((tmp_path / "out" / "comparison.json").read_text())["sequence"]["notes"]
    assert notes["log.part"] == "30.000 s to 60.000 s of the recording"
    capsys.readouterr()
    assert run("inspect", basin, "--start", "30", "--end", "60") == 0
    assert ", 30.0 s" in capsys.readouterr().out
    assert run("run", basin, "-o", tmp_path / "out", "--start", "1e6") == 2
    assert "nothing was recorded from 1000000.000 s to the end" in capsys.readouterr().err


def test_a_damaged_log_is_refused_with_the_option_that_reads_it(
    basin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "damaged.mcap"
    content = bytearray(basin.read_bytes())
    content[len(content) // 3] ^= 1
    log.write_bytes(content)
    options = ("-o", tmp_path / "out", "--estimator", "dead-reckoning")
    assert run("run", log, *options) == 2
    assert re.search(r"is damaged: bytes .* is lost: .*--salvage", capsys.readouterr().err)
    assert run("run", log, *options, "--salvage") == 0
    notes = json.loads((tmp_path / "out" / "comparison.json").read_text())["sequence"]["notes"]
    assert "is lost" in notes["log.damage"]


# --- help ---------------------------------------------------------------------------------------------------------


def test_no_argument_shows_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 0
    shown = capsys.readouterr().out
    for path in commands():
        assert path[0] in shown


def test_help_does_not_wait_for_heavy_imports() -> None:
    heavy = "{'gtsam', 'matplotlib', 'numba', 'numpy', 'scipy'}"
    code = f"import sys, sonar_graph.cli; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out == f"sonar-graph {sonar_graph.__version__}\n"


@pytest.mark.parametrize("path", commands(), ids=" ".join)
def test_every_command_has_help_that_ends_in_examples(
    path: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*path, "--help") == 0
    assert f"sonar-graph {' '.join(path)}" in capsys.readouterr().out.partition("Examples:")[2]


@pytest.mark.parametrize("path", commands(), ids=" ".join)
def test_examples_in_help_are_understood(
    path: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (
        "dive.mcap",
        "vehicle.toml",
        "dive.toml",
        "dive.bag",
        "dive.ddf",
        "dive.aris",
        "pings.raw",
        "reference.json",
        "suite.toml",
    ):
        Path(name).touch()
    for name in ("comparison", "MRCLAM_Dataset6", "DLR", "A-KIT", "ros2_bag_folder", "results"):
        Path(name).mkdir()
    command = commands()[path]
    examples = examples_of(command)
    assert examples
    for words in examples:
        assert tuple(words[1 : 1 + len(path)]) == path
        command.make_context(path[-1], words[1 + len(path) :])


@pytest.mark.parametrize("group", ["simulate", "convert", "bench"])
def test_help_of_a_group_ends_in_examples(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(group, "--help") == 0
    assert f"sonar-graph {group} " in capsys.readouterr().out.partition("Examples:")[2]


def test_help_names_defaults_presets_and_roles_as_they_are() -> None:
    from sonar_graph.logs.roles import ROLES
    from sonar_graph.simulation.basin import BasinOptions
    from sonar_graph.simulation.image_options import ImageOptions
    from sonar_graph.simulation.presets import DVL_PRESETS, IMU_PRESETS

    options = BasinOptions()
    helps = {option.name: option.help for option in commands()["simulate", "basin"].params}
    for name in ("seed", "duration_s", "laps"):
        assert helps[name].endswith(f" Default: {getattr(options, name):g}.")
    for name, presets in (("imu", IMU_PRESETS), ("dvl", DVL_PRESETS)):
        assert f"{getattr(options, name)} (default)" in helps[name]
        assert all(preset in helps[name] for preset in presets)
    said = set(re.findall(r"[a-z_]+", helps["settings"].partition("repeated: ")[2].partition(". ")[0]))
    others = BasinOptions.model_fields.keys() - {"seed", "imu", "dvl", "duration_s", "laps", "image"}
    assert said - {"and", "with", "images", "image"} == others | ImageOptions.model_fields.keys()
    topic = next(option.help for option in commands()["compare",].params if option.name == "topics")
    assert topic.endswith(f" Roles: {', '.join(ROLES)}.")


# --- the user's mistakes ------------------------------------------------------------------------------------------

MISTAKES = {
    "unknown command": (["dance"], "dance"),
    "unknown option": (["compare", "LOG", "-o", "OUT", "--speed", "9"], "--speed"),
    "no log": (["compare", "missing.mcap", "-o", "OUT"], "missing.mcap"),
    "folder as log": (["inspect", "FOLDER"], "is a directory"),
    "text as log": (["inspect", "TEXT"], "notes.txt"),
    "text as log to compare": (["compare", "TEXT", "-o", "OUT"], "notes.txt"),
    "file as output folder": (["compare", "LOG", "-o", "TEXT"], "is a file; give a folder"),
    "output below a file": (["compare", "LOG", "-o", "TEXT/deeper"], "cannot be written"),
    "folder as output log": (["simulate", "basin", "-o", "FOLDER"], "is a folder; give the name of a file"),
    "output log with another ending": (["simulate", "basin", "-o", "basin.bag"], "ends in .mcap"),
    "unknown estimator": (["compare", "LOG", "-o", "OUT", "--estimators", "isam3"], "no estimator is called 'isam3'"),
    "no estimator": (["compare", "LOG", "-o", "OUT", "--estimators", ","], "expected names such as"),
    "estimator without name": (["compare", "LOG", "-o", "OUT", "--estimators", "isam2,,mine"], "a name is empty"),
    "estimator twice": (["compare", "LOG", "-o", "OUT", "--estimators", "isam2,isam2"], "isam2 is named twice"),
    "rate of zero": (["compare", "LOG", "-o", "OUT", "--rate-hz", "0"], "--rate-hz"),
    "rate without end": (["compare", "LOG", "-o", "OUT", "--rate-hz", "inf"], "--rate-hz"),
    "rate of no number": (["compare", "LOG", "-o", "OUT", "--rate-hz", "nan"], "--rate-hz"),
    "rate too high": (["compare", "LOG", "-o", "OUT", "--rate-hz", "2000"], "--rate-hz"),
    "rate above the IMU's": (
        ["compare", "LOG", "-o", "OUT", "--rate-hz", "200"],
        "measures 100 times a second; give at most 100",
    ),
    "rate too low": (["run", "LOG", "-o", "OUT", "--estimator", "dead-reckoning", "--rate-hz", "0.001"], "too short"),
    "setting without value": (["run", "LOG", "-o", "OUT", "--set", "isam2.lag_s"], "expected name=value"),
    "setting of another": (
        ["run", "LOG", "-o", "OUT", "--set", "ekf-slam.x=1"],
        "ekf-slam is not among the estimators",
    ),
    "setting without name": (["run", "LOG", "-o", "OUT", "--set", "isam2.=1"], "expected ESTIMATOR.setting=value"),
    "unknown setting": (["run", "LOG", "-o", "OUT", "--set", "isam2.nonsense=1"], "nonsense"),
    "topic without role": (["run", "LOG", "-o", "OUT", "--topic", "/imu/data"], "expected ROLE=TOPIC"),
    "topic of no such role": (["run", "LOG", "-o", "OUT", "--topic", "smell=/imu/data"], "smell"),
    "topic that is not there": (["run", "LOG", "-o", "OUT", "--topic", "imu=/imu/raw"], "/imu/raw"),
    "broken calibration": (["run", "LOG", "-o", "OUT", "--calibration", "TEXT"], "not TOML"),
    "list as calibration": (["run", "LOG", "-o", "OUT", "--calibration", "LIST"], "expected an object with sections"),
    "unknown simulation option": (["simulate", "basin", "-o", "new.mcap", "--set", "wind=3"], "wind"),
    "unknown preset": (["simulate", "basin", "-o", "new.mcap", "--imu", "sundial"], "sundial"),
    "too short for the laps": (["simulate", "basin", "-o", "new.mcap", "--duration-s", "1"], "laps"),
    "laps that are no number": (["simulate", "basin", "-o", "new.mcap", "--laps", "many"], "--laps"),
    "empty dataset": (["convert", "mrclam", "FOLDER", "--robot", "1", "-o", "new.mcap"], "FOLDER"),
    "report of nothing": (["report", "FOLDER"], "FOLDER"),
}


@pytest.mark.parametrize(("arguments", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_mistake_is_told_in_one_line(
    arguments: list[str],
    expected: str,
    basin: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FOLDER").mkdir()
    Path("notes.txt").write_text("these are = = words")
    Path("list.json").write_text("[1]")
    places = {"LOG": str(basin), "LIST": "list.json", "TEXT": "notes.txt", "TEXT/deeper": "notes.txt/deeper"}
    assert run(*(places.get(word, word) for word in arguments)) == 2
    told = capsys.readouterr().err
    assert re.fullmatch(r"sonar-graph: .+\n", told)
    assert expected in told
    assert not Path("new.mcap").exists()
    assert not Path("OUT/comparison.json").exists()


@pytest.mark.parametrize("stop", [KeyboardInterrupt, PermissionError(13, "Permission denied", "x.mcap")])
def test_interruption_and_refused_access_end_in_one_line(
    stop: Any, basin: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> None:
        raise stop

    monkeypatch.setattr("sonar_graph.logs.inspection.inspect_log", stopped)
    assert run("inspect", basin) == (130 if stop is KeyboardInterrupt else 2)
    assert re.fullmatch(r"sonar-graph: .+\n", capsys.readouterr().err)


def test_unforeseen_error_is_not_hidden(basin: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("sonar_graph.logs.inspection.inspect_log", broken)
    with pytest.raises(ZeroDivisionError):
        main(["inspect", str(basin)])


# --- the main job -------------------------------------------------------------------------------------------------


def test_compare_writes_report_numbers_results_and_runs(compared: Path) -> None:
    for name in ("report.html", "comparison.json", "result.mcap", "result.foxglove.json", "result.rviz"):
        assert (compared / name).stat().st_size > 1000
    for estimator in ("isam2", "ekf-slam", "dead-reckoning"):
        there = {path.name for path in (compared / "runs" / estimator).iterdir()}
        assert {"trajectory.tum", "causal.tum", "landmarks.csv", "result.json"} <= there
        assert json.loads((compared / "runs" / estimator / "result.json").read_text())["status"] == "ok"


def test_compare_says_where_the_report_is_and_nothing_on_stderr(
    basin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("compare", basin, "-o", tmp_path, "--estimators", "dead-reckoning") == 0
    told = capsys.readouterr()
    assert f"Report: {tmp_path / 'report.html'}" in told.out.splitlines()
    assert "dead-reckoning" in told.out
    assert told.err == ""


def test_report_draws_the_same_page_again(compared: Path) -> None:
    page = compared / "report.html"
    before = page.read_text()
    page.unlink()
    assert run("report", compared) == 0
    assert len(page.read_text()) == pytest.approx(len(before), rel=0.01)


def test_failed_run_is_written_and_reported_by_exit_code(
    basin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from baselines.dead_reckoning import DeadReckoning

    def fail(*_: object) -> None:
        raise RuntimeError("the filter is tired")

    monkeypatch.setattr(DeadReckoning, "process", fail)
    assert run("compare", basin, "-o", tmp_path, "--estimators", "dead-reckoning,ekf-slam") == 1
    assert "the filter is tired" in capsys.readouterr().err
    assert "the filter is tired" in (tmp_path / "report.html").read_text()
    assert json.loads((tmp_path / "runs" / "dead-reckoning" / "result.json").read_text())["status"] == "failed"
    assert json.loads((tmp_path / "runs" / "ekf-slam" / "result.json").read_text())["status"] == "ok"


def test_run_writes_one_estimator(basin: Path, tmp_path: Path) -> None:
    assert run("run", basin, "--estimator", "dead-reckoning", "-o", tmp_path) == 0
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["dead-reckoning"]


def test_calibration_file_goes_before_that_of_the_log_field_by_field(basin: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved.toml"
    moved.write_text("[start]\nposition_m = [100.0, 0.0, -1.0]\n")
    arguments = ("run", basin, "--estimator", "dead-reckoning", "-o", tmp_path / "out")
    calibrations = []
    for more in ((), ("--calibration", moved)):
        assert run(*arguments, *more) == 0
        said = json.loads((tmp_path / "out" / "comparison.json").read_text())["sequence"]
        calibrations.append(said["calibration"])
    first = (tmp_path / "out" / "runs" / "dead-reckoning" / "causal.tum").read_text().splitlines()[1].split()
    assert float(first[1]) == pytest.approx(100, abs=3)
    of_log, changed = calibrations
    assert changed["start"].pop("position_m") != of_log["start"].pop("position_m")
    assert changed == of_log
    assert said["notes"]["log.calibration"] == f"from {moved}: start.position_m; else from the log"


def test_inspect_names_the_topics(basin: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("inspect", basin) == 0
    shown = capsys.readouterr().out
    for name in ("sensor_msgs/Imu", "marine_acoustic_msgs/Dvl", "sonar_graph_msgs/LandmarkDetections"):
        assert name in shown


def test_inspect_ends_in_what_compare_would_lack(
    basin: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sonar_graph.logs.inspection import LogSummary

    assert run("inspect", basin) == 0
    assert "not usable" not in capsys.readouterr().out
    monkeypatch.setattr(LogSummary, "obstacles", ("no IMU (a/msg/B)", "no DVL (c/msg/D)"))
    assert run("inspect", basin) == 0
    *_, lack, advice = capsys.readouterr().out.splitlines()
    assert lack == "not usable for compare: no IMU (a/msg/B), no DVL (c/msg/D)"
    assert "--toml > log.toml" in advice


def test_estimators_lists_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    from sonar_graph.estimator import load_estimator

    assert run("estimators") == 0
    shown = capsys.readouterr().out
    for name in ("isam2", "invariant-ekf", "ekf-slam", "dead-reckoning"):
        assert name in shown
        for setting in load_estimator(name).Params.model_fields:
            assert setting in shown


def test_converted_data_set_can_be_inspected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "victoria_park.mcap"
    assert run("convert", "victoria-park", "-o", log) == 0
    assert "3640 landmark detections" in capsys.readouterr().out
    assert run("inspect", log) == 0


# --- options ------------------------------------------------------------------------------------------------------


def test_simulation_flags_and_settings_reach_the_simulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given_options = []
    monkeypatch.setattr("sonar_graph.simulation.basin.simulate_basin", given_options.append)
    monkeypatch.setattr("sonar_graph.logs.writing.write_sequence", lambda path, _: path.touch())
    flags = ("--seed", 7, "--laps", 2, "--imu", "mti1", "--no-bias", "--set", "wrong_id_rate=0.05")
    assert run("simulate", "basin", "-o", tmp_path / "new" / "basin.mcap", *flags) == 0
    options = given_options[0]
    assert (options.seed, options.laps, options.imu) == (7, 2, "mti1")
    assert (options.gyro_bias_scale, options.wrong_id_rate) == (0.0, 0.05)
    assert capsys.readouterr().out == f"Log: {tmp_path / 'new' / 'basin.mcap'}\n"


@given(st.one_of(st.integers(-(2**62), 2**62), st.booleans(), st.floats(allow_nan=False, allow_infinity=False)))
def test_setting_keeps_type_and_value(value: float) -> None:
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    name, parsed = parse_setting(f"gain = {text}")
    assert (name, parsed, type(parsed)) == ("gain", value, type(value))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a=huber", "huber"),
        ('a="2"', "2"),
        ("a=[1, 2.5]", [1, 2.5]),
        ("a=", ""),
        ("a=x=y", "x=y"),
        ("a=1\nb=2", "1\nb=2"),
    ],
)
def test_setting_that_is_no_toml_is_text(text: str, value: object) -> None:
    assert parse_setting(text) == ("a", value)


def test_settings_go_to_their_estimator_at_any_depth() -> None:
    texts = ["one.gain=1", "two.gate.sigma=3", "two.gate.kind=hard", "one.gain=2"]
    assert estimator_settings(texts, ["one", "two"]) == {
        "one": {"gain": 2},
        "two": {"gate": {"sigma": 3, "kind": "hard"}},
    }


def test_setting_of_an_estimator_that_does_not_run_is_refused() -> None:
    with pytest.raises(EstimatorError, match="other is not among the estimators that run: isam2, mine"):
        estimator_settings(["other.gain=1"], ["isam2", "mine"])


def test_topics_go_to_their_roles() -> None:
    assert topic_choices(["imu=/imu/data", "dvl=/a=b"]) == {"imu": "/imu/data", "dvl": "/a=b"}


@pytest.mark.parametrize(
    ("name", "text"), [("a.toml", "[imu]\ngyro_bias_sigma = 0.5\n"), ("a.json", '{"imu": {"gyro_bias_sigma": 0.5}}')]
)
def test_calibration_is_read_from_toml_and_json(name: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert read_calibration(path) == PartialCalibration({"imu": {"gyro_bias_sigma": 0.5}}, str(path))


def test_calibration_with_an_unknown_field_names_file_and_field(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text("[imu]\ngyro_sigma = 1\n")
    with pytest.raises(CalibrationError, match=r"vehicle\.toml: imu\.gyro_sigma"):
        read_calibration(path)


@pytest.mark.slow
def test_demo_goes_from_images_to_the_papers_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sonar_graph.cli.demonstrating.DEMO", DEMO | {"duration_s": 130.0, "laps": 1})
    assert run("demo", "-o", tmp_path) == 0
    told = capsys.readouterr().out
    assert f"Report: {tmp_path / 'report.html'}" in told
    assert "2014 paper x" in told
    sequence = read_sequence(tmp_path / "basin.mcap")
    assert sequence.detections is None, "the log holds images, not what is in them"
    comparison = read_comparison(tmp_path)
    assert comparison.recognition is not None
    assert comparison.recognition.frames > 600
    assert {run.estimator for run in comparison.runs if run.landmarks is not None and len(run.landmarks) == 4} == {
        "isam2",
        "ekf-slam",
    }


def test_demo_drives_the_three_laps_of_the_paper_with_images() -> None:
    options = BasinOptions.model_validate(DEMO)
    assert options.laps == PAPER_LAPS
    assert options.image is not None
    assert cruise_speed(options) < FASTEST_M_S
