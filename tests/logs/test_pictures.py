from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.viewer_messages import PICTURES, Picture, picture_messages


def jpeg(width: int, grey: int) -> bytes:
    return cv2.imencode(".jpg", np.full((20, width), grey, np.uint8))[1].tobytes()


def test_another_library_sees_each_picture_whole_with_its_stamp(tmp_path: Path) -> None:
    """Of different sizes, as JPEG files are."""
    pictures = [Picture(1_700_000_000_000_000_001 + k * 10**9, jpeg(30 + 40 * k, 90 * k)) for k in range(3)]
    write_recording(tmp_path / "log.mcap", picture_messages(PICTURES, pictures), {})
    with (tmp_path / "log.mcap").open("rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [entry.channel.topic for entry in found] == ["/sonar/recognised"] * 3
    assert {entry.schema.name for entry in found} == {"sensor_msgs/msg/CompressedImage"}
    for entry, picture in zip(found, pictures, strict=True):
        message = entry.decoded_message
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert stamp_ns == entry.message.log_time == picture.stamp_ns
        assert message.header.frame_id == "sonar"
        assert message.format == "jpeg"
        assert bytes(message.data) == picture.jpeg
        decoded = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert decoded.shape == cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape


def test_no_picture_is_no_message() -> None:
    assert picture_messages(PICTURES, []) == []
