from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sonar_graph.batch.recorded import ALL_LOGS, RESULTS, is_batch, read_batch
from sonar_graph.errors import EvaluationError
from tests.recorded_batches import LOGS, drawn_batch, with_failures, write_batch


def test_a_batch_is_read_as_it_was_written(tmp_path):
    batch = drawn_batch(3)
    back = read_batch(write_batch(batch, tmp_path))
    assert is_batch(tmp_path)
    assert (back.name, back.reference, back.metrics, back.suite) == (
        "drawn",
        "dead-reckoning",
        batch.metrics,
        batch.suite,
    )
    assert [(run.key, run.log, run.seed, run.contestant) for run in back.runs] == [
        (run.key, run.log, run.seed, run.contestant) for run in batch.runs
    ]
    assert all(back.runs[i].values == pytest.approx(batch.runs[i].values) for i in range(len(batch.runs)))


def test_pairs_have_the_same_log_and_seed(tmp_path):
    batch = drawn_batch(5)
    own, reference = batch.pairs(LOGS[0], "isam2", "causal.ate_se2_m")
    assert own.tolist() == [run.value("causal.ate_se2_m") for run in batch.group(LOGS[0], "isam2")]
    assert reference.tolist() == [run.value("causal.ate_se2_m") for run in batch.group(LOGS[0], "dead-reckoning")]
    assert len(batch.pairs(ALL_LOGS, "isam2", "causal.ate_se2_m")[0]) == 10


def test_a_run_that_did_not_end_has_no_value_whatever_is_recorded():
    assert math.isinf(replace(drawn_batch(2).runs[0], status="timeout").value("causal.ate_se2_m"))
    batch = with_failures(drawn_batch(3), "isam2", LOGS[0], 1)
    assert math.isinf(batch.group(LOGS[0], "isam2")[0].value("causal.ate_se2_m"))
    assert len(batch.pairs(LOGS[0], "isam2", "causal.ate_se2_m")[0]) == 3, "it is not left out"


def test_a_seed_that_the_reference_lacks_makes_no_pair():
    batch = drawn_batch(3)
    fewer = replace(batch, runs=[run for run in batch.runs if (run.contestant, run.seed) != ("dead-reckoning", 1)])
    assert len(fewer.pairs(LOGS[0], "isam2", "causal.ate_se2_m")[0]) == 2


def test_a_score_that_a_contestant_never_has_is_no_failure():
    batch = drawn_batch(3)
    assert not batch.is_asked(LOGS[0], "dead-reckoning", "landmarks.se2_m")
    assert batch.is_asked(LOGS[0], "isam2", "landmarks.se2_m")
    assert len(batch.pairs(LOGS[0], "isam2", "landmarks.se2_m")[0]) == 0


def test_a_contestant_that_never_ended_is_compared_as_one_that_failed():
    batch = drawn_batch(6)
    for log in LOGS:
        batch = with_failures(batch, "isam2", log, 6)
    own, reference = batch.pairs(LOGS[0], "isam2", "causal.ate_se2_m")
    assert np.isinf(own).tolist() == [True] * 6
    assert np.isfinite(reference).all()
    assert not batch.is_asked(LOGS[0], "isam2", "depth_m"), "nobody has it"
    assert not batch.is_asked(LOGS[0], "dead-reckoning", "landmarks.se2_m"), "it ended, and has no map"


def test_another_reference_can_be_chosen_and_an_unknown_one_is_refused(tmp_path):
    write_batch(drawn_batch(2), tmp_path)
    assert read_batch(tmp_path, "isam2").reference == "isam2"
    with pytest.raises(
        EvaluationError, match="no run of the reference 'isam3'; there are runs of: dead-reckoning, isam"
    ):
        read_batch(tmp_path, "isam3")


def test_what_is_no_batch_is_refused_with_the_file_at_fault(tmp_path):
    with pytest.raises(EvaluationError, match=r"no results\.parquet in it"):
        read_batch(tmp_path)
    (tmp_path / RESULTS).write_bytes(b"PAR1 but not really")
    with pytest.raises(EvaluationError, match="cannot be read as Parquet"):
        read_batch(tmp_path)
    pq.write_table(pa.table({"key": ["a"], "log": ["b"]}), tmp_path / RESULTS)
    with pytest.raises(EvaluationError, match="no column estimator, status"):
        read_batch(tmp_path)


def test_a_run_with_two_rows_is_refused(tmp_path):
    write_batch(drawn_batch(2), tmp_path)
    table = pq.read_table(tmp_path / RESULTS)
    pq.write_table(pa.concat_tables([table, table.slice(0, 1)]), tmp_path / RESULTS)
    with pytest.raises(EvaluationError, match="has more than one row"):
        read_batch(tmp_path)
