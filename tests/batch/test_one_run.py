from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.batch.catalogue import is_timing
from sonar_graph.batch.one_run import perform
from sonar_graph.batch.planned import PlannedRun
from sonar_graph.batch.results import COLUMNS
from sonar_graph.batch.suite import METRICS
from sonar_graph.errors import BatchError
from sonar_graph.evaluation.comparison import compare
from sonar_graph.evaluation.storage import read_comparison
from sonar_graph.simulation.basin import BasinOptions, simulate_basin

Planned = Callable[..., PlannedRun]


def test_scores_are_those_of_compare_bit_for_bit(planned: Planned, tmp_path: Path) -> None:
    row = perform(planned("isam2"), tmp_path / "run")
    comparison = compare(simulate_basin(BasinOptions(duration_s=120, laps=1)), ["isam2"])
    scores = {key: score.value for key, score in comparison.scores["isam2"].items()}
    assert set(scores) <= set(row)
    assert set(scores) <= set(METRICS)
    assert {k: row[k] for k in scores if not is_timing(k)} == {k: v for k, v in scores.items() if not is_timing(k)}
    assert set(row) - set(METRICS) - set(COLUMNS) == {name for name in row if name.endswith(("_dof", "_end"))}


def test_all_libraries_that_are_in_the_key_are_in_the_row(planned: Planned, tmp_path: Path) -> None:
    run = planned()
    row = perform(run, tmp_path / "run")
    libraries = {"gtsam", "numpy", "scipy", "numba"}
    assert {name: row[name] for name in libraries} == {name: run.versions[name] for name in libraries}
    assert libraries <= set(COLUMNS)


def test_nees_at_the_end_is_that_of_the_last_error(planned: Planned, tmp_path: Path) -> None:
    row = perform(planned(), tmp_path / "run")
    (errors,) = read_comparison(tmp_path / "run").errors.values()
    causal = errors["causal"]
    share = causal.position_m[-1] / causal.position_sigma_m[-1]
    assert causal.nees_position[-1] / 3 == row["causal.nees_position_end"]
    # The squares of the axes alone bound it from below, and the worst axis does not exceed all of them.
    assert row["causal.nees_position_end"] >= np.max(share**2) / 3 - 1e-12
    assert row["causal.nees_position_end_dof"] == row["causal.nees_position_dof"] == 3
    assert row["causal.nees_yaw_end_dof"] == 1
    assert row["scored_instants"] == len(causal.stamps_ns)


def test_same_run_gives_the_same_bits(planned: Planned, tmp_path: Path) -> None:
    first, second = (perform(planned(), tmp_path / name) for name in ("a", "b"))
    assert {k: v for k, v in first.items() if not is_timing(k)} == {k: v for k, v in second.items() if not is_timing(k)}
    other = perform(replace(planned(), seed=1), tmp_path / "c")
    assert other["causal.ate_raw_m"] != first["causal.ate_raw_m"]


def test_log_that_cannot_be_read_is_a_row_with_a_reason(planned: Planned, tmp_path: Path) -> None:
    log = tmp_path / "dive.mcap"
    log.write_bytes(b"not a log")
    row = perform(replace(planned(), kind="mcap", options={"log": str(log)}, seed=None), tmp_path / "run")
    assert row["status"] == "failed"
    assert str(row["reason"]).startswith("while reading or simulating the log: LogError: ")
    assert "dive.mcap" in str(row["reason"])


def test_estimator_that_fails_is_a_row_with_a_reason(planned: Planned, misbehaving: None, tmp_path: Path) -> None:
    row = perform(planned("prints"), tmp_path / "run")
    assert row["status"] == "failed"
    assert str(row["reason"]).endswith("RuntimeError: diverged")
    assert not [name for name in row if name.startswith("causal.")]


def test_other_versions_than_planned_are_no_result(planned: Planned, tmp_path: Path) -> None:
    run = planned()
    with pytest.raises(BatchError, match=r"a worker has gtsam 4\.3\S*, planned with gtsam 4\.2; install the same"):
        perform(replace(run, versions=run.versions | {"gtsam": "4.2"}), tmp_path / "run")
    with pytest.raises(BatchError, match=r"a worker has source \w+, planned with source changed; "):
        perform(replace(run, versions=run.versions | {"source": "changed"}), tmp_path / "run")


def test_folder_that_cannot_be_written_is_no_result(planned: Planned, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        perform(planned(), tmp_path / "file")
