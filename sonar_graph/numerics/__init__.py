"""Compiled functions, and rotations, vectors and matrices inside them; quantiles of chi-square; integrals."""

# fmt: off
from sonar_graph.numerics.chi_square import chi_square_exceeded, chi_square_quantile, chi_square_share
from sonar_graph.numerics.compiled_beside import compiled_beside
from sonar_graph.numerics.compiling import compiling_s, needs_compiling
from sonar_graph.numerics.matrices import (
    I3, LOWER_LEFT, LOWER_RIGHT, O3, UPPER_LEFT, UPPER_RIGHT, ZERO, Mat3, Mat6, Vec3, Vec6, chord_inverse, compilable,
    compiled, cross, curvature, diagonal, diagonal_blocks, exp_and_mean, inlined, innovation_of, mat, mat6,
    outer, rodrigues, rotation_log, row_of, running_rotations, skew, store, store6, store_all, store_row, store_row6,
    store_vector, vec,
)
from sonar_graph.numerics.series import columns_at, running_integral

__all__ = [
    "I3", "LOWER_LEFT", "LOWER_RIGHT", "Mat3", "Mat6", "O3", "UPPER_LEFT", "UPPER_RIGHT", "Vec3", "Vec6", "ZERO",
    "chi_square_exceeded", "chi_square_quantile", "chi_square_share", "chord_inverse", "columns_at", "compilable",
    "compiled", "compiled_beside", "compiling_s", "cross", "curvature", "diagonal", "diagonal_blocks",
    "exp_and_mean", "inlined", "innovation_of", "mat", "mat6", "needs_compiling", "outer", "rodrigues", "rotation_log",
    "row_of", "running_integral", "running_rotations", "skew",
    "store", "store6", "store_all", "store_row", "store_row6", "store_vector", "vec",
]
