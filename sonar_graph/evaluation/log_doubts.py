"""What a log's notes say that a reader of results must know: damage, rows left out, gaps, numbers that look wrong."""

from __future__ import annotations

from collections.abc import Mapping

WARNING = "Warning"
SAID_NOTES = {
    "log.ending": "Log",
    "log.damage": "Log",
    "log.start": "Log",
    "log.stamps": "Log",
    "log.dropped": "Log, left out",
    "log.warnings": WARNING,
    "log.gaps": WARNING,
}
"""Notes that are said in the terminal, and after which word; the report has all."""


def doubt_lines(notes: Mapping[str, str]) -> list[str]:
    """A line for each of `SAID_NOTES` that a log has."""
    return [f"{word}: {notes[subject]}" for subject, word in SAID_NOTES.items() if subject in notes]


def warning_lines(notes: Mapping[str, str]) -> list[str]:
    """Of these the ones that put results in doubt."""
    return [line for line in doubt_lines(notes) if line.startswith(f"{WARNING}:")]
