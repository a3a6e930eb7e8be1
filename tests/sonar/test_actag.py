import sys
from types import ModuleType
from typing import Any, ClassVar

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.images import SonarFrames
from sonar_graph.simulation.sonar_image.frames import FrameSimulator
from sonar_graph.simulation.sonar_image.imaging_sonar import DIDSON, ImageOptions
from sonar_graph.simulation.sonar_image.scene import place_landmark
from sonar_graph.sonar.actag import (
    AcTagRecogniser,
    AcTagSettings,
    tag_design,
)
from sonar_graph.sonar.recogniser import REPORTED
from sonar_graph.sonar.tracker import SonarStep

FAMILY = "AcTag24h10"
RANGES_M = DIDSON.ranges_m()
AZIMUTHS_RAD = DIDSON.azimuths_rad()


class Decoder:
    """In place of AcTag: gives what it is told, and remembers what it was given."""

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


def at_once(settings: AcTagSettings | None = None) -> AcTagRecogniser:
    """Reports a tag from the first frame on."""
    return AcTagRecogniser(Calibration(), settings or AcTagSettings(least_frames=1))


def test_a_decoded_tag_becomes_a_detection_of_its_centre(decoder):
    corners = np.array([[1.9, 0.10], [2.0, 0.11], [2.02, 0.02], [1.92, 0.01]])
    decoder.found = [[3, corners * 0, corners]]
    recogniser = at_once(
        AcTagSettings(probability=0.97, range_sigma_m=0.02, least_frames=1)
    )
    found = recogniser.process(frame_of(noise()))
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
    assert [fate.outcome for fate in recogniser.fates] == [REPORTED]
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
    recogniser = AcTagRecogniser(Calibration())
    is_reported = []
    for n, (range_m, moved_m) in enumerate(zip(ranges_m, ahead_m, strict=True)):
        decoder.found = [[3, np.zeros((4, 2)), np.tile([range_m, 0.0], (4, 1))]]
        step = SonarStep(
            gtsam.Pose3(gtsam.Rot3(), np.array([moved_m, 0.0, 0.0])), np.zeros((6, 6))
        )
        is_reported.append(recogniser.process(frame_of(noise(n), n), step) is not None)
    assert is_reported == expected


def test_bad_frames_are_not_shown_to_actag(
    decoder,
):
    recogniser = AcTagRecogniser(Calibration())
    block = SonarFrames(
        np.array([5, 6]), np.stack([noise(1), noise(2)]), RANGES_M, AZIMUTHS_RAD
    )
    with pytest.raises(
        MeasurementError, match=r"a block of 2 frames; give blocks of one"
    ):
        recogniser.process(block)
    assert recogniser.process(frame_of(np.zeros((96, 512), np.uint8))) is None
    assert "zero" in recogniser.fates[0].outcome
    assert decoder.image is None
    assert recogniser.process(frame_of(noise())) is None
    assert decoder.image is not None


def test_an_unknown_family_and_a_missing_package_are_named(decoder, monkeypatch):
    with pytest.raises(CalibrationError, match="AcTag99h1"):
        AcTagRecogniser(Calibration(), AcTagSettings(family="AcTag99h1"))
    monkeypatch.setitem(sys.modules, "actag", None)
    with pytest.raises(CalibrationError, match=r"sonar-graph\[actag\]"):
        AcTagRecogniser(Calibration())


@pytest.mark.parametrize("tag", [0, 5])
def test_actag_itself_reads_tags_in_simulated_frames(tag):
    pytest.importorskip(
        "actag",
        reason="AcTag has wheels for Linux with Python 3.10 and 3.11 only: extra actag",
    )
    right = 0
    for frame, range_m, azimuth_rad in (simulated(tag, number) for number in range(3)):
        found = at_once().process(frame)
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
