"""``inspect`` names what a log has, compares its sensors, and gives advice that can be followed."""

import json
import re
from typing import Any

import pytest

from sonar_graph.logs import LogSummary, write_log
from sonar_graph.simulation import MissionOptions, simulate_mission


def sensor(said: str, quantity: str) -> dict[str, Any]:
    sensors = json.loads(said)["sensors"]
    return next(entry for entry in sensors if entry["quantity"] == quantity)


def test_sensors_are_compared_in_numbers_and_sentences(tmp_path, reply):
    log = tmp_path / "mission.mcap"
    options = MissionOptions(seed=6, duration_s=80, landmarks=2)
    write_log(log, simulate_mission(options))
    said = reply(0, "inspect", log, "--json").out
    assert sensor(said, LEVER)["value"] == pytest.approx(-0.2, abs=0.1)
    assert sensor(said, LEVER)["unit"] == "m"
    assert abs(sensor(said, "gyro bias, x")["value"]) < 1e-3
    assert 0 < sensor(said, "start pitch: value")["sigma"] < 0.2
    text = reply(0, "inspect", log).out
    assert "sensors against each other (± 95 %)" in text
    assert "no need to act" in text
    assert "cannot be told: never still for 30 s" in text
    rows = LEVER, "gyro bias, x", "start roll: value", "start pitch: value"
    assert all(f"\n{row} " in text for row in rows)
    # a mounting in the calibration moves the yaw found
    turned = tmp_path / "turned.toml"
    turned.write_text("[dvl]\nmounting.rpy_rad = [0, 0, 0.1]\n")
    yaw = sensor(reply(3, "inspect", log, "--json", "--calibration", turned).out, YAW)
    assert yaw["value"] == pytest.approx(-5.73, abs=1.0)
    assert "dvl.mounting.rpy_rad" in yaw["advice"]
    said = json.loads(reply(0, "inspect", log, "--quick", "--json").out)
    assert said["sensors"] == []
    assert "--quick" in said["sensors_skipped"]
    assert "/imu/data" in {topic["name"] for topic in said["topics"]}


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
    lacking = "no IMU (a/msg/B)", "no DVL (c/msg/D)"
    monkeypatch.setattr(LogSummary, "obstacles", lacking)
    *_, lack, advice = reply(1, "inspect", basin, "--quick").out.splitlines()
    assert lack == "not usable for compare: no IMU (a/msg/B), no DVL (c/msg/D)"
    assert "--toml > log.toml" in advice


def test_of_very_many_topics_the_first_are_shown_and_the_others_counted(
    basin, monkeypatch, reply
):
    monkeypatch.setattr("sonar_graph.cli.inspect_log.MOST_TOPICS", 2)
    words = "inspect", basin, "--quick"
    found = re.search(r"(?s)(.*?)not shown (\d+) more topics", reply(0, *words).out)
    topics = json.loads(reply(0, *words, "--json").out)["topics"]
    assert len(topics) == 2 + int(found[2])
    assert sum(f"\n{topic['name']} " in found[1] for topic in topics) == 2


LEVER = "lever arm from IMU to DVL, x"


YAW = "DVL mounting yaw"
