"""Sonar images from a log, a chunk of the file at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sonar_graph.logs.adapters import LogConfig, Refused, SonarAdapter
from sonar_graph.logs.mcap import Keep, TimeWindow, scan, stream
from sonar_graph.logs.roles import SONAR, choose_topics
from sonar_graph.measurements import SonarFrames


def read_sonar_frames(
    path: Path,
    topic: str | None = None,
    config: LogConfig | None = None,
    *,
    window: TimeWindow | None = None,
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
        As of `read_log`.
    refused
        Called with stamp and reason of each message that is no image; None: the first is an error.

    Raises
    ------
    MissingTopicError
        When the topic that was asked for is not there, or is none that can be read.
    LogError
        When several topics fit, the file is damaged in its middle (without ``salvage``, after the last frame), or an
        image is not what its message says (without ``refused``). A log without sonar images gives no block.
    """
    config, path = config or LogConfig(), Path(path)
    recording = scan(path, lambda _: Keep.NONE)
    choice = choose_topics(recording, {SONAR: topic} if topic else {}, config, (SONAR,))[SONAR]
    if choice.topic is None or not isinstance(choice.adapter, SonarAdapter):
        return
    kind = recording.topics[choice.topic].type_name
    for piece in stream(path, lambda name: Keep.ALL if name == kind else Keep.NONE, window, salvage=salvage):
        if piece.name == choice.topic:
            yield from choice.adapter.read(piece, refused)


def describe_frames(frames: SonarFrames) -> str:
    """Size, sector and range of a block, in words."""
    _, beams, bins = frames.intensity.shape
    left, right = np.degrees([frames.azimuths_rad.max(), frames.azimuths_rad.min()])
    return (
        f"{beams} beams x {bins} bins of {frames.intensity.dtype}, azimuth {right:.1f}° to {left:.1f}°, "
        f"{frames.ranges_m.min():.2f} m to {frames.ranges_m.max():.2f} m"
    )
