"""``inspect`` names what a log has and what ``compare`` would lack."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

Run = Callable[..., int]


def test_inspect_names_the_topics(run: Run, basin: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("inspect", basin) == 0
    shown = capsys.readouterr().out
    for name in ("sensor_msgs/Imu", "marine_acoustic_msgs/Dvl", "sonar_graph_msgs/LandmarkDetections"):
        assert name in shown


def test_inspect_ends_in_what_compare_would_lack(
    run: Run, basin: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sonar_graph.logs.inspection import LogSummary

    assert run("inspect", basin) == 0
    assert "not usable" not in capsys.readouterr().out
    monkeypatch.setattr(LogSummary, "obstacles", ("no IMU (a/msg/B)", "no DVL (c/msg/D)"))
    assert run("inspect", basin) == 0
    *_, lack, advice = capsys.readouterr().out.splitlines()
    assert lack == "not usable for compare: no IMU (a/msg/B), no DVL (c/msg/D)"
    assert "--toml > log.toml" in advice


def test_converted_data_set_can_be_inspected(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "victoria_park.mcap"
    assert run("convert", "victoria-park", "-o", log) == 0
    assert "3640 landmark detections" in capsys.readouterr().out
    assert run("inspect", log) == 0
