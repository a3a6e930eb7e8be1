"""From inertial and Doppler samples to motion and its covariance; no landmarks here.

Of use in any GTSAM program (docs/tutorials/05_preintegration.py); factors: `sonar_graph.slam.inertial_factors`.
"""

from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.navigation.joint_preintegration import JointMotion, JointPreintegrator
from sonar_graph.navigation.joint_rules import DopplerRule

__all__ = ["DopplerRule", "JointMotion", "JointPreintegrator", "PreintegratedMotion"]
