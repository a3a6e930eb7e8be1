"""``inspect`` names what a log has, compares its sensors, and gives advice that can be followed."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sonar_graph.cli.main import app
from sonar_graph.logs import LogSummary, write_log
from sonar_graph.simulation import MissionOptions, simulate_mission


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("inspect") / "mission.mcap"
    write_log(
        path, simulate_mission(MissionOptions(seed=6, duration_s=80, landmarks=2))
    )
    return path


def answer(*words: str | Path) -> dict:
    result = CliRunner().invoke(app, ["inspect", *map(str, words), "--json"])
    assert result.exit_code in (0, 3), result.output
    return json.loads(result.stdout)


def sensor(said: dict, quantity: str) -> dict:
    return next(entry for entry in said["sensors"] if entry["quantity"] == quantity)


def test_a_mounting_in_the_calibration_moves_the_yaw_found(log, tmp_path):
    (tmp_path / "turned.toml").write_text("[dvl]\nmounting.rpy_rad = [0, 0, 0.1]\n")
    yaw = sensor(
        answer(log, "--calibration", tmp_path / "turned.toml"), "DVL mounting yaw"
    )
    assert yaw["value"] == pytest.approx(-5.73, abs=1.0)
    assert "dvl.mounting.rpy_rad" in yaw["advice"]


def test_json_has_lever_arm_bias_and_start_as_numbers(log):
    said = answer(log)
    assert sensor(said, "lever arm from IMU to DVL, x")["value"] == pytest.approx(
        -0.2, abs=0.1
    )
    assert sensor(said, "lever arm from IMU to DVL, z")["unit"] == "m"
    assert abs(sensor(said, "gyro bias, x")["value"]) < 1e-3
    assert 0 < sensor(said, "start pitch: value")["sigma"] < 0.2
    said = answer(log, "--quick")
    assert said["sensors"] == []
    assert "--quick" in said["sensors_skipped"]
    assert {topic["name"] for topic in said["topics"]} >= {"/imu/data"}


def test_sentences_say_whether_to_act(log):
    result = CliRunner().invoke(app, ["inspect", str(log)])
    assert result.exit_code == 0, result.output
    assert "sensors against each other (± 95 %)" in result.stdout
    assert "no need to act" in result.stdout
    assert "cannot be told: never still for 30 s" in result.stdout
    for row in (
        "lever arm from IMU to DVL, x",
        "gyro bias, x",
        "start roll: value",
        "start pitch: value",
    ):
        assert f"\n{row} " in result.stdout


def test_inspect_names_the_topics_and_ends_in_what_compare_would_lack(
    basin, monkeypatch, reply
):
    shown = reply(0, "inspect", basin).out
    for name in (
        "sensor_msgs/msg/Imu",
        "marine_acoustic_msgs/msg/Dvl",
        "sonar_graph_msgs/msg/LandmarkDetections",
    ):
        assert name in shown
    assert "not usable" not in shown
    monkeypatch.setattr(
        LogSummary, "obstacles", ("no IMU (a/msg/B)", "no DVL (c/msg/D)")
    )
    *_, lack, advice = reply(1, "inspect", basin).out.splitlines()
    assert lack == "not usable for compare: no IMU (a/msg/B), no DVL (c/msg/D)"
    assert "--toml > log.toml" in advice


def test_of_very_many_topics_the_first_are_shown_and_the_others_counted(
    basin, monkeypatch, reply
):
    monkeypatch.setattr("sonar_graph.cli.inspect_log.MOST_TOPICS", 2)
    shown, hidden = re.search(
        r"(?s)(.*?)not shown (\d+) more topics",
        reply(0, "inspect", basin, "--quick").out,
    ).groups()
    topics = {topic["name"] for topic in answer(basin, "--quick")["topics"]}
    assert len(topics) == 2 + int(hidden)
    assert sum(f"\n{name} " in shown for name in topics) == 2
