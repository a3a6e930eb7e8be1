"""Suites of many runs: planned from a file, done by many processes, kept and compared."""

# fmt: off
from sonar_graph.batch.batch import Batch, run_suite
from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.recorded import ALL_LOGS, GOING_ON, RESULTS, RecordedBatch, RecordedRun, is_batch, read_batch
from sonar_graph.batch.result_table import KINDS, Metric, metrics_of
from sonar_graph.batch.statistics import (
    LEAST_PAIRS, Anees, PairedDifference, SampleSummary, anees, failure_rate, holm, paired, quantile, standard_error,
    summarise,
)
from sonar_graph.batch.store import Limits, Where
from sonar_graph.batch.suite import read_suite

__all__ = [
    "ALL_LOGS", "Anees", "Batch", "GOING_ON", "KINDS", "LEAST_PAIRS", "Limits", "Metric",
    "PairedDifference", "RESULTS", "RecordedBatch", "RecordedRun", "SampleSummary", "Where", "anees",
    "failure_rate", "holm", "is_batch", "metrics_of",
    "paired", "plan_runs", "quantile", "read_batch", "read_suite", "run_suite", "standard_error",
    "summarise",
]
