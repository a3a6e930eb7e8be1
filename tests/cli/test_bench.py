"""``bench``: suites are run, blessed and judged from the command line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sonar_graph
from sonar_graph.batch.gate import GateVerdict
from sonar_graph.cli.arguments import printable
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


def test_missing_packages_are_named_with_how_to_get_them(
    run, tmp_path, capsys, monkeypatch
):
    (tmp_path / "suite.toml").touch()
    for name in [name for name in sys.modules if name.startswith("sonar_graph.batch")]:
        monkeypatch.delitem(sys.modules, name)
    # back to the modules that are known by now
    monkeypatch.setattr(sonar_graph, "batch", sonar_graph.batch)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run("bench", tmp_path / "suite.toml", "-o", tmp_path / "out") == 2
    assert "pip install 'sonar-graph[bench]'" in capsys.readouterr().err


def batch(folder: Path, factor: float = 1.0, seeds: int = 8, not_run: int = 0) -> Path:
    """A batch whose errors of isam2 are so many times as large, and whose last runs were not done."""
    rng = np.random.default_rng(0)
    rows = []
    for seed in range(seeds):
        for name, size_m in (("dead-reckoning", 0.4), ("isam2", 0.1 * factor)):
            row = {
                "key": f"{name}-{seed}",
                "log": "basin",
                "seed": seed,
                "estimator": name,
                "variant": "default",
            }
            row |= {
                "status": "ok",
                "asked": json.dumps({"generator": "basin", "options": {}}),
            }
            rows.append(row | {"causal.ate_se2_m": size_m * rng.lognormal(0, 0.2)})
    for row in rows[len(rows) - not_run :]:
        row |= {"status": "not run", "causal.ate_se2_m": None}
    folder.mkdir()
    with (folder / "results.parquet").open("wb") as stream:
        pq.write_table(pa.Table.from_pylist(rows), stream)
    return folder


def test_report_rebuilds_page_and_tables_of_a_batch_and_warns_of_an_incomplete_one(
    run, tmp_path, capsys
):
    for folder, warned in (
        (batch(tmp_path / "\udcff"), ""),
        (batch(tmp_path / "part", not_run=3), "3 of 16 runs"),
    ):
        assert run("report", folder) == 0
        said = capsys.readouterr()
        assert said.out == f"Report: {printable(str(folder / 'report.html'))}\n"
        assert (folder / "tables" / "difference-ate-se2-m.tex").is_file()
        assert warned in (folder / "report.html").read_text("utf-8")
    assert (
        "Warning: This batch is not complete: 3 of 16 runs have not been done (dead-reckoning 1 of 8"
        in said.err
    )


def test_a_batch_passes_by_the_reference_that_it_became_and_a_worse_one_fails(
    run, tmp_path, capsys
):
    reference, folder = tmp_path / "reference.json", batch(tmp_path / "batch")
    assert run("bench", "bless", folder, reference) == 0
    assert (
        json.loads(reference.read_text("utf-8"))["format"]
        == "sonar_graph batch reference 2"
    )
    assert run("bench", "gate", folder, reference) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Reference: {reference} (16 runs, 0 of which did not end)",
        "Hardly different from the reference: dead-reckoning, isam2",
        f"Gate: passed, 16 runs held against {reference}",
    ]
    assert run("bench", "gate", batch(tmp_path / "worse", 1.5), reference) == 1
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


def test_only_a_strict_gate_fails_by_a_difference_that_no_test_can_judge(
    run, tmp_path, capsys
):
    """Two seeds: twice the error is a line to look at."""
    reference, before = tmp_path / "reference.json", batch(tmp_path / "before", seeds=2)
    run("bench", "bless", before, reference)
    after = batch(tmp_path / "after", 2.0, seeds=2)
    assert run("bench", "gate", after, reference) == 0
    assert "Look at: basin, isam2" in capsys.readouterr().out
    assert run("bench", "gate", after, reference, "--strict") == 1
    assert "Gate: failed, 4 runs" in capsys.readouterr().out
    assert run("bench", "gate", before, reference, "--strict") == 0


def test_no_more_than_ten_runs_that_stand_out_are_printed():
    lines = verdict_lines(
        GateVerdict([], [f"run {n}" for n in range(12)], 24, {"isam2": 2}, {}, [])
    )
    assert len([line for line in lines if line.startswith("Look at: run")]) == 10
    assert "Look at: 2 more such lines are not shown" in lines
    assert any("No test of errors: isam2 (2)" in line for line in lines)


@pytest.mark.parametrize("content", ['{"a": 1}', "words", "[]"])
def test_a_json_file_of_others_is_replaced_only_when_asked_for(
    content, basin, run, tmp_path, capsys
):
    mine, folder = tmp_path / "mine.json", batch(tmp_path / "batch")
    mine.write_text(content)
    bless, calibrate = (
        ("bench", "bless", folder, mine),
        ("calibrate", basin, "-o", mine),
    )
    for command, what in ((calibrate, "a model"), (bless, "a reference")):
        assert run(*command) == 2
        said = f"holds something else than {what}; choose another name, or give --overwrite"
        assert said in capsys.readouterr().err
    assert mine.read_text() == content
    assert (
        run("bench", "bless", folder, mine, "--overwrite")
        == run("bench", "bless", folder, mine)
        == 0
    )


def test_an_incomplete_batch_is_neither_blessed_nor_judged(run, tmp_path, capsys):
    reference, incomplete = (
        tmp_path / "reference.json",
        batch(tmp_path / "incomplete", not_run=3),
    )
    assert run("bench", "bless", incomplete, reference) == 2
    assert not reference.exists()
    run("bench", "bless", batch(tmp_path / "whole"), reference)
    capsys.readouterr()
    assert run("bench", "gate", incomplete, reference) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "3 of 16 runs have not been done" in line
    assert line.endswith(
        "give the bench command that began it again: it goes on from there"
    )


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
    program = [
        sys.executable,
        "-c",
        "from sonar_graph.cli.main import main; main()",
        "bench",
    ]

    def bench(words: str, code: int) -> subprocess.CompletedProcess[str]:
        command = [*program, *words.split()]
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
    bench("suite.toml -o first --workers 1", 0)
    bench("bless first reference.json", 0)
    same = bench("suite.toml -o same --workers 1 --gate reference.json", 0)
    assert "Gate: passed, 6 runs" in same.stdout
    assert "Worse" not in same.stdout

    install(tmp_path / "site", 1.0)
    worse = bench("suite.toml -o worse --workers 1 --gate reference.json", 1)
    assert (
        "Worse: basin, noisy, causal.ate_se2_m, smoothed.ate_se2_m: +" in worse.stdout
    )
    assert "dead-reckoning, causal" not in worse.stdout

    (tmp_path / "suite.toml").write_text(
        SUITE.replace('"noisy"\n', '"noisy"\nparams = { lag_s = 2.0 }\n')
    )
    other = bench("suite.toml -o other --workers 1 --gate reference.json", 2)
    assert (
        "noisy, seed 0: settings.lag_s is 2.0, in the reference not given"
        in other.stderr
    )
