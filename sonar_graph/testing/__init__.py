"""Checks for your own estimators, factors and covariances, and small worlds with known truth to try them on."""

# fmt: off
from sonar_graph.estimator import MakeEstimator
from sonar_graph.testing.drives import aided_world, misnamed_world, small_world, still_world
from sonar_graph.testing.laws import (
    CHECKS, FILTER_CHECKS, Check, ContractError, check_estimator,
)
from sonar_graph.testing.numerical import check_consistent, check_derivative, check_jacobians

__all__ = [
    "CHECKS", "FILTER_CHECKS", "Check", "ContractError", "MakeEstimator", "aided_world", "check_consistent",
    "check_derivative", "check_estimator", "check_jacobians", "misnamed_world", "small_world", "still_world",
]
