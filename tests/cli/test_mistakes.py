"""A user's mistake is told in one line, with nothing written; other errors are not hidden."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.cli.main import main

Run = Callable[..., int]

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
    "setting twice": (
        ["run", "LOG", "-o", "OUT", "--set", "isam2.smoother.lag_s=5", "--set", "isam2.smoother.lag_s=6"],
        "isam2.smoother.lag_s is also set to 5; give it once",
    ),
    "simulation option twice": (
        ["simulate", "basin", "-o", "new.mcap", "--set", "tracks=true", "--set", "tracks=false"],
        "tracks is also set to True; give it once",
    ),
    "share of tracks without tracks": (
        ["simulate", "basin", "-o", "new.mcap", "--set", "wrong_id_share=0.3"],
        "wrong_id_share = 0.3 is a share of a track; set tracks = true",
    ),
    "settings that exclude each other": (
        ["run", "TEXT", "-o", "OUT", "--set", "isam2.identity.policy=gnc", "--set", "isam2.history.policy=bounded"],
        'settings of isam2: history.policy = "bounded" cannot be with identity.policy = "gnc"',
    ),
    "setting that does nothing": (
        ["run", "TEXT", "-o", "OUT", "--set", "isam2.history.remembered_s=10"],
        'there is no such field with policy = "whole"; history.policy = "bounded" has it',
    ),
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
    run: Run,
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
    run: Run, stop: Any, basin: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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
