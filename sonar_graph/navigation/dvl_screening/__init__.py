"""Dvl_screening."""

# fmt: off
from sonar_graph.navigation.dvl_screening.row_intake import RowIntake

__all__ = [
    "RowIntake",
]
