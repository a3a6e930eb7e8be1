"""The table of a batch: one row for each planned run, as Parquet.

Columns in this order: what was run, how it went, on what, how long it took, and then every score by its key, in
alphabetical order. What was not measured is null. A run that was not done has the status ``not run`` and no numbers.
The file's metadata say under ``sonar_graph.suite`` what the suite compares: its name, description, reference, metrics
and rate, as JSON.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sonar_graph.batch.catalogue import TIMINGS
from sonar_graph.batch.planned import NOT_RUN, PlannedRun, Row
from sonar_graph.batch.store import Store
from sonar_graph.batch.suite import Suite
from sonar_graph.evaluation.atomic import replacing

RESULTS = "results.parquet"
SUITE_METADATA = b"sonar_graph.suite"
TEXTS = ("key", "suite", "log", "generator", "options", "asked")
SETTINGS = ("variant", "params", "estimator", "status", "reason", "log_file")
VERSIONS = ("sonar_graph", "source", "estimator_source", "gtsam", "numpy", "scipy", "numba", "python", "machine")
COLUMNS: dict[str, pa.DataType] = {
    **dict.fromkeys(TEXTS, pa.string()),
    "seed": pa.int64(),
    **dict.fromkeys(SETTINGS, pa.string()),
    "rate_hz": pa.float64(),
    **dict.fromkeys(VERSIONS, pa.string()),
    **dict.fromkeys(TIMINGS, pa.float64()),
    "scored_instants": pa.int64(),
}


def write_results(store: Store, suite: Suite, runs: list[PlannedRun]) -> Path:
    """Write the table of all runs, also of those that are not done, in the order of the plan; whole or not at all."""
    rows = [_described(run) | _came_of(run, store) for run in runs]
    scores = sorted({name for row in rows for name in row} - set(COLUMNS))
    types = COLUMNS | {name: pa.int64() if name.endswith("_dof") else pa.float64() for name in scores}
    about = suite.model_dump(mode="json", include={"name", "description", "reference", "metrics", "rate_hz"})
    schema = pa.schema(types, metadata={SUITE_METADATA: json.dumps(about).encode()})
    path = store.folder / RESULTS
    with replacing(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), partial)
    return path


def _came_of(run: PlannedRun, store: Store) -> Row:
    """What was measured and where its log is, or that nothing was."""
    row = store.row(run.key)
    if row is None:
        return {"status": NOT_RUN, "reason": "not done when this table was written"}
    return {"log_file": store.log_file(run.key), **row}


def _described(run: PlannedRun) -> Row:
    """What was run; versions are told again by the run itself, where it came so far."""
    return {
        "key": run.key,
        "suite": run.suite,
        "log": run.log,
        "generator": run.kind,
        "options": _plain(run.options if run.landmarks is None else run.options | {"landmarks": run.landmarks}),
        "asked": _plain(run.asked),
        "seed": run.seed,
        "variant": run.variant,
        "params": _plain(run.params),
        "estimator": run.estimator,
        "rate_hz": run.rate_hz,
        **{name: number for name, number in run.versions.items() if name in VERSIONS},
    }


def _plain(values: dict[str, Any]) -> str:
    return json.dumps(values, sort_keys=True)
