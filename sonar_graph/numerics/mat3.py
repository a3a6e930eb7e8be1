"""Vectors of three numbers and 3 × 3 matrices as tuples, and rotations, for compiled code.

In machine code a tuple lives in registers. An array of nine numbers is an allocation, which costs as much as a product
of two such matrices. Rotations follow Forster et al., "On-Manifold Preintegration", IEEE TRO 33(1), 2017, (3), (8),
(9). Euler angles are roll, pitch and yaw (phi, theta, psi)::

    world_R_body = Rz(psi) Ry(theta) Rx(phi)
    w = W (phi', theta', psi')^T        body rates from Euler rates, W = rates_from_euler
    (phi', theta', psi')^T = E w        E = W^-1; infinite at theta = +-90 degrees

A small rotation of the body, ``world_R_body Exp(delta)``, changes the angles by ``E delta``. Fossen, "Handbook of
Marine Craft Hydrodynamics and Motion Control", 2011, (2.18), (2.28).
"""

import math

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.numerics.jit import compiled, inlined

SMALL_ANGLE_RAD = 1e-4
"""Angle below which the series are exact to 1e-18 relative."""


@compiled
def skew(v: Floats) -> Floats:
    """[v]x with ``[v]x w = v x w``, shape (3, 3)."""
    m = np.zeros((3, 3))
    m[0, 1], m[0, 2] = -v[2], v[1]
    m[1, 0], m[1, 2] = v[2], -v[0]
    m[2, 0], m[2, 1] = -v[1], v[0]
    return m


@compiled
def rotation_exp(phi: Floats) -> Floats:
    """Rotation matrix of a rotation vector (rad): ``I + a [phi]x + b [phi]x^2`` (Rodrigues), shape (3, 3)."""
    angle2 = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    if angle2 < SMALL_ANGLE_RAD**2:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    K = skew(phi)
    return np.eye(3) + a * K + b * (K @ K)


@compiled
def left_jacobian(phi: Floats) -> Floats:
    """Mean of ``Exp(s phi)`` over s in [0, 1]: turns a constant body velocity into a chord, shape (3, 3)."""
    angle2 = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    if angle2 < SMALL_ANGLE_RAD**2:
        b, c = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = np.sqrt(angle2)
        b, c = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    K = skew(phi)
    return np.eye(3) + b * K + c * (K @ K)


Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
"""Three rows."""
ZERO: Vector = (0.0, 0.0, 0.0)
ZEROS: Matrix = (ZERO, ZERO, ZERO)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@inlined
def vector(a: Floats) -> Vector:
    """A vector from an array, shape (3,)."""
    return a[0], a[1], a[2]


@inlined
def matrix(A: Floats) -> Matrix:
    """A matrix from an array, shape (3, 3)."""
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
    """Write A into a larger array, with its first element at (row, column)."""
    for r in range(3):
        out[row + r, column], out[row + r, column + 1], out[row + r, column + 2] = A[r]


@inlined
def rotation_from_euler(angles: Vector) -> Matrix:
    """world_R_body from (phi, theta, psi), rad."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, s_p = math.cos(angles[1]), math.sin(angles[1])
    c_y, s_y = math.cos(angles[2]), math.sin(angles[2])
    return (
        (c_y * c_p, c_y * s_p * s_r - s_y * c_r, c_y * s_p * c_r + s_y * s_r),
        (s_y * c_p, s_y * s_p * s_r + c_y * c_r, s_y * s_p * c_r - c_y * s_r),
        (-s_p, c_p * s_r, c_p * c_r),
    )


@inlined
def euler_from_rotation(R: Matrix) -> Vector:
    """(phi, theta, psi), rad; phi and psi in (-pi, pi], theta in [-pi/2, pi/2]."""
    return (
        math.atan2(R[2][1], R[2][2]),
        math.atan2(-R[2][0], math.hypot(R[2][1], R[2][2])),
        math.atan2(R[1][0], R[0][0]),
    )


@inlined
def rates_from_euler(angles: Vector) -> Matrix:
    """W of the module's docstring."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, s_p = math.cos(angles[1]), math.sin(angles[1])
    return (1.0, 0.0, -s_p), (0.0, c_r, s_r * c_p), (0.0, -s_r, c_r * c_p)


@inlined
def euler_from_rates(angles: Vector) -> Matrix:
    """E of the module's docstring."""
    c_r, s_r = math.cos(angles[0]), math.sin(angles[0])
    c_p, t_p = math.cos(angles[1]), math.tan(angles[1])
    return (1.0, s_r * t_p, c_r * t_p), (0.0, c_r, -s_r), (0.0, s_r / c_p, c_r / c_p)
