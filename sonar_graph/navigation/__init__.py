"""Motion and its covariance from inertial and Doppler samples, roll, pitch and biases at the start; no landmarks.

For use in any GTSAM program: docs/tutorials/05_preintegration.py; factors: `sonar_graph.slam.models.inertial_factors`.
"""

# fmt: off
from sonar_graph.navigation.alignment import InitialTilt, align_at_rest, align_in_motion
from sonar_graph.motion import Motions, MotionSource, PreintegratedMotion
from sonar_graph.navigation.odometry import (
    Odometry, RunningMotion, motion_between, motion_between_nodes, motion_since_node,
)
from sonar_graph.navigation.preintegration import JointMotion, JointPreintegrator, Preintegrator
from sonar_graph.navigation.samples import finite_vector, in_numbers, rows_until, value_at

__all__ = [
    "InitialTilt", "JointMotion", "JointPreintegrator", "MotionSource", "Motions", "Odometry", "PreintegratedMotion",
    "Preintegrator", "RunningMotion", "align_at_rest", "align_in_motion", "finite_vector", "in_numbers",
    "motion_between", "motion_between_nodes", "motion_since_node", "rows_until", "value_at",
]
