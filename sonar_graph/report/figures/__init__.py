"""Figures of a comparison, and how its page and a paper show them."""

# fmt: off
from sonar_graph.report.figures.error_figures import (bounds_figure, error_figure, innovation_figure, nees_figure,
    yaw_figure)
from sonar_graph.report.figures.illustrations import RAW_VIEW, drawings, illustrations, panels_of
from sonar_graph.report.figures.maps import growth_figure, map_figure

__all__ = [
    "RAW_VIEW", "bounds_figure", "drawings", "error_figure", "growth_figure", "illustrations", "innovation_figure",
    "map_figure", "nees_figure", "panels_of", "yaw_figure",
]
