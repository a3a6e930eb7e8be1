"""Many runs from one file: logs or simulations, seeds, estimators and variants, each run kept once and never lost.

`suite` reads what is asked for, `plan` makes a list of runs of it, `one_run` does one of them in a process of its own
(`runner`), which `supervision` watches from a Dask worker (`execution`); `store` keeps what came out, and `results`
makes one table of it. Decisions: docs/design/0011-batch.md.
"""

# fmt: off
from sonar_graph.batch.batch import Batch, limits_of, terminations_as_interrupts
from sonar_graph.batch.cluster import Where
from sonar_graph.batch.gate import GateVerdict, bless, gate
from sonar_graph.batch.plan import plan_runs
from sonar_graph.batch.recorded import ALL_LOGS, GOING_ON, RESULTS, RecordedBatch, RecordedRun, is_batch, read_batch
from sonar_graph.batch.result_table import KINDS, Metric, estimate_sentences, metrics_of
from sonar_graph.batch.statistics import (
    LEAST_PAIRS, Anees, PairedDifference, SampleSummary, anees, failure_rate, holm, least_p, paired, quantile,
    quantile_error, standard_error, summarise,
)
from sonar_graph.batch.store import Limits
from sonar_graph.batch.suite import read_suite

__all__ = [
    "ALL_LOGS", "Anees", "Batch", "GOING_ON", "GateVerdict", "KINDS", "LEAST_PAIRS", "Limits", "Metric",
    "PairedDifference", "RESULTS", "RecordedBatch", "RecordedRun", "SampleSummary", "Where", "anees", "bless",
    "estimate_sentences", "failure_rate", "gate", "holm", "is_batch", "least_p", "limits_of", "metrics_of",
    "paired", "plan_runs", "quantile", "quantile_error", "read_batch", "read_suite", "standard_error", "summarise",
    "terminations_as_interrupts",
]
