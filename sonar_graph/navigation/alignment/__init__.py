"""Roll, pitch and gyro bias at the start, time offsets, mountings and noise, from sensors of one run."""

# fmt: off
from sonar_graph.motion import earth_rate_in_world
from sonar_graph.navigation.alignment.allan import longest_rest, noise_densities
from sonar_graph.navigation.alignment.at_rest import InitialTilt, align_at_rest, in_body_axes
from sonar_graph.navigation.alignment.dvl_imu import (
    DvlMatch, Estimates3D, InertialPath, cross_matrices, holes_before, match_dvl_to_imu, means_over, stretches_of,
)
from sonar_graph.navigation.alignment.in_motion import LONGEST_S, align_in_motion, until_hole
from sonar_graph.navigation.alignment.reference_offset import match_reference_to_imu
from sonar_graph.navigation.alignment.time_offset import Estimate1D

__all__ = [
    "DvlMatch", "Estimate1D", "Estimates3D", "InertialPath", "InitialTilt", "LONGEST_S", "align_at_rest",
    "align_in_motion", "cross_matrices", "earth_rate_in_world", "holes_before", "in_body_axes", "longest_rest",
    "match_dvl_to_imu", "match_reference_to_imu", "means_over", "noise_densities", "stretches_of", "until_hole",
]
