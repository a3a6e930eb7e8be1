"""``simulate basin --images`` writes a log whose images are those of the library."""

from pathlib import Path

import numpy as np
import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader
from typer.testing import CliRunner

from sonar_graph.cli.main import app
from sonar_graph.logs.reading import read_log, read_sonar_frames
from sonar_graph.simulation.basin import BasinOptions, simulate_basin, simulate_basin_frames

SHORT = {"duration_s": 120, "laps": 1, "frame_rate_hz": 0.5, "image": {"multipath": False}}


def simulate(path: Path, *more: str, said: str = "Log: ") -> None:
    words = ["simulate", "basin", "-o", str(path), "--images", "--duration-s", "120", "--laps", "1"]
    result = CliRunner().invoke(app, [*words, "--set", "frame_rate_hz=0.5", "--set", "image.multipath=false", *more])
    assert result.exit_code == 0, result.output
    assert said in result.output


def test_images_and_other_sensors_are_those_of_the_library(tmp_path: Path):
    simulate(
        tmp_path / "a.mcap", said="Landmarks: 1 disc at (5, 0), 2 square at (7, -5), 3 triangle at (2, -7), 4 cross"
    )
    options = BasinOptions.model_validate(SHORT)
    read, made = list(read_sonar_frames(tmp_path / "a.mcap")), list(simulate_basin_frames(options))
    order = np.argsort([block.stamps_ns[0] for block in read])
    images = np.concatenate([read[k].intensity for k in order])
    np.testing.assert_array_equal(images, np.concatenate([block.frames.intensity for block in made]))
    np.testing.assert_allclose(read[0].azimuths_rad, made[0].frames.azimuths_rad, atol=1e-12)
    sequence, expected = read_log(tmp_path / "a.mcap"), simulate_basin(options)
    assert sequence.detections is None
    np.testing.assert_array_equal(sequence.imu.angular_velocity, expected.imu.angular_velocity)
    assert sequence.true_landmarks is not None


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes(tmp_path: Path):
    for name, seed in (("a", "3"), ("b", "3"), ("c", "4")):
        simulate(tmp_path / f"{name}.mcap", "--seed", seed)
    contents = [(tmp_path / f"{name}.mcap").read_bytes() for name in "abc"]
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]


def test_image_options_without_images_are_refused():
    result = CliRunner().invoke(app, ["simulate", "basin", "-o", "a.mcap", "--set", "image.designs=mine.toml"])
    assert result.exit_code == 2
    assert "give --images too" in " ".join(result.output.replace("│", " ").split())


def test_unknown_image_option_is_answered_with_those_there_are():
    result = CliRunner().invoke(app, ["simulate", "basin", "-o", "a.mcap", "--images", "--set", "image.nois=1"])
    assert result.exit_code == 2
    assert "there is no option image.nois" in " ".join(result.output.split())
    assert "image.noise_db" in result.output


def test_images_lie_among_the_other_messages_in_the_order_of_time(tmp_path: Path):
    simulate(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as stream:
        times_ns = [record.log_time for record in StreamReader(stream).records if isinstance(record, Message)]
    assert len(times_ns) > 60
    assert times_ns == sorted(times_ns)
