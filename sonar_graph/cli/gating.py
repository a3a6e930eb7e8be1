"""``sonar-graph bench``: the group of its commands; ``bless`` a reference, and ``gate`` a batch by it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperGroup

from sonar_graph.cli.benching import BatchFolder, Strict, bench, exit_by_gate
from sonar_graph.cli.outputs import writable_json
from sonar_graph.cli.texts import examples

DEFAULT_COMMAND = "run"


class SuiteFirst(TyperGroup):
    """Commands of which `DEFAULT_COMMAND` need not be named: ``bench SUITE.toml`` is ``bench run SUITE.toml``."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """Put the name of the default command where none is given."""
        is_named = not args or args[0] in self.commands or args[0] in ctx.help_option_names
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
    ),
)(bench)


@benches.command(epilog=examples("sonar-graph bench bless results reference.json"))
def bless(
    folder: BatchFolder,
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE.json", help="File to write; replaced if it exists.")],
) -> None:
    """Make a batch the reference that later ones are held against."""
    from sonar_graph.batch.gate import bless as write_reference
    from sonar_graph.batch.recorded import read_batch

    batch = read_batch(folder)
    write_reference(batch, writable_json(reference, []))
    failed = sum(not run.ended for run in batch.runs)
    typer.echo(f"Reference: {reference} ({len(batch.runs)} runs, {failed} of which did not end)")


@benches.command(epilog=examples("sonar-graph bench gate results reference.json"))
def gate(
    folder: BatchFolder,
    reference: Annotated[
        Path, typer.Argument(metavar="REFERENCE.json", exists=True, dir_okay=False, help="What bless wrote.")
    ],
    is_strict: Strict = False,
) -> None:
    """Say whether accuracy or consistency got worse beyond noise; exit with 1 if so. Nothing is run."""
    exit_by_gate(folder, reference, is_strict=is_strict)
