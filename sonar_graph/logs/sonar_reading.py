"""Sonar images from a log, a chunk of the file at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.adapters.config import LogConfig
from sonar_graph.logs.adapters.sonar_images import Refused, SonarAdapter
from sonar_graph.logs.container import Keep, Recording, Topic, stream
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.roles import ROLES, SONAR, advice, choose_topic, wanted_types
from sonar_graph.logs.window import Window
from sonar_graph.measurements import SonarFrames


def read_sonar_frames(
    path: Path,
    topic: str | None = None,
    config: LogConfig | None = None,
    *,
    window: Window | None = None,
    salvage: bool = False,
    refused: Refused | None = None,
) -> Iterator[SonarFrames]:
    """Frames of one sonar, in blocks that share beams and bins; only one chunk of the file is held at a time.

    Blocks and the frames in them are in the order of the log; a block ends before a frame with an earlier stamp.

    Parameters
    ----------
    path
        An MCAP file.
    topic
        Where several fit.
    config
        What the topics of a foreign log are; its table is ``[sonar]``.
    window, salvage
        As of `read_sequence`.
    refused
        Called with stamp and reason of each message that is no image; None: the first is an error.

    Raises
    ------
    MissingTopicError
        When ``topic`` has no image.
    LogError
        When several topics fit, the file is damaged in its middle (without ``salvage``, after the last frame), or an
        image is not what its message says (without ``refused``). A log without sonar images gives no block.
    """
    config = config or LogConfig()
    types = wanted_types(config, roles=(SONAR,))
    seen: dict[str, Topic] = {}

    def keep(kind: str) -> Keep:
        return Keep.ALL if short_name(kind) in types else Keep.NONE

    for piece in stream(Path(path), keep, window, salvage=salvage):
        seen.setdefault(piece.name, piece)
        choice = choose_topic(ROLES[SONAR], Recording(Path(path), seen), config, topic)
        if choice.candidates:
            raise LogError(f"{path}: for {SONAR}, {choice.reason}; choose one: {advice(choice)}")
        if choice.topic == piece.name and isinstance(choice.adapter, SonarAdapter):
            yield from choice.adapter.read(piece, refused)
    if topic is not None and topic not in seen:
        raise MissingTopicError(f"{path}: no image on {topic}; sonar images are on {', '.join(seen) or 'no topic'}")


def describe_frames(frames: SonarFrames) -> str:
    """Size, sector and range of a block, in words."""
    _, beams, bins = frames.intensity.shape
    left, right = np.degrees([frames.azimuths_rad.max(), frames.azimuths_rad.min()])
    return (
        f"{beams} beams x {bins} bins of {frames.intensity.dtype}, azimuth {right:.1f}° to {left:.1f}°, "
        f"{frames.ranges_m.min():.2f} m to {frames.ranges_m.max():.2f} m"
    )
