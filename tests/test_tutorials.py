"""The tutorials run as they stand, and what they print is true."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
TRUE_LANDMARKS = {1: (5.0, 0.0), 2: (7.0, -5.0), 3: (2.0, -7.0), 4: (0.0, -2.0)}


def run(name: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", TUTORIALS / name], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def number_after(text: str, pattern: str) -> float:
    found = re.search(pattern + r"\s*(-?[\d.]+(?:e-?\d+)?)", text)
    assert found, f"{pattern!r} is not in:\n{text}"
    return float(found[1])


def test_first_comparison_finds_the_landmarks_and_writes_a_page_about_every_estimator(tmp_path: Path) -> None:
    printed = run("01_first_comparison.py", tmp_path)
    for landmark, true in TRUE_LANDMARKS.items():
        row = re.search(rf"^ +{landmark} +(-?[\d.]+) +(-?[\d.]+) +([\d.]+)$", printed, re.MULTILINE)
        assert row, printed
        assert float(row[1]) == pytest.approx(true[0], abs=0.3)
        assert float(row[2]) == pytest.approx(true[1], abs=0.3)
    page = (tmp_path / "comparison" / "report.html").read_text(encoding="utf-8")
    for name in ("isam2", "ekf-slam", "dead-reckoning"):
        assert number_after(printed, rf"\n{name}") < 0.5
        assert name in page
        assert (tmp_path / "comparison" / "runs" / name / "trajectory.tum").is_file()


def test_library_page_prints_what_it_says(tmp_path: Path) -> None:
    printed = run("02_library.py", tmp_path)
    assert number_after(printed, r"in 10\.00 s:") == pytest.approx(0.39 * 10, abs=1.5)
    assert abs(number_after(printed, "turns it by")) == pytest.approx(1e-4 * 10, rel=0.01)
    assert "landmarks [1, 2, 3, 4]" in printed
    assert "120 poses" in printed or "119 poses" in printed
    correlation = number_after(printed, r"landmarks \[1, 2\]:")
    assert 0 < abs(correlation) < 1


def test_page_on_viewers_has_commands_and_a_program_that_work(tmp_path: Path) -> None:
    page = (TUTORIALS / "03_viewers.md").read_text(encoding="utf-8")
    here = Path(sys.executable).parent
    environment = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
    short = ["basin", "-o", "basin.mcap", "--duration-s", "120", "--laps", "1"]
    compared = ["basin.mcap", "-o", "comparison", "--estimators", "isam2"]
    for command in (["simulate", *short], ["compare", *compared]):
        subprocess.run([here / "sonar-graph", *command], cwd=tmp_path, check=True, capture_output=True)
    lines = re.findall(r"^    (evo_\w+ .*)$|`(evo_\w+ [^`]*)`", page, re.MULTILINE)
    assert len(lines) == 4
    for name, *words in ((indented or inline).split() for indented, inline in lines):
        command = [here / name, *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=120)
        assert done.returncode == 0, f"{name} {words}\n{done.stdout}{done.stderr}"
        assert "rmse" in done.stdout or "poses" in done.stdout
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    seen = re.findall(r"landmark (\d) at (-?[\d.]+), (-?[\d.]+)", done.stdout)
    assert seen
    for landmark, x_m, y_m in seen:
        assert (float(x_m), float(y_m)) == pytest.approx(TRUE_LANDMARKS[int(landmark)], abs=0.3)


def test_every_tutorial_is_listed_and_run() -> None:
    listed = (TUTORIALS / "README.md").read_text(encoding="utf-8")
    run_here = Path(__file__).read_text(encoding="utf-8")
    for script in TUTORIALS.glob("0*"):
        assert script.name in listed
        assert script.name in run_here
