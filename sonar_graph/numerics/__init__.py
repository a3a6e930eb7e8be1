"""Compiled functions, and vectors and matrices of three rows inside them."""

# fmt: off
from sonar_graph.numerics.compiling import compiling_s
from sonar_graph.numerics.jit import compiled, inlined
from sonar_graph.numerics.mat3 import (
    IDENTITY, ZERO, ZEROS, Matrix, Vector, cross, difference_of, dot, euler_from_rates, euler_from_rotation, gram,
    left_jacobian, matrix, minus, multiple_of, place, plus, product, rates_from_euler, rotation_exp,
    rotation_from_euler, sandwich, scaled, skew, skew_times, sum_of, symmetric, times, times_skew, transformed,
    transposed, vector,
)
from sonar_graph.numerics.matrices import running_rotations

__all__ = [
    "IDENTITY", "Matrix", "Vector", "ZERO", "ZEROS", "compiled", "compiling_s", "cross", "difference_of", "dot",
    "euler_from_rates", "euler_from_rotation", "gram", "inlined", "left_jacobian", "matrix", "minus", "multiple_of",
    "place", "plus", "product", "rates_from_euler", "rotation_exp", "rotation_from_euler", "running_rotations",
    "sandwich", "scaled", "skew", "skew_times", "sum_of", "symmetric", "times", "times_skew", "transformed",
    "transposed", "vector",
]
