"""Solvers of the graph: incremental in a window, whole on request, without factors that leave variables undetermined.

smoother.py        the growing graph: updates, exchanges of factors, restarts
window.py          GTSAM's iSAM2, and its fixed-lag smoother for a bounded history
batch_solution.py  Levenberg-Marquardt over the whole graph, marginal and joint covariances
factor_store.py    variables, and groups of factors by handle
observability.py   factors that leave directions open, and messages about them
"""

# fmt: off
from sonar_graph.slam.smoother.batch_solution import solve, solve_in_sight
from sonar_graph.slam.smoother.batch_solution import JointCovariance, Marginals
from sonar_graph.slam.smoother.factor_store import FactorGroup, Factors, Sightline
from sonar_graph.slam.smoother.smoother import (
    BoundedHistory, Changed, Estimates, HistoryParams, Smoother, SmootherParams, WholeHistory,
)
from sonar_graph.slam.smoother.factor_store import Known

__all__ = [
    "BoundedHistory", "Changed", "Estimates", "FactorGroup", "Factors", "HistoryParams", "JointCovariance", "Known",
    "Marginals", "Sightline", "Smoother", "SmootherParams", "WholeHistory", "solve", "solve_in_sight",
]
