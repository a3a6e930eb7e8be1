"""Preintegration of gyros, accelerometers and Doppler log between two instants, and over gaps of the log."""

# fmt: off
from sonar_graph.navigation.preintegration.dvl_gaps import NO_GAPS, GapMotion, GapValues, bridge, gap_values
from sonar_graph.navigation.preintegration.joint_preintegration import (
    DISPLACEMENT, ROTATION, JointMotion, JointPreintegrator,
)
from sonar_graph.navigation.preintegration.joint_recursion import DopplerRule
from sonar_graph.navigation.preintegration.preintegrator import Preintegrator
from sonar_graph.navigation.preintegration.recursion import (
    NO_MOTION, Columns, Cursor, Integral, Steps, are_nodes, cursor_at, exp_and_chord, extended, extended_by_bias,
    increment, merge_rows, mirrored, next_step, rate_of_turn,
)

__all__ = [
    "Columns", "Cursor", "DISPLACEMENT", "DopplerRule", "GapMotion", "GapValues", "Integral", "JointMotion",
    "JointPreintegrator", "NO_GAPS", "NO_MOTION", "Preintegrator", "ROTATION", "Steps",
    "are_nodes", "bridge", "cursor_at", "exp_and_chord", "extended", "extended_by_bias", "gap_values", "increment",
    "merge_rows", "mirrored", "next_step", "rate_of_turn",
]
