"""From an MCAP log to a `Sequence`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from sonar_graph.calibration import Calibration
from sonar_graph.logs.adapters.config import LogConfig
from sonar_graph.logs.assembly import Assembly
from sonar_graph.logs.calibration_sources import PartialCalibration
from sonar_graph.logs.container import Keep, Progress, Recording, scan
from sonar_graph.logs.log_record import read_calibration
from sonar_graph.logs.message_definitions import short_name
from sonar_graph.logs.roles import choose_topics, wanted_types
from sonar_graph.logs.window import Window
from sonar_graph.sequence import Sequence


def read_sequence(
    path: Path,
    *,
    calibration: Calibration | PartialCalibration | None = None,
    name: str | None = None,
    topics: Mapping[str, str] | None = None,
    config: LogConfig | None = None,
    window: Window | None = None,
    salvage: bool = False,
    progress: Progress | None = None,
) -> Sequence:
    """Read a log of ROS 2 messages.

    Stamps are those of the sensors' headers. What was left out, which topic was used for what and where the
    calibration comes from is in the sequence's notes, under ``log.*``.

    Parameters
    ----------
    path
        An MCAP file.
    calibration
        A `Calibration` replaces all that the file says. A `PartialCalibration` goes before it, field by field.
        Without either: the file's record; where it has none, defaults with the mountings of ``/tf_static``.
    name
        Instead of the one in the file; without either, the file's name.
    topics
        Topics by role (``imu``, ``dvl``, ``depth``, ``detections``, ``truth``, ``true_landmarks``), where several
        fit or none is found by type and name; before those of `config`.
    config
        What the topics of a foreign log are; `read_log_config` reads one from a TOML file.
    window
        Only what was recorded then, with ``/tf_static`` and other latched topics whenever recorded.
    salvage
        Read what is whole of a file that is damaged in its middle; what is lost is in the notes, under ``log.damage``.
    progress
        Called with the bytes done and the bytes in all.

    Raises
    ------
    MissingTopicError
        When the log has no IMU or no DVL; listing the topics that it has.
    LogError
        When the file is not MCAP, is damaged in its middle without `salvage`, has nothing in the window, or a message
        breaks its own rules.
    CalibrationError
        When the calibration in the file, or what `calibration` makes of it, is not one.
    """
    path = Path(path)
    config = config or LogConfig()
    types = wanted_types(config)
    recording = scan(path, lambda kind: Keep.ALL if short_name(kind) in types else Keep.NONE, window, progress)
    if not salvage:
        recording.require_sound()
    sequence = Assembly(recording, choose_topics(recording, topics or {}, config), calibration).sequence(name)
    said = _start_elsewhere(recording, calibration, window)
    return replace(sequence, notes=sequence.notes | {"log.start": said}) if said else sequence


def _start_elsewhere(
    recording: Recording, given: Calibration | PartialCalibration | None, window: Window | None
) -> str | None:
    """That the start pose in the log is of another instant than the first one read; None where that is not so."""
    if window is None or window.start is None or recording.beginning_ns is None or isinstance(given, Calibration):
        return None
    recorded = read_calibration(recording)
    is_given = given is not None and "start" in given.values
    late_ns = window.start.resolve(recording.beginning_ns) - recording.beginning_ns
    if is_given or late_ns <= 0 or recorded is None or "start" not in recorded.model_fields_set:
        return None
    return (
        f"the start pose that it states is of its beginning, {late_ns * 1e-9:.3f} s before the part that was read; "
        "give the pose there as [start] position_m and rpy_rad in a file for --calibration"
    )
