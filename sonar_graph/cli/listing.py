"""``sonar-graph estimators``: what is installed, with every setting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer
from rich.markup import escape
from rich.table import Table

from sonar_graph.cli.texts import answers

if TYPE_CHECKING:
    from sonar_graph.calibration import Section


def estimators() -> None:
    """List the installed estimators with their settings, defaults and meaning."""
    from sonar_graph.errors import EstimatorError
    from sonar_graph.estimator import installed_estimators, load_estimator

    console = answers()
    failed = False
    for name, point in installed_estimators().items():
        try:
            settings = load_estimator(name).Params
        except EstimatorError as error:
            console.print(escape(str(error)), "", sep="\n", soft_wrap=True)
            failed = True
            continue
        console.print(f"[bold]{escape(name)}[/] ({escape(point.value)})", soft_wrap=True)
        console.print(_settings_table(settings) if settings.model_fields else "  no settings")
        console.print()
    if failed:
        raise typer.Exit(1)


def _settings_table(settings: type[Section]) -> Table:
    table = Table("setting", "default", "meaning", box=None, pad_edge=True)
    for name, field in settings.model_fields.items():
        default = field.get_default(call_default_factory=True)
        table.add_row(escape(name), escape(str(default)), escape(" ".join((field.description or "").split())))
    return table
