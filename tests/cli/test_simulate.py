"""``simulate``: the commands are the library's functions between reading and writing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.logs import read_log, read_sonar_frames, write_log
from sonar_graph.simulation import (
    BasinOptions,
    LandmarkOptions,
    MissionOptions,
    add_landmarks,
    simulate_basin,
    simulate_basin_frames,
    simulate_mission,
)

SHORT = {
    "seed": 3,
    "duration_s": 120,
    "laps": 1,
    "frame_rate_hz": 0.5,
    "image": {"multipath": False},
}


def test_images_and_sensors_are_those_of_the_library(run, tmp_path, capsys):
    log = tmp_path / "a.mcap"
    flags = "--images --seed 3 --duration-s 120 --laps 1"
    settings = "--set frame_rate_hz=0.5 --set image.multipath=false"
    words = f"{flags} {settings}".split()
    assert run("simulate", "basin", "-o", log, *words) == 0
    laid = "Landmarks: 1 disc at (5, 0), 2 square at (7, -5), 3 triangle at (2, -7), 4 cross"
    assert laid in capsys.readouterr().out
    options = BasinOptions.model_validate(SHORT)
    read = list(read_sonar_frames(log))
    assert sum(len(block.stamps_ns) for block in read) > 50
    first = min(read, key=lambda block: block.stamps_ns[0])
    made = next(simulate_basin_frames(options, 1)).frames
    assert first.stamps_ns[0] == made.stamps_ns[0]
    np.testing.assert_array_equal(first.intensity[0], made.intensity[0])
    np.testing.assert_allclose(first.azimuths_rad, made.azimuths_rad, atol=1e-12)
    sequence = read_log(log)
    rates = simulate_basin(options).imu.angular_velocity
    np.testing.assert_array_equal(sequence.imu.angular_velocity, rates)
    assert sequence.detections is None
    assert sequence.true_landmarks is not None


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("landmarks") / "recorded.mcap"
    run = simulate_mission(MissionOptions(seed=5, duration_s=60))
    write_log(path, replace(run, detections=None, true_landmarks=None))
    return path


def test_the_log_gets_what_the_library_places_and_keeps_its_sensors(
    log, run, tmp_path, capsys
):
    new = tmp_path / "new.mcap"
    words = "--seed", 3, "--set", "spacing_m=4"
    assert run("simulate", "landmarks", "--on", log, "-o", new, *words) == 0
    read, recorded = (read_log(path) for path in (new, log))
    expected = add_landmarks(recorded, LandmarkOptions(seed=3, spacing_m=4.0))
    ranges_m = expected.detections.range_m
    np.testing.assert_allclose(read.detections.range_m, ranges_m, atol=1e-6)
    for sensor, column in (("imu", "angular_velocity"), ("dvl", "velocity")):
        values = [getattr(getattr(one, sensor), column) for one in (read, recorded)]
        np.testing.assert_array_equal(*values)
    said = f"{len(read.true_landmarks)} landmarks, {len(read.detections)} detections"
    assert said in " ".join(capsys.readouterr().out.split())
