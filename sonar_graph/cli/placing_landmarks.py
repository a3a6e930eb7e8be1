"""``sonar-graph simulate landmarks``: simulated landmarks on a recorded run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sonar_graph.cli.arguments import CalibrationPath, LogConfigPath, OutputLog, Overwrite, TopicChoices
from sonar_graph.cli.outputs import writable_log
from sonar_graph.cli.progress import working
from sonar_graph.cli.settings import nested_settings, read_calibration, read_config, topic_choices

if TYPE_CHECKING:
    from sonar_graph.simulation.landmarks_on_log import LandmarkOptions


def landmarks(
    log: Annotated[
        Path,
        typer.Option("--on", metavar="LOG", exists=True, dir_okay=False, help="MCAP log with a reference trajectory."),
    ],
    output: OutputLog,
    seed: Annotated[int | None, typer.Option(min=0, help="Same seed, same log. Default: 0.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other option of the landmarks; may be repeated."),
    ] = None,
    calibration: CalibrationPath = None,
    log_config: LogConfigPath = None,
    topics: TopicChoices = None,
    overwrite: Overwrite = False,
) -> None:
    """Landmarks along a recorded run, and the detections of a sonar; IMU and DVL stay as recorded."""
    from sonar_graph.logs.reading import read_sequence
    from sonar_graph.logs.writing import write_sequence
    from sonar_graph.simulation.landmarks_on_log import add_landmarks

    options = _landmark_options(({} if seed is None else {"seed": seed}) | nested_settings(settings or []))
    path = writable_log(output, log, overwrite=overwrite)
    with working("simulating"):
        recorded = read_sequence(
            log,
            calibration=read_calibration(calibration),
            config=read_config(log_config),
            topics=topic_choices(topics or []),
        )
        sequence = add_landmarks(recorded, options)
        write_sequence(path, sequence)
    detections, placed = sequence.detections, sequence.true_landmarks
    typer.echo(f"{len(placed or ())} landmarks, {len(detections or ())} detections\nLog: {path}")


def _landmark_options(values: dict[str, Any]) -> LandmarkOptions:
    from pydantic import ValidationError

    from sonar_graph.simulation.landmarks_on_log import LandmarkOptions

    try:
        return LandmarkOptions.model_validate(values)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise typer.BadParameter(f"{faults}. There are: {', '.join(LandmarkOptions.model_fields)}") from error
