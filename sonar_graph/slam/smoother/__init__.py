"""Solvers of the graph.

Incremental in a window (`incremental`), whole at the end (`batch_solution`), and without factors that leave variables
undetermined (`observability`).
"""

# fmt: off
from sonar_graph.slam.smoother.batch_solution import (
    JointCovariance, Marginals, Sightline, solve, solve_in_sight,
)
from sonar_graph.slam.smoother.factor_store import FactorGroup, Factors
from sonar_graph.slam.smoother.incremental import (
    BoundedHistory, Changed, HistoryParams, Smoother, SmootherParams, WholeHistory,
)

__all__ = [
    "BoundedHistory", "Changed", "FactorGroup", "Factors", "HistoryParams", "JointCovariance", "Marginals", "Sightline",
    "Smoother", "SmootherParams", "WholeHistory", "solve", "solve_in_sight",
]
