from __future__ import annotations

from sonar_graph.report.findings import SAID_NOTES, doubt_lines, warning_lines


def test_every_doubt_is_a_line_and_nothing_else_is() -> None:
    notes = {subject: f"<{subject}>" for subject in SAID_NOTES} | {"log.topics": "imu: /imu"}
    assert [line.partition(": ")[2] for line in doubt_lines(notes)] == [f"<{subject}>" for subject in SAID_NOTES]


def test_gaps_and_unlikely_numbers_are_warnings_and_rows_left_out_are_not() -> None:
    notes = {"log.gaps": "a gap", "log.warnings": "a spike", "log.dropped": "a row"}
    assert warning_lines(notes) == ["Warning: a spike", "Warning: a gap"]


def test_a_sound_log_has_none() -> None:
    assert doubt_lines({"log.topics": "imu: /imu", "log.noise": "dvl: 1 of 1 rows"}) == []
