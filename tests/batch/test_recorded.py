"""The table of a batch has a row for each planned run, and is read as it was written."""

import json
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sonar_graph.batch import (
    ALL_LOGS,
    RESULTS,
    is_batch,
    plan_runs,
    read_batch,
    read_suite,
)
from sonar_graph.batch.result_table import (
    COLUMNS,
    is_timing,
    write_results,
)
from sonar_graph.batch.store import RunOutcome, Store
from sonar_graph.errors import EvaluationError
from tests.recorded_batches import LOGS, drawn_batch, write_batch

from .conftest import BASIN, DEAD_RECKONING, HEADER

ATE = "causal.ate_se2_m"
MAP = "landmarks.se2_m"


def test_a_batch_is_read_as_it_was_written_also_against_another_reference(tmp_path):
    batch = drawn_batch(3)
    back = read_batch(write_batch(batch, tmp_path))
    assert is_batch(tmp_path)
    for name in ("name", "reference", "metrics", "suite"):
        assert getattr(back, name) == getattr(batch, name)
    for own, run in zip(back.runs, batch.runs, strict=True):
        for name in ("key", "log", "seed", "contestant"):
            assert getattr(own, name) == getattr(run, name)
        assert own.values == pytest.approx(run.values)
    assert read_batch(tmp_path, "isam2").reference == "isam2"


def test_pairs_have_the_same_log_and_seed():
    batch = drawn_batch(5)
    names = "isam2", "dead-reckoning"
    for values, name in zip(batch.pairs(LOGS[0], "isam2", ATE), names, strict=True):
        assert values.tolist() == [run.value(ATE) for run in batch.group(LOGS[0], name)]
    assert len(batch.pairs(ALL_LOGS, "isam2", ATE)[0]) == 10
    lost = "dead-reckoning", 1
    runs = [run for run in batch.runs if (run.contestant, run.seed) != lost]
    fewer = replace(batch, runs=runs)
    assert len(fewer.pairs(LOGS[0], "isam2", ATE)[0]) == 4
    # a score that the reference never has is no failure
    assert batch.is_asked(LOGS[0], "isam2", MAP)
    assert len(batch.pairs(LOGS[0], "isam2", MAP)[0]) == 0


def test_what_is_no_batch_is_refused_with_the_file_at_fault(tmp_path):
    def refused(told, *reference):
        with pytest.raises(EvaluationError, match=told):
            read_batch(tmp_path, *reference)

    results = tmp_path / RESULTS
    refused(r"no results\.parquet in it")
    results.write_bytes(b"PAR1 but not really")
    refused("cannot be read as Parquet")
    pq.write_table(pa.table({"key": ["a"], "log": ["b"]}), results)
    refused("no column estimator, status")
    write_batch(drawn_batch(2), tmp_path)
    others = "there are runs of: dead-reckoning, isam"
    refused(f"no run of the reference 'isam3'; {others}", "isam3")
    table = pq.read_table(results)
    pq.write_table(pa.concat_tables([table, table.slice(0, 1)]), results)
    refused("has more than one row")


def test_table_has_a_row_for_each_planned_run_in_the_order_of_the_plan(
    write_suite, tmp_path
):
    file = read_suite(write_suite(HEADER, BASIN, "seeds = 4\n", DEAD_RECKONING))
    runs = plan_runs(file)
    store = Store(tmp_path / "out")
    ok = {"status": "ok", "causal.nees_yaw_dof": 1}
    for place, row in (
        (2, ok | {"causal.ate_raw_m": 0.3}),
        (0, ok | {"causal.ate_raw_m": 0.1}),
        (3, {"status": "timeout", "reason": "took longer than 1 s"}),
    ):
        store.write(runs[place].key, RunOutcome(row))
    table = pq.read_table(write_results(store, file.suite, runs))
    assert table.column_names == [*COLUMNS, "causal.ate_raw_m", "causal.nees_yaw_dof"]
    rows = table.to_pylist()
    found = [(row["seed"], row["status"], row["causal.ate_raw_m"]) for row in rows]
    ends = "ok", "not run", "ok", "timeout"
    assert found == [*zip(range(4), ends, (0.1, None, 0.3, None), strict=True)]
    assert rows[1]["reason"] == "not done when this table was written"
    assert all(row["sonar_graph"] for row in rows)
    assert table["causal.nees_yaw_dof"].type == pa.int64()
    assert json.loads(rows[0]["options"])["duration_s"] == 120
    for row in rows:
        written = row["log_file"] and (store.folder / row["log_file"]).is_file()
        assert written == (None if row["status"] == "not run" else True)
    assert read_batch(store.folder).reference == "dead-reckoning"


def test_table_of_a_batch_without_any_run_has_the_columns(write_suite, tmp_path):
    file = read_suite(write_suite())
    (tmp_path / "\udcff").mkdir()  # no name in UTF-8
    path = write_results(Store(tmp_path / "\udcff"), file.suite, plan_runs(file))
    table = pq.read_table(path.rename(tmp_path / path.name))
    assert table.column_names == [*COLUMNS]
    assert table["status"].to_pylist() == ["not run"]


def test_times_and_memory_alone_may_differ_between_equal_runs():
    timings = "wall_s", "cpu_s", "time.total_s", "memory.peak_mb"
    others = "key", "causal.ate_raw_m", "scored_instants", "machine", "status"
    assert [name for name in (*others, *timings) if is_timing(name)] == [*timings]
