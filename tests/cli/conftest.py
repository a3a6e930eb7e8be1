"""Commands as a user gives them, and a short log to give them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.cli import main
from sonar_graph.logs import write_log
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.testing import small_world

Run = Callable[..., int]


def run_command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.fixture(scope="session")
def run() -> Run:
    """Gives the exit code of ``sonar-graph`` with these arguments."""
    return run_command


@pytest.fixture(scope="session")
def basin_content(tmp_path_factory) -> bytes:
    log = tmp_path_factory.mktemp("log") / "basin.mcap"
    write_log(log, simulate_basin(BasinOptions(seed=3, duration_s=120.0, laps=1)))
    return log.read_bytes()


@pytest.fixture
def basin(basin_content, tmp_path) -> Path:
    """A log of a short run in the basin."""
    log = tmp_path / "basin.mcap"
    log.write_bytes(basin_content)
    return log


@pytest.fixture
def dive(tmp_path) -> Path:
    """A log of 20 s, for commands that would do the same with any."""
    write_log(tmp_path / "dive.mcap", small_world())
    return tmp_path / "dive.mcap"


@pytest.fixture
def reply(run, capsys) -> Callable[..., Any]:
    """Gives what ``sonar-graph`` prints with these arguments, after its expected exit code."""

    def answer(code, *arguments):
        assert run(*arguments) == code
        return capsys.readouterr()

    return answer


@pytest.fixture
def refuse(reply, monkeypatch) -> Callable[[Path, str, str], None]:
    """Checks that a command, given in a folder, ends with code 2 and one line that names why, and writes no file."""

    def check(folder, command, expected):
        def written():
            stats = {path: path.stat() for path in folder.rglob("*") if path.is_file()}
            return {path: (one.st_size, one.st_mtime_ns) for path, one in stats.items()}

        before = written()
        monkeypatch.chdir(folder)
        said = reply(2, *command.split()).err
        assert re.fullmatch(r"sonar-graph: .+\n", said)
        assert re.search(expected, said), said
        assert written() == before

    return check
