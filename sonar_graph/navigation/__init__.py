"""Motion and its covariance from inertial and Doppler samples, roll, pitch and biases at the start; no landmarks.

For use in any GTSAM program: docs/tutorials/05_preintegration.py; factors: `sonar_graph.slam.inertial_factors`.
"""

# fmt: off
from sonar_graph.motion import Motions, MotionSource, PreintegratedMotion
from sonar_graph.navigation.alignment import InitialTilt, align_at_rest, align_in_motion
from sonar_graph.navigation.joint_preintegration import (
    DISPLACEMENT, ROTATION, DopplerRule, JointMotion, JointPreintegrator,
)
from sonar_graph.navigation.moved_poses import MovedPoses
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.samples import finite_vector, in_numbers

__all__ = [
    "DISPLACEMENT", "DopplerRule", "InitialTilt", "JointMotion", "JointPreintegrator", "MotionSource", "Motions",
    "MovedPoses", "Odometry", "PreintegratedMotion", "ROTATION", "align_at_rest", "align_in_motion", "finite_vector",
    "in_numbers",
]
