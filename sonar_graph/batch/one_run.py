"""One run of a batch: sequence, estimator, scores; files as `compare` writes them, and a row.

``python -m sonar_graph.batch.one_run`` is the process that does runs, one after the other
(`sonar_graph.files.own_process`). Everything printed, also by native code, is the run's log.
"""

import json
import logging
import math
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from sonar_graph.batch.plan import versions_of
from sonar_graph.batch.result_table import FINDINGS
from sonar_graph.batch.sources import fingerprint, read_source, with_findings
from sonar_graph.batch.store import PlannedRun, Preparation, Row, RunOutcome
from sonar_graph.errors import BatchError
from sonar_graph.evaluation import (
    LIBRARIES,
    Comparison,
    describe_environment,
    judge,
    one_line,
    run_here,
    write_comparison,
)
from sonar_graph.files import LOCK, MANIFEST, READY, Tell, serve
from sonar_graph.sequence import Sequence

# sequences kept in memory, since estimators of one log mostly follow each other; one is that of the warm-up
KEPT_SEQUENCES = 3
WARM_UP_LOG = ("basin", {"duration_s": 120.0, "laps": 1, "wrong_id_rate": 0.1})
TWO_DIMENSIONS = 2
LOG = logging.getLogger(__name__)


@contextmanager
def timed(seconds: dict[str, float], activity: str) -> Iterator[None]:
    """Measure the seconds of the block, also if it ends with an error."""
    before = time.perf_counter()
    try:
        yield
    finally:
        seconds[activity] = time.perf_counter() - before


def perform(run: PlannedRun, folder: Path) -> Row:
    """Do one run and write what `compare` writes into a folder.

    Returns scores, times and versions. A log that cannot be read and an estimator that fails are rows with a reason.
    Raises `BatchError` when this process has other versions or another source than those that the run was planned with,
    or when its files have another content, and `OSError` when the folder cannot be written; neither is a result.
    """
    # a worker of a cluster may have another checkout
    here = versions_of(run.estimator)
    # results of other versions must not stand in one table with those of the plan
    if differing := _differing(here, run.versions):
        raise BatchError(
            f"a worker has {_told(here, differing)}, planned with {_told(run.versions, differing)}; "
            "install the same everywhere and start the workers anew"
        )
    seconds: dict[str, float] = {}
    # processor time is nearly free of the load of the machine, unlike the time of the clock
    cpu_before_s = time.process_time()
    try:
        with timed(seconds, "read_s"):
            source = run.kind, run.options, run.content, run.seed, run.landmarks
            sequence = _sequence(json.dumps(source, sort_keys=True))
            instants_ns = sequence.instants(run.rate_hz)
        with timed(seconds, "estimate_s"):
            # supervision has given this run a process of its own already
            result = run_here(sequence, run.estimator, run.overrides, instants_ns)
        comparison = judge(sequence, instants_ns, [result])
        command = {"command": f"sonar-graph bench: run {run.key} of {run.suite}"}
        comparison = replace(comparison, environment=comparison.environment | command)
    except BatchError:
        raise
    except Exception as error:  # a log or a simulator may fail in any way, and the other runs still go on
        LOG.exception("run %s", run.key)
        is_read = "estimate_s" in seconds
        stage = "judging" if is_read else "reading or simulating the log"
        reason = f"while {stage}: {one_line(error)}"
        row: Row = {"status": "failed", "reason": reason, "scored_instants": 0}
        row |= _versions(describe_environment())
    else:
        # a single run can be looked at as any comparison
        write_comparison(comparison, folder)
        row = measured(comparison)
        row |= {name: sequence.notes.get(f"log.{name}") for name in FINDINGS}
    row |= {**seconds, "cpu_s": time.process_time() - cpu_before_s}
    return row


def warm_up(run: PlannedRun) -> None:
    """Do the run of an estimator on a short simulated log, so that its code is compiled and loaded.

    A failure here happens again in the run itself and is reported there.
    """
    # written and thrown away: writing results loads code too
    with (
        suppress(Exception),
        tempfile.TemporaryDirectory(prefix="sonar-graph-warm-up-") as scratch,
    ):
        kind, options = WARM_UP_LOG
        of_basin = replace(run, kind=kind, options=options, landmarks=None, seed=0)
        content = fingerprint(kind, options)
        perform(replace(of_basin, content=content), Path(scratch))


@lru_cache(KEPT_SEQUENCES)
def _sequence(source: str) -> Sequence:
    """Sequence of a source: JSON of kind, options, content, seed and landmarks of a run.

    Equal sources give the same object, which must not be changed. Raises `BatchError` when files are not what they were
    when the run was planned.
    """
    kind, options, content, seed, landmarks = json.loads(source)
    sequence = read_source(kind, options, seed, landmarks)
    sequence = with_findings(kind, options, sequence)
    if differing := _differing(fingerprint(kind, options), content):
        names = ", ".join(
            f"{name} {options.get(name, '')}".rstrip() for name in differing
        )
        raise BatchError(
            f"{platform.node()}: {names}: not what it was when the run was planned; start the batch anew"
        )
    return sequence


def measured(comparison: Comparison) -> Row:
    """Scores, status and times of a comparison of one run, by column.

    NEES is also given at the last instant, per degree of freedom. Over the seeds of one simulated run these values are
    independent, so their average has a chi-square band; an average over the instants of one run has none.
    """
    (run,) = comparison.runs
    scores = comparison.scores[run.estimator]
    row: Row = {
        **{key: score.value for key, score in scores.items()},
        **_versions(comparison.environment),
        "status": run.status,
        "reason": run.reason,
        "withheld": "; ".join(run.withheld) or None,
    }
    if run.status == "failed":
        # numpy and GTSAM name it differently
        out_of_memory = "MemoryError" in run.reason or "bad_alloc" in run.reason
        row["status"] = "memory" if out_of_memory else "failed"
    row["scored_instants"] = 0
    # over seeds only the last instants are independent
    for kind, errors in comparison.errors.get(run.estimator, {}).items():
        row["scored_instants"] = len(errors.stamps_ns)
        for key, dof in (("position", errors.position_dof), ("yaw", 1)):
            name = f"{kind}.nees_{key}"
            nees = getattr(errors, f"nees_{key}")
            row |= {f"{name}_end": float(nees[-1] / dof), f"{name}_dof": dof}
            row[f"{name}_end_dof"] = dof
    planar = row.keys() & {"landmarks.nees", "detections.nis"}
    row |= {f"{key}_dof": TWO_DIMENSIONS for key in planar}
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def _versions(environment: dict[str, str]) -> Row:
    names = ("sonar_graph", *LIBRARIES, "python", "machine")
    return {name: environment[name] for name in names}


def _differing(here: dict[str, Any], planned: dict[str, Any]) -> list[str]:
    return [
        name for name in sorted(here | planned) if here.get(name) != planned.get(name)
    ]


def _told(versions: dict[str, str], names: list[str]) -> str:
    return ", ".join(f"{name} {versions.get(name, 'missing')}" for name in names)


def answer(request: PlannedRun | Preparation, _tell: Tell) -> object:
    """Outcome of a run, or `READY` after a warm-up."""
    if isinstance(request, Preparation):
        warm_up(request.run)
        return READY
    with tempfile.TemporaryDirectory(prefix="sonar-graph-run-") as scratch:
        folder = Path(scratch)
        row = perform(request, folder)
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file() and path.name not in (MANIFEST, LOCK)
        }
        return RunOutcome(row, files)


if __name__ == "__main__":
    logging.basicConfig(stream=sys.stderr, level=logging.INFO)
    serve(answer)
