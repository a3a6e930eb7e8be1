import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.cli import main
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.images import SonarFrames
from sonar_graph.logs import read_log
from sonar_graph.recognition import RECOGNISERS, LandmarkRecogniser
from sonar_graph.simulation.sonar_image import (
    FrameSimulator,
    ImageOptions,
    place_landmark,
)
from sonar_graph.simulation.sonar_image.imaging_sonar import DIDSON
from sonar_graph.sonar import REPORTED, SonarStep

PLUGIN = Path(__file__).parents[1] / "benchmarks" / "actag_plugin"
FAMILY = "AcTag24h10"
RANGES_M = DIDSON.ranges_m()
AZIMUTHS_RAD = DIDSON.azimuths_rad()


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The plug-in as pip installs it: its module on the path, and the entry points of its pyproject.toml."""
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text("utf-8"))["project"]
    about = tmp_path / "sonar_graph_actag-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Name: {project['name']}\nVersion: 1\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [
            f"[{group}]",
            *(f"{name} = {place}" for name, place in points.items()),
        ]
    (about / "entry_points.txt").write_text("\n".join([*lines, ""]))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(PLUGIN)


def made(**settings: Any) -> LandmarkRecogniser:
    make, _ = RECOGNISERS.load("actag")
    return make(Calibration(), settings)


class Decoder:
    """In place of AcTag: gives what it is set to, and remembers what it was given."""

    found: ClassVar[list[list[Any]]] = []
    settings: ClassVar[dict[str, Any]] = {}
    image: ClassVar[np.ndarray | None] = None

    def __init__(self, **settings: Any) -> None:
        if settings["tag_family"] != FAMILY:
            raise FileNotFoundError(f"no {settings['tag_family']}")
        Decoder.settings = settings

    def run_detection(self, image: np.ndarray) -> list[list[Any]]:
        Decoder.image = image
        return Decoder.found


@pytest.fixture
def decoder(monkeypatch: pytest.MonkeyPatch) -> type[Decoder]:
    module = ModuleType("actag")
    module.AcTag = Decoder  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "actag", module)
    Decoder.found, Decoder.image = [], None
    return Decoder


def frame_of(image: np.ndarray, stamp_ns: int = 5) -> SonarFrames:
    return SonarFrames(np.array([stamp_ns]), image[None], RANGES_M, AZIMUTHS_RAD)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 200, (96, 512)).astype(np.uint8)


def at_once(**settings: Any) -> LandmarkRecogniser:
    """Reports a tag from the first frame on."""
    return made(least_frames=1, **settings)


def test_a_decoded_tag_becomes_a_detection_of_its_centre(decoder):
    corners = np.array([[1.9, 0.10], [2.0, 0.11], [2.02, 0.02], [1.92, 0.01]])
    decoder.found = [[3, corners * 0, corners]]
    recogniser = at_once(probability=0.97, range_sigma_m=0.02)
    result = recogniser.process(frame_of(noise()))
    found = result.detections
    assert (found.range_m, found.azimuth_rad) == (
        pytest.approx([1.96]),
        pytest.approx([0.06]),
    )
    assert (found.candidate_ids.tolist(), found.id_probability.tolist()) == (
        [[3]],
        [[0.97]],
    )
    assert found.range_azimuth_cov[0] == pytest.approx(np.diag([0.02**2, 0.001**2]))
    assert found.stamps_ns.tolist() == [5]
    assert [fate.outcome for fate in result.fates] == [REPORTED]
    given = [
        decoder.settings[name]
        for name in ("min_range", "max_range", "horizontal_aperture")
    ]
    assert given == pytest.approx(
        [RANGES_M[0], RANGES_M[-1], 2 * np.abs(AZIMUTHS_RAD).max()]
    )
    assert decoder.image.shape == pytest.approx(
        [1.25 / 0.00544, 0.497 * 1.885 / 0.00544], rel=0.01
    )


@pytest.mark.parametrize(
    ("ranges_m", "ahead_m", "expected"),
    [
        ([2.3, 1.5, 2.3], [0.0, 0.8, -0.8], [False, True, True]),
        ([2.3, 1.5, 1.5], [0.0, 0.0, 0.0], [False, False, True]),
        ([2.0, 2.0, 2.0], [0.0, 1.0, 1.0], [False, False, False]),
    ],
)
def test_a_tag_is_reported_when_it_was_decoded_twice_in_one_place(
    decoder, ranges_m, ahead_m, expected
):
    """Decoded at these ranges after these motions ahead."""
    recogniser = made()
    is_reported = []
    for n, (range_m, moved_m) in enumerate(zip(ranges_m, ahead_m, strict=True)):
        decoder.found = [[3, np.zeros((4, 2)), np.tile([range_m, 0.0], (4, 1))]]
        step = SonarStep(
            gtsam.Pose3(gtsam.Rot3(), np.array([moved_m, 0.0, 0.0])), np.zeros((6, 6))
        )
        result = recogniser.process(frame_of(noise(n), n), step)
        is_reported.append(result.detections is not None)
    assert is_reported == expected


def test_bad_frames_are_not_shown_to_actag(
    decoder,
):
    recogniser = made()
    block = SonarFrames(
        np.array([5, 6]), np.stack([noise(1), noise(2)]), RANGES_M, AZIMUTHS_RAD
    )
    with pytest.raises(
        MeasurementError, match=r"a block of 2 frames; give blocks of one"
    ):
        recogniser.process(block)
    refused = recogniser.process(frame_of(np.zeros((96, 512), np.uint8)))
    assert not refused.is_used
    assert "zero" in refused.fates[0].outcome
    assert decoder.image is None
    assert recogniser.process(frame_of(noise())).detections is None
    assert decoder.image is not None


def test_an_unknown_family_and_a_missing_package_are_named(decoder, monkeypatch):
    with pytest.raises(CalibrationError, match="AcTag99h1"):
        made(family="AcTag99h1")
    monkeypatch.setitem(sys.modules, "actag", None)
    with pytest.raises(CalibrationError, match=r"pip install benchmarks/actag_plugin"):
        made()


@pytest.mark.parametrize("tag", [0, 5])
def test_actag_itself_reads_tags_in_simulated_frames(tag):
    pytest.importorskip(
        "actag",
        reason="AcTag has wheels for Linux with Python 3.10 and 3.11 only",
    )
    right = 0
    for frame, range_m, azimuth_rad in (simulated(tag, number) for number in range(3)):
        found = at_once().process(frame).detections
        if found is not None:
            assert found.candidate_ids.ravel().tolist() == [tag]
            assert found.range_m[0] == pytest.approx(range_m, abs=0.015)
            assert found.azimuth_rad[0] == pytest.approx(azimuth_rad, abs=0.004)
            right += 1
    assert right >= 2


def simulated(tag: int, number: int) -> tuple[SonarFrames, float, float]:
    """A tag on the floor of a basin, seen from a height of 0.95 m, and its range and azimuth."""
    rng = np.random.default_rng([tag, number])
    floor_m = -1.7
    centre_m = np.array([11.7, 7.0 + rng.uniform(-0.1, 0.1), -1.687])
    from actag_plugin import tag_design  # of the fixture's path

    design = place_landmark(
        tag_design(FAMILY, tag, 0.1306), centre_m, rng.uniform(-np.pi, np.pi), floor_m
    )
    simulator = FrameSimulator(ImageOptions(), [design], floor_m, seed=tag)
    sonar_m = np.array([10.0 + 0.1 * (number - 1), 7.0, floor_m + 0.95])
    world_R_sonar = Rotation.from_euler("ZYX", [0, np.radians(30), 0])
    x, y, z = world_R_sonar.inv().apply(centre_m - sonar_m)
    return (
        frame_of(simulator.frame(sonar_m, world_R_sonar, number, 0.0)),
        np.hypot(np.hypot(x, y), z),
        np.arctan2(y, x),
    )


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)


def test_tags_are_written_as_landmarks_by_the_command(
    decoder, lane_log, tmp_path, capsys
):
    written = tmp_path / "tags.mcap"
    words = ("recognise", lane_log, "-o", written, "--recogniser", "actag")
    assert run(*words, "--rule", "jeffrey") == 2
    assert "not for the recogniser actag: use --set" in capsys.readouterr().err
    assert run(*words, "--set", "tag_size=1") == 2
    assert "tag_size_m" in capsys.readouterr().err
    assert not written.exists()
    corners = np.array([[1.9, 0.1], [2.0, 0.1], [2.0, 0.0], [1.9, 0.0]])
    decoder.found = [[5, corners, corners]]
    assert run(*words, "--set", "tag_size_m=0.15") == 0
    sequence = read_log(written)
    found = sequence.detections
    assert len(found) > 50
    assert set(found.candidate_ids.ravel().tolist()) == {5}
    np.testing.assert_allclose(found.range_m, 1.95)
    np.testing.assert_allclose(found.azimuth_rad, 0.05)
    assert "AcTag" in sequence.notes["detections.rule"]
    assert "0.15 m" in sequence.notes["detections.designs"]
