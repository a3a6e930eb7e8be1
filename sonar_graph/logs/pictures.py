"""Pictures as ``sensor_msgs/CompressedImage``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sonar_graph.logs import encoding
from sonar_graph.logs.recorder import Outgoing

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
PICTURES = "/sonar/recognised"
"""The topic of sonar images with what was recognised drawn into them."""


class Picture(NamedTuple):
    """One picture."""

    stamp_ns: int
    jpeg: bytes


def picture_messages(topic: str, pictures: Sequence[Picture]) -> list[Outgoing]:
    """One message a picture."""
    return [_message(topic, picture) for picture in pictures]


def _message(topic: str, picture: Picture) -> Outgoing:
    stamps_ns = np.array([picture.stamp_ns])
    content = np.frombuffer(picture.jpeg, np.uint8)[None, :]
    values = encoding.header(stamps_ns, "sonar") | {"format": "jpeg", "data": content}
    return encoding.outgoing(topic, COMPRESSED_IMAGE, stamps_ns, values, {"data": content.shape[1]})
