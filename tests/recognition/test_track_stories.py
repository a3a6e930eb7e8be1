"""What became of tracks and candidates, against the account that the session keeps, and its page."""

import re
from collections import Counter

import pytest

from sonar_graph.recognition import Recognition, RecognitionSession, TrackStories
from sonar_graph.recognition.track_stories import MOST_EXAMPLES
from sonar_graph.report import write_track_page
from sonar_graph.sonar import Recogniser
from tests.recognition.imaged_lane import Lane

NAMES = ["1: disc", "2: square", "3: triangle", "4: cross"]


@pytest.fixture(scope="module")
def told(lane: Lane) -> tuple[Recognition, TrackStories]:
    recogniser = Recogniser(lane.sequence.calibration)
    stories = TrackStories(lane.sequence.calibration.sonar.image)
    session = RecognitionSession(lane.sequence, recogniser)
    for frame, result in session.run([lane.frames]):
        stories.see(frame, result)
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
