"""``sonar-graph bench``: run a suite on all cores or on a cluster."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sonar_graph.cli.arguments import (
    OutputFolder,
    Overwrite,
    argument,
    echo,
    option,
)
from sonar_graph.cli.outputs import progress_bars, working
from sonar_graph.files import INTERRUPTED

if TYPE_CHECKING:
    from sonar_graph.batch import RecordedRun

MOST_REASONS = 5


@dataclass(frozen=True)
class BenchOptions:
    """Options for where the runs of a suite are done."""

    workers: int | None = option(
        "Processes on this machine. Default: one a core.", min=1
    )
    scheduler: str | None = option(
        "A Dask scheduler that exists, such as tcp://10.0.0.5:8786, instead.",
        metavar="ADDRESS",
    )
    retry_failed: bool = option(
        "Do runs anew that failed, timed out or were killed.", False
    )
    overwrite: Overwrite = False


def bench(
    suite: Path = argument(
        "What is run: see benchmarks/suites.", "SUITE.toml", exists=True, dir_okay=False
    ),
    *,
    output: OutputFolder,
    options: BenchOptions,
) -> None:
    """Run a suite: logs or simulations, seeds, estimators and variants. Runs that are done already are kept.

    Writes report.html, its tables, results.parquet with one row a run, and runs/KEY/ with what compare writes and the
    log of the run.
    """
    # loads Dask, which the other commands do not need
    from sonar_graph.batch import run_suite

    try:
        with progress_bars() as show:

            def progress(done: int, planned: int, failed: int) -> None:
                remark = f"{done}/{planned}" + (f", {failed} failed" if failed else "")
                show("runs", done, planned, remark)

            batch = run_suite(suite, output, **vars(options), progress=progress)
    except KeyboardInterrupt as error:
        echo(f"sonar-graph: interrupted; {error}".rstrip("; "), err=True)
        # the ordinary way waits for threads, also for those of workers that are gone
        os._exit(INTERRUPTED)
    counts = Counter(run.status for run in batch.runs)
    # those that ended first
    told = sorted(counts.items(), key=lambda count: (count[0] != "ok", count[0]))
    echo(f"Runs: {', '.join(f'{number} {status}' for status, number in told)}")
    for line in reasons_told(batch.runs):
        echo(line, err=True)
    echo(f"Results: {output / 'results.parquet'}")
    echo(f"Report: {write_report_of(output, overwrite=options.overwrite)}")
    # results are written all the same; scripts see the failure by the exit code
    if set(counts) - {"ok"}:
        raise typer.Exit(1)


def reasons_told(runs: list[RecordedRun]) -> list[str]:
    """A line for each reason why runs did not end well, with their number, the most frequent first."""
    reasons = Counter(
        f"{run.status}: {run.reason}" for run in runs if run.status != "ok"
    )
    lines = [
        f"  {number} {reason}" for reason, number in reasons.most_common(MOST_REASONS)
    ]
    more = len(reasons) - MOST_REASONS
    return [*lines, f"  and {more} other reasons, in the report"] if more > 0 else lines


def write_report_of(folder: Path, *, overwrite: bool = False) -> Path:
    """Write the page and the tables of a batch from its results, and warn of runs that are missing."""
    from sonar_graph.batch import read_batch
    from sonar_graph.report import (
        lost_told,
        missing_told,
        sensors_told,
        withheld_told,
        write_batch_report,
    )

    with working("drawing"):
        # from the files alone, as `report` does later
        batch = read_batch(folder)
        page = write_batch_report(batch, folder, overwrite=overwrite)
    for sentence in [*missing_told(batch), *lost_told(batch)]:
        echo(f"Warning: {sentence}", err=True)
    for sentence in [*sensors_told(batch), *withheld_told(batch)]:
        echo(sentence, err=True)
    return page
