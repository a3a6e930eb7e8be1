from __future__ import annotations

from pathlib import Path

import pytest

from sonar_graph.errors import LogError
from sonar_graph.files import written_whole


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "log.mcap"
    with written_whole(path) as stream:
        stream.write(b"all of it")
        stream.flush()
        assert not path.exists()
    assert path.read_bytes() == b"all of it"
    assert list(path.parent.iterdir()) == [path]


def break_off(path: Path) -> None:
    with written_whole(path) as stream:
        stream.write(b"half")
        raise ZeroDivisionError


def test_after_an_error_the_file_is_what_it_was_and_nothing_lies_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError):
        break_off(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_the_system_refuses_is_told_with_the_name_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LogError, match=r"file/log\.mcap cannot be written: "):
        break_off(tmp_path / "file" / "log.mcap")
