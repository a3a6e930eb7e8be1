"""Models of measurements (`sonar_model`, `views`, `aiding`), kernels, factors, and predicted frames."""

# fmt: off
from sonar_graph.slam.models.aiding import HUBER_WIDTHS, Contradictions, doubted, yaw_and_derivative
from sonar_graph.slam.models.biased_odometry import OdometryStack, OdometryWithBias
from sonar_graph.slam.models.kernels import GaussianKernel, Kernel, KernelParams, Robust, RobustKernel
from sonar_graph.slam.models.odometry_arrays import pose
from sonar_graph.slam.models.prediction import PredictedView, Source
from sonar_graph.slam.models.sonar_model import (
    FLOOR_GATE, elevation_on_floor, project, sonar_point, sonar_point_jacobian, wrap_angle,
)
from sonar_graph.slam.models.views import locate, locate_jacobians, pose_row, range_azimuth_jacobians

__all__ = [
    "Contradictions", "FLOOR_GATE", "GaussianKernel", "HUBER_WIDTHS", "Kernel", "KernelParams", "OdometryStack",
    "OdometryWithBias", "PredictedView", "Robust", "RobustKernel", "Source", "doubted", "elevation_on_floor", "locate",
    "locate_jacobians", "pose", "pose_row", "project", "range_azimuth_jacobians", "sonar_point", "sonar_point_jacobian",
    "wrap_angle", "yaw_and_derivative",
]
