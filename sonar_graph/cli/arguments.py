"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
