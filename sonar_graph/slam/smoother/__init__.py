"""Solvers of the graph.

Incremental in a window (`incremental`), whole at the end (`batch_solution`), and without factors that leave variables
undetermined (`observability`).
"""

# fmt: off
from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance, Sightline, Sightlines, marginals_of, solve, solve_in_sight,
)
from sonar_graph.slam.smoother.factor_store import GraphEdit
from sonar_graph.slam.smoother.incremental import (
    BoundedHistory, HistoryParams, Smoother, SmootherParams, WholeHistory,
)
from sonar_graph.slam.smoother.observability import Withheld

__all__ = [
    "BoundedHistory", "GraphEdit", "HistoryParams", "JointCovariance", "Sightline", "Sightlines", "Smoother",
    "SmootherParams", "WholeHistory", "Withheld", "marginals_of", "solve", "solve_in_sight",
]
