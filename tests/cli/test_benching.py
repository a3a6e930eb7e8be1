from __future__ import annotations

import sys
from pathlib import Path

import pytest

from sonar_graph.cli.main import main


def code(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["bench", *arguments])
    return int(str(ended.value.code))


def test_mistake_in_a_suite_is_one_line_and_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = tmp_path / "suite.toml"
    for text, told in (
        ('name = "x"\nreference = "isam2"\nlogs = 3\n', "line 3: logs"),
        (
            'name = "x"\nreference = "b"\n[[logs]]\nname = "a"\nlog = "a.mcap"\n[[estimators]]\nname = "b"\n',
            "line 7: est",
        ),
    ):
        suite.write_text(text)
        assert code(str(suite), "-o", str(tmp_path / "out")) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{suite}, {told}" in line
        assert not (tmp_path / "out").exists()


def test_missing_packages_are_named_with_how_to_get_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = tmp_path / "suite.toml"
    suite.touch()
    for name in [name for name in sys.modules if name.startswith("sonar_graph.batch")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert code(str(suite), "-o", str(tmp_path / "out")) == 2
    assert "pip install 'sonar-graph[bench]'" in capsys.readouterr().err


def test_workers_and_scheduler_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = tmp_path / "suite.toml"
    suite.touch()
    assert code(str(suite), "-o", str(tmp_path), "--workers", "2", "--scheduler", "tcp://127.0.0.1:1") == 2
    assert "give one of them" in capsys.readouterr().err
