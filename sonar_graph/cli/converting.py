"""``sonar-graph convert``: public data sets as MCAP logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonar_graph.cli.arguments import OutputLog
from sonar_graph.cli.outputs import writable_log
from sonar_graph.cli.progress import working
from sonar_graph.cli.texts import examples

if TYPE_CHECKING:
    from collections.abc import Callable

    from sonar_graph.sequence import Sequence

datasets = typer.Typer(
    name="convert",
    help="Convert a public data set to an MCAP log.",
    epilog=examples(
        "sonar-graph convert victoria-park -o victoria_park.mcap",
        "sonar-graph convert mrclam MRCLAM_Dataset6 --robot 3 -o mrclam_6_3.mcap",
    ),
)

DatasetFolder = Annotated[
    Path, typer.Argument(metavar="DATASET_DIR", exists=True, file_okay=False, help="Folder of the data set.")
]


@datasets.command(epilog=examples("sonar-graph convert mrclam MRCLAM_Dataset6 --robot 3 -o mrclam_6_3.mcap"))
def mrclam(
    dataset: DatasetFolder,
    output: OutputLog,
    robot: Annotated[int, typer.Option(help="Robot, 1 to 5.")],
) -> None:
    """UTIAS multi-robot data set: odometry, ranges and bearings to landmarks, motion-capture truth."""
    from sonar_graph.logs.converters.mrclam import read_mrclam

    _convert(lambda: read_mrclam(dataset, robot), output)


@datasets.command("victoria-park", epilog=examples("sonar-graph convert victoria-park -o victoria_park.mcap"))
def victoria_park(
    output: OutputLog,
    source: Annotated[
        Path | None,
        typer.Option("--file", exists=True, dir_okay=False, help="Default: the one which the gtsam package brings."),
    ] = None,
) -> None:
    """Victoria Park: a truck among trees, odometry and landmarks, no truth."""
    from sonar_graph.logs.converters.victoria_park import read_victoria_park

    _convert(lambda: read_victoria_park(source), output)


@datasets.command(epilog=examples("sonar-graph convert dlr DLR -o dlr.mcap"))
def dlr(
    dataset: Annotated[
        Path, typer.Argument(metavar="PATH", exists=True, help="Folder of the data set, or its map.circles file.")
    ],
    output: OutputLog,
) -> None:
    """DLR Spatial Cognition: a robot in an office building, artificial landmarks with IDs, no truth."""
    from sonar_graph.logs.converters.dlr import read_dlr

    _convert(lambda: read_dlr(dataset), output)


@datasets.command(epilog=examples("sonar-graph convert akit A-KIT --trajectory 1 -o akit_1.mcap"))
def akit(
    dataset: DatasetFolder,
    output: OutputLog,
    trajectory: Annotated[int, typer.Option(help="Trajectory, counted from 1.")],
) -> None:
    """A-KIT: an autonomous underwater vehicle at sea, fibre-optic IMU and DVL, navigation-system reference."""
    from sonar_graph.logs.converters.akit import read_akit

    _convert(lambda: read_akit(dataset, trajectory), output)


def _convert(read: Callable[[], Sequence], output: Path) -> None:
    from sonar_graph.logs.writing import write_sequence

    path = writable_log(output)
    with working("converting"):
        sequence = read()
        write_sequence(path, sequence)
    detections = len(sequence.detections) if sequence.detections else 0
    typer.echo(f"{sequence.name}: {sequence.duration_s:.1f} s, {detections} landmark detections\nLog: {path}")
