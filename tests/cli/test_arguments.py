"""Settings, topics, calibrations and rates as a user writes them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from sonar_graph.cli import arguments
from sonar_graph.cli.arguments import (
    ReadingOptions,
    estimator_settings,
    parse_settings,
)


@given(
    st.one_of(
        st.integers(-(2**62), 2**62),
        st.booleans(),
        st.floats(allow_nan=False, allow_infinity=False),
    )
)
def test_setting_keeps_type_and_value(value):
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    ((name, parsed),) = parse_settings([f"gain = {text}"]).items()
    assert (name, parsed, type(parsed)) == ("gain", value, type(value))


def test_setting_that_is_no_toml_is_text():
    cases = {
        "huber": "huber",
        '"2"': "2",
        "[1, 2.5]": [1, 2.5],
        "": "",
        "x=y": "x=y",
        "1\nb=2": "1\nb=2",
    }
    for text, value in cases.items():
        assert parse_settings([f"a={text}"]) == {"a": value}


def test_settings_go_to_their_estimator_at_any_depth():
    texts = ["one.gain=1", "two.gate.sigma=3", "two.gate.kind=hard", "one.gain=1.0"]
    assert estimator_settings(texts, ["one", "two"]) == {
        "one": {"gain": 1.0},
        "two": {"gate": {"sigma": 3, "kind": "hard"}},
    }


def test_topics_go_to_their_roles():
    options = ReadingOptions(topics=["imu=/imu/data", "dvl=/a=b"])
    assert options.choices == {"imu": "/imu/data", "dvl": "/a=b"}


def test_nothing_that_a_terminal_obeys_is_printed(capsys):
    name = "a\x1b[2J\x9b31m\u202eb\r\x00 5 °\N{NO-BREAK SPACE}m\n"
    arguments.echo(name)
    table = Table("[bold]x[/]")
    table.add_row(Text(name))
    console = arguments.answers()
    console.print(table, escape(name))
    said = capsys.readouterr().out
    assert said.count(r"a\u001b[2J\u009b31m\u202eb\u000d\u0000 5 °") == 1
    assert not set(said) & set("\x1b\x9b\u202e\r\x00")


@pytest.mark.parametrize(
    "command",
    ["label", "recognise", "calibrate", "join", "calibration", "simulate landmarks"],
)
def test_a_command_that_has_no_use_for_a_map_refuses_it(basin, command, reply):
    assert (
        "No such option: --map" in reply(2, *command.split(), basin, "--map", basin).err
    )
