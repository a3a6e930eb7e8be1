"""``simulate landmarks --on LOG``: the command is the library's function between reading and writing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonar_graph.cli.main import app
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.writing import write_log
from sonar_graph.simulation.landmarks_on_log import LandmarkOptions, add_landmarks
from sonar_graph.simulation.mission import MissionOptions, simulate_mission


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("landmarks") / "recorded.mcap"
    run = simulate_mission(MissionOptions(seed=5, duration_s=60))
    write_log(path, replace(run, detections=None, true_landmarks=None))
    return path


def place(*words: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["simulate", "landmarks", *map(str, words)])
    return result.exit_code, " ".join(result.output.split())


def test_the_log_gets_what_the_library_places_and_keeps_its_sensors(log: Path, tmp_path: Path):
    code, said = place("--on", log, "-o", tmp_path / "new.mcap", "--seed", "3", "--set", "spacing_m=4")
    assert code == 0, said
    read, recorded = read_log(tmp_path / "new.mcap"), read_log(log)
    expected = add_landmarks(recorded, LandmarkOptions(seed=3, spacing_m=4.0))
    assert read.detections is not None
    assert expected.detections is not None
    np.testing.assert_allclose(read.detections.range_m, expected.detections.range_m, atol=1e-6)
    np.testing.assert_array_equal(read.imu.angular_velocity, recorded.imu.angular_velocity)
    np.testing.assert_array_equal(read.dvl.velocity, recorded.dvl.velocity)
    assert f"{len(read.true_landmarks or ())} landmarks, {len(read.detections)} detections" in said


def test_another_seed_is_another_map(log: Path, tmp_path: Path):
    maps = []
    for seed in "12":
        assert place("--on", log, "-o", tmp_path / f"{seed}.mcap", "--seed", seed)[0] == 0
        maps.append(read_log(tmp_path / f"{seed}.mcap").true_landmarks)
    assert maps[0] is not None
    assert maps[1] is not None
    assert not np.array_equal(maps[0].positions, maps[1].positions)


def test_an_unknown_option_is_answered_with_those_there_are(log: Path, tmp_path: Path):
    code, said = place("--on", log, "-o", tmp_path / "new.mcap", "--set", "spacing=4")
    assert code == 2
    assert "spacing_m" in said
    assert not (tmp_path / "new.mcap").exists()


def test_the_recorded_log_is_never_written_over(log: Path):
    before = log.read_bytes()
    code, _ = place("--on", log, "-o", log, "--overwrite")
    assert code != 0
    assert log.read_bytes() == before
