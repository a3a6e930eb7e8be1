"""``sonar-graph recognise`` and ``calibrate``: landmarks in sonar images."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from sonar_graph.cli.arguments import (
    CalibrationPath,
    DesignsPath,
    LogConfigPath,
    LogPath,
    ModelPath,
    OutputLog,
    Overwrite,
    RuleName,
    Salvage,
    TopicChoices,
    answers,
    nested_settings,
    read_calibration,
    read_config,
    topic_choices,
)
from sonar_graph.cli.outputs import progress_bars, working, writable_json, writable_log
from sonar_graph.errors import LogError

if TYPE_CHECKING:
    from sonar_graph.calibration import Calibration, Section
    from sonar_graph.devices import LandmarkDesign
    from sonar_graph.logs import Amended
    from sonar_graph.recognition import LandmarkRecogniser, Recognition
    from sonar_graph.sequence import Sequence
    from sonar_graph.sonar import Confusion, Recogniser, RecogniserParams


_Kind = TypeVar("_Kind", bound="Section")
TOPIC = "/sonar/landmarks"
RECORD = "sonar_graph_recognition"
"""The metadata record with what became of every frame."""
MOST_WARNINGS_SHOWN = 10
FEW_TRACKS = 10
"""Of a class, below which calibrate cautions."""
RecogniserName = Annotated[
    Literal["designs", "actag"],
    typer.Option(
        "--recogniser", help="designs: ours; actag: AcTag's own detector, which sees AcTags only (extra actag)."
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A setting of the recogniser, such as identity.temper=0.5 (sections: detection, tracking, appearance, "
        "identity; a wrong name is answered with those that there are, and help(sonar_graph.sonar.recogniser) "
        "explains them), or of actag: family, tag_size_m (side of the inner square), bit_corrections, pixels_per_bit; "
        "may be repeated.",
    ),
]


def recognise(
    log: LogPath,
    output: OutputLog,
    designs: DesignsPath = None,
    model: ModelPath = None,
    rule: RuleName = None,
    recogniser: RecogniserName = "designs",
    settings: Settings = None,
    calibration: CalibrationPath = None,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
    salvage: Salvage = False,
    overwrite: Overwrite = False,
) -> None:
    """Recognise landmarks in a log's sonar images; write the log anew with the detections in it.

    Detections that an earlier recognise put into the log are replaced.
    """
    path = writable_log(output, log, overwrite=overwrite)
    choices, config = topic_choices(topics or []), read_config(log_config)
    others = {role: topic for role, topic in choices.items() if role != "sonar"}
    sequence = _read(log, calibration, others, log_config, salvage=salvage)
    from sonar_graph.recognition import no_images, recognise_images

    with progress_bars() as progress:
        found = recognise_images(
            log,
            sequence,
            topic=choices.get("sonar"),
            config=config,
            recogniser=_recogniser(recogniser, sequence.calibration, designs, model, rule, settings or []),
            salvage=salvage,
            progress=lambda done: progress("recognising", done, 0),
        )
    if found is None:
        raise LogError(no_images(log))
    with working("writing"):
        amended = _write(log, path, found, sequence.notes, salvage=salvage)
    print_outcomes(found, sequence)
    if designs is None and recogniser == "designs":
        warn_of_other_designs(sequence)
    for topic, count in amended.replaced.items():
        typer.echo(f"Replaced: {count} messages that the log had on {topic}")
    for note in amended.notes.values():
        typer.echo(f"Not copied: {note}")
    typer.echo(f"Log: {path}")


def calibrate(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", exists=True, dir_okay=False, help="Logs with images and truth.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="MODEL.json", help="File to write.")],
    designs: DesignsPath = None,
    settings: Settings = None,
    calibration: CalibrationPath = None,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
    salvage: Salvage = False,
) -> None:
    """Measure how often landmarks look like which, on logs with sonar images whose truth is known."""
    from sonar_graph.recognition import calibrate as measure

    path = writable_json(output, logs)
    _require_each_once(logs)
    choices, params = topic_choices(topics or []), recogniser_params(None, None, settings or [])
    others = {role: topic for role, topic in choices.items() if role != "sonar"}
    with working("calibrating"):
        runs = [(log, _read(log, calibration, others, log_config, salvage=salvage)) for log in logs]
        measured = measure(
            runs,
            topic=choices.get("sonar"),
            config=read_config(log_config),
            designs=_designs(designs),
            params=params,
            salvage=salvage,
        )
    path.write_text(measured.model_dump_json(indent=2) + "\n", encoding="utf-8")
    _print_model(measured)
    typer.echo(f"Model: {path}")


def _require_each_once(logs: list[Path]) -> None:
    """Refuse a log that is named twice: its frames would count twice.

    Raises
    ------
    LogError
        Naming the second.
    """
    for row, log in enumerate(logs):
        if any(log.samefile(other) for other in logs[:row]):
            raise LogError(f"{log}: is named twice, and would count twice; name each log once")


def _print_model(measured: Confusion) -> None:
    """What the model rests on, on stdout."""
    out, classes = answers(), [*(f"landmark {i}" for i in measured.ids), "no landmark"]
    few = []
    for name in classes:
        frames, tracks = (measured.provenance[f"{what} of {name}"] for what in ("frames", "tracks"))
        out.print(f"  {name}: {frames} frames, {tracks} tracks")
        few += [name] if int(tracks) < FEW_TRACKS else []
    if few:
        out.print(
            f"Caution: fewer than {FEW_TRACKS} tracks of {', '.join(few)}: frames of one track are alike; "
            "give more logs before the model is relied on"
        )


def _recogniser(
    name: str,
    calibration: Calibration,
    designs: Path | None,
    model: Path | None,
    rule: str | None,
    settings: list[str],
) -> LandmarkRecogniser:
    """The recogniser of that name.

    Raises
    ------
    CalibrationError
        When a file is not what it should be, or AcTag is asked for and not installed.
    """
    if name != "actag":
        return our_recogniser(calibration, designs, model, rule, settings)
    if designs is not None or model is not None or rule is not None:
        raise typer.BadParameter("--designs, --model and --rule are not for actag, which knows its own tags: use --set")
    from sonar_graph.sonar import AcTagRecogniser, AcTagSettings

    return AcTagRecogniser(calibration, _with_settings(AcTagSettings, nested_settings(settings), "actag"))


def our_recogniser(
    calibration: Calibration, designs: Path | None, model: Path | None, rule: str | None, settings: Iterable[str] = ()
) -> Recogniser:
    """The recogniser of designs.

    Raises
    ------
    CalibrationError
        When a file is not what it should be, or designs and model are of different landmarks.
    """
    from sonar_graph.sonar import Recogniser

    return Recogniser(calibration, _designs(designs), recogniser_params(model, rule, settings))


def recogniser_params(model: Path | None, rule: str | None, settings: Iterable[str] = ()) -> RecogniserParams:
    """Settings of our recogniser.

    Raises
    ------
    CalibrationError
        When the model's file is not one.
    """
    from sonar_graph.sonar import RecogniserParams, read_confusion

    values = nested_settings(list(settings))
    if rule is not None:
        if "rule" in (identity := values.setdefault("identity", {})):
            raise typer.BadParameter(f"--rule {rule} and --set identity.rule={identity['rule']}: give one of them")
        identity["rule"] = rule
    if model is not None:
        values["confusion"] = read_confusion(model)
    return _with_settings(RecogniserParams, values, "recogniser")


def _with_settings(kind: type[_Kind], values: dict[str, Any], whose: str) -> _Kind:
    from pydantic import ValidationError

    from sonar_graph.settings import faults_in

    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise typer.BadParameter(f"settings of the {whose}: {faults_in(error, kind)}") from error


def print_outcomes(found: Recognition, sequence: Sequence) -> None:
    """What became of everything, on stdout; warnings with seconds after the start."""
    out = answers()
    out.print(f"{found.frames} frames, {0 if found.detections is None else len(found.detections)} detections")
    for outcome, count in found.outcomes.most_common():
        out.print(f"  {count:6d}  {outcome}")
    for line in found.naming(sequence.true_landmarks):
        out.print(line)
    for stamp_ns, reason in found.warnings[:MOST_WARNINGS_SHOWN]:
        out.print(f"Warning: {(stamp_ns - sequence.start_ns) * 1e-9:.3f} s: {reason}")
    if (more := sum(found.warned().values()) - MOST_WARNINGS_SHOWN) > 0:
        out.print(f"Warning: {more} more such rows; with their stamps in the log's metadata record {RECORD}")


def warn_of_other_designs(sequence: Sequence) -> None:
    """Say so where a log's notes name designs that were not looked for, which ship with neither it nor us."""
    named = re.search(r'"designs":"([^"]+)"', sequence.notes.get("options", ""))
    if named is not None:
        answers().print(f"Warning: the log was made with the designs of {named[1]}; give them with --designs")


def _write(log: Path, path: Path, found: Recognition, notes: Mapping[str, str], *, salvage: bool) -> Amended:
    """The log with the detections, and with how they came about, and what it is not a copy of, in its notes."""
    from sonar_graph.logs import DETECTIONS, METADATA, detection_messages, with_notes, write_amended

    losses = {f"copied.{name}": f"{log.name}: {notes[name]}" for name in ("log.ending", "log.damage") if name in notes}
    record = with_notes(log, found.notes | losses)
    return write_amended(
        log,
        path,
        detection_messages(TOPIC, found.detections) if found.detections else [],
        anew={TOPIC: DETECTIONS},
        metadata={METADATA: record, RECORD: {"recognition": json.dumps(found.entry())}},
        salvage=salvage,
    )


def _designs(path: Path | None) -> tuple[LandmarkDesign, ...] | None:
    from sonar_graph.devices import load_designs

    return None if path is None else load_designs(path)


def _read(
    log: Path, calibration: Path | None, topics: dict[str, str], log_config: Path | None, *, salvage: bool = False
) -> Sequence:
    from sonar_graph.logs import read_log

    given, config = read_calibration(calibration), read_config(log_config)
    return read_log(log, calibration=given, topics=topics, config=config, salvage=salvage)
