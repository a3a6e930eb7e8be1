"""One run of a batch: sequence, estimator, scores; a folder as `compare` writes it, and a row.

The process in which runs are done, one after the other: ``python -m sonar_graph.batch.one_run``.

Planned runs and preparations come pickled on stdin, outcomes go pickled to what was stdout; whatever is printed, also
by native code, goes to stderr, which is the run's log. The process ends when stdin does, so it never outlives who
started it.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import math
import os
import pickle
import platform
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO

import numpy as np

from sonar_graph.batch.plan import sources_now, versions_of
from sonar_graph.batch.sources import fingerprint, read_source
from sonar_graph.batch.store import PlannedRun, Preparation, Row, RunOutcome
from sonar_graph.errors import BatchError, EstimatorError
from sonar_graph.estimator import load_estimator
from sonar_graph.evaluation import (
    LIBRARIES,
    Comparison,
    ErrorSeries,
    RunResult,
    describe_environment,
    judge,
    one_line,
    run_estimator,
    write_comparison,
)
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import LandmarkOptions, add_landmarks

KEPT_SEQUENCES = 3
"""Estimators of one log mostly follow each other in a process; one is that of the warm-up."""
WARM_UP_LOG = ("basin", {"duration_s": 120.0, "laps": 1, "wrong_id_rate": 0.1})
TWO_DIMENSIONS = 2
LOG = logging.getLogger(__name__)


@dataclass
class Clock:
    """Seconds by what they were spent on."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def on(self, what: str) -> Iterator[None]:
        """Count the time of the block, also where it ends with an error."""
        before = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[what] = time.perf_counter() - before


def perform(run: PlannedRun, folder: Path) -> Row:
    """Do one run and write what `compare` writes into a folder.

    Returns
    -------
    What was measured. A log that cannot be read and an estimator that fails are rows with a reason.

    Raises
    ------
    BatchError
        When this process has other versions or another source than those that the run was planned with, before the
        estimator is loaded or after the run, or its files have another content.
    OSError
        When the folder cannot be written: that is no result.
    """
    _check_versions(run)
    _load(run)
    row = _performed(run, folder)
    _check_source_now(run)
    return row


def warm_up(run: PlannedRun) -> None:
    """Do the run of an estimator on a short simulated log, so that what it needs is compiled and loaded.

    What fails here fails in the run itself, and is told there.
    """
    with suppress(Exception), tempfile.TemporaryDirectory(prefix="sonar-graph-warm-up-") as scratch:
        kind, options = WARM_UP_LOG
        content = fingerprint(kind, options)
        perform(replace(run, kind=kind, options=options, content=content, landmarks=None, seed=0), Path(scratch))


def _performed(run: PlannedRun, folder: Path) -> Row:
    clock, cpu_s = Clock(), time.process_time()
    try:
        comparison = _compared(run, clock)
    except BatchError:
        raise
    except Exception as error:  # a log or a simulator may fail in any way, and the other runs still go on
        LOG.exception("run %s", run.key)
        stage = "while judging" if "estimate_s" in clock.seconds else "while reading or simulating the log"
        return _failed(f"{stage}: {one_line(error)}") | _spent(clock, cpu_s)
    write_comparison(comparison, folder)
    return measured(comparison) | _spent(clock, cpu_s)


def _check_versions(run: PlannedRun) -> None:
    here = versions_of(run.estimator)
    if differing := [name for name in sorted(here | run.versions) if here.get(name) != run.versions.get(name)]:
        raise BatchError(
            f"a worker has {_told(here, differing)}, planned with {_told(run.versions, differing)}; "
            "install the same everywhere and start the workers anew"
        )


def _load(run: PlannedRun) -> None:
    """Import the estimator between two looks at its source; one that cannot be loaded fails later, with the reason."""
    if run.versions["estimator_target"].partition(":")[0] not in sys.modules:
        with suppress(EstimatorError):
            load_estimator(run.estimator)


def _check_source_now(run: PlannedRun) -> None:
    """Modules may be imported as late as during the run: what they were is known only if nothing changed."""
    now = sources_now(run.versions["estimator_target"])
    if differing := [name for name in sorted(now) if now[name] != run.versions.get(name)]:
        raise BatchError(
            f"the code changed during a run: {_told(now, differing)}, planned with {_told(run.versions, differing)}; "
            "leave it alone while a batch runs, and start the workers anew"
        )


def _compared(run: PlannedRun, clock: Clock) -> Comparison:
    """The run as a comparison of one."""
    with clock.on("read_s"):
        sequence = _sequence(run.kind, _as_text(run.options), _as_text(run.content), run.seed, _as_text(run.landmarks))
        instants_ns = sequence.instants(run.rate_hz)
    with clock.on("estimate_s"):
        result = run_estimator(sequence, run.estimator, run.overrides, instants_ns=instants_ns)
    comparison = judge(sequence, instants_ns, [result])
    environment = comparison.environment | {"command": f"sonar-graph bench: run {run.key} of {run.suite}"}
    return replace(comparison, environment=environment)


@lru_cache(KEPT_SEQUENCES)
def _sequence(kind: str, options: str, content: str, seed: int | None, landmarks: str) -> Sequence:
    """The same object for the same arguments: estimators cannot change it.

    Raises
    ------
    BatchError
        When files are not, before or after they were read, what they were when the run was planned.
    """
    values = json.loads(options)
    _check_content(kind, values, content)
    sequence = read_source(kind, values, seed)
    _check_content(kind, values, content)
    placed = json.loads(landmarks)
    return sequence if placed is None else add_landmarks(sequence, LandmarkOptions(**(placed | {"seed": seed})))


def _check_content(kind: str, options: dict[str, Any], content: str) -> None:
    here, planned = fingerprint(kind, options), json.loads(content)
    if differing := [name for name in sorted(here | planned) if here.get(name) != planned.get(name)]:
        names = ", ".join(f"{name} {options.get(name, '')}".rstrip() for name in differing)
        raise BatchError(f"{platform.node()}: {names}: not what it was when the run was planned; start the batch anew")


def measured(comparison: Comparison) -> Row:
    """Scores and times of a comparison of one run, by column."""
    (run,) = comparison.runs
    row: Row = {key: score.value for key, score in comparison.scores[run.estimator].items()}
    row |= _versions(comparison.environment) | _state(run)
    row["scored_instants"] = 0
    for kind, errors in comparison.errors.get(run.estimator, {}).items():
        row["scored_instants"] = len(errors.stamps_ns)
        row |= _consistency(kind, errors)
    row |= {f"{key}_dof": TWO_DIMENSIONS for key in ("landmarks.nees", "detections.nis") if key in row}
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()}


def _state(run: RunResult) -> Row:
    """Status and times."""
    row: Row = {"status": run.status, "reason": run.reason}
    if run.status == "failed":
        out_of_memory = "MemoryError" in run.reason or "bad_alloc" in run.reason
        return row | {"status": "memory" if out_of_memory else "failed"}
    p50, p99 = np.quantile(run.update_s * 1e3, [0.5, 0.99]).tolist()
    return row | {
        "peak_memory_mb": run.peak_memory_mb,
        "update_p50_ms": p50,
        "update_p99_ms": p99,
        "finish_s": run.finish_s,
    }


def _consistency(kind: str, errors: ErrorSeries) -> Row:
    """NEES at the last instant, per degree of freedom, and the degrees of freedom of all NEES columns.

    Over the seeds of one simulated run these values are independent, so their average has a chi-square band; an average
    over the instants of one run has none.
    """
    row: Row = {}
    for key, nees, dof in (("position", errors.nees_position, errors.position_dof), ("yaw", errors.nees_yaw, 1)):
        row[f"{kind}.nees_{key}_end"] = float(nees[-1] / dof)
        row |= {f"{kind}.nees_{key}_dof": dof, f"{kind}.nees_{key}_end_dof": dof}
    return row


def _failed(reason: str) -> Row:
    return {**_versions(describe_environment()), "status": "failed", "reason": reason, "scored_instants": 0}


def _versions(environment: dict[str, str]) -> Row:
    return {key: environment[key] for key in ("sonar_graph", *LIBRARIES, "python", "machine")}


def _spent(clock: Clock, cpu_before_s: float) -> Row:
    return {**clock.seconds, "cpu_s": time.process_time() - cpu_before_s}


def _as_text(values: dict[str, Any] | None) -> str:
    return json.dumps(values, sort_keys=True)


def _told(versions: dict[str, str], names: list[str]) -> str:
    return ", ".join(f"{name} {versions.get(name, 'missing')}" for name in names)


READY = "ready"


def main() -> None:
    """Do runs until there are no more."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    faulthandler.enable()
    logging.basicConfig(stream=sys.stderr, level=logging.INFO)
    requests: SimpleQueue[PlannedRun | Preparation] = SimpleQueue()

    threading.Thread(target=_listen, args=(sys.stdin.buffer, requests), daemon=True).start()
    _answer(answers, READY)
    while True:
        request = requests.get()
        try:
            _answer(answers, _prepared(request) if isinstance(request, Preparation) else _outcome(request))
        except Exception as error:  # told to who waits for the answer
            _answer(answers, error)


def _outcome(run: PlannedRun) -> RunOutcome:

    with tempfile.TemporaryDirectory(prefix="sonar-graph-run-") as scratch:
        folder = Path(scratch)
        row = perform(run, folder)
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        return RunOutcome(row, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths})


def _prepared(preparation: Preparation) -> str:

    warm_up(preparation.run)
    return READY


def _listen(source: BinaryIO, requests: SimpleQueue[PlannedRun | Preparation]) -> None:
    with contextlib.suppress(EOFError, OSError):
        while True:
            requests.put(pickle.load(source))
    os._exit(0)


def _answer(answers: BinaryIO, content: object) -> None:
    pickle.dump(content, answers)
    answers.flush()


if __name__ == "__main__":
    main()
