"""Arguments and options that several commands share.

Settings given on the command line or in a file: ``--set``, ``--topic``, ``--log-config``, ``--start``.

What commands say in the same way everywhere.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from sonar_graph.errors import CalibrationError, EstimatorError, EvaluationError, LogError
from sonar_graph.settings import nested

if TYPE_CHECKING:
    from sonar_graph.logs import PartialCalibration
    from sonar_graph.logs.adapters import LogConfig
    from sonar_graph.logs.mcap import TimeWindow
    from sonar_graph.sequence import Sequence


LogPath = Annotated[
    Path, typer.Argument(metavar="LOG", exists=True, dir_okay=False, readable=True, help="MCAP log to read.")
]
OutputLog = Annotated[Path, typer.Option("--output", "-o", metavar="OUT.mcap", help="MCAP log to write.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a file even where sonar-graph did not write it.")]
OutputFolder = Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write to.")]
CalibrationPath = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        metavar="FILE",
        exists=True,
        dir_okay=False,
        help="TOML or JSON file whose fields go before those of the log's own calibration and mountings.",
    ),
]
RateHz = Annotated[
    float,
    typer.Option(
        "--rate-hz",
        min=1e-3,
        max=1e3,
        help="How often every estimator is asked for its estimate; at most as often as the IMU measures.",
    ),
]
EstimatorSettings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME.SETTING=VALUE", help="Change a setting of an estimator; may be repeated."),
]
LogConfigPath = Annotated[
    Path | None,
    typer.Option(
        "--log-config",
        metavar="FILE.toml",
        exists=True,
        dir_okay=False,
        help="What the topics of a foreign log are: types, fields, units, axes. `inspect LOG --toml` prints one.",
    ),
]
TopicChoices = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="ROLE=TOPIC",
        help="Topic for a role, where inspect says that several fit or none; may be repeated. "
        "Roles: imu, dvl, depth, detections, truth, true_landmarks, sonar.",
    ),
]
StartTime = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="TIME",
        help="Leave out what was recorded before: seconds from the log's beginning (90.5), or a date and time, "
        "in UTC unless it says else (2026-05-01T12:30:00Z).",
    ),
]
EndTime = Annotated[
    str | None,
    typer.Option("--end", metavar="TIME", help="Leave out what was recorded then and later; written like --start."),
]
Salvage = Annotated[
    bool,
    typer.Option(
        "--salvage",
        help="Read what is whole of a log that is damaged in its middle, "
        "and say what is lost. One that is cut off is always read as far as it goes.",
    ),
]
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
    str | None,
    typer.Option(
        "--rule",
        help="How beliefs are updated: virtual-evidence (ours, the default) or jeffrey (the 2014 paper's equations).",
    ),
]
_SLACK = 1.01
"""For a rate that is counted, not stated."""


def parse_setting(text: str) -> tuple[str, Any]:
    """Name and value of ``name=value``; the value is read as TOML, and as plain text where it is none.

    Raises
    ------
    EstimatorError
        When there is no name or no ``=``.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise EstimatorError(f"--set {text}: expected name=value")
    return name.strip(), _plain_value(value.strip())


def nested_settings(texts: list[str]) -> dict[str, Any]:
    """Settings by name, from texts such as ``laps=2``; dots go into nested settings: ``image.noise_db=20``.

    Raises
    ------
    EstimatorError
        When there is no name or no ``=``, or one comes again with another value.
    """
    return nested(_each_once(texts))


def _plain_value(text: str) -> Any:
    if "\n" in text:
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def estimator_settings(texts: list[str], names: list[str]) -> dict[str, dict[str, Any]]:
    """Settings by estimator, from texts such as ``isam2.smoother.lag_s=20``; dots go into nested settings.

    Raises
    ------
    EstimatorError
        When a text does not begin with one of the estimators that run, or one setting comes again with another value.
    """
    given = _each_once(texts)
    for path in given:
        estimator, dot, setting = path.partition(".")
        if dot and estimator not in names:
            raise EstimatorError(f"--set {path}: {estimator} is not among the estimators that run: {', '.join(names)}")
        if not dot or not all(setting.split(".")):
            raise EstimatorError(f"--set {path}: expected ESTIMATOR.setting=value with one of {', '.join(names)}")
    return nested(given)


def _each_once(texts: list[str]) -> dict[str, Any]:
    """Values by the names before ``=``; one name may come again only with the same value."""
    settings: dict[str, Any] = {}
    for text in texts:
        path, value = parse_setting(text)
        if path in settings and settings[path] != value:
            raise EstimatorError(f"--set {text}: {path} is also set to {settings[path]}; give it once")
        settings[path] = value
    return settings


def topic_choices(texts: list[str]) -> dict[str, str]:
    """Topics by role, from texts such as ``imu=/imu/data``.

    Raises
    ------
    LogError
        When there is no role, no ``=`` or no topic.
    """
    choices = {}
    for text in texts:
        role, _, topic = text.partition("=")
        if not role or not topic:
            raise LogError(f"--topic {text}: expected ROLE=TOPIC such as imu=/imu/data")
        choices[role] = topic
    return choices


def check_rate(rate_hz: float, sequence: Sequence, default_hz: float) -> None:
    """Refuse to ask for estimates more often than the IMU measures; the default rate holds for any log.

    Raises
    ------
    EvaluationError
        Naming the highest rate.
    """
    stamps_ns = sequence.imu.stamps_ns
    imu_hz = len(stamps_ns) / max(float(stamps_ns[-1] - stamps_ns[0]) * 1e-9, 1.0)
    highest_hz = max(default_hz, imu_hz)
    if rate_hz > highest_hz * _SLACK:
        raise EvaluationError(
            f"--rate-hz {rate_hz:g}: the IMU of {sequence.name} measures {imu_hz:.4g} times a second; "
            f"give at most {highest_hz:.4g}"
        )


def read_config(path: Path | None) -> LogConfig | None:
    """What a TOML file says about a log's topics; None where no file is given.

    Raises
    ------
    LogError
        When the file is not TOML, or says something that cannot be.
    """
    from sonar_graph.logs.adapters import read_log_config

    return None if path is None else read_log_config(path)


def read_calibration(path: Path | None) -> PartialCalibration | None:
    """What a TOML or JSON file says of the calibration, before the log's own; None where no file is given.

    Raises
    ------
    CalibrationError
        When the file is neither TOML nor JSON, or a field does not fit.
    """
    from sonar_graph.logs import PartialCalibration

    if path is None:
        return None
    try:
        text = path.read_text(encoding="utf-8")
        values = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        kind = "JSON" if path.suffix == ".json" else "TOML"
        raise CalibrationError(f"{path}: not {kind}: {error}") from error
    if not isinstance(values, dict):
        raise CalibrationError(f"{path}: expected an object with sections such as imu, not {json.dumps(values):.40}")
    return PartialCalibration.parse(values, str(path))


def window_of(start: str | None, end: str | None) -> TimeWindow:
    """The part of a log that ``--start`` and ``--end`` name.

    Raises
    ------
    LogError
        When one is no time.
    """
    from sonar_graph.logs.mcap import Instant, TimeWindow

    return TimeWindow(Instant.parse(start) if start else None, Instant.parse(end) if end else None)


WIDTH_OF_A_FILE = 200


def examples(*commands: str) -> str:
    """Commands to copy, for the end of a help page; an empty line keeps each on a line of its own."""
    return "\n\n".join(["Examples:", *commands])


def answers() -> Console:
    """Where results go: stdout, and where that is no terminal, wide enough for lines to stay whole."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH_OF_A_FILE)
