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
from sonar_graph.cli.progress import working
from sonar_graph.errors import BatchError

if TYPE_CHECKING:
    from sonar_graph.batch.batch import Batch
    from sonar_graph.batch.execution import Where
    from sonar_graph.batch.planned import Limits

INTERRUPTED = 130
BatchFolder = Annotated[
    Path, typer.Argument(metavar="DIR", exists=True, file_okay=False, help="Folder that bench wrote.")
]
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
    reference: Annotated[
        Path | None,
        typer.Option(
            "--gate",
            metavar="REFERENCE.json",
            exists=True,
            dir_okay=False,
            help="What `bench bless` wrote: exit with 1 where accuracy or consistency got worse, and only then.",
        ),
    ] = None,
) -> None:
    """Run a suite: logs or simulations, seeds, estimators and variants. Runs that are done already are kept.

    Writes report.html, its tables, results.parquet with one row a run, and runs/KEY/ with what compare writes and the
    log of the run.
    """
    if workers is not None and scheduler is not None:
        raise typer.BadParameter("--workers is for this machine, --scheduler for a cluster; give one of them")
    with _opened(suite, output, timeout_s) as (batch, limits):
        if retry_failed:
            batch.discard_failed()
        counts = _run(batch, _where(workers, scheduler), limits)
        typer.echo(f"Runs: {_told(counts)}")
        typer.echo(f"Results: {output / 'results.parquet'}")
        typer.echo(f"Report: {write_report_of(output)}")
    if reference is not None:
        exit_by_gate(output, reference)
    elif set(counts) - {"ok"}:
        raise typer.Exit(1)


def exit_by_gate(folder: Path, reference: Path) -> None:
    """Print what got worse, and exit with 1 where anything did."""
    from sonar_graph.batch.gate import gate as judge
    from sonar_graph.batch.recorded import read_batch

    verdict = judge(read_batch(folder), reference)
    for worsening in verdict.worsenings:
        typer.echo(f"Worse: {worsening}")
    if verdict.new:
        typer.echo(f"Not judged: {len(verdict.new)} runs that the reference does not have, first {verdict.new[0]}")
    typer.echo(f"Gate: {'passed' if verdict.passed else 'failed'}, {verdict.compared} runs held against {reference}")
    if not verdict.passed:
        raise typer.Exit(1)


def write_report_of(folder: Path) -> Path:
    """Write the page and the tables of a batch from its results, and say where runs are missing in them."""
    from sonar_graph.batch.incomplete import missing_told
    from sonar_graph.batch.page import write_batch_report
    from sonar_graph.batch.recorded import read_batch

    with working("drawing"):
        batch = read_batch(folder)
        page = write_batch_report(batch, folder)
    for sentence in missing_told(batch):
        typer.echo(f"Warning: {sentence}", err=True)
    return page


@contextmanager
def _opened(suite: Path, output: Path, timeout_s: float | None) -> Iterator[tuple[Batch, Limits]]:
    try:
        from sonar_graph.batch.batch import Batch, limits_of
        from sonar_graph.batch.suite import read_suite
    except ModuleNotFoundError as error:
        raise BatchError(f"bench needs {error.name}, which is not installed: {INSTALL}") from error
    file = read_suite(suite)
    with Batch.opened(file, writable_folder(output)) as batch:
        yield batch, limits_of(file, timeout_s)


def _where(workers: int | None, scheduler: str | None) -> Where:
    from sonar_graph.batch.execution import Where

    return Where(workers, scheduler)


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
