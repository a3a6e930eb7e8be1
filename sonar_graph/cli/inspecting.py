"""``sonar-graph inspect``: what is in a log, and what would be used for what."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from sonar_graph.cli.arguments import LogPath

if TYPE_CHECKING:
    from sonar_graph.logs.inspection import LogSummary


def inspect(log: LogPath) -> None:
    """Say what is in a log: topics, rates, gaps, and which topic would be used for what and why."""
    from sonar_graph.logs.inspection import inspect_log

    _print_summary(Console(), inspect_log(log))


def _print_summary(console: Console, summary: LogSummary) -> None:
    console.print(summary)
