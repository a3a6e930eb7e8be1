"""Every refusal of input names cause, file, topic and field, and what accepts it, in at most 300 characters."""

from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from sonar_graph.errors import LogError
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.roles import LONGEST
from tests.logs.adapters.conftest import at, dvl, imu, rows_of
from tests.logs.conftest import vector

ROWS = 20
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
DENIED = {"angular_velocity_covariance": [-1.0] + [0.0] * 8}
PACKETS = (
    "/pd0",
    "provider_dvl/msg/PD0Packet",
    [{"timestamp": 1.0, "range": [1.0] * 4, "velocity": [0.1] * 4}] * ROWS,
)
PACKET_TABLE = '[dvl]\ntopic = "/pd0"\ntype = "provider_dvl/msg/PD0Packet"\n'
LATER = [
    {"header": at(10**4 + row), "velocity": vector(1, 2, 3), "velocity_mode": 1}
    for row in range(ROWS)
]

Refusal = tuple[list[Any], str, str]
"""Entries of a log, a log configuration, and what the refusal must name."""
# fmt: off
REFUSALS: dict[str, Refusal] = {
    "velocities through water": (
        [imu(ROWS), dvl(ROWS, velocity_mode=2)], "",
        r"topic /dvl: none of its 20 messages can be used: 20 with velocity_mode not 1; `valid_where = \{\}` under"),
    "a flag that is never true": (
        [imu(ROWS), rows_of("/dvl", "dvl_msgs/msg/DVL", [{"velocity": vector(1, 2, 3)}] * ROWS)], "",
        r"topic /dvl: none .* 20 with velocity_valid not true; `valid_where = \{\}` under \[dvl\]"),
    "covariances that call all invalid": (
        [imu(ROWS), rows_of("/dvl", "stonefish_ros2/msg/DVL", [{"velocity_covariance": [-1.0] * 9}] * ROWS)], "",
        r'`covariance = \{negative = "unknown", zero = "unknown"\}` under \[dvl\]'),
    "rates that are not measured": (
        [imu(ROWS, **{f"at_{row}": DENIED for row in range(ROWS)}), dvl(ROWS)], "",
        r"topic /imu: none .* 20 without angular rate; `angular_velocity_status = false` under \[imu\]"),
    "one stamp for all": (
        [imu(ROWS), ("/dvl", "marine_acoustic_msgs/msg/Dvl", [{"header": at(0), "velocity_mode": 2}] * ROWS)], "",
        r"topic /dvl: none"),
    "no header": (
        [imu(ROWS), PACKETS], PACKET_TABLE + 'velocity = ["velocity[0]", "velocity[1]", "velocity[2]"]',
        r'topic /pd0: its provider_dvl/msg/PD0Packet has no field header\.stamp\.sec; stamp = "log", or the name'),
    "an array for a number": (
        [imu(ROWS), PACKETS],
        PACKET_TABLE + 'stamp = "log"\nvelocity = ["velocity", "velocity[1]", "velocity[2]"]',
        r"topic /pd0: field velocity of .* is an array of 4; name one element, such as velocity\[0\]"),
    "an element that is not there": (
        [imu(ROWS), PACKETS],
        PACKET_TABLE + 'stamp = "log"\nvelocity = ["velocity[0]", "velocity[1]", "velocity[9]"]',
        r"topic /pd0: field velocity\[9\] of .* has 4 elements"),
    "a field that is not there": (
        [imu(ROWS), PACKETS], PACKET_TABLE + 'velocity = ["velocit[0]", "velocity[1]", "velocity[2]"]',
        r"log\.toml: \[dvl\] velocity: .* has no field velocit\[0\]; did you mean velocity[?] it has: timestamp"),
    "two sensors": (
        [imu(ROWS), ("/imu2", *imu(ROWS)[1:]), dvl(ROWS)], "",
        r"for imu, 2 topics fit: /imu, /imu2; choose one: --topic imu=/imu"),
    "no Doppler log": (
        [imu(ROWS), *[(f"/twist_{i}", TWIST, [{"header": at(0)}]) for i in range(9)]],
        "", r"nothing for dvl: no .*--topic dvl=/twist_0.*`sonar-graph inspect .* --toml` begins"),
    "no common time": (
        [imu(ROWS), ("/dvl", "marine_acoustic_msgs/msg/Dvl", LATER)], "",
        r"IMU from .* DVL from .*no common time; .*`stamp = \"log\"` under"),
}
# fmt: on


@pytest.mark.parametrize(("entries", "toml", "named"), REFUSALS.values(), ids=REFUSALS)
def test_a_refusal_names_its_cause_and_what_accepts_the_input(
    foreign: Any, entries: list[Any], toml: str, named: str
) -> None:
    with pytest.raises(LogError, match=named) as refusal:
        foreign.read(*entries, toml=toml)
    without_folder = str(refusal.value).replace(f"{foreign.folder}/", "")
    assert without_folder.startswith(("log.mcap: ", "log.toml: "))
    assert len(without_folder) <= LONGEST


def test_what_a_refusal_names_accepts_the_input(foreign: Any) -> None:
    """Each line is written as it was named."""
    water = [imu(ROWS), dvl(ROWS, velocity_mode=2)]
    assert (
        len(foreign.read(*water, toml="[dvl]\nvalid_where = {}").dvl.stamps_ns) == ROWS
    )
    denied = [imu(ROWS, **{f"at_{row}": DENIED for row in range(ROWS)}), dvl(ROWS)]
    assert (
        len(
            foreign.read(
                *denied, toml="[imu]\nangular_velocity_status = false"
            ).imu.stamps_ns
        )
        == ROWS
    )
    packets = (
        PACKET_TABLE
        + 'velocity = ["velocity[0]", "velocity[1]", "velocity[2]"]\nstamp = "log"'
    )
    assert len(foreign.read(imu(ROWS), PACKETS, toml=packets).dvl.stamps_ns) == ROWS
    invalid = rows_of(
        "/dvl", "stonefish_ros2/msg/DVL", [{"velocity_covariance": [-1.0] * 9}] * ROWS
    )
    unknown = '[dvl]\ncovariance = {negative = "unknown", zero = "unknown"}'
    assert len(foreign.read(imu(ROWS), invalid, toml=unknown).dvl.stamps_ns) == ROWS


ENCODINGS: dict[str, tuple[str, str, str]] = {
    "protobuf": (
        "protobuf",
        "protobuf",
        r"has messages in protobuf; only ROS 2 CDR is read: record ROS 2 messages, or",
    ),
    "json": (
        "json",
        "jsonschema",
        r"has messages in json; .*tables for `sonar-graph convert csv`",
    ),
    "ros1": (
        "ros1",
        "ros1msg",
        r"has ROS 1 messages: `sonar-graph convert rosbag .*log\.mcap -o OUT\.mcap`",
    ),
    "idl": (
        "cdr",
        "ros2idl",
        r"has a definition in ros2idl; only ros2msg is read: record it where",
    ),
    "none": (
        "cdr",
        "",
        r"has no definition of its messages: record ROS 2 messages, or write tables",
    ),
}


@pytest.mark.parametrize(
    ("encoding", "schema", "named"), ENCODINGS.values(), ids=ENCODINGS
)
def test_messages_of_other_encodings_are_refused_with_the_way_to_read_them(
    tmp_path: Path, encoding: str, schema: str, named: str
) -> None:
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("x", "test")
        number = (
            writer.register_schema("sensor_msgs/msg/Imu", schema, b"float64 x")
            if schema
            else 0
        )
        writer.add_message(
            writer.register_channel("/imu", encoding, number), 1, b"\0\1\0\0", 1
        )
        writer.finish()
    with pytest.raises(LogError, match=named) as refusal:
        read_log(tmp_path / "log.mcap")
    assert len(str(refusal.value).replace(f"{tmp_path}/", "")) <= LONGEST
