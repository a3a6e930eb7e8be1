"""Every refusal of input names cause, file, topic and field, and what accepts it, in at most 300 characters."""

from typing import Any

import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs.roles import LONGEST
from tests.logs.adapters.conftest import at, dvl, imu
from tests.logs.conftest import vector

ROWS = 20
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

STAMPED_TABLE = """[dvl]
type = "dvl_msgs/msg/DVL"
covariance = false
valid_where = {}
altitude = false
"""


def dated(first: float) -> tuple[str, str, list[dict[str, Any]]]:
    """Velocities at 10 Hz, stamped by numbers of microseconds from a first one on."""
    rows = [
        {"time": first + 1e5 * row, "velocity": vector(1, 2, 3)} for row in range(ROWS)
    ]
    return "/dvl", "dvl_msgs/msg/DVL", rows


STAMPED = dated(5e9)
Refusal = tuple[list[Any], str, str]
"""Entries of a log, a log configuration, and what the refusal must name."""
# fmt: off
REFUSALS: dict[str, Refusal] = {
    "velocities through water": (
        [imu(ROWS), dvl(ROWS, velocity_mode=2)], "",
        r"topic /dvl: none of its 20 messages can be used: 20 with velocity_mode not 1; `valid_where = \{\}` under"),
    "rates that are not measured": (
        [imu(ROWS, **{f"at_{row}": DENIED for row in range(ROWS)}), dvl(ROWS)], "",
        r"topic /imu: none .* 20 without angular rate; `angular_velocity_status = false` under \[imu\]"),
    "no header": (
        [imu(ROWS), PACKETS], PACKET_TABLE + 'velocity = ["velocity[0]", "velocity[1]", "velocity[2]"]',
        r'topic /pd0: its provider_dvl/msg/PD0Packet has no field header\.stamp\.sec; stamp = "log", or the name'),
    "a field that is not there": (
        [imu(ROWS), PACKETS], PACKET_TABLE + 'velocity = ["velocit[0]", "velocity[1]", "velocity[2]"]',
        r"log\.toml: \[dvl\] velocity: .* has no field velocit\[0\]; did you mean velocity[?] it has: timestamp"),
    "no common time": (
        [imu(ROWS), ("/dvl", "marine_acoustic_msgs/msg/Dvl", LATER)], "",
        r'IMU from \d.* DVL from \d.*no common time; .*stamp = "log" under .* See stamp, stamp_unit_s and stamp_offset_s'),
    "stamps of a boot in microseconds": (
        [imu(ROWS), STAMPED], STAMPED_TABLE + 'stamp = "time"',
        r'no common time; .* Perhaps stamp_unit_s = "us" under \[dvl\]'),
    "stamps since 1970 in microseconds": (
        [imu(ROWS), dated(1.7e15)], STAMPED_TABLE + 'stamp = "time"',
        r'field time .* 1\.7e\+15 s, beyond any date: another unit[?] `stamp_unit_s = "us"`'),
}
# fmt: on


@pytest.mark.parametrize(("entries", "toml", "named"), REFUSALS.values(), ids=REFUSALS)
def test_a_refusal_names_its_cause_and_what_accepts_the_input(
    foreign, tmp_path, entries, toml, named
):
    with pytest.raises(LogError, match=named) as refusal:
        foreign.read(*entries, toml=toml)
    without_folder = str(refusal.value).replace(f"{tmp_path}/", "")
    assert without_folder.startswith(("log.mcap: ", "log.toml: "))
    assert len(without_folder) <= LONGEST
