from __future__ import annotations

from pathlib import Path

import pytest

from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert.didson_aris import ArisFormat
from sonar_graph.logs.convert.sonar_file import ByteSource, FrameHead, Lost

MIB = 1 << 20


def test_a_pattern_is_found_wherever_it_is(tmp_path: Path) -> None:
    """Also across the places where one read ends and the next begins, and where it overlaps itself."""
    places = [0, 7, MIB - 3, MIB + 1, 2 * MIB - 1, 2 * MIB + 1, 3 * MIB, 3 * MIB + 2]
    content = bytearray(3 * MIB + 5)
    for at in places:
        content[at : at + 3] = b"aba"
    path = tmp_path / "a.bin"
    path.write_bytes(content)
    with ByteSource(path) as source:
        assert list(source.places(b"aba", 0)) == places
        assert list(source.places(b"aba", 8)) == places[2:]
        assert list(source.places(b"abb", 0)) == []


def test_reading_ends_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"abcdef")
    with ByteSource(path) as source:
        assert (source.size, source.read(1, 3), source.read(4, 9), source.read(20, 1)) == (6, b"bcd", b"ef", b"")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"a\.bin: cannot be read: No such file"):
        ByteSource(tmp_path / "a.bin")


@pytest.mark.parametrize(
    ("content", "may_be"),
    [
        (b"", True),
        (b"\x05", True),
        (b"\x05\x01\0\0", True),
        (b"\x06", False),
        (b"\x05\x02", False),
        (b"\x05\x01\0\0" + b"?" * 8, True),
        (b"\x05\x01\0\0" + b"?" * 8 + b"DD", True),
        (b"\x05\x01\0\0" + b"?" * 8 + b"DDF\x05" + b"?" * 50, True),
        (b"\x05\x01\0\0" + b"?" * 8 + b"DX", False),
        (b"\x04\x01\0\0" + b"?" * 8 + b"DDF\x05", False),
    ],
)
def test_the_beginning_of_a_header_is_told_from_other_bytes(content: bytes, may_be: bool) -> None:
    kind = object.__new__(ArisFormat)
    assert kind.may_follow(content, FrameHead(0, 1, 0x104, 0, ())) is may_be


def test_a_loss_names_its_first_and_last_byte() -> None:
    assert str(Lost(10, 20, "because")) == "bytes 10 to 19: because"
