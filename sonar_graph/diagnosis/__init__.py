"""Diagnosis."""

# fmt: off
from sonar_graph.diagnosis.findings import Finding
from sonar_graph.diagnosis.sensor_check import check_sensors

__all__ = [
    "Finding", "check_sensors",
]
