"""Parts of logs, and damaged ones."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

Run = Callable[..., int]


def test_start_and_end_cut_the_log(run: Run, basin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--estimator", "dead-reckoning", "--start", "30", "--end", "60")
    assert run("run", basin, "-o", tmp_path / "out", *options) == 0
    notes = json.loads((tmp_path / "out" / "comparison.json").read_text())["sequence"]["notes"]
    assert notes["log.part"] == "30.000 s to 60.000 s of the recording"
    capsys.readouterr()
    assert run("inspect", basin, "--start", "30", "--end", "60") == 0
    assert ", 30.0 s" in capsys.readouterr().out
    assert run("run", basin, "-o", tmp_path / "out", "--start", "1e6") == 2
    assert "nothing was recorded from 1000000.000 s to the end" in capsys.readouterr().err


def test_a_damaged_log_is_refused_with_the_option_that_reads_it(
    run: Run, basin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "damaged.mcap"
    content = bytearray(basin.read_bytes())
    content[len(content) // 3] ^= 1
    log.write_bytes(content)
    options = ("-o", tmp_path / "out", "--estimator", "dead-reckoning")
    assert run("run", log, *options) == 2
    assert re.search(r"is damaged: bytes .* is lost: .*--salvage", capsys.readouterr().err)
    assert run("run", log, *options, "--salvage") == 0
    notes = json.loads((tmp_path / "out" / "comparison.json").read_text())["sequence"]["notes"]
    assert "is lost" in notes["log.damage"]
