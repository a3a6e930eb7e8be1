"""A pool run with a Doppler log of unknown axes: the commands and the file of docs/theory/datasets.md, and no code."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sonar_graph.cli.main import app

PAGE = Path(__file__).parents[2] / "docs" / "theory" / "datasets.md"
FOLDER = os.environ.get("SONAR_GRAPH_DATA")


@pytest.mark.slow
@pytest.mark.recording
@pytest.mark.skipif(not FOLDER, reason="SONAR_GRAPH_DATA is not set")
def test_the_documented_commands_convert_inspect_and_reckon(tmp_path, monkeypatch):
    section = PAGE.read_text(encoding="utf-8").split("## SONIA")[1]
    (toml,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    (tmp_path / "sonia.toml").write_text(toml, encoding="utf-8")
    (tmp_path / "sonia_imu_dvl.bag").symlink_to(Path(str(FOLDER)) / "bags" / "sonia_imu_dvl.bag")
    monkeypatch.chdir(tmp_path)
    printed = []
    for line in re.findall(r"^    sonar-graph (.*)$", section, re.MULTILINE):
        result = CliRunner().invoke(app, line.split())
        assert result.exit_code == 0, result.output
        printed.append(result.output)
    assert len(printed) == 3
    assert re.search(r"DVL against IMU: time offset [+-]0\.\d+ ± 0\.\d+ s: no need to act", printed[1])
    path = np.loadtxt("sonia/runs/dead-reckoning/causal.tum")[:, 1:4]
    assert np.all(np.ptp(path, axis=0)[:2] < 5), "the vehicle stays in the pool"
    assert 35 < np.linalg.norm(np.diff(path, axis=0), axis=1).sum() < 50
