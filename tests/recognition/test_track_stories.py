"""What became of tracks and candidates, against the account that the session keeps, and its page."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.recognition import Recognition, RecognitionSession, TrackStories
from sonar_graph.recognition.track_stories import MOST_EXAMPLES
from sonar_graph.report.tracks import write_track_page
from sonar_graph.sonar import Recogniser
from sonar_graph.states import LandmarkMap
from tests.recognition.imaged_lane import Lane

NAMES = ["1: disc", "2: square", "3: triangle", "4: cross"]


@pytest.fixture(scope="module")
def told(lane: Lane) -> tuple[Recognition, TrackStories]:
    recogniser = Recogniser(lane.sequence.calibration)
    stories = TrackStories(lane.sequence.calibration.sonar.image)
    session = RecognitionSession(
        lane.sequence, recogniser=recogniser, pictures=False, seen=stories.see
    )
    for row in range(len(lane.frames)):
        session.take(lane.one(row))
    return session.finish(), stories


def test_every_track_and_candidate_is_told_once_for_each_frame(told):
    recognition, stories = told
    outcomes: Counter[str] = Counter()
    for story in stories.tracks.values():
        outcomes.update(story.outcomes)
    outcomes.update({reason: found.count for reason, found in stories.rejected.items()})
    assert outcomes == recognition.outcomes
    assert all(
        1 <= len(found.examples) <= MOST_EXAMPLES for found in stories.rejected.values()
    )


def test_the_page_shows_every_track_with_picture_and_reasons(told, lane, tmp_path):
    recognition, stories = told
    write_track_page(
        tmp_path / "page.html",
        "<lane>",
        recognition,
        stories,
        NAMES,
        lane.sequence.start_ns,
    )
    text = (tmp_path / "page.html").read_text("utf-8")
    assert "<h1>&lt;lane&gt;</h1>" in text
    assert "http" not in re.sub(r'src="data:[^"]*"', "", text)
    for story in stories.tracks.values():
        assert f'id="track-{story.number}"' in text
    for reason, found in stories.rejected.items():
        assert f"<h3>{reason}: {found.count}</h3>" in text
    assert re.search(r"<strong>(0\.9\d|1\.00)</strong> 3: triangle", text)


def of_tracks(recognition: Recognition, count: int, none: int) -> Recognition:
    """Detections of some tracks, some of no landmark."""
    row = recognition.detections.rows(np.zeros(1, np.int64))
    blocks = [
        replace(
            row,
            track=np.array([k]),
            id_probability=np.full((1, 4), 0.01 if k < none else 0.25),
        )
        for k in range(count)
    ]
    return Recognition(frames=9, detections=LandmarkDetections.concatenate(blocks))


@pytest.mark.parametrize(
    ("count", "none", "is_doubted"),
    [(20, 20, True), (20, 18, True), (20, 17, False), (9, 9, False), (10, 10, True)],
)
def test_images_of_which_nearly_all_tracks_are_none_are_doubted(
    told, count, none, is_doubted
):
    lines = of_tracks(told[0], count, none).naming()
    doubts = [
        line
        for line in lines
        if "the images may be unlike those that the model was measured on" in line
    ]
    assert len(doubts) == is_doubted
    if doubts:
        assert doubts[0].startswith(
            f"Warning: {none} of {count} tracks are of no landmark"
        )
    assert told[0].unlike_the_model() is None


def test_a_log_of_other_landmarks_is_the_reason_for_tracks_of_none(told):
    others = LandmarkMap(
        np.array([11, 12]), np.zeros((2, 3)), np.full((2, 3, 3), np.nan)
    )
    lines = of_tracks(told[0], 20, 20).naming(others)
    assert any(
        "the log has landmarks 11, 12, of which there is no design" in line
        for line in lines
    )
    assert not any("may be unlike" in line for line in lines)
