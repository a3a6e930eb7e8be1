from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ESTIMATOR = """
from dataclasses import replace
import numpy as np
from baselines.dead_reckoning import DeadReckoning
from sonar_graph.calibration import Section


class Params(Section):
    velocity_noise_m_s: float = {default}
    lag_s: float = 1.0


class Noisy(DeadReckoning):
    Params = Params

    def __init__(self, calibration, params=None):
        super().__init__(calibration)
        self._sigma, self._rng = (params or Params()).velocity_noise_m_s, np.random.default_rng(0)

    def process(self, measurements):
        if (dvl := measurements.dvl) is not None:
            dvl = replace(dvl, velocity=dvl.velocity + self._rng.normal(0, self._sigma, dvl.velocity.shape))
        return super().process(replace(measurements, dvl=dvl))
"""
SUITE = """
name = "short"
reference = "dead-reckoning"
[[logs]]
name = "basin"
generator = "basin"
options = { duration_s = 120, laps = 1 }
seeds = 3
[[estimators]]
name = "noisy"
[[estimators]]
name = "dead-reckoning"
"""


def install(site: Path, default: float) -> None:
    info = site / "noisy-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: noisy\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[sonar_graph.estimators]\nnoisy = noisy_estimator:Noisy\n")
    (site / "noisy_estimator.py").write_text(ESTIMATOR.format(default=default))


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(folder / "site"), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    program = "from sonar_graph.cli.main import main; main()"
    return subprocess.run(
        [sys.executable, "-c", program, "bench", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.slow
def test_a_default_that_got_worse_fails_the_gate_and_the_same_code_passes(tmp_path: Path) -> None:
    pytest.importorskip("dask", reason="needs sonar-graph[bench]")
    install(tmp_path / "site", 0.0)
    (tmp_path / "suite.toml").write_text(SUITE)
    first = command(tmp_path, "suite.toml", "-o", "first", "--workers", "1")
    assert first.returncode == 0, first.stderr
    assert command(tmp_path, "bless", "first", "reference.json").returncode == 0

    same = command(tmp_path, "suite.toml", "-o", "same", "--workers", "1", "--gate", "reference.json")
    assert same.returncode == 0, same.stdout + same.stderr
    assert "Gate: passed, 6 runs" in same.stdout
    assert "Worse" not in same.stdout

    install(tmp_path / "site", 1.0)
    worse = command(tmp_path, "suite.toml", "-o", "worse", "--workers", "1", "--gate", "reference.json")
    assert worse.returncode == 1, worse.stdout + worse.stderr
    assert "Worse: basin, noisy, causal.ate_se2_m, smoothed.ate_se2_m: +" in worse.stdout
    assert "dead-reckoning, causal" not in worse.stdout

    (tmp_path / "suite.toml").write_text(SUITE.replace('"noisy"\n', '"noisy"\nparams = { lag_s = 2.0 }\n'))
    other = command(tmp_path, "suite.toml", "-o", "other", "--workers", "1", "--gate", "reference.json")
    assert other.returncode == 2
    assert "noisy, seed 0: settings.lag_s is 2.0, in the reference not given" in other.stderr
