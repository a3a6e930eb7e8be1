"""Solvers of the graph.

Incremental in a window (`incremental`), whole at the end (`batch_solution`), and without factors that leave variables
undetermined (`observability`).
"""

# fmt: off
from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance, Sightline, marginals_of, solve, solve_in_sight,
)
from sonar_graph.slam.smoother.factor_store import FactorGroup, Factors
from sonar_graph.slam.smoother.incremental import (
    BoundedHistory, Changed, HistoryParams, Smoother, SmootherParams, WholeHistory,
)

__all__ = [
    "BoundedHistory", "Changed", "FactorGroup", "Factors", "HistoryParams", "JointCovariance", "Sightline", "Smoother",
    "SmootherParams", "WholeHistory", "marginals_of", "solve", "solve_in_sight",
]
