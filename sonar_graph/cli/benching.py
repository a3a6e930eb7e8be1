"""``sonar-graph bench``: a suite of runs, done on all cores or on a cluster."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sonar_graph.cli.arguments import OutputFolder
from sonar_graph.cli.outputs import writable_folder
from sonar_graph.errors import BatchError

if TYPE_CHECKING:
    from sonar_graph.batch.batch import Batch
    from sonar_graph.batch.execution import Where
    from sonar_graph.batch.planned import Limits

INTERRUPTED = 130
INSTALL = "pip install 'sonar-graph[bench]'"


def bench(
    suite: Annotated[
        Path,
        typer.Argument(metavar="SUITE.toml", exists=True, dir_okay=False, help="What is run: see benchmarks/suites."),
    ],
    output: OutputFolder,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes on this machine. Default: one a core.")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A Dask scheduler that exists, such as tcp://10.0.0.5:8786, instead."),
    ] = None,
    timeout_s: Annotated[
        float | None,
        typer.Option("--timeout", metavar="S", min=1e-3, help="End a run after so long. Default: the suite's."),
    ] = None,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Do runs anew that failed, timed out or were killed.")
    ] = False,
) -> None:
    """Run a suite: logs or simulations, seeds, estimators and variants. Runs that are done already are kept.

    Writes results.parquet, one row a run, and runs/KEY/ with what compare writes and the log of the run.
    """
    if workers is not None and scheduler is not None:
        raise typer.BadParameter("--workers is for this machine, --scheduler for a cluster; give one of them")
    batch, limits, where = _opened(suite, output, workers, scheduler, timeout_s)
    if retry_failed:
        batch.discard_failed()
    counts = _run(batch, where, limits)
    typer.echo(f"Runs: {_told(counts)}")
    typer.echo(f"Results: {output / 'results.parquet'}")
    if set(counts) - {"ok"}:
        raise typer.Exit(1)


def _opened(
    suite: Path, output: Path, workers: int | None, scheduler: str | None, timeout_s: float | None
) -> tuple[Batch, Limits, Where]:
    try:
        from sonar_graph.batch.batch import Batch, limits_of
        from sonar_graph.batch.execution import Where
        from sonar_graph.batch.suite import read_suite
    except ModuleNotFoundError as error:
        raise BatchError(f"bench needs {error.name}, which is not installed: {INSTALL}") from error
    file = read_suite(suite)
    batch = Batch.open(file, writable_folder(output))
    return batch, limits_of(file, timeout_s), Where(workers, scheduler)


def _run(batch: Batch, where: Where, limits: Limits) -> Counter[str]:
    """All runs; on Ctrl-C it says how to go on."""
    try:
        with _shown(batch) as progress:
            return batch.run(where, limits, progress)
    except KeyboardInterrupt:
        print(f"sonar-graph: interrupted; {batch.resuming()}", file=sys.stderr, flush=True)
        os._exit(INTERRUPTED)  # the ordinary way waits for threads, and those for workers that are gone


@contextmanager
def _shown(batch: Batch) -> Iterator[Callable[[Any, Any], None]]:
    """Runs done, failed, and the time that is left, for people only: silent where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[failed]}"))
    statuses = Counter(str(row["status"]) for row in batch.rows().values())
    with Progress(
        *columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal, transient=True
    ) as bar:
        task = bar.add_task("runs", total=len(batch.runs), completed=statuses.total(), failed=_failures(statuses))

        def show(_run: Any, outcome: Any) -> None:
            statuses[str(outcome.row["status"])] += 1
            bar.update(task, completed=statuses.total(), failed=_failures(statuses))

        yield show


def _failures(statuses: Counter[str]) -> str:
    failed = statuses.total() - statuses["ok"]
    return f"{failed} failed" if failed else ""


def _told(counts: Counter[str]) -> str:
    return ", ".join(
        f"{count} {status}" for status, count in sorted(counts.items(), key=lambda c: (c[0] != "ok", c[0]))
    )
