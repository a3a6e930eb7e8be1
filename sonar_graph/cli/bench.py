"""``sonar-graph bench``: ``run`` a suite on all cores or on a cluster, ``bless`` a reference, ``gate`` a batch."""

from __future__ import annotations

import math
import os
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

from sonar_graph.cli.arguments import OutputFolder, Overwrite, echo, examples
from sonar_graph.cli.outputs import progress_bars, working, writable_json
from sonar_graph.files import INTERRUPTED

if TYPE_CHECKING:
    from sonar_graph.batch import GateVerdict


SHOWN = 10
"""Most lines about runs that stand out; the report lists every run."""
BatchFolder = Annotated[
    Path,
    typer.Argument(
        metavar="DIR", exists=True, file_okay=False, help="Folder that bench wrote."
    ),
]
Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="Fail the gate by lines that say 'look at' too: these are no tests.",
    ),
]


def bench(
    suite: Annotated[
        Path,
        typer.Argument(
            metavar="SUITE.toml",
            exists=True,
            dir_okay=False,
            help="What is run: see benchmarks/suites.",
        ),
    ],
    output: OutputFolder,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes on this machine. Default: one a core."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A Dask scheduler that exists, such as tcp://10.0.0.5:8786, instead.",
        ),
    ] = None,
    timeout_s: Annotated[
        float | None,
        typer.Option(
            "--timeout",
            metavar="S",
            min=1e-3,
            help="End a run after so long. Default: the suite's.",
        ),
    ] = None,
    retry_failed: Annotated[
        bool,
        typer.Option(
            "--retry-failed", help="Do runs anew that failed, timed out or were killed."
        ),
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY",
            help="Do only the run of this key, which the report lists; can be repeated.",
        ),
    ] = None,
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
    is_strict: Strict = False,
    overwrite: Overwrite = False,
) -> None:
    """Run a suite: logs or simulations, seeds, estimators and variants. Runs that are done already are kept.

    Writes report.html, its tables, results.parquet with one row a run, and runs/KEY/ with what compare writes and the
    log of the run.
    """
    if is_strict and reference is None:
        raise typer.BadParameter("--strict is about the gate; give it with --gate")
    from sonar_graph.batch import run_suite

    try:
        with progress_bars() as show:

            def progress(done: int, planned: int, failed: int) -> None:
                show(
                    "runs",
                    done,
                    planned,
                    f"{done}/{planned}{f', {failed} failed' if failed else ''}",
                )

            batch = run_suite(
                suite,
                output,
                workers=workers,
                scheduler=scheduler,
                timeout_s=timeout_s,
                retry_failed=retry_failed,
                only=only or (),
                overwrite=overwrite,
                progress=progress,
                notice=partial(echo, err=True),
            )
    except KeyboardInterrupt as error:
        echo(f"sonar-graph: interrupted; {error}".rstrip("; "), err=True)
        # the ordinary way waits for threads, also for those of workers that are gone
        os._exit(INTERRUPTED)
    counts = Counter(run.status for run in batch.runs if not only or run.key in only)
    told = sorted(counts.items(), key=lambda count: (count[0] != "ok", count[0]))
    echo(f"Runs: {', '.join(f'{number} {status}' for status, number in told)}")
    echo(f"Results: {output / 'results.parquet'}")
    echo(f"Report: {write_report_of(output, overwrite=overwrite)}")
    if reference is not None:
        exit_by_gate(output, reference, is_strict=is_strict)
    elif set(counts) - {"ok"}:
        raise typer.Exit(1)


def exit_by_gate(folder: Path, reference: Path, *, is_strict: bool) -> None:
    """Print the verdict of the gate, and exit with 1 if it fails; if strict, also if there is anything to look at."""
    from sonar_graph.batch import gate as judge
    from sonar_graph.batch import read_batch

    with working("judging"):
        verdict = judge(read_batch(folder), reference)
    for line in verdict_lines(verdict):
        echo(line)
    is_passed = verdict.passed and not (is_strict and verdict.look_at)
    outcome = (
        "failed"
        if not is_passed
        else "passed"
        if verdict.has_test
        else "passed, without any test of errors"
    )
    echo(f"Gate: {outcome}, {verdict.compared} runs held against {reference}")
    if not is_passed:
        raise typer.Exit(1)


def verdict_lines(verdict: GateVerdict) -> list[str]:
    """Lines of the verdict: what got worse, what to look at, and what the tests could have found."""
    lines = [f"Worse: {worsening}" for worsening in verdict.worsenings]
    lines += [f"Look at: {line}" for line in verdict.look_at[:SHOWN]]
    if len(verdict.look_at) > SHOWN:
        lines.append(
            f"Look at: {len(verdict.look_at) - SHOWN} more such lines are not shown"
        )
    if verdict.new:
        lines.append(
            f"Not judged: {len(verdict.new)} runs that the reference does not have, first {verdict.new[0]}"
        )
    if verdict.untested:
        told = ", ".join(f"{name} ({verdict.cases[name]})" for name in verdict.untested)
        lines.append(
            f"No test of errors: {told}: it needs 3 cases, which are seeds, or logs without seeds"
        )
    if verdict.unmoved:
        lines.append(
            f"Hardly different from the reference: {', '.join(verdict.unmoved)}"
        )
    if verdict.detectable:
        sizes = []
        for name, share in verdict.detectable.items():
            size = (
                f"about {share:.0%}" if math.isfinite(share) else "more than ten times"
            )
            sizes.append(f"{size} ({name}, {verdict.cases[name]} cases)")
        told = ", ".join(sizes)
        lines.append(
            f"Would have been found in four of five batches: one error larger on all logs by {told}"
        )
    return lines


def write_report_of(folder: Path, *, overwrite: bool = False) -> Path:
    """Write the page and the tables of a batch from its results, and warn of runs that are missing."""
    from sonar_graph.batch import read_batch
    from sonar_graph.report import (
        lost_told,
        missing_told,
        sensors_told,
        write_batch_report,
    )

    with working("drawing"):
        batch = read_batch(folder)
        page = write_batch_report(batch, folder, overwrite=overwrite)
    for sentence in [*missing_told(batch), *lost_told(batch)]:
        echo(f"Warning: {sentence}", err=True)
    for sentence in sensors_told(batch):
        echo(sentence, err=True)
    return page


DEFAULT_COMMAND = "run"


class SuiteFirst(TyperGroup):
    """Group of commands with a default one: ``bench SUITE.toml`` is ``bench run SUITE.toml``."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """Insert the name of the default command if none is given."""
        is_named = (
            not args or args[0] in self.commands or args[0] in ctx.help_option_names
        )
        return super().parse_args(ctx, args if is_named else [DEFAULT_COMMAND, *args])


benches = typer.Typer(
    name="bench",
    cls=SuiteFirst,
    help="Run suites: many logs, seeds, estimators and variants; judge what came out. For the options of a run: "
    "sonar-graph bench run --help.",
    epilog=examples(
        "sonar-graph bench suite.toml -o results",
        "sonar-graph bench suite.toml -o results --gate reference.json",
        "sonar-graph bench bless results reference.json",
    ),
)
benches.command(
    DEFAULT_COMMAND,
    epilog=examples(
        "sonar-graph bench run suite.toml -o results",
        "sonar-graph bench run suite.toml -o results --workers 2 --timeout 600",
        "sonar-graph bench run suite.toml -o results --scheduler tcp://10.0.0.5:8786",
        "sonar-graph bench run suite.toml -o results --gate reference.json",
        "sonar-graph bench run suite.toml -o again --only 0123456789abcdef0123",
    ),
)(bench)


@benches.command(epilog=examples("sonar-graph bench bless results reference.json"))
def bless(
    folder: BatchFolder,
    reference: Annotated[
        Path,
        typer.Argument(
            metavar="REFERENCE.json",
            help="File to write; replaces an earlier reference.",
        ),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Make a batch the reference that later ones are held against."""
    from sonar_graph.batch import bless as write_reference
    from sonar_graph.batch import is_reference, read_batch

    batch = read_batch(folder)
    write_reference(
        batch,
        writable_json(reference, "a reference", [], is_reference, overwrite=overwrite),
    )
    failed = sum(not run.ended for run in batch.runs)
    echo(
        f"Reference: {reference} ({len(batch.runs)} runs, {failed} of which did not end)"
    )


@benches.command(epilog=examples("sonar-graph bench gate results reference.json"))
def gate(
    folder: BatchFolder,
    reference: Annotated[
        Path,
        typer.Argument(
            metavar="REFERENCE.json",
            exists=True,
            dir_okay=False,
            help="What bless wrote.",
        ),
    ],
    is_strict: Strict = False,
) -> None:
    """Say whether accuracy or consistency got worse beyond noise; exit with 1 if so. Nothing is run."""
    exit_by_gate(folder, reference, is_strict=is_strict)
