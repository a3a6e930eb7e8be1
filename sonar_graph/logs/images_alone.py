"""Setup of a log with sonar images and without IMU or Doppler log: name, calibration and notes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.mcap import Keep, TimeWindow, scan
from sonar_graph.logs.reading import read_sonar_frames
from sonar_graph.logs.roles import choose_each
from sonar_graph.logs.vehicle_setup import (
    PartialCalibration,
    gathered,
    read_calibration,
    read_notes,
    recorded_name,
)

NAVIGATION = ("imu", "dvl")
"""Roles without which nothing is known of the motion but what images show."""


@dataclass(frozen=True, eq=False)
class ImagesAlone:
    """What goes with sonar images where no other sensor is used."""

    name: str
    calibration: Calibration
    start_ns: int
    """Stamp of the first frame."""
    notes: dict[str, str]


def lacking_navigation(
    path: Path, topics: Mapping[str, str], config: LogConfig | None = None, window: TimeWindow | None = None
) -> list[str]:
    """Roles of `NAVIGATION` that no topic of a log plays, where the user did not ask for one.

    Of several that fit, the user is asked when the log is read.
    """
    config = config or LogConfig()
    recording = scan(path, lambda _: Keep.NONE, window)
    wanted = {role: topic for role, topic in topics.items() if role in NAVIGATION}
    choices = choose_each(recording, wanted, config, NAVIGATION)
    asked = wanted.keys() | {role for role in NAVIGATION if {"topic", "type"} & config.table(role).keys()}
    return [role for role, choice in choices.items() if not (choice.topic or choice.candidates or role in asked)]


def read_images_alone(
    path: Path,
    *,
    calibration: PartialCalibration | None = None,
    topic: str | None = None,
    config: LogConfig | None = None,
    window: TimeWindow | None = None,
    salvage: bool = False,
) -> ImagesAlone:
    """Read the setup of a log of which only the sonar images are used.

    Parameters are those of `read_sonar_frames`, with the fields of a calibration that go before the log's own.

    Raises
    ------
    LogError
        When the log has no sonar images, or cannot be read.
    CalibrationError
        When the calibration in the log is invalid, or becomes so.
    """
    recording = scan(path, lambda _: Keep.NONE)
    if not salvage:
        recording.require_sound()
    first = next(read_sonar_frames(path, topic, config, window=window, salvage=salvage, refused=_passed_over), None)
    if first is None:
        raise LogError(no_images(path))
    return ImagesAlone(
        recorded_name(recording) or path.stem,
        gathered(calibration, read_calibration(recording), {}),
        int(first.stamps_ns[0]),
        read_notes(recording) | recording.notes(),
    )


def _passed_over(_stamp_ns: int, _reason: str) -> None:
    """Messages that are no images are named when the frames are used."""


def no_images(log: Path | str) -> str:
    """Message for a log without sonar images."""
    return (
        f"{log}: has no sonar images; `sonar-graph inspect {log}` lists what it has "
        "(`sonar-graph compare` and read_log need none)"
    )
