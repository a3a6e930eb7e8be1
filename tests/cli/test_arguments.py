"""Settings, topics, calibrations and rates as a user writes them."""

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from sonar_graph.cli import arguments
from sonar_graph.cli.arguments import (
    ReadingOptions,
    estimator_settings,
    parse_settings,
)


def test_settings_go_to_their_estimator_at_any_depth():
    texts = ["one.gain=1", "two.gate.sigma=3", "two.gate.kind=hard", "one.gain=1.0"]
    assert estimator_settings(texts, ["one", "two"]) == {
        "one": {"gain": 1.0},
        "two": {"gate": {"sigma": 3, "kind": "hard"}},
    }


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


def test_a_setting_is_toml_or_else_a_text():
    cases = {
        "2": 2,
        "-2.0e3": -2000.0,
        "true": True,
        "huber": "huber",
        '"2"': "2",
        "[1, 2.5]": [1, 2.5],
        "": "",
        "x=y": "x=y",
        "1\nb=2": "1\nb=2",
    }
    for text, value in cases.items():
        (found,) = parse_settings([f"a = {text}"]).values()
        assert (found, type(found)) == (value, type(value))


def test_topics_go_to_their_roles():
    options = ReadingOptions(topics=["imu=/imu/data", "dvl=/a=b"])
    assert options.choices == {"imu": "/imu/data", "dvl": "/a=b"}
