from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.adapters.drivers import SHIPPED
from sonar_graph.logs.adapters.log_config import LogConfig, read_log_config, table_text, toml_value
from sonar_graph.logs.inspection import inspect_log

MISTAKES = {
    "a role that there is not": ("[sonra]\n", r"there is no role \[sonra\]; tables are for imu, dvl, depth"),
    "no table": ('imu = "/imu"', r"imu: expected a table, \[imu\]"),
    "an unknown key": (
        '[dvl]\ntopc = "/dvl"',
        r"\[dvl\] topc: there is no such field; did you mean topic\? it has: type, topic, .*velocity",
    ),
    "a type of which too little is said": (
        '[imu]\ntype = "my_msgs/msg/Gyro"',
        r"\[imu\] angular_velocity: is missing; .*no adapter is shipped for my_msgs/msg/Gyro",
    ),
    "a key in an inner table": (
        "[dvl]\ncovariance = {kind = 1}",
        r"\[dvl\] covariance\.kind: there is no such field; covariance has: fields, meaning",
    ),
    "axes that are none": ('[imu]\nrotation = "ned"', r"\[imu\] rotation.*'flu' or 'frd'.*not 'ned'"),
    "two angles": ("[imu]\nrotation = [1, 2]", r"\[imu\] rotation"),
    "a type that comes along with a wrong meaning": (
        '[dvl]\ntype = "marine_acoustic_msgs/msg/Dvl"\ncovariance = {meaning = "sigma"}',
        r"\[dvl\] covariance\.meaning: Input should be 'variance' or 'standard deviation', not 'sigma'",
    ),
    "an unknown type without fields": (
        '[imu]\ntype = "my_msgs/msg/Imu"',
        r"\[imu\] angular_velocity: is missing.*linear_acceleration: is missing",
    ),
    "a DVL without a velocity": ('[dvl]\ntype = "my_msgs/msg/Dvl"', r"\[dvl\] .*give velocity = \[x, y, z\] fields"),
    "both pressure and height": (
        '[depth]\ntype = "sensor_msgs/msg/FluidPressure"\nheight = "data"',
        r"\[depth\] .*give either",
    ),
    "a type that is no text": ("[dvl]\ntype = 3", r"\[dvl\] type: expected a text such as 'marine"),
    "a scale of nothing": ("[dvl]\nscale = 0", r"\[dvl\] scale: expected a factor, .*not 0"),
    "no TOML": ("[dvl", "not TOML"),
    "no file": (None, "cannot be read"),
}


@pytest.mark.parametrize(("toml", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_with_its_file_table_and_key(tmp_path: Path, toml: str | None, message: str) -> None:
    path = tmp_path / "my log.toml"
    if toml is not None:
        path.write_text(toml)
    with pytest.raises(LogError, match=rf"my log\.toml:? ?.*{message}") as caught:
        read_log_config(path)
    assert "\n" not in str(caught.value)


def test_a_table_changes_only_what_it_names() -> None:
    config = LogConfig.parse({"dvl": {"scale": 2.0, "covariance": {"zero": "invalid"}, "good_beams": False}}, "x")
    (adapter,) = config.adapters("dvl", "marine_acoustic_msgs/msg/Dvl")
    (shipped, *_) = (offer.adapter for offer in SHIPPED["dvl"])
    changed = {name for name in type(adapter).model_fields if getattr(adapter, name) != getattr(shipped, name)}
    assert changed == {"scale", "covariance", "good_beams"}
    assert adapter.covariance.fields == ("velocity_covar",)  # type: ignore[attr-defined]


def test_the_notes_tell_what_was_said(foreign: Any, read: Any) -> None:
    toml = '[dvl]\nrotation = "frd"\ngood_beams = false\n[imu]\ntopic = "/imu"'
    notes = read(foreign.imu(), foreign.dvl(), toml=toml).notes
    assert notes["log.adapters"] == 'dvl: rotation = "frd", good_beams = false'
    assert "log.adapters" not in read(foreign.imu(), foreign.dvl()).notes


def test_a_role_can_be_switched_off(foreign: Any, read: Any) -> None:
    pressure = ("/bar30", "sensor_msgs/msg/FluidPressure", [{"header": foreign.header(0), "fluid_pressure": 2e5}])
    assert read(foreign.imu(), foreign.dvl(), pressure).depth is not None
    assert read(foreign.imu(), foreign.dvl(), pressure, toml="[depth]\nuse = false").depth is None


def test_a_topic_of_the_command_line_goes_before_that_of_the_file(foreign: Any, read: Any) -> None:
    _, kind, messages = foreign.dvl()
    entries = (foreign.imu(), ("/a", kind, messages[:2]), ("/b", kind, messages))
    assert len(read(*entries, toml='[dvl]\ntopic = "/a"').dvl) == 2
    assert len(read(*entries, toml='[dvl]\ntopic = "/a"', topics={"dvl": "/b"}).dvl) == 5


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ('[dvl]\ntopic = "/missing"', "nothing for dvl: /missing was chosen but is not in the log"),
        (
            '[dvl]\ntopic = "/imu"',
            "/imu was chosen but is a sensor_msgs/msg/Imu; no adapter of role dvl reads it, it is a type of role imu",
        ),
        ('[dvl]\ntype = "dvl_msgs/msg/DVL"', "nothing for dvl: no dvl_msgs/msg/DVL, which .* asks for"),
        ('[depth]\ntopic = "/missing"', "nothing for depth: /missing was chosen"),
        (
            '[dvl]\ntopic = "/dvl"\ntype = "dvl_msgs/msg/DVL"',
            "/dvl was chosen but is a marine_acoustic_msgs/msg/Dvl, and .* asks for a dvl_msgs/msg/DVL",
        ),
    ],
)
def test_a_topic_that_cannot_be_is_refused(foreign: Any, read: Any, toml: str, message: str) -> None:
    with pytest.raises(MissingTopicError, match=message):
        read(foreign.imu(), foreign.dvl(), toml=toml)


SHIPPED_ADAPTERS = [(role, offer.adapter) for role, offers in SHIPPED.items() for offer in offers]


@pytest.mark.parametrize(("role", "adapter"), SHIPPED_ADAPTERS, ids=lambda value: getattr(value, "type", value))
def test_every_adapter_that_comes_along_can_be_written_as_a_table_and_read_again(role: str, adapter: Any) -> None:
    values = tomllib.loads(table_text(role, "/a topic", adapter, None))
    config = LogConfig.parse(values, "x")
    assert adapter.model_copy(update={"topic": "/a topic"}) in config.adapters(role, adapter.type)


LEAVES = st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False, allow_infinity=False) | st.text()


@given(st.dictionaries(st.text(min_size=1), LEAVES | st.lists(LEAVES, max_size=3), max_size=4))
def test_values_are_toml(values: dict[str, Any]) -> None:
    assert tomllib.loads(f"x = {toml_value(values)}")["x"] == values


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (
            '[imu]\nangular_velocity = ["angular_velocity.x", "angular_velocity.y", "angular_velocity.w"]',
            r"\[imu\] angular_velocity: sensor_msgs/Imu has no field angular_velocity\.w; did you mean "
            r"angular_velocity\.[xyz]\? it has: .*angular_velocity_covariance\[9\]",
        ),
        ('[imu]\nstamp = "header.time"', r"\[imu\] stamp: .* has no field header\.time; .*header\.stamp\.sec"),
        ('[imu]\nframe_id_field = "frame"', r"\[imu\] frame_id_field: .* has no field frame; .*header\.frame_id"),
        ('[dvl]\ntopic = "/dvl"\ngood_beams = "beams"', r"\[dvl\] good_beams: .* has no field beams; .*num_good_beams"),
        ("[dvl]\nvalid_where = {lock = true}", r"\[dvl\] valid_where: .* has no field lock; .*velocity_mode"),
        (
            '[dvl]\ncovariance = {fields = ["velocity_cov"]}',
            r"\[dvl\] covariance\.fields: .* has no field velocity_cov; did you mean velocity_covar\?",
        ),
        (
            '[dvl]\ntype = "marine_acoustic_msgs/msg/Dvl"\nsound_speed = "speed"',
            r"\[dvl\] sound_speed: .* has no field speed; ",
        ),
    ],
)
def test_a_field_that_messages_do_not_have_is_named_with_file_table_and_key(
    foreign: Any, read: Any, tmp_path: Path, toml: str, message: str
) -> None:
    with pytest.raises(LogError, match=rf"log\.toml: {message}") as told:
        read(foreign.imu(), foreign.dvl(), toml=toml)
    path = next(tmp_path.rglob("*.mcap"))
    with pytest.raises(LogError) as inspected:
        inspect_log(path, read_log_config(next(tmp_path.rglob("*.toml"))))
    assert str(inspected.value) == str(told.value)


def test_fields_of_a_topic_that_is_not_meant_do_not_matter(foreign: Any, read: Any) -> None:
    toml = '[dvl]\ntopic = "/dvl"\ngood_beams = "num_good_beams"\nstamp = "log"\nframe_id_field = false'
    twist = ("/dvl/twist", "geometry_msgs/msg/TwistWithCovarianceStamped", [{"header": foreign.header(0)}] * 2)
    assert len(read(foreign.imu(), foreign.dvl(), twist, toml=toml).dvl) == 5
