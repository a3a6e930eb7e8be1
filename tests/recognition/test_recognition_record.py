from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from sonar_graph.recognition import (
    DrawnFrame,
    Recognition,
    read_recognition,
    write_recognition,
)
from sonar_graph.recognition.recognition_record import CANDIDATE_OFF_FLOOR

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


def test_what_was_written_is_read_again_commonest_outcome_first(
    recognition, tmp_path: Path
) -> None:
    write_recognition(recognition, tmp_path)
    read = read_recognition(tmp_path)
    assert (read.frames, read.outcomes, read.notes) == (
        7,
        recognition.outcomes,
        recognition.notes,
    )
    assert list(read.outcomes) == ["reported", "not reported: rare"]
    assert read.warnings == recognition.warnings
    assert [p.__dict__ for p in read.pictures] == [
        p.__dict__ for p in recognition.shown()
    ]
    assert read.detections is None


def test_nothing_of_an_earlier_recognition_is_left(
    recognition: Recognition, tmp_path: Path
) -> None:
    for pictures, files in (
        (recognition.pictures, ["2.jpg"]),
        ([drawn(9, id1=0.8)], ["9.jpg"]),
        (None, []),
    ):
        write_recognition(
            None if pictures is None else replace(recognition, pictures=pictures),
            tmp_path,
        )
        assert [path.name for path in tmp_path.glob("recognised/*")] == files
    assert read_recognition(tmp_path) is None


@pytest.mark.parametrize(
    ("unlike", "is_doubted"),
    [((6, 10), True), ((5, 10), False), ((9, 9), False), ((0, 0), False)],
)
def test_a_floor_of_another_roughness_is_named(recognition, unlike, is_doubted):
    lines = [
        line
        for line in replace(recognition, unlike=unlike).naming()
        if "rougher or smoother" in line
    ]
    assert len(lines) == is_doubted
    assert all(line.startswith("Warning: 6 of 10 tracks") for line in lines)


@pytest.mark.parametrize(
    ("off", "other", "is_doubted"),
    [
        (60, 40, True),
        (40, 60, False),
    ],
)
def test_a_wrong_floor_is_doubted_if_most_candidates_lie_off_it(
    recognition, off, other, is_doubted
):
    outcomes = Counter(
        {CANDIDATE_OFF_FLOOR: off, "candidate rejected: too small": other}
    )
    lines = [
        line
        for line in replace(recognition, outcomes=outcomes).naming()
        if "where no floor can be" in line
    ]
    assert len(lines) == is_doubted
    assert all(
        line.startswith("Warning: 60 of 100 rejected candidates") for line in lines
    )
