"""Doppler rows that are used, refused, or waiting for confirmation."""

# fmt: off
from sonar_graph.navigation.dvl_screening.row_intake import RowIntake

__all__ = [
    "RowIntake",
]
