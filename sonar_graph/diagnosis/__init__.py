"""Diagnosis of a log: its sensors compared with each other and with the calibration."""

# fmt: off
from sonar_graph.diagnosis.findings import Finding
from sonar_graph.diagnosis.sensor_check import check_sensors, compared, trusted

__all__ = [
    "Finding", "check_sensors", "compared", "trusted",
]
