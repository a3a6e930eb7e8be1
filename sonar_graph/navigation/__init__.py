"""From inertial and Doppler samples to motion and its covariance; no landmarks here.

Of use in any GTSAM program (docs/tutorials/05_preintegration.py); factors: `sonar_graph.slam.inertial_factors`.
"""

from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.navigation.initial_tilt import InitialTilt
from sonar_graph.navigation.joint_preintegration import JointMotion, JointPreintegrator
from sonar_graph.navigation.joint_rules import DopplerRule
from sonar_graph.navigation.moving_alignment import align_in_motion
from sonar_graph.navigation.still_alignment import align_at_rest

__all__ = [
    "DopplerRule",
    "InitialTilt",
    "JointMotion",
    "JointPreintegrator",
    "PreintegratedMotion",
    "align_at_rest",
    "align_in_motion",
]
