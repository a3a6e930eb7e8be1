"""Page of ``recognise --report``: each track with its picture, its probabilities and the reasons of its fate."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.recognition import SEE_TRACKS, Recognition, TrackStories, TrackStory
from sonar_graph.report.rendering import Section, write_html
from sonar_graph.sonar import REPORTED

# tracks with a picture; of more those with the most frames
MOST_TRACKS = 400
# probability below which an identity is not listed
LEAST_SHOWN = 0.005
NONE = "none of them"
SECTIONS = [
    Section("tracks", "Tracks"),
    Section("rejected", "Candidates that were rejected"),
    Section("frames", "Frames"),
]


def write_track_page(
    path: Path,
    name: str,
    recognition: Recognition,
    stories: TrackStories,
    identities: Sequence[str],
    start_ns: int,
) -> None:
    """Write the page, one file with all pictures in it; ``identities`` are names of the designs in their order."""
    longest = sorted(stories.tracks.values(), key=lambda story: -story.frames)[
        :MOST_TRACKS
    ]
    shown = sorted(
        longest, key=lambda story: (REPORTED not in story.outcomes, story.first_ns)
    )
    content: dict[str, Any] = {
        "name": name,
        "extent": f"{_number_of(recognition.frames, 'frame')}, {_number_of(len(stories.tracks), 'track')}",
        "names": [_number_of(len(stories.tracks), "track")],
        "recognition": recognition,
        "tracks": [_row(story, [*identities, NONE], start_ns) for story in shown],
        "left_out": len(stories.tracks) - len(shown),
        "rejected": sorted(stories.rejected.items(), key=lambda item: -item[1].count),
        "start_ns": start_ns,
        "lines": [line for line in recognition.naming() if line != SEE_TRACKS],
    }
    write_html(path, "recognition", SECTIONS, content)


def _number_of(count: int, what: str) -> str:
    """Such as "1 frame" and "2 frames"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def _row(story: TrackStory, names: Sequence[str], start_ns: int) -> dict[str, Any]:
    """Values of one track, by the names that the template uses."""
    order = np.argsort(-story.beliefs).tolist()
    return {
        "number": story.number,
        "jpeg": story.jpeg,
        "from_s": (story.first_ns - start_ns) * 1e-9,
        "to_s": (story.last_ns - start_ns) * 1e-9,
        "frames": _number_of(story.frames, "frame"),
        "beliefs": [
            (names[k], float(story.beliefs[k]))
            for k in order
            if story.beliefs[k] >= LEAST_SHOWN
        ],
        "outcomes": story.outcomes.most_common(),
    }
