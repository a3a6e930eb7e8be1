"""``bench``: suites are run, blessed and judged from the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sonar_graph.batch.gate import GateVerdict
from sonar_graph.cli.bench import verdict_lines

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


def test_mistake_in_a_suite_is_one_line_and_exit_code_2(run, tmp_path, capsys):
    suite = tmp_path / "suite.toml"
    for text, told in (
        ('name = "x"\nreference = "isam2"\nlogs = 3\n', "line 3: logs"),
        (
            'name = "x"\nreference = "b"\n[[logs]]\nname = "a"\nlog = "a.mcap"\n[[estimators]]\nname = "b"\n',
            "line 7: est",
        ),
    ):
        suite.write_text(text)
        assert run("bench", suite, "-o", tmp_path / "out") == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{suite}, {told}" in line
        assert not (tmp_path / "out").exists()


def test_missing_packages_are_named_with_how_to_get_them(run, tmp_path, capsys, monkeypatch):
    suite = tmp_path / "suite.toml"
    suite.touch()
    for name in [name for name in sys.modules if name.startswith("sonar_graph.batch")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run("bench", suite, "-o", tmp_path / "out") == 2
    assert "pip install 'sonar-graph[bench]'" in capsys.readouterr().err


def test_workers_and_scheduler_exclude_each_other(run, tmp_path, capsys):
    suite = tmp_path / "suite.toml"
    suite.touch()
    assert run("bench", suite, "-o", tmp_path, "--workers", 2, "--scheduler", "tcp://127.0.0.1:1") == 2
    assert "give one of them" in capsys.readouterr().err


@pytest.fixture
def folder(tmp_path) -> Path:
    return _write(tmp_path / "batch", 1.0)


@pytest.fixture
def incomplete(folder) -> Path:
    """The batch, had the last three runs not been done."""
    rows = pq.read_table(folder / "results.parquet").to_pylist()
    for row in rows[-3:]:
        row |= {"status": "not run", "causal.ate_se2_m": None}
    pq.write_table(pa.Table.from_pylist(rows), folder / "results.parquet")
    return folder


def _write(folder: Path, factor: float, seeds: int = 8) -> Path:
    rng = np.random.default_rng(0)
    rows = [
        {
            "key": f"{name}-{seed}",
            "log": "basin",
            "seed": seed,
            "estimator": name,
            "variant": "default",
            "status": "ok",
            "asked": json.dumps({"generator": "basin", "options": {}}),
            "causal.ate_se2_m": size_m * (factor if name == "isam2" else 1.0) * rng.lognormal(0, 0.2),
        }
        for seed in range(seeds)
        for name, size_m in (("dead-reckoning", 0.4), ("isam2", 0.1))
    ]
    folder.mkdir()
    pq.write_table(pa.Table.from_pylist(rows), folder / "results.parquet")
    return folder


def test_report_rebuilds_page_and_tables_of_a_batch(run, folder, capsys):
    assert run("report", folder) == 0
    assert capsys.readouterr().out == f"Report: {folder / 'report.html'}\n"
    assert (folder / "report.html").is_file()
    assert (folder / "tables" / "difference-ate-se2-m.tex").is_file()


def test_a_batch_passes_by_the_reference_that_it_became(run, folder, tmp_path, capsys):
    reference = tmp_path / "reference.json"
    assert run("bench", "bless", folder, reference) == 0
    assert json.loads(reference.read_text("utf-8"))["format"] == "sonar_graph batch reference 2"
    assert run("bench", "gate", folder, reference) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Reference: {reference} (16 runs, 0 of which did not end)",
        "Hardly different from the reference: dead-reckoning, isam2",
        f"Gate: passed, 16 runs held against {reference}",
    ]


def test_a_worse_batch_ends_with_one_and_says_what_is_worse(run, folder, tmp_path, capsys):
    reference = tmp_path / "reference.json"
    run("bench", "bless", folder, reference)
    assert run("bench", "gate", _write(tmp_path / "worse", 1.5), reference) == 1
    said = capsys.readouterr().out
    assert (
        "Worse: basin, isam2, causal.ate_se2_m: +50.0% in the mean of 8 cases, p = 0.0039 (of the whole batch)" in said
    )
    assert "Gate: failed" in said
    assert "Would have been found in four of five batches: one error larger on all logs by about" in said
    assert "Hardly different from the reference: dead-reckoning" in said


def test_only_a_strict_gate_fails_by_a_difference_that_no_test_can_judge(run, tmp_path, capsys):
    """Two seeds: twice the error is a line to look at."""
    reference = tmp_path / "reference.json"
    run("bench", "bless", _write(tmp_path / "before", 1.0, seeds=2), reference)
    after = _write(tmp_path / "after", 2.0, seeds=2)
    assert run("bench", "gate", after, reference) == 0
    assert "Look at: basin, isam2" in capsys.readouterr().out
    assert run("bench", "gate", after, reference, "--strict") == 1
    assert "Gate: failed, 4 runs" in capsys.readouterr().out
    assert run("bench", "gate", tmp_path / "before", reference, "--strict") == 0


def test_no_more_than_ten_runs_that_stand_out_are_printed():
    lines = verdict_lines(GateVerdict([], [f"run {n}" for n in range(12)], 24, {"isam2": 2}, {}, []))
    assert len([line for line in lines if line.startswith("Look at: run")]) == 10
    assert "Look at: 2 more such lines are not shown" in lines
    assert any("No test of errors: isam2 (2)" in line for line in lines)


def test_report_of_an_incomplete_batch_warns_and_is_written(run, incomplete, capsys):
    assert run("report", incomplete) == 0
    said = capsys.readouterr()
    assert said.out == f"Report: {incomplete / 'report.html'}\n"
    assert "Warning: This batch is not complete: 3 of 16 runs have not been done (dead-reckoning 1 of 8" in said.err
    assert "3 of 16 runs" in (incomplete / "report.html").read_text("utf-8")


def test_an_incomplete_batch_is_neither_blessed_nor_judged(run, incomplete, tmp_path, capsys):
    reference = tmp_path / "reference.json"
    assert run("bench", "bless", incomplete, reference) == 2
    assert not reference.exists()
    run("bench", "bless", _write(tmp_path / "whole", 1.0), reference)
    capsys.readouterr()
    assert run("bench", "gate", incomplete, reference) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "3 of 16 runs have not been done" in line
    assert line.endswith("give the bench command that began it again: it goes on from there")


def test_report_of_a_batch_that_was_killed_at_once_says_what_to_do(run, tmp_path, capsys):
    (tmp_path / ".lock").touch()
    assert run("report", tmp_path) == 2
    assert "before any of its runs was done; give the bench command that began it again" in capsys.readouterr().err


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
def test_a_default_that_got_worse_fails_the_gate_and_the_same_code_passes(tmp_path):
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
