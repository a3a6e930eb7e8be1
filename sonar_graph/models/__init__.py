"""Measurement models, below every estimator: predicted measurements, their derivatives, noise and kernels."""

# fmt: off
from sonar_graph.models.aiding import (
    HUBER_WIDTHS, Contradictions, gravity_direction, huber_scale, tilt_sigma, up_and_derivative, up_direction,
    yaw_and_derivative,
)
from sonar_graph.models.biases import (
    ACCEL, BIASES, COMPASS, HEADING, SCALE, TILT, bias_jacobian, bias_sigmas, by_biases, gyro_bias_of,
)
from sonar_graph.models.identity import ACCEPTED, MINIMUM_PROBABILITY, identify
from sonar_graph.models.kernels import GaussianKernel, Kernel, KernelParams, Robust, RobustKernel
from sonar_graph.models.sonar import (
    FLOOR_GATE, Mount, body_point_jacobian, elevation_on_floor, floor_elevation, locate, locate_from_body,
    locate_jacobians, project, project_points, range_azimuth, range_azimuth_jacobians, sight_of, sonar_point,
    view_points, wrap_angle,
)
from sonar_graph.numerics import gate_threshold

__all__ = [
    "ACCEL", "ACCEPTED", "bias_jacobian", "bias_sigmas", "BIASES", "body_point_jacobian", "by_biases", "COMPASS",
    "Contradictions", "elevation_on_floor", "floor_elevation", "FLOOR_GATE", "gate_threshold", "GaussianKernel",
    "gravity_direction", "gyro_bias_of", "HEADING", "huber_scale", "HUBER_WIDTHS", "identify", "Kernel", "KernelParams",
    "locate", "locate_from_body", "locate_jacobians", "MINIMUM_PROBABILITY", "Mount", "project", "project_points",
    "range_azimuth", "range_azimuth_jacobians", "Robust", "RobustKernel", "SCALE", "sight_of", "sonar_point", "TILT",
    "tilt_sigma", "up_and_derivative", "up_direction", "view_points", "wrap_angle", "yaw_and_derivative",
]
