"""Quotations on pages of theory: what scripts print, and lines of code."""

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

THEORY = Path(__file__).parents[1] / "docs" / "theory"


def drawn(script: str, picture: Path) -> str:
    """What a script prints; its picture has the shape of that which the page shows."""
    command = [sys.executable, "-W", "error", THEORY / script, picture]
    done = subprocess.run(
        command, capture_output=True, text=True, encoding="utf-8", timeout=120
    )
    assert done.returncode == 0, done.stderr
    shown = THEORY.parent / "images" / picture.name
    new, old = (cv2.imread(os.fspath(path)) for path in (picture, shown))
    assert new.shape == old.shape
    return done.stdout


def test_recognition_quotes_what_its_script_prints_and_draws(tmp_path):
    printed = drawn("recognition.py", tmp_path / "recognition.png")
    assert len(printed.splitlines()) == 13
    page = (THEORY / "recognition.md").read_text(encoding="utf-8")
    assert f"```\n{printed}```\n" in page


@pytest.mark.slow
def test_the_picture_of_scenes_is_what_its_script_draws(tmp_path):
    drawn("sonar_image.py", tmp_path / "scenes.png")


def test_lines_quoted_on_the_way_from_the_paper_stand_in_the_files():
    code = ""
    quoted = []
    for line in (THEORY / "from_the_paper.md").read_text(encoding="utf-8").splitlines():
        if named := re.findall(r"`((?:sonar_graph|baselines)/[a-z_/0-9]+[.]py)`", line):
            code = (THEORY.parents[1] / named[-1]).read_text(encoding="utf-8")
        if row := re.fullmatch(r"\| .* \| `(.*)` \|", line):
            quoted.append(row[1])
            assert row[1] in code
    assert len(quoted) >= 20
