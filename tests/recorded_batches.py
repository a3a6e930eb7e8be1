"""Batches as `bench` would leave them, with numbers drawn from known distributions."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sonar_graph.batch import RESULTS, RecordedBatch, RecordedRun
from sonar_graph.batch.store import SUITE

METRICS = ["causal.ate_se2_m", "causal.yaw_rmse_rad", "landmarks.se2_m"]
ESTIMATORS = {"dead-reckoning": 0.4, "isam2": 0.1, "ekf-slam": 0.12}
ASKED = {
    "generator": "basin",
    "options": {"laps": 1},
    "landmarks": None,
    "settings": {},
    "rate_hz": 2.0,
    "files": {},
}
FIELDS = ("key", "log", "seed", "variant", "estimator", "status", "reason", "log_file")
LOGS = ("basin", "basin, wrong_id_rate=0.05")


def drawn_batch(seeds: int = 10, *, logs: tuple[str, ...] = LOGS) -> RecordedBatch:
    """Estimators with errors of known size on hard and easy seeds; ekf-slam reports variances four times too small."""
    rng = np.random.default_rng(3)
    runs = []
    for log in logs:
        for seed in range(seeds):
            hardness = rng.lognormal(0, 0.3)
            for name, size_m in ESTIMATORS.items():
                runs.append(_run(rng, log, seed, name, size_m * hardness))
    runs = [replace(run, place=place) for place, run in enumerate(runs)]
    return RecordedBatch(
        "drawn", runs, "dead-reckoning", METRICS, "Drawn, not run.", 'name = "drawn"\n'
    )


def failed(
    run: RecordedRun, status: str = "timeout", reason: str = "took longer than 60 s"
) -> RecordedRun:
    """The run, had it not ended."""
    return replace(run, status=status, reason=reason, values={})


def with_failures(
    batch: RecordedBatch, contestant: str, log: str, count: int
) -> RecordedBatch:
    """The batch, had the first runs of a group not ended."""
    gone = {id(run) for run in batch.group(log, contestant)[:count]}
    return replace(
        batch, runs=[failed(run) if id(run) in gone else run for run in batch.runs]
    )


def with_missing(
    batch: RecordedBatch, contestant: str, log: str, count: int
) -> RecordedBatch:
    """The batch, had the last runs of a group not been done."""
    group = batch.group(log, contestant)
    gone = {id(run) for run in group[len(group) - count :]}
    lacking = [
        replace(run, status="not run", values={}, log_file="")
        for run in batch.runs
        if id(run) in gone
    ]
    done = [run for run in batch.runs if id(run) not in gone]
    return replace(batch, runs=done, missing=[*batch.missing, *lacking])


def updated(
    batch: RecordedBatch,
    values: Callable[[RecordedRun], dict[str, float]],
    contestants: tuple[str, ...] = (),
) -> RecordedBatch:
    """The batch, had every run, or those of some contestants, these values too."""
    some = contestants or batch.contestants
    runs = [
        replace(run, values=run.values | values(run)) if run.contestant in some else run
        for run in batch.runs
    ]
    return replace(batch, runs=runs)


def changed(
    batch: RecordedBatch, contestant: str, column: str, factors: np.ndarray | float
) -> RecordedBatch:
    """The batch, had one column of a contestant been multiplied."""
    count = sum(run.contestant == contestant for run in batch.runs)
    own = iter(np.broadcast_to(factors, count).tolist())
    return updated(
        batch, lambda run: {column: run.values[column] * next(own)}, (contestant,)
    )


def without(batch: RecordedBatch, column: str, log: str | None = None) -> RecordedBatch:
    """The batch, had its runs, or those on one log, no column whose name has this part."""

    def without_column(run: RecordedRun) -> RecordedRun:
        return replace(
            run,
            values={
                key: value for key, value in run.values.items() if column not in key
            },
        )

    return replace(
        batch,
        runs=[
            without_column(run) if log in (None, run.log) else run for run in batch.runs
        ],
    )


def write_batch(batch: RecordedBatch, folder: Path) -> Path:
    """``results.parquet`` and ``suite.toml`` in a folder."""
    rows = [
        {
            **{name: getattr(run, name) for name in FIELDS},
            **{
                "suite": batch.name,
                "generator": "basin",
                "options": '{"laps": 1}',
                "params": "{}",
            },
            **{
                "asked": run.texts["asked"],
                "sonar_graph": "0.1",
                "machine": "Linux, 4 processors",
            },
            **{
                key: run.values.get(key)
                for key in (batch.runs or batch.missing)[-1].values
            },
        }
        for run in sorted([*batch.runs, *batch.missing], key=lambda run: run.place)
    ]
    about = {"name": batch.name, "reference": batch.reference, "metrics": batch.metrics}
    table = pa.Table.from_pylist(rows).replace_schema_metadata(
        {b"sonar_graph.suite": json.dumps(about).encode()}
    )
    folder.mkdir(exist_ok=True)
    pq.write_table(table, folder / RESULTS)
    (folder / SUITE).write_text(batch.suite, "utf-8")
    return folder


def _run(
    rng: np.random.Generator, log: str, seed: int, name: str, error_m: float
) -> RecordedRun:
    causal_m = error_m * rng.lognormal(0, 0.1)
    smoothed_m = 0.6 * error_m * rng.lognormal(0, 0.1)
    values = {
        "causal.ate_se2_m": causal_m,
        "smoothed.ate_se2_m": smoothed_m,
        "causal.yaw_rmse_rad": 0.1 * causal_m,
    }
    values |= {"smoothed.yaw_rmse_rad": 0.1 * smoothed_m}
    if name != "dead-reckoning":
        values["landmarks.se2_m"] = 0.5 * causal_m
    scale = 4.0 if name == "ekf-slam" else 1.0
    for kind in ("causal", "smoothed"):
        for what, dof in (("position", 2), ("yaw", 1)):
            key = f"{kind}.nees_{what}"
            values |= {
                key: scale * rng.chisquare(20) / 20,
                f"{key}_end": scale * rng.chisquare(dof) / dof,
            }
            values[f"{key}_end_dof"] = float(dof)
    values |= {
        "time.update_median_ms": 1.0 + rng.random(),
        "time.update_p99_ms": 4.0 + rng.random(),
        "wall_s": 3.0,
        "cpu_s": 2.9,
    }
    values["memory.peak_mb"] = 20.0
    key = f"{name}-{seed}-{len(log)}"
    texts = {"asked": json.dumps(ASKED)}
    return RecordedRun(
        key, log, seed, name, "default", "ok", "", f"runs/{key}/log.txt", texts, values
    )


def written_batch(
    folder: Path, factor: float = 1.0, seeds: int = 8, not_run: int = 0
) -> Path:
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
