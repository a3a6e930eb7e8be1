"""``sonar-graph recognise`` with another recogniser and with settings."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

from sonar_graph.logs.reading import read_log


class Decoder:
    """In place of AcTag: sees tag 5 in every frame."""

    def __init__(self, **settings: object) -> None:
        self.settings = settings

    def run_detection(self, image: np.ndarray) -> list:
        corners = np.array([[1.9, 0.1], [2.0, 0.1], [2.0, 0.0], [1.9, 0.0]])
        return [[5, corners, corners]] if image.any() else []


@pytest.fixture
def actag(monkeypatch):
    module = ModuleType("actag")
    module.AcTag = Decoder
    monkeypatch.setitem(sys.modules, "actag", module)


def test_tags_are_written_as_landmarks(lane_log, actag, run, tmp_path):
    written = tmp_path / "tags.mcap"
    assert run("recognise", lane_log, "-o", written, "--recogniser", "actag", "--set", "tag_size_m=0.15") == 0
    sequence = read_log(written)
    found = sequence.detections
    assert found is not None
    assert len(found) > 50
    assert set(found.candidate_ids.ravel().tolist()) == {5}
    np.testing.assert_allclose(found.range_m, 1.95)
    np.testing.assert_allclose(found.azimuth_rad, 0.05)
    assert "AcTag" in sequence.notes["detections.rule"]
    assert "0.15 m" in sequence.notes["detections.designs"]


def test_without_actag_one_line_names_the_extra(lane_log, monkeypatch, run, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "actag", None)
    assert run("recognise", lane_log, "-o", tmp_path / "tags.mcap", "--recogniser", "actag") == 2
    assert "sonar-graph[actag]" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "tags.mcap").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--set", "identity.tempre=0.5"), "temper"),
        (("--set", "least_frames=many"), "least_frames"),
        (("--rule", "bogus"), "virtual-evidence"),
        (("--recogniser", "actag", "--rule", "jeffrey"), "--set"),
        (("--recogniser", "bogus"), "actag"),
    ],
)
def test_wrong_choices_are_named(lane_log, arguments, named, actag, run, tmp_path, capsys):
    assert run("recognise", lane_log, "-o", tmp_path / "out.mcap", *arguments) == 2
    assert named in capsys.readouterr().err


def test_settings_reach_the_recogniser(lane_log, run, tmp_path):
    written = tmp_path / "none.mcap"
    assert run("recognise", lane_log, "-o", written, "--set", "least_frames=10000") == 0
    assert read_log(written).detections is None
