"""What a log written by this package says about itself: name, calibration and notes, in a metadata record."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.logs.container import Keep, Recording, scan

METADATA = "sonar_graph"
"""The metadata record that carries name, calibration and notes."""


def recorded_name(recording: Recording) -> str | None:
    """The name that a log gives itself, or None."""
    return recording.metadata.get(METADATA, {}).get("name")


def read_calibration(recording: Recording) -> Calibration | None:
    """The calibration that a log carries, or None.

    Raises
    ------
    CalibrationError
        When it is not one.
    """
    text = recording.metadata.get(METADATA, {}).get("calibration")
    if text is None:
        return None
    return Calibration.parse(_json(recording, "calibration", text), f"{recording.path}: metadata record {METADATA!r}")


def read_notes(recording: Recording) -> dict[str, str]:
    """The notes that a log carries.

    Raises
    ------
    LogError
        When they are not a JSON object.
    """
    notes = _json(recording, "notes", recording.metadata.get(METADATA, {}).get("notes", "{}"))
    if not isinstance(notes, dict):
        raise LogError(f"{recording.path}: metadata record {METADATA!r}: notes must be a JSON object")
    return {str(subject): str(note) for subject, note in notes.items()}


def with_notes(path: Path, notes: Mapping[str, str]) -> dict[str, str]:
    """A log's record as it is, with further notes.

    Parameters
    ----------
    path
        The log; one without a record is given one that holds only notes.
    notes
        By subject; they go before those of the log.

    Raises
    ------
    LogError
        When the log cannot be read, or its notes are no JSON object.
    """
    recording = scan(path, lambda _: Keep.NONE)
    return recording.metadata.get(METADATA, {}) | {"notes": json.dumps(read_notes(recording) | dict(notes))}


def _json(recording: Recording, key: str, text: str) -> object:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise LogError(f"{recording.path}: metadata record {METADATA!r}: {key} is not JSON: {error}") from error
