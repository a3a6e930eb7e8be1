"""Measurement models, below every estimator: what a sensor measures at a state, its derivatives and its noise.

sonar.py       range and azimuth of a landmark, and the inverse
aiding.py      gravity, headings and position fixes
biases.py      biases that last through a run, and what they do to a motion
kernels.py     robust kernels of range and azimuth
identity.py    acceptance of a recogniser's identities
"""

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
    locate_jacobians, project, project_points, range_azimuth, range_azimuth_jacobians, sonar_point,
    sonar_point_jacobian, view_from_body, view_points, wrap_angle,
)
from sonar_graph.numerics import gate_threshold

__all__ = [
    "gravity_direction", "tilt_sigma", "up_direction",
    "ACCEL", "ACCEPTED", "BIASES", "COMPASS", "Contradictions", "FLOOR_GATE", "GaussianKernel", "HEADING",
    "HUBER_WIDTHS", "Kernel", "KernelParams", "MINIMUM_PROBABILITY", "Mount", "Robust", "RobustKernel", "SCALE",
    "TILT", "bias_jacobian", "bias_sigmas", "body_point_jacobian", "by_biases", "elevation_on_floor", "floor_elevation",
    "gate_threshold", "gyro_bias_of", "huber_scale", "identify", "locate", "locate_from_body", "locate_jacobians",
    "project", "project_points", "range_azimuth", "range_azimuth_jacobians", "sonar_point", "sonar_point_jacobian",
    "up_and_derivative",
    "view_from_body", "view_points", "wrap_angle", "yaw_and_derivative",
]
