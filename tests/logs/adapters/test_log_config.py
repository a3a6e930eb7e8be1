"""Log configurations: tables that change adapters, mistakes in them, and tables written from adapters."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.errors import LogError, MissingTopicError
from sonar_graph.logs.adapters import read_log_config
from sonar_graph.logs.adapters.log_config import toml_value

# fmt: off
MISTAKES: dict[str, tuple[str | None, str]] = {
    "no such role": ("[sonra]\n", r"there is no role \[sonra\]; tables are for imu, dvl, depth"),
    "no table": ('imu = "/imu"', r"imu: expected a table, \[imu\]"),
    "unknown axes": ('[imu]\nrotation = "ned"', r"\[imu\] rotation.*'flu' or 'frd'.*not 'ned'"),
    "no velocity": ('[dvl]\ntype = "my_msgs/msg/Dvl"', r"\[dvl\] .*give velocity = \[x, y, z\] fields"),
    "pressure and height": ('[depth]\ntype = "sensor_msgs/msg/FluidPressure"\nheight = "data"',
        r"\[depth\] .*give either"),
    "a heading of nothing": ('[heading]\ntype = "a/msg/B"', r"\[heading\] .*give either orientation"),
    "a position of nothing": ('[positions]\ntype = "a/msg/B"', r"\[positions\] .*give either position"),
    "type that is no text": ("[dvl]\ntype = 3", r"\[dvl\] type: expected a text such as 'marine"),
    "scale of zero": ("[dvl]\nscale = 0", r"\[dvl\] scale: expected a factor, .*not 0"),
    "no TOML": ("[dvl", "not TOML"),
    "no file": (None, "cannot be read"),
}
NO_TOPIC: dict[str, str] = {
    '[dvl]\ntopic = "/missing"': "nothing for dvl: /missing was chosen but is not in the log",
    '[dvl]\ntype = "dvl_msgs/msg/DVL"': "nothing for dvl: no dvl_msgs/msg/DVL, which .* asks for",
    '[dvl]\ntopic = "/dvl"\ntype = "dvl_msgs/msg/DVL"':
        "/dvl was chosen but is a marine_acoustic_msgs/msg/Dvl, and .* asks for a dvl_msgs/msg/DVL",
}
# fmt: on


@pytest.mark.parametrize(("toml", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_with_its_file_table_and_key(tmp_path, toml, message):
    path = tmp_path / "my log.toml"
    if toml is not None:
        path.write_text(toml)
    with pytest.raises(LogError, match=rf"my log\.toml:? ?.*{message}") as caught:
        read_log_config(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("toml", "message"), NO_TOPIC.items())
def test_a_topic_that_cannot_be_is_refused(foreign, toml, message):
    with pytest.raises(MissingTopicError, match=message):
        foreign.read(toml=toml)


LEAVES = (
    st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
)


@given(
    st.dictionaries(
        st.text(min_size=1), LEAVES | st.lists(LEAVES, max_size=3), max_size=4
    )
)
def test_values_are_toml(values):
    assert tomllib.loads(f"x = {toml_value(values)}")["x"] == values
