"""The table of a batch has a row for each planned run."""

from __future__ import annotations

import json

import pyarrow as pa
import pyarrow.parquet as pq

from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.result_table import COLUMNS, SUITE_METADATA, is_timing, write_results
from sonar_graph.batch.store import RunOutcome, Store
from sonar_graph.batch.suite import read_suite

from .conftest import BASIN, DEAD_RECKONING, HEADER


def test_table_has_a_row_for_each_planned_run_in_the_order_of_the_plan(write_suite, tmp_path):
    file = read_suite(write_suite(HEADER, BASIN, "seeds = 4\n", DEAD_RECKONING))
    runs, store = plan_runs(file), Store(tmp_path / "out")
    for run, error_m in ((runs[2], 0.3), (runs[0], 0.1)):
        store.write(run.key, RunOutcome({"status": "ok", "causal.ate_raw_m": error_m, "causal.nees_yaw_dof": 1}))
    store.write(runs[3].key, RunOutcome({"status": "timeout", "reason": "took longer than 1 s"}))
    table = pq.read_table(write_results(store, file.suite, runs))
    assert table.column_names == [*COLUMNS, "causal.ate_raw_m", "causal.nees_yaw_dof"]
    assert table["seed"].to_pylist() == [0, 1, 2, 3]
    assert table["causal.ate_raw_m"].to_pylist() == [0.1, None, 0.3, None]
    assert table["status"].to_pylist() == ["ok", "not run", "ok", "timeout"]
    assert table["log_file"].null_count == 1
    assert table["reason"].to_pylist()[1] == "not done when this table was written"
    assert table["sonar_graph"].null_count == 0
    assert table["causal.nees_yaw_dof"].type == pa.int64()
    assert json.loads(table["options"][0].as_py())["duration_s"] == 120
    assert (store.folder / table["log_file"][0].as_py()).is_file()
    about = json.loads(table.schema.metadata[SUITE_METADATA])
    assert about["reference"] == "dead-reckoning"


def test_table_of_a_batch_without_any_run_has_the_columns(write_suite, tmp_path):
    file = read_suite(write_suite())
    table = pq.read_table(write_results(Store(tmp_path), file.suite, plan_runs(file)))
    assert table.column_names == [*COLUMNS]
    assert table["status"].to_pylist() == ["not run"]


def test_times_and_memory_alone_may_differ_between_equal_runs():
    timings = {"wall_s", "cpu_s", "peak_memory_mb", "update_p99_ms", "time.total_s", "memory.peak_mb"}
    assert all(map(is_timing, timings))
    assert not any(map(is_timing, ("key", "causal.ate_raw_m", "scored_instants", "machine", "status")))
