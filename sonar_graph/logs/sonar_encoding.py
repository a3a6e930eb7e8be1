"""Sonar images as ``marine_acoustic_msgs/ProjectedSonarImage``, read back by `read_sonar_frames`."""

from __future__ import annotations

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.sonar_images import SAMPLE_TYPES
from sonar_graph.logs.encoding import header, outgoing
from sonar_graph.logs.recorder import Outgoing
from sonar_graph.logs.roles import SONAR_IMAGE
from sonar_graph.measurements import SonarFrames


def sonar_image_messages(
    topic: str, frames: SonarFrames, *, frequency_hz: float = 0.0, sound_speed_m_s: float = 0.0
) -> Outgoing:
    """One message a frame, recorded at the frame's stamp.

    A beam points to ``(x, y, z) = (0, -sin azimuth, cos azimuth)``: z forward, x up, y to the right. Samples keep their
    type, little-endian, all beams of the first range first. Ranges are float32 in this message.

    Parameters
    ----------
    topic
        Such as ``/sonar/image``.
    frames
        A block of frames.
    frequency_hz, sound_speed_m_s
        What the sonar says; 0: unknown.

    Raises
    ------
    LogError
        When the samples have a type that the message does not know, or a stamp does not fit into it.
    """
    count, beams, _ = frames.intensity.shape
    kind = f"{frames.intensity.dtype.kind}{frames.intensity.dtype.itemsize}"
    if kind not in SAMPLE_TYPES:
        raise LogError(f"{topic}: samples of type {frames.intensity.dtype} cannot be written; give {SAMPLE_TYPES}")
    samples = np.ascontiguousarray(frames.intensity.transpose(0, 2, 1), dtype=f"<{kind}")
    values = header(frames.stamps_ns, "sonar") | {
        "ping_info.frequency": frequency_hz,
        "ping_info.sound_speed": sound_speed_m_s,
        "beam_directions.y": -np.sin(frames.azimuths_rad)[None, :],
        "beam_directions.z": np.cos(frames.azimuths_rad)[None, :],
        "ranges": frames.ranges_m[None, :],
        "image.dtype": SAMPLE_TYPES.index(kind),
        "image.beam_count": beams,
        "image.data": samples.reshape(count, -1).view(np.uint8),
    }
    return outgoing(topic, SONAR_IMAGE, frames.stamps_ns, values, {"beam_directions": beams})
