"""Settings, topics, calibrations and rates as a user writes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration
from sonar_graph.cli.arguments import ReadingOptions, estimator_settings, parse_settings
from sonar_graph.cli.compare import check_rate
from sonar_graph.errors import CalibrationError, EstimatorError, EvaluationError
from sonar_graph.logs.vehicle_setup import PartialCalibration
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.sequence import Sequence

Run = Callable[..., int]


def measured_at(stamps_s: list[float]) -> Sequence:
    stamps_ns = np.round(np.array(stamps_s) * 1e9).astype(np.int64)
    vectors = np.zeros((len(stamps_ns), 3))
    dvl = Dvl(stamps_ns, vectors, np.full((len(stamps_ns), 3, 3), np.nan))
    return Sequence("dive", Calibration(), Imu(stamps_ns, vectors, vectors), dvl)


def test_estimates_are_asked_for_at_most_as_often_as_the_imu_measures() -> None:
    dive = measured_at(np.arange(0, 10.01, 0.05).tolist())
    check_rate(20.0, dive, 2.0)
    with pytest.raises(EvaluationError, match=r"--rate-hz 21: the IMU of dive .* at most 20\.1"):
        check_rate(21.0, dive, 2.0)


def test_the_default_rate_is_never_refused() -> None:
    slow = measured_at([0.0, 1.0, 2.0])
    check_rate(2.0, slow, 2.0)
    with pytest.raises(EvaluationError, match=r"give at most 2$"):
        check_rate(3.0, slow, 2.0)
    check_rate(2.0, replace(slow, imu=slow.imu.between(0, 10**9)), 2.0)  # one row


def test_simulation_flags_and_settings_reach_the_simulator(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given_options = []
    monkeypatch.setattr("sonar_graph.simulation.basin.simulate_basin", given_options.append)
    monkeypatch.setattr("sonar_graph.logs.writing.write_log", lambda path, _: path.touch())
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
    texts = ["one.gain=1", "two.gate.sigma=3", "two.gate.kind=hard", "one.gain=1.0"]
    assert estimator_settings(texts, ["one", "two"]) == {
        "one": {"gain": 1.0},
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
