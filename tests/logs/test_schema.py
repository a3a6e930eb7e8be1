from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonar_graph.errors import LogError
from sonar_graph.logs.cdr.definitions import DEFINITIONS, STRING, Struct, definition, parse_definition

NAME = "some_msgs/msg/Thing"
RULE = "=" * 80


def long_name(name: str) -> str:
    return name.replace("/", "/msg/")


@pytest.mark.parametrize("name", [n for n in DEFINITIONS if not n.startswith(("sonar_graph_msgs", "marine"))])
def test_standard_messages_have_the_fields_of_ros_jazzy(name: str) -> None:
    jazzy = get_typestore(Stores.ROS2_JAZZY).fielddefs[long_name(name)][1]
    ours = get_types_from_msg(definition(name), long_name(name))[long_name(name)][1]
    assert ours == jazzy


@pytest.mark.parametrize("name", DEFINITIONS)
def test_definitions_travel_with_all_that_they_use(name: str) -> None:
    tree = parse_definition(long_name(name), definition(long_name(name)))
    assert tree.name == name
    assert definition(name).count("MSG: ") == len(set(names_within(tree))) - 1


def names_within(struct: Struct) -> list[str]:
    return [struct.name] + [n for f in struct.fields if isinstance(f.kind, Struct) for n in names_within(f.kind)]


def test_constants_comments_defaults_and_bounds_are_understood() -> None:
    text = """# a comment with a field-like line: float64 no
    uint8 A=1
    string NAME = "with # sign"
    float64 x 1.5   # a default
    string<=10 s
    int32[<=4] bounded
    int32[4] fixed
    float32[] open
    """
    fields = {f.name: (f.kind, f.length, f.is_array) for f in parse_definition(NAME, text).fields}
    assert fields == {
        "x": ("float64", 1, False),
        "s": (STRING, 1, False),
        "bounded": ("int32", None, True),
        "fixed": ("int32", 4, True),
        "open": ("float32", None, True),
    }


def test_types_may_be_named_with_msg_as_rosbag2_does() -> None:
    text = f"some_msgs/Part part\n{RULE}\nMSG: some_msgs/msg/Part\nfloat64 x\n"
    assert [field.name for field in parse_definition(NAME, text).fields] == ["part"]


def test_types_of_the_own_package_need_no_prefix_and_time_needs_no_definition() -> None:
    text = f"Part part\nbuiltin_interfaces/Time stamp\n{RULE}\nMSG: some_msgs/Part\nfloat64 x\n"
    part, stamp = parse_definition(NAME, text).fields
    assert isinstance(part.kind, Struct)
    assert part.kind.name == "some_msgs/Part"
    assert isinstance(stamp.kind, Struct)
    assert [f.name for f in stamp.kind.fields] == ["sec", "nanosec"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("other_msgs/Part part\n", "other_msgs/Part"),
        ("wstring text\n", "wstring"),
        ("float64\n", "no ros2msg field"),
        (f"Part p\n{RULE}\nMSG: some_msgs/Part\nPart[] p\n", "within itself"),
        ("Thing[] things\n", "within itself"),
        ("float64 x\nint8 x\n", "two fields called x"),
        ("float64[0] x\n", "no ros2msg field"),
        ("{}", "no ros2msg field"),
    ],
)
def test_what_cannot_be_understood_is_named(text: str, message: str) -> None:
    with pytest.raises(LogError, match=message):
        parse_definition(NAME, text)


def doubling(levels: int) -> str:
    """Types of which each has two of the next: a few lines with as many fields as 2 to the power of their number."""
    names = [f"some_msgs/T{i}" for i in range(levels)] + ["float64"]
    parts = [f"MSG: {name}\n{names[i + 1]} a\n{names[i + 1]} b\n" for i, name in enumerate(names[:-1])]
    return f"T0 root\n{RULE}\n" + f"{RULE}\n".join(parts)


def test_a_definition_that_grows_without_bounds_is_refused_at_once() -> None:
    assert len(parse_definition(NAME, doubling(8)).fields) == 1
    with pytest.raises(LogError, match="more than 10000 fields"):
        parse_definition(NAME, doubling(45))


def test_a_definition_nested_without_bounds_is_refused() -> None:
    chain = "".join(f"{RULE}\nMSG: some_msgs/T{i}\nT{i + 1} next\n" for i in range(3000))
    with pytest.raises(LogError, match="more than 50 deep"):
        parse_definition(NAME, "T0 first\n" + chain)
