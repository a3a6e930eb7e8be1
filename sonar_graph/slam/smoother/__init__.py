"""Solvers of the graph: incremental in a window, whole on request, without factors that leave variables undetermined.

smoother.py        the growing graph: updates, exchanges of factors, restarts
window.py          GTSAM's iSAM2, and its fixed-lag smoother for a bounded history
batch_solution.py  Levenberg-Marquardt over the whole graph, marginal and joint covariances
factor_store.py    variables, and groups of factors by handle
observability.py   factors that leave directions open, and messages about them
"""

# fmt: off
from sonar_graph.slam.smoother.batch_solution import JointCovariance, Marginals, solve
from sonar_graph.slam.smoother.factor_store import FactorGroup, Factors, Known, Sightline, sighted_from
from sonar_graph.slam.smoother.smoother import (
    BoundedHistory, Changed, HistoryParams, Smoother, SmootherParams, WholeHistory,
)

__all__ = [
    "BoundedHistory", "Changed", "FactorGroup", "Factors", "HistoryParams", "JointCovariance", "Known",
    "Marginals", "Sightline", "Smoother", "SmootherParams", "WholeHistory", "sighted_from", "solve",
]
