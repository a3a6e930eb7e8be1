"""The script of the gate: batches become references and are judged."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import regression_gate

from tests.recorded_batches import written_batch

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

    def __init__(self, calibration, odometry, params=None):
        super().__init__(calibration, odometry)
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


def run(*words: object) -> int:
    return regression_gate.main([str(word) for word in words])


def test_a_batch_passes_by_its_own_reference(tmp_path, capsys):
    reference = tmp_path / "reference.json"
    folder = written_batch(tmp_path / "batch")
    assert run("bless", folder, reference) == 0
    assert (
        json.loads(reference.read_text("utf-8"))["format"]
        == "sonar_graph batch reference 2"
    )
    assert run("judge", folder, reference) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Reference: {reference} (16 runs, 0 of which did not end)",
        "Hardly different from the reference: dead-reckoning, isam2",
        f"Gate: passed, 16 runs held against {reference}",
    ]
    assert run("judge", written_batch(tmp_path / "worse", 1.5), reference) == 1
    said = capsys.readouterr().out
    assert (
        "Worse: basin, isam2, causal.ate_se2_m: +50.0% in the mean of 8 cases, p = 0.0039 (of the whole batch)"
        in said
    )
    assert "Gate: failed" in said
    assert (
        "Would have been found in four of five batches: one error larger on all logs by about"
        in said
    )
    assert "Hardly different from the reference: dead-reckoning" in said


def install(site: Path, default: float) -> None:
    info = site / "noisy-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: noisy\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[sonar_graph.estimators]\nnoisy = noisy_estimator:Noisy\n"
    )
    (site / "noisy_estimator.py").write_text(ESTIMATOR.format(default=default))


@pytest.mark.slow
def test_a_default_that_got_worse_fails_the_gate_and_the_same_code_passes(tmp_path):
    pytest.importorskip("dask", reason="needs sonar-graph[bench]")
    path = os.pathsep.join(
        [str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")]
    ).rstrip(os.pathsep)
    environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    bench = ["-c", "from sonar_graph.cli.main import main; main()", "bench"]
    script = [regression_gate.__file__]

    def outcome(
        program: list[str], words: str, code: int
    ) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, *program, *words.split()]
        done = subprocess.run(
            command,
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done

    install(tmp_path / "site", 0.0)
    (tmp_path / "suite.toml").write_text(SUITE)
    outcome(bench, "suite.toml -o first --workers 1", 0)
    outcome(script, "bless first reference.json", 0)
    outcome(bench, "suite.toml -o same --workers 1", 0)
    same = outcome(script, "judge same reference.json", 0)
    assert "Gate: passed, 6 runs" in same.stdout
    assert "Worse" not in same.stdout

    install(tmp_path / "site", 1.0)
    outcome(bench, "suite.toml -o worse --workers 1", 0)
    worse = outcome(script, "judge worse reference.json", 1)
    assert (
        "Worse: basin, noisy, causal.ate_se2_m, smoothed.ate_se2_m: +" in worse.stdout
    )
    assert "dead-reckoning, causal" not in worse.stdout

    (tmp_path / "suite.toml").write_text(
        SUITE.replace('"noisy"\n', '"noisy"\nparams = { lag_s = 2.0 }\n')
    )
    outcome(bench, "suite.toml -o other --workers 1", 0)
    other = outcome(script, "judge other reference.json", 2)
    assert (
        "noisy, seed 0: settings.lag_s is 2.0, in the reference not given"
        in other.stderr
    )
