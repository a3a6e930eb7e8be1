from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.recognition import (
    DrawnFrame,
    Recognition,
    read_recognition,
    write_recognition,
)
from sonar_graph.recognition.recognition_record import CANDIDATE_OFF_FLOOR
from sonar_graph.states import LandmarkMap

JPEG = b"\xff\xd8 a picture \xff\xd9"


def drawn(stamp_ns: int, **probability_of: float) -> DrawnFrame:
    """A frame with detections such as ``id3=0.9``."""
    ids = tuple(int(name.removeprefix("id")) for name in probability_of)
    return DrawnFrame(
        stamp_ns, JPEG + bytes([stamp_ns]), ids, tuple(probability_of.values())
    )


@pytest.fixture
def recognition() -> Recognition:
    return Recognition(
        frames=7,
        outcomes=Counter({"not reported: rare": 1, "reported": 4}),
        warnings=[(12, "frame not used: saturated"), (15, 'frame not used: "ä" & <b>')],
        pictures=[
            drawn(1, id2=0.6),
            drawn(2, id2=0.9, id4=0.7),
            drawn(3, id1=0.4),
            drawn(4, id2=0.8),
        ],
        notes={"detections.rule": "jeffrey"},
    )


def test_what_was_written_is_read_again_commonest_outcome_first(recognition, tmp_path):
    write_recognition(recognition, tmp_path)
    read = read_recognition(tmp_path)
    for name in ("frames", "outcomes", "notes", "warnings"):
        assert getattr(read, name) == getattr(recognition, name)
    assert list(read.outcomes) == ["reported", "not reported: rare"]
    assert [*map(vars, read.pictures)] == [*map(vars, recognition.shown())]
    assert read.detections is None


def test_nothing_of_an_earlier_recognition_is_left(recognition, tmp_path):
    other = replace(recognition, pictures=[drawn(9, id1=0.8)])
    for one, files in ((recognition, ["2.jpg"]), (other, ["9.jpg"]), (None, [])):
        write_recognition(one, tmp_path)
        assert [path.name for path in tmp_path.glob("recognised/*")] == files
    assert read_recognition(tmp_path) is None


def of_tracks(count: int, none: int) -> LandmarkDetections:
    """A detection of each of some tracks, of which some are of no landmark."""
    probability = np.full((count, 4), 0.25)
    probability[:none] = 0.01
    return LandmarkDetections(
        stamps_ns=np.arange(count),
        range_m=np.ones(count),
        azimuth_rad=np.zeros(count),
        range_azimuth_cov=np.tile(1e-4 * np.eye(2), (count, 1, 1)),
        candidate_ids=np.tile([1, 2, 3, 4], (count, 1)),
        id_probability=probability,
        track=np.arange(count),
    )


def rejected(off_floor: int, others: int) -> Counter[str]:
    return Counter(
        {CANDIDATE_OFF_FLOOR: off_floor, "candidate rejected: too small": others}
    )


@pytest.mark.parametrize(
    ("changes", "words", "start"),
    [
        ({"unlike": (6, 10)}, "rougher or smoother", "6 of 10 tracks"),
        ({"unlike": (5, 10)}, "rougher or smoother", None),
        ({"unlike": (9, 9)}, "rougher or smoother", None),
        ({"outcomes": rejected(60, 40)}, "no floor can be", "60 of 100 rejected"),
        ({"outcomes": rejected(40, 60)}, "no floor can be", None),
        ({"detections": of_tracks(20, 18)}, "may be unlike", "18 of 20 tracks are of"),
        ({"detections": of_tracks(10, 10)}, "may be unlike", "10 of 10 tracks are of"),
        ({"detections": of_tracks(20, 17)}, "may be unlike", None),
        ({"detections": of_tracks(9, 9)}, "may be unlike", None),
    ],
)
def test_doubtful_images_are_named_from_a_number_and_share_on(
    recognition, changes, words, start
):
    doubted = replace(recognition, **changes).naming()
    found = [line for line in doubted if words in line]
    assert len(found) == (start is not None)
    assert all(line.startswith(f"Warning: {start}") for line in found)


def test_a_log_of_other_landmarks_is_the_reason_for_tracks_of_none(recognition):
    others = LandmarkMap(
        np.array([11, 12]), np.zeros((2, 3)), np.full((2, 3, 3), np.nan)
    )
    said = "\n".join(replace(recognition, detections=of_tracks(20, 20)).naming(others))
    assert "the log has landmarks 11, 12, of which there is no design" in said
    assert "may be unlike" not in said
