"""Doppler rows that are used, refused, waiting for confirmation, or completed from few beams."""

# fmt: off
from sonar_graph.navigation.dvl_screening.row_intake import RowIntake

__all__ = [
    "RowIntake",
]
