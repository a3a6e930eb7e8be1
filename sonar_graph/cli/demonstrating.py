"""``sonar-graph demo``: the experiment of the 2014 paper in short, from sonar images to the report."""

from __future__ import annotations

from pathlib import Path

import typer

from sonar_graph.cli.arguments import OutputFolder
from sonar_graph.cli.comparing import compare
from sonar_graph.cli.outputs import writable_folder, writable_log
from sonar_graph.cli.simulating import write_basin

LOG = "basin.mcap"
DEMO = {"duration_s": 390.0, "laps": 3, "imu": "mti1", "dvl": "explorer", "image": {}}
"""The three laps of the paper in less time; cheap sensors, so that dead reckoning drifts within minutes."""


def demo(output: OutputFolder = Path("demo")) -> None:
    """Repeat the 2014 paper's basin experiment in short: simulate sonar images, recognise landmarks, compare, report.

    Three laps in 390 s instead of 2039 s; the log takes about 90 MB.
    """
    from sonar_graph.simulation.basin import BasinOptions

    log = writable_log(writable_folder(output) / LOG)
    options = BasinOptions.model_validate(DEMO)
    typer.echo(f"Simulating {options.duration_s:g} s in a basin, {options.laps} laps, with sonar images: {log}")
    write_basin(log, options)
    typer.echo("Recognising landmarks in them, then running the estimators")
    compare(log, output)
