"""``sonar-graph recognise`` and ``calibrate``: landmarks in sonar images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonar_graph.cli.arguments import CalibrationPath, LogConfigPath, LogPath, OutputLog, Overwrite, TopicChoices
from sonar_graph.cli.outputs import writable_json, writable_log
from sonar_graph.cli.progress import progress_bars, working
from sonar_graph.cli.settings import read_calibration, read_config, topic_choices
from sonar_graph.cli.texts import answers
from sonar_graph.errors import LogError

if TYPE_CHECKING:
    from sonar_graph.evaluation.recognition import Recognition
    from sonar_graph.landmark_designs import LandmarkDesign
    from sonar_graph.sequence import Sequence
    from sonar_graph.sonar.recogniser import RecogniserParams

TOPIC = "/sonar/landmarks"

DesignsPath = Annotated[
    Path | None,
    typer.Option(
        "--designs",
        metavar="PATH",
        exists=True,
        help="Landmark designs: a TOML file, or a folder of such files. Default: those that ship.",
    ),
]
ModelPath = Annotated[
    Path | None,
    typer.Option(
        "--model",
        metavar="MODEL.json",
        exists=True,
        dir_okay=False,
        help="How often landmarks look like which, as calibrate measured it.",
    ),
]
RuleName = Annotated[
    str,
    typer.Option(help="How beliefs are updated: virtual-evidence (ours) or jeffrey (the 2014 paper's equations)."),
]


def recognise(
    log: LogPath,
    output: OutputLog,
    designs: DesignsPath = None,
    model: ModelPath = None,
    rule: RuleName = "virtual-evidence",
    calibration: CalibrationPath = None,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
    overwrite: Overwrite = False,
) -> None:
    """Recognise landmarks in a log's sonar images; write the log anew with the detections in it."""
    from sonar_graph.logs.amending import write_amended
    from sonar_graph.logs.encoding import detection_messages

    path = writable_log(output, log, overwrite=overwrite)
    choices, config = topic_choices(topics or []), read_config(log_config)
    sequence = _read(log, calibration, {r: t for r, t in choices.items() if r != "sonar"}, log_config)
    from sonar_graph.evaluation.recognising import recognise as recognise_log

    with progress_bars() as progress:
        found = recognise_log(
            log,
            sequence,
            topic=choices.get("sonar"),
            config=config,
            designs=_designs(designs),
            params=recogniser_params(model, rule),
            progress=lambda done: progress("recognising", done, 0),
        )
    if found is None:
        raise LogError(f"{log}: has no sonar images; `sonar-graph inspect {log}` lists what it has")
    with working("writing"):
        write_amended(log, path, detection_messages(TOPIC, found.detections) if found.detections else [])
    print_outcomes(found)
    typer.echo(f"Log: {path}")


def calibrate(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", exists=True, dir_okay=False, help="Logs with images and truth.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="MODEL.json", help="File to write.")],
    designs: DesignsPath = None,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
) -> None:
    """Measure how often landmarks look like which, on logs with sonar images whose truth is known."""
    from sonar_graph.evaluation.calibrating import calibrate as measure

    path = writable_json(output, logs)
    choices = topic_choices(topics or [])
    others = {role: topic for role, topic in choices.items() if role != "sonar"}
    with working("calibrating"):
        runs = [(log, _read(log, None, others, log_config)) for log in logs]
        measured = measure(runs, topic=choices.get("sonar"), config=read_config(log_config), designs=_designs(designs))
    path.write_text(measured.model_dump_json(indent=2) + "\n", encoding="utf-8")
    typer.echo(f"Model: {path}")


def recogniser_params(model: Path | None, rule: str) -> RecogniserParams:
    """Settings of the recogniser.

    Raises
    ------
    CalibrationError
        When the model's file is not one.
    """
    from pydantic import ValidationError

    from sonar_graph.sonar.beliefs import IdentityParams
    from sonar_graph.sonar.confusion import read_confusion
    from sonar_graph.sonar.recogniser import RecogniserParams

    try:
        identity = IdentityParams.model_validate({"rule": rule})
    except ValidationError as error:
        raise typer.BadParameter(f"--rule {rule}: expected virtual-evidence or jeffrey") from error
    return RecogniserParams(identity=identity, confusion=None if model is None else read_confusion(model))


def print_outcomes(found: Recognition) -> None:
    """What became of everything, on stdout."""
    out = answers()
    out.print(f"{found.frames} frames, {0 if found.detections is None else len(found.detections)} detections")
    for outcome, count in found.outcomes.most_common():
        out.print(f"  {count:6d}  {outcome}")


def _designs(path: Path | None) -> tuple[LandmarkDesign, ...] | None:
    from sonar_graph.landmark_designs import load_designs

    return None if path is None else load_designs(path)


def _read(log: Path, calibration: Path | None, topics: dict[str, str], log_config: Path | None) -> Sequence:
    from sonar_graph.logs.reading import read_sequence

    config = read_config(log_config)
    return read_sequence(log, calibration=read_calibration(calibration), topics=topics, config=config)
