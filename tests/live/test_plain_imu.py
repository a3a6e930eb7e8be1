"""A quick reading of IMU messages gives the rows of the adapter, to the bit, or leaves the message to it."""

from pathlib import Path

import numpy as np
import pytest

from sonar_graph.live.message_reader import PlainImu
from sonar_graph.live.zenoh_link import definition_of
from sonar_graph.logs.adapters import Setup, shipped_for
from sonar_graph.logs.cdr import encode, parse_definition
from sonar_graph.logs.mcap import Keep, Topic

KIND = "sensor_msgs/msg/Imu"
USUAL = {"header.stamp.sec": 5, "header.frame_id": "imu", "linear_acceleration.z": 9.81}
CHANGES = {
    "none": {},
    "degrees and g": {
        "angular_velocity_scale": np.pi / 180,
        "linear_acceleration_scale": -9.80665,
    },
    "forward, right, down": {"rotation": "frd"},
    "rates with axes of their own": {"angular_velocity_axes": ("x", "y", "-z")},
    "turned": {"rotation": (10.0, 20.0, 30.0)},
    "stamped at arrival": {"stamp_offset_s": -0.0123456789},
}


def payload_of(**values):
    return encode(parse_definition(KIND, definition_of(KIND)), 1, USUAL | values)[
        0
    ].tobytes()


def topic_of(payload):
    topic = Topic(
        Path("x.mcap"), "/imu", KIND, "cdr", "ros2msg", definition_of(KIND), Keep.ALL
    )
    topic.gather(
        payload, np.zeros(1, np.int64), np.array([len(payload)]), np.array([7])
    )
    return topic


def adapter_of(change="none"):
    return shipped_for("imu", KIND)[0].model_copy(update=CHANGES[change])


def form_of(adapter):
    return PlainImu.like(adapter, topic_of(payload_of()).messages()[0])


@pytest.mark.parametrize("change", CHANGES)
def test_rows_are_those_of_the_adapter_to_the_bit(change):
    adapter, noise = adapter_of(change), np.random.default_rng(0)
    form = form_of(adapter)
    for _ in range(100):
        values = {
            f"{what}.{axis}": noise.normal()
            for what in ("angular_velocity", "linear_acceleration")
            for axis in "xyz"
        }
        payload = payload_of(
            **values,
            **{
                "header.stamp.nanosec": int(noise.integers(10**9)),
                "orientation.w": 0.3,
            },
        )
        expected, _ = adapter.read(adapter.table(topic_of(payload)), Setup())
        row = form.row(payload)
        for name, column in vars(expected).items():
            assert getattr(row, name).tobytes() == column.tobytes(), name
            assert getattr(row, name).dtype == column.dtype


@pytest.mark.parametrize(
    "unusual",
    [
        {"header.stamp.sec": 0},
        {"angular_velocity.x": np.nan},
        {"angular_velocity.x": 1e16},
        {"linear_acceleration.z": np.inf},
        {"linear_acceleration.z": 0.0},
        {"linear_acceleration_covariance": np.array([[-1.0, *[0.0] * 8]])},
        {"header.frame_id": "imv"},
        {"header.frame_id": "imu_link"},
    ],
    ids=str,
)
def test_what_is_unusual_is_left_to_the_adapter(unusual):
    form = form_of(adapter_of())
    assert form.row(payload_of()) is not None
    assert form.row(payload_of(**unusual)) is None


def test_a_message_that_is_cut_or_in_another_byte_order_is_left_to_the_adapter():
    form, payload = form_of(adapter_of()), payload_of()
    assert form.row(payload[:-8]) is None
    assert form.row(b"\0\0" + payload[2:]) is None
