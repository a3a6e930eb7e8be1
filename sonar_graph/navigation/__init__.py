"""From inertial and Doppler samples to motion and its covariance; no landmarks here.

Of use in any GTSAM program (docs/tutorials/05_preintegration.py); factors: `sonar_graph.slam.inertial_factors`.
"""

# fmt: off
from sonar_graph.navigation.odometry import (
    Odometry, RunningMotion, motion_between, motion_between_nodes, motion_since_node,
)
from sonar_graph.navigation.samples import finite_vector, rows_until, value_at, weights_at_end

__all__ = [
    "Odometry", "RunningMotion", "finite_vector", "motion_between", "motion_between_nodes", "motion_since_node",
    "rows_until", "value_at", "weights_at_end",
]
