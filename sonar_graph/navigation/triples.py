"""Vectors of three numbers and 3 × 3 matrices as tuples, for compiled code.

In machine code a tuple lives in registers. An array of nine numbers is an allocation, which costs as much as a product
of two such matrices, and every store to it keeps the compiler from reordering what follows.
"""

from __future__ import annotations

from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import inlined

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
"""Three rows."""

ZERO: Vector = (0.0, 0.0, 0.0)
ZEROS: Matrix = (ZERO, ZERO, ZERO)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@inlined
def vector(a: Floats) -> Vector:
    """From an array, shape (3,)."""
    return a[0], a[1], a[2]


@inlined
def matrix(A: Floats) -> Matrix:
    """From an array, shape (3, 3)."""
    return vector(A[0]), vector(A[1]), vector(A[2])


@inlined
def dot(a: Vector, b: Vector) -> float:
    """``a^T b``."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    """``a x b``."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def plus(a: Vector, b: Vector) -> Vector:
    """``a + b``."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def minus(a: Vector, b: Vector) -> Vector:
    """``a - b``."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def scaled(s: float, a: Vector) -> Vector:
    """``s a``."""
    return s * a[0], s * a[1], s * a[2]


@inlined
def times(A: Matrix, v: Vector) -> Vector:
    """``A v``."""
    return dot(A[0], v), dot(A[1], v), dot(A[2], v)


@inlined
def transformed(p: Vector, R: Matrix, v: Vector) -> Vector:
    """``p + R v``, summed from the left."""
    return (
        p[0] + R[0][0] * v[0] + R[0][1] * v[1] + R[0][2] * v[2],
        p[1] + R[1][0] * v[0] + R[1][1] * v[1] + R[1][2] * v[2],
        p[2] + R[2][0] * v[0] + R[2][1] * v[1] + R[2][2] * v[2],
    )


@inlined
def transposed(A: Matrix) -> Matrix:
    """``A^T``."""
    return (A[0][0], A[1][0], A[2][0]), (A[0][1], A[1][1], A[2][1]), (A[0][2], A[1][2], A[2][2])


@inlined
def product(A: Matrix, B: Matrix) -> Matrix:
    """``A B``."""
    columns = transposed(B)
    return times(columns, A[0]), times(columns, A[1]), times(columns, A[2])


@inlined
def gram(A: Matrix) -> Matrix:
    """``A A^T``, symmetric to the last bit."""
    return times(A, A[0]), times(A, A[1]), times(A, A[2])


@inlined
def skew_times(v: Vector, A: Matrix) -> Matrix:
    """``[v]x A``."""
    columns = transposed(A)
    return transposed((cross(v, columns[0]), cross(v, columns[1]), cross(v, columns[2])))


@inlined
def times_skew(A: Matrix, v: Vector) -> Matrix:
    """``A [v]x``."""
    return cross(A[0], v), cross(A[1], v), cross(A[2], v)


@inlined
def sum_of(A: Matrix, B: Matrix) -> Matrix:
    """``A + B``."""
    return plus(A[0], B[0]), plus(A[1], B[1]), plus(A[2], B[2])


@inlined
def difference_of(A: Matrix, B: Matrix) -> Matrix:
    """``A - B``."""
    return minus(A[0], B[0]), minus(A[1], B[1]), minus(A[2], B[2])


@inlined
def multiple_of(s: float, A: Matrix) -> Matrix:
    """``s A``."""
    return scaled(s, A[0]), scaled(s, A[1]), scaled(s, A[2])


@inlined
def sandwich(A: Matrix, C: Matrix, B: Matrix) -> Matrix:
    """``A C B^T``: the covariance of A a and B b, where C is that of a and b."""
    return product(product(A, C), transposed(B))


@inlined
def symmetric(A: Matrix) -> Matrix:
    """``(A + A^T) / 2``: symmetric to the last bit."""
    return multiple_of(0.5, sum_of(A, transposed(A)))


@inlined
def place(A: Matrix, out: Floats, row: int, column: int) -> None:
    """Write into a larger array."""
    for r in range(3):
        out[row + r, column], out[row + r, column + 1], out[row + r, column + 2] = A[r]
