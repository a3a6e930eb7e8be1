"""Summaries of logs: roles, times, damage, doubts, and the log configuration to start from."""

import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs import (
    ROLES,
    LogSummary,
    inspect_log,
    read_log,
    write_log,
)
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.convert import read_victoria_park
from sonar_graph.logs.mcap import Keep, scan
from sonar_graph.logs.roles import choose_topic
from sonar_graph.simulation import BasinOptions, simulate_basin

from .conftest import T0_NS, Change, copy, recorded, writing


def roles(summary: LogSummary) -> dict[str, tuple[str | None, str]]:
    return {r.role: (r.topic, r.reason) for r in summary.roles}


def test_roles_are_explained_whether_filled_or_not(bench):
    imu, dvl = bench.basics()
    odometry = ("/odom", "odometry", [bench.odometry(bench.t0_ns)])
    path = bench.write(imu, dvl, ("/second", "imu", imu[2]), odometry)
    summary = inspect_log(path)
    found = roles(summary)
    assert found["imu"] == (None, "2 topics fit: /imu, /second")
    assert found["dvl"] == ("/dvl", "the only marine_acoustic_msgs/msg/Dvl that fits")
    assert found["truth"][0] is None
    assert "/odom only if chosen: --topic truth=/odom" in found["truth"][1]
    assert summary.obstacles == ("2 topics for imu (choose: --topic imu=/imu)",)
    assert summary.calibration.startswith("defaults; mountings from /tf_static: none")
    assert '# [imu]  # one of\n# topic = "/imu"\n# topic = "/second"' in summary.toml
    assert '# [truth]  # one of\n# topic = "/odom"' in summary.toml
    assert 'rotation = "flu"' in summary.toml
    alone = inspect_log(bench.write(odometry, name="other.mcap"))
    assert alone.obstacles == ("no IMU", "no DVL")
    chosen = roles(inspect_log(path, topics={"imu": "/second"}))
    assert chosen["imu"] == ("/second", "chosen by name")
    tables = {"imu": {"topic": "/imu"}, "dvl": {"use": False}}
    said = roles(inspect_log(path, LogConfig.parse(tables, "my.toml")))
    assert said["imu"] == ("/imu", "chosen in my.toml")
    assert said["dvl"] == (None, "switched off in my.toml")


@pytest.mark.recording
def test_a_third_party_log_is_described(recordings):
    summary = inspect_log(recordings / "bags" / "nav2_turtlebot.mcap")
    counts = {t.name: t.messages for t in summary.topics}
    assert counts == {"/amcl_pose": 135, "/odom": 2639, "/tf": 5422, "/tf_static": 1}
    assert all(r.topic is None for r in summary.roles)
    # by the robot's clock, not the recorder's
    assert summary.duration_s == pytest.approx(101.394)
    assert summary.damage == ()


def test_what_a_run_would_leave_out_and_doubt_is_told_before(bench):
    imu, dvl = bench.basics()
    for message in imu[2]:
        message["linear_acceleration"] = {"x": 0.0, "y": 9.8, "z": 0.0}
    imu[2][0]["header"]["stamp"] = {}
    dvl[2][2]["velocity_mode"] = 2
    path = bench.write(imu, dvl)
    summary = inspect_log(path)
    notes = read_log(path).notes
    assert summary.left_out == ("dvl: 1 with velocity_mode not 1",)
    assert "; ".join(summary.left_out) == notes["log.dropped"]
    told = (notes["log.doubtful"], notes["log.warnings"])
    assert "; ".join(summary.warnings) == "; ".join(told)
    assert "gravity is felt along +y" in told[0]
    faults = {topic.name: topic.stamp_faults for topic in summary.topics}
    assert faults["/dvl"] == ()
    assert "1 message without a stamp: the time of recording is used" in faults["/imu"]


def test_what_this_package_wrote_gives_no_warning(tmp_path):
    basin = simulate_basin(BasinOptions(seed=1, duration_s=120.0, laps=1))
    path = tmp_path / "a.mcap"
    for sequence in (read_victoria_park(), basin):
        write_log(path, sequence)
        summary = inspect_log(path)
        assert summary.warnings == summary.damage == ()
        assert not any(topic.stamp_faults for topic in summary.topics)
        assert not {"log.stamps", "log.warnings"} & read_log(path).notes.keys()


# --- topics that cannot be read, and broken messages -----------------------------------------------------------------

IMU = "sensor_msgs/msg/Imu"
IDL = "module sensor_msgs { module msg { struct Imu { double x; }; }; };"
FOREIGN = {
    "/json": ("Some", "jsonschema", b"{}", "json", "has messages in json; only ROS 2 CDR is read"),
    "/idl": (IMU, "ros2idl", IDL.encode(), "cdr", "has a definition in ros2idl; only ros2msg is read: record it"),
    "/wide": ("a/msg/B", "ros2msg", b"wstring s\n", "cdr", "cannot be read: the definition of a/B uses wstring"),
    "/loop": ("a/msg/B", "ros2msg", b"B[] b\n", "cdr", "cannot be read: the definition of a/B uses a/B within itself"),
    "/noise": (IMU, "ros2msg", b"\xff\xfe{", "cdr", "has a definition that cannot be read: the definition of"),
    "/bare": ("", "", b"", "cdr", "has no definition of its messages"),
    "/nothing": ("", "", b"", "", "has messages in no named encoding"),
}  # fmt: skip


def copied(
    source: Path,
    change: Change = lambda *message: message[-1],
    *,
    beside: bool = False,
) -> Path:
    """Copy of a log with changed messages; with ``beside``, with channels of other kinds."""
    target = source.with_name("copy.mcap")
    with writing(target) as writer:
        for topic, (name, kind, text, encoding, _) in FOREIGN.items() if beside else ():
            schema = writer.register_schema(name, kind, text) if kind else 0
            channel = writer.register_channel(topic, encoding, schema)
            for _ in range(2):
                writer.add_message(channel, T0_NS, b"{}", T0_NS)
        copy(recorded(source), writer, change)
    return target


def test_unreadable_topics_are_listed_with_the_reason(bench):
    path = bench.write(*bench.basics())
    mixed = copied(path, beside=True)
    topics = {topic.name: topic for topic in inspect_log(mixed).topics}
    assert {name for name, topic in topics.items() if topic.refusal} == set(FOREIGN)
    scanned = scan(mixed, lambda _: Keep.STAMP).topics
    for name, (*_, reason) in FOREIGN.items():
        assert topics[name].messages == len(scanned[name]) == 2
        assert reason in str(topics[name].refusal)
    rates = read_log(mixed).imu.angular_velocity
    np.testing.assert_array_equal(read_log(path).imu.angular_velocity, rates)
    without = copied(
        path, lambda topic, _, data: None if topic == "/imu" else data, beside=True
    )
    message = r"nothing for imu: .*/idl has a definition in ros2idl"
    with pytest.raises(MissingTopicError, match=message):
        read_log(without)


@pytest.mark.parametrize(
    ("role", "column"), [("imu", "angular_velocity"), ("depth", "z_m")]
)
def test_broken_messages_are_counted_and_the_others_are_as_if_alone(
    bench, role, column
):
    """A sensor that no estimator needs may have no whole message at all."""
    pressures = [bench.pressure(bench.t0_ns + i) for i in range(9)]
    path = bench.write(*bench.basics(9), ("/depth", "pressure", pressures))

    def cut(*broken: int) -> Path:
        return copied(
            path,
            lambda topic, i, data: (
                data[:-8] if topic == f"/{role}" and i in broken else data
            ),
        )

    whole = getattr(read_log(path), role)
    sequence = read_log(cut(0, 4, 5))
    for name in ("stamps_ns", column):
        values = getattr(getattr(sequence, role), name)
        kept = getattr(whole, name)[[1, 2, 3, 6, 7, 8]]
        np.testing.assert_array_equal(values, kept)
    end = "that end before their definition does"
    assert sequence.notes["log.dropped"] == f"{role}: 3 {end}"
    wholly = cut(*range(9))
    if role == "imu":
        with pytest.raises(LogError, match=rf"topic /imu: no message .* 9 {end}"):
            read_log(wholly)
    else:
        sequence = read_log(wholly)
        assert sequence.depth is None
        assert sequence.notes["log.dropped"] == f"depth: 9 {end}"


# --- the log configuration to start from ---------------------------------------------------------------------------


def choices(path: Path, config: LogConfig) -> dict[str, object]:
    """For each role the topic, others that fit, and the adapter but for the topic that the text names."""
    recording = scan(path, lambda _: Keep.STAMP)
    found = {}
    for name in ROLES:
        choice = choose_topic(name, recording, config)
        adapter = choice.adapter and choice.adapter.model_copy(update={"topic": None})
        found[name] = choice.topic, choice.candidates, adapter
    return found


def test_read_back_unchanged_it_makes_the_same_choices(bench, make_sequence, tmp_path):
    imu, dvl = bench.basics()
    odometry = ("/odom", "odometry", [bench.odometry(bench.t0_ns)])
    pressure = ("/bar30", "pressure", [bench.pressure(bench.t0_ns)])
    logs = [
        bench.write(imu, dvl, pressure, odometry, name="plain.mcap"),
        bench.write(imu, dvl, ("/second", "imu", imu[2]), name="two.mcap"),
        bench.write(imu, name="half.mcap"),
        tmp_path / "own.mcap",
    ]
    write_log(logs[-1], make_sequence())
    frame = {"frame_id": 'a "frame"', "stamp_offset_s": -0.04}
    said: list[dict[str, Any]] = [
        {},
        {"dvl": {"rotation": [1, 2, 3], "covariance": False}, "depth": {"use": False}},
        {"truth": {"topic": "/odom"}, "imu": frame},
    ]
    for path, tables in product(logs, said):
        config = LogConfig.parse(tables, "x")
        again = LogConfig.parse(tomllib.loads(inspect_log(path, config).toml), "again")
        assert choices(path, config) == choices(path, again)


def test_an_unknown_type_is_proposed_with_its_fields(bench):
    own = "float64 time\nfloat64[3] speed\nfloat32[] beams\n"
    rows = [{"time": 0.0, "speed": [1.0, 2.0, 3.0], "beams": []}] * 3
    velocities = ("/my_dvl", "my_msgs/msg/Velocity", rows, own)
    path = bench.write(bench.basics()[0], velocities)
    text = inspect_log(path).toml
    kind = '# topic = "/my_dvl"\n# type = "my_msgs/msg/Velocity"\n# stamp = "log"'
    assert kind in text
    assert "#   time\n#   speed[3]\n#   beams[]" in text
    lines = [line for line in text.splitlines() if "my_dvl is" not in line]
    filled = "\n".join(line.removeprefix("# ") for line in lines)
    table = filled[filled.index("[dvl]") : filled.index("[depth]")]
    table = table.replace('"..."', '"speed[{}]"').format(0, 1, 2)
    sequence = read_log(path, config=LogConfig.parse(tomllib.loads(table), "x"))
    assert sequence.dvl.velocity.tolist() == [[1, 2, 3]] * 3
