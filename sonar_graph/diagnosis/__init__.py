"""Diagnosis of a log: its sensors compared with each other and with the calibration."""

# fmt: off
from sonar_graph.diagnosis.findings import Finding, notes_of
from sonar_graph.diagnosis.sensor_check import check_sensors, doubts

__all__ = [
    "Finding", "check_sensors", "doubts", "notes_of",
]
