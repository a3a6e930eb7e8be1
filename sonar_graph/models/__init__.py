"""Measurement models, below every estimator: predicted measurements, their derivatives, noise and kernels."""

# fmt: off
from sonar_graph.models.aiding import (
    ACCEL, BIASES, COMPASS, HEADING, HUBER_WIDTHS, SCALE, TILT, Contradictions, bias_jacobian, bias_sigmas, by_biases,
    gravity_direction, gyro_bias_of, huber_scale, tilt_sigma, up_and_derivative, up_direction, yaw_and_derivative,
)
from sonar_graph.models.kernels import GaussianKernel, Kernel, KernelParams, Robust, RobustKernel
from sonar_graph.models.known_map import FEWEST, LOCATED_AGAIN, MOVED, NOT_LOCATED, KnownLandmarks, Verdict, listed, named
from sonar_graph.models.sonar import (
    ACCEPTED, FLOOR_GATE, MINIMUM_PROBABILITY, Mount, body_point_jacobian, elevation_on_floor, floor_elevation,
    identify, locate, locate_from_body, locate_jacobians, polar_difference, polar_measurements, project_points,
    range_azimuth, range_azimuth_jacobians, Sight, sight_of, view_points, wrap_angle,
)

__all__ = [
    "ACCEL", "ACCEPTED", "bias_jacobian", "bias_sigmas", "BIASES", "body_point_jacobian", "by_biases", "COMPASS",
    "Contradictions", "elevation_on_floor", "FEWEST", "floor_elevation", "FLOOR_GATE", "GaussianKernel",
    "gravity_direction", "gyro_bias_of", "HEADING", "huber_scale", "HUBER_WIDTHS", "identify", "Kernel", "KernelParams",
    "KnownLandmarks", "listed", "locate", "locate_from_body", "locate_jacobians", "LOCATED_AGAIN",
    "MINIMUM_PROBABILITY", "Mount", "MOVED", "named", "NOT_LOCATED", "polar_difference", "polar_measurements",
    "project_points", "range_azimuth", "range_azimuth_jacobians", "Robust", "RobustKernel", "SCALE", "Sight", "sight_of",
    "TILT", "tilt_sigma", "up_and_derivative", "up_direction", "Verdict", "view_points", "wrap_angle",
    "yaw_and_derivative",
]
