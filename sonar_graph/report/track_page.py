"""Page of ``recognise --report``: each track with its picture, its probabilities and the reasons of its fate."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.recognition import SEE_TRACKS, Recognition, TrackStories
from sonar_graph.report.rendering import PageSection, write_html
from sonar_graph.sonar import REPORTED
from sonar_graph.states import counted

# tracks with a picture; of more those with the most frames
MOST_TRACKS = 400
# probability below which an identity is not listed
LEAST_SHOWN = 0.005
NONE = "none of them"
SECTIONS = [
    PageSection("tracks", "Tracks"),
    PageSection("rejected", "Candidates that were rejected"),
    PageSection("frames", "Frames"),
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
    longest = sorted(stories.tracks.values(), key=lambda story: -story.frames)
    shown = sorted(
        longest[:MOST_TRACKS],
        key=lambda story: (REPORTED not in story.outcomes, story.first_ns),
    )
    tracks = counted(len(stories.tracks), "track")
    content: dict[str, Any] = {
        "name": name,
        "extent": f"{counted(recognition.frames, 'frame')}, {tracks}",
        "names": [tracks],
        "recognition": recognition,
        "tracks": shown,
        "likely": partial(likely, [*identities, NONE]),
        "left_out": len(stories.tracks) - len(shown),
        "rejected": sorted(stories.rejected.items(), key=lambda item: -item[1].count),
        "start_ns": start_ns,
        "lines": [line for line in recognition.naming() if line != SEE_TRACKS],
    }
    write_html(path, "recognition", SECTIONS, content)


def likely(names: Sequence[str], beliefs: Floats) -> list[tuple[str, float]]:
    """Names and probabilities of what a track may be, most probable first."""
    order = np.argsort(-beliefs).tolist()
    return [(names[k], beliefs[k]) for k in order if beliefs[k] >= LEAST_SHOWN]
