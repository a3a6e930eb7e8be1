"""Compilation of loops, and the vectors, matrices and rotations in them: ``F @ P @ F.T + G @ C @ G.T`` as in the paper.

Vectors and matrices are tuples. Inside a compiled function they live in registers, where an array of nine numbers is an
allocation that costs as much as a product; outside, the same operators are ordinary methods. The last functions are
for arrays that never enter compiled code. Rotations follow Forster et al.,
"On-Manifold Preintegration", IEEE TRO 33(1), 2017, (3), (8).
"""

import hashlib
import itertools
import math
import operator
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NamedTuple, TypeVar, cast

import numba.extending
import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher
from scipy.spatial.transform import Rotation

from sonar_graph.measurements import Floats

# -------------------------------------------------------------------------------- compilation, with a cache on disk

Compiled = TypeVar("Compiled")
extending: Any = numba.extending
# nobody calls compiled code from C
OPTIONS: Any = {"error_model": "numpy", "no_cfunc_wrapper": True}
COMPILED_IN: Counter[str] = Counter()
"""Number of compiled functions of each module."""


def compiled(function: Compiled) -> Compiled:
    """Compile to machine code at the first call; the code is cached beside the source.

    It is compiled again when the contents of its file change, or of a file whose compiled functions it can call.
    """
    assert isinstance(function, FunctionType)
    COMPILED_IN[function.__module__] += 1
    # the wrapper for C, which nobody calls, would take as long as a small function
    made = numba.njit(cache=True, **OPTIONS)(function)
    if isinstance(made, Dispatcher):  # a plain function with NUMBA_DISABLE_JIT
        # numba's own stamp is of the function's file alone, and in its older versions of the file's time
        cached = cast(Any, made)._cache._cache_file
        cached._source_stamp = _digest(function.__globals__)
        cached._load_index = partial(_readable, cached._load_index)
    return cast(Compiled, made)


def _readable(load_index: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """Index of cached code; empty where it names a class that another version of the package had."""
    try:
        return load_index()
    except (AttributeError, ImportError):
        return {}


def inlined(function: Compiled) -> Compiled:
    """Inline into every compiled caller, and leave to Python elsewhere: for the steps of a loop over samples.

    There, tuples stay in registers only within one function. Elsewhere it just costs compile time in every caller.
    """
    assert isinstance(function, FunctionType)
    COMPILED_IN[function.__module__] += 1
    make = extending.register_jitable(forceinline=True, **OPTIONS)
    return cast(Compiled, make(function))


def compilable(function: Compiled) -> Compiled:
    """Leave a function to Python, where arrays of any kind need no compilation; compiled functions can call it too."""
    assert isinstance(function, FunctionType)
    COMPILED_IN[function.__module__] += 1
    return cast(Compiled, extending.register_jitable(**OPTIONS)(function))


def _digest(module: dict[str, Any]) -> str:
    """Digest of the files of a module and of all modules with compiled functions that it names, directly or not.

    Numbers that these modules name are part of it, since the code holds their values.
    """
    parts: dict[str, str] = {}
    waiting = [module]
    while waiting:
        names = waiting.pop()
        if names["__name__"] in parts:  # modules may name each other in a circle
            continue
        numbers = sorted(
            (name, repr(value))
            for name, value in names.items()
            if isinstance(value, int | float)
        )
        status = Path(names["__file__"]).stat()
        parts[names["__name__"]] = repr(
            (_contents(names["__file__"], status.st_mtime_ns, status.st_size), numbers)
        )
        for value in names.values():
            of = (
                value
                if isinstance(value, ModuleType)
                else sys.modules.get(getattr(value, "__module__", None) or "")
            )
            if of is not None and of.__name__ in COMPILED_IN:
                waiting.append(vars(of))
    return hashlib.sha256(
        "".join(parts[name] for name in sorted(parts)).encode()
    ).hexdigest()


@cache
def _contents(path: str, _mtime_ns: int, _size: int) -> str:
    """Digest of a file, read again in a process when the file has changed."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


# -------------------------------------------------------------------------------- vectors and matrices in registers


class Operators:
    """Base class with the operators in `RULES`."""

    __array_ufunc__ = None  # numpy's numbers leave `s * A` to the rules

    def __add__(self, other: Any) -> Any:
        return _applied("add", self, other)

    def __sub__(self, other: Any) -> Any:
        return _applied("sub", self, other)

    def __matmul__(self, other: Any) -> Any:
        return _applied("matmul", self, other)

    def __rmul__(self, scale: Any) -> Any:
        return _applied("mul", scale, self)

    @property
    def T(self) -> Any:
        """Transpose."""
        return TRANSPOSES[type(self)](self)


class Vec3(Operators, NamedTuple("Vec3", [("x", float), ("y", float), ("z", float)])):
    """Vector; ``a @ b`` is the scalar product."""


class Mat3(Operators, NamedTuple("Mat3", [("x", Vec3), ("y", Vec3), ("z", Vec3)])):
    """Matrix of three rows."""


class Skew(Operators, NamedTuple("Skew", [("v", Vec3)])):
    """Matrix ``[v]x`` with ``[v]x w = v x w``."""


class Vec6(Operators, NamedTuple("Vec6", [("a", Vec3), ("b", Vec3)])):
    """Vector of two halves."""


class Mat6(
    Operators, NamedTuple("Mat6", [("a", Mat3), ("b", Mat3), ("c", Mat3), ("d", Mat3)])
):
    """Matrix of four blocks, ``[[a, b], [c, d]]``."""


RULES: dict[str, dict[tuple[type, type], Callable[[Any, Any], Any]]] = {
    "add": {
        (Vec3, Vec3): lambda a, b: Vec3(a.x + b.x, a.y + b.y, a.z + b.z),
        (Mat3, Mat3): lambda a, b: Mat3(a.x + b.x, a.y + b.y, a.z + b.z),
        (Mat6, Mat6): lambda a, b: Mat6(a.a + b.a, a.b + b.b, a.c + b.c, a.d + b.d),
    },
    "sub": {
        (Vec3, Vec3): lambda a, b: Vec3(a.x - b.x, a.y - b.y, a.z - b.z),
        (Mat3, Mat3): lambda a, b: Mat3(a.x - b.x, a.y - b.y, a.z - b.z),
    },
    "mul": {
        (float, Vec3): lambda a, b: Vec3(a * b.x, a * b.y, a * b.z),
        (float, Mat3): lambda a, b: Mat3(a * b.x, a * b.y, a * b.z),
        (float, Vec6): lambda a, b: Vec6(a * b.a, a * b.b),
        (float, Mat6): lambda a, b: Mat6(a * b.a, a * b.b, a * b.c, a * b.d),
    },
    "matmul": {
        (Vec3, Vec3): lambda a, b: a.x * b.x + a.y * b.y + a.z * b.z,
        (Mat3, Vec3): lambda a, b: Vec3(a.x @ b, a.y @ b, a.z @ b),
        (Mat3, Mat3): lambda a, b: Mat3(b.T @ a.x, b.T @ a.y, b.T @ a.z),
        (Mat3, Skew): lambda a, b: Mat3(
            cross(a.x, b.v), cross(a.y, b.v), cross(a.z, b.v)
        ),
        (Skew, Mat3): lambda a, b: (
            Mat3(cross(a.v, b.T.x), cross(a.v, b.T.y), cross(a.v, b.T.z)).T
        ),
        (Vec6, Vec6): lambda a, b: a.a @ b.a + a.b @ b.b,
        (Mat6, Vec6): lambda a, b: Vec6(a.a @ b.a + a.b @ b.b, a.c @ b.a + a.d @ b.b),
        (Mat6, Mat6): lambda a, b: Mat6(
            a.a @ b.a + a.b @ b.c,
            a.a @ b.b + a.b @ b.d,
            a.c @ b.a + a.d @ b.c,
            a.c @ b.b + a.d @ b.d,
        ),
    },
}
"""Operators by the kinds of both operands."""
TRANSPOSES: dict[type, Callable[[Any], Any]] = {
    Mat3: lambda a: Mat3(
        Vec3(a.x.x, a.y.x, a.z.x), Vec3(a.x.y, a.y.y, a.z.y), Vec3(a.x.z, a.y.z, a.z.z)
    ),
    Mat6: lambda a: Mat6(a.a.T, a.c.T, a.b.T, a.d.T),
}


def _applied(name: str, a: Any, b: Any) -> Any:
    kinds = (float if isinstance(a, float | int | np.number) else type(a)), type(b)
    # NotImplemented: Python goes on to the operator of b
    return RULES[name][kinds](a, b) if kinds in RULES[name] else NotImplemented


def _compiled_kind(t: types.Type) -> Any:
    return (
        float
        if isinstance(t, types.Float | types.Integer)
        else getattr(t, "instance_class", None)
    )


# the same for compiled code, inlined: tuples stay in registers only within one function
INLINE: Any = {"jit_options": {"forceinline": True, **OPTIONS}, "strict": False}
for _op in (
    operator.add,
    operator.iadd,
    operator.sub,
    operator.isub,
    operator.mul,
    operator.matmul,
):
    _rules = RULES[_op.__name__.lstrip("i")]
    extending.overload(_op, **INLINE)(
        lambda a, b, r=_rules: r.get((_compiled_kind(a), _compiled_kind(b)))
    )
extending.overload_attribute(types.NamedUniTuple, "T", **INLINE)(
    lambda a: TRANSPOSES.get(_compiled_kind(a))
)

ZERO = Vec3(0.0, 0.0, 0.0)
O3 = Mat3(ZERO, ZERO, ZERO)
I3 = Mat3(Vec3(1.0, 0.0, 0.0), Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0))
Place = int | np.integer[Any]
Index = tuple[Place, ...]
UPPER_LEFT, UPPER_RIGHT, LOWER_LEFT, LOWER_RIGHT = itertools.product(
    np.arange(0, 6, 3), repeat=2
)
"""First elements of the blocks of a 6 by 6 array; not literals: numba would compile a function for each of them."""

SERIES_RAD2 = 1e-2
"""Squared angle below which the series of `curvature` serve: their next terms are below 1e-12."""


@inlined
def cross(a: Vec3, b: Vec3) -> Vec3:
    """``a x b``."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@inlined
def skew(v: Vec3) -> Skew:
    """``[v]x``; ``I3 @ skew(v)`` has it as a `Mat3`."""
    return Skew(v)


@inlined
def diagonal(v: Vec3) -> Mat3:
    """``diag(v)``."""
    return Mat3(Vec3(v.x, 0.0, 0.0), Vec3(0.0, v.y, 0.0), Vec3(0.0, 0.0, v.z))


@inlined
def vec(a: Any) -> Vec3:
    """Vector from the first three numbers of an array or tuple."""
    return Vec3(a[0], a[1], a[2])


@inlined
def row_of(A: Floats, k: int) -> Vec3:
    """Row k of an array of shape (n, 3) (a view of it would be slow to compile)."""
    return Vec3(A[k, 0], A[k, 1], A[k, 2])


@inlined
def outer(a: Vec3, b: Vec3) -> Mat3:
    """``a b^T``."""
    return Mat3(a.x * b, a.y * b, a.z * b)


@inlined
def mat(A: Floats, at: Index = UPPER_LEFT) -> Mat3:
    """3 × 3 block of an array, its first element at a row and column."""
    r, c = at
    return Mat3(
        Vec3(A[r, c], A[r, c + 1], A[r, c + 2]),
        Vec3(A[r + 1, c], A[r + 1, c + 1], A[r + 1, c + 2]),
        Vec3(A[r + 2, c], A[r + 2, c + 1], A[r + 2, c + 2]),
    )


@inlined
def mat6(A: Floats) -> Mat6:
    """Matrix from the first six rows and columns of an array."""
    return Mat6(
        mat(A, UPPER_LEFT), mat(A, UPPER_RIGHT), mat(A, LOWER_LEFT), mat(A, LOWER_RIGHT)
    )


@inlined
def store_vector(v: Vec3, out: Floats, at: int) -> None:
    """Write a vector into an array of one dimension, its first element at a place."""
    out[at] = v.x
    out[at + 1] = v.y
    out[at + 2] = v.z


@inlined
def store_row(v: Vec3, out: Floats, row: Place, column: Place) -> None:
    """Write a vector into a row of an array, its first element at a column."""
    out[row, column] = v.x
    out[row, column + 1] = v.y
    out[row, column + 2] = v.z


@inlined
def store_row6(v: Vec6, out: Floats, row: Place, column: Place) -> None:
    """Write a vector of six into a row of an array, its first element at a column."""
    store_row(v.a, out, row, column)
    store_row(v.b, out, row, column + 3)


@inlined
def store(A: Mat3, out: Floats, at: Index = UPPER_LEFT) -> None:
    """Write a matrix into an array, its first element at a row and column."""
    r, c = at
    store_row(A.x, out, r, c)
    store_row(A.y, out, r + 1, c)
    store_row(A.z, out, r + 2, c)


@inlined
def store_all(A: Mat6, out: Floats) -> None:
    """Write a matrix into the first six rows and columns of an array."""
    store(A.a, out, UPPER_LEFT)
    store(A.b, out, UPPER_RIGHT)
    store(A.c, out, LOWER_LEFT)
    store(A.d, out, LOWER_RIGHT)


@inlined
def store6(A: Mat6, out: Floats) -> None:
    """Write a symmetric matrix into the first six rows and columns of an array, symmetric to the last bit."""
    store(0.5 * (A.a + A.a.T), out, UPPER_LEFT)
    store(A.c.T, out, UPPER_RIGHT)
    store(A.c, out, LOWER_LEFT)
    store(0.5 * (A.d + A.d.T), out, LOWER_RIGHT)


@compilable
def innovation_of(P: Floats, H: Floats, R: Floats) -> tuple[Floats, Floats]:
    """``H P``, shape (m, n), and ``S = H P H^T + R``, shape (m, m), symmetric to the last bit."""
    m, n = H.shape
    HP = np.zeros((m, n))
    S = R.copy()
    for r in range(m):
        for k in range(n):
            # most numbers of a Jacobian are zero: a detection has nine others in each row
            if H[r, k] != 0.0:
                for j in range(n):
                    HP[r, j] += H[r, k] * P[k, j]
        for i in range(r + 1):
            HPH = 0.0
            for k in range(n):
                HPH += H[i, k] * HP[r, k]
            S[r, i] += HPH
            S[i, r] = S[r, i]
    return HP, S


@inlined
def exp_and_mean(phi: Vec3) -> tuple[Mat3, Mat3]:
    """``Exp(phi)`` and ``J_l(phi)``, the mean of ``Exp(s phi)`` over s in [0, 1]; by series below 0.05 rad."""
    x = phi @ phi  # squared angle
    if x < 2.5e-3:  # 1 - cos and 1 - a cancel at small angles
        a = 1.0 - x * (1.0 / 6.0 - x * (1.0 / 120.0 - x / 5040.0))
        b = 0.5 - x * (1.0 / 24.0 - x * (1.0 / 720.0 - x / 40320.0))
        c = 1.0 / 6.0 - x * (1.0 / 120.0 - x * (1.0 / 5040.0 - x / 362880.0))
    else:
        angle = math.sqrt(x)
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / x
        c = (1.0 - a) / x
    # Exp(phi) = I + a [phi]x + b [phi]x^2  (3);  J_l(phi) = I + b [phi]x + c [phi]x^2, (8) with the other sign
    return rodrigues(phi, x, a, b), rodrigues(phi, x, b, c)


@inlined
def rodrigues(phi: Vec3, x: float, a: float, b: float) -> Mat3:
    """``I + a [phi]x + b [phi]x^2``, with ``[phi]x^2 = phi phi^T - x I`` and ``x = |phi|^2``."""
    p = phi.x
    q = phi.y
    r = phi.z
    d = 1.0 - b * x
    return Mat3(
        Vec3(d + b * p * p, b * p * q - a * r, b * p * r + a * q),
        Vec3(b * q * p + a * r, d + b * q * q, b * q * r - a * p),
        Vec3(b * r * p - a * q, b * r * q + a * p, d + b * r * r),
    )


@inlined
def quaternion(R: Mat3) -> tuple[Vec3, float]:
    """Quaternion of any length, scalar last and not negative, by its largest part (Shepperd, JGC 1(3), 1978)."""
    xx = R.x.x
    yy = R.y.y
    zz = R.z.z
    # each branch is the quaternion times four times its largest part, so that nothing small is divided by
    across = Vec3(R.z.y - R.y.z, R.x.z - R.z.x, R.y.x - R.x.y)
    w2 = xx + yy + zz
    if w2 >= max(xx, yy, zz):
        w = 1.0 + w2
        v = across
    elif xx >= yy and xx >= zz:
        w = across.x
        v = Vec3(1.0 + xx - yy - zz, R.x.y + R.y.x, R.x.z + R.z.x)
    elif yy >= zz:
        w = across.y
        v = Vec3(R.x.y + R.y.x, 1.0 + yy - zz - xx, R.y.z + R.z.y)
    else:
        w = across.z
        v = Vec3(R.x.z + R.z.x, R.y.z + R.z.y, 1.0 + zz - xx - yy)
    if w < 0.0:  # q and -q are one rotation; this one turns by at most pi
        w = -w
        v = -1.0 * v
    return v, w


@inlined
def rotation_log(R: Mat3) -> Vec3:
    """Rotation vector, at any angle."""
    v, w = quaternion(R)
    n = math.sqrt(v @ v)
    # atan2, unlike acos of the trace, keeps its digits at small angles and near pi
    return (2.0 * math.atan2(n, w) / n if n > 0.0 else 0.0) * v


@inlined
def curvature(x: float) -> tuple[float, float]:
    """``a = (1 - y cot y) / x``, y half the angle of the square x, and its derivative by the angle, over the angle."""
    if x < SERIES_RAD2:  # the differences below cancel, the second to the fourth order
        return 1.0 / 12.0 + x * (1.0 / 720.0 + x / 30240.0), 1.0 / 360.0 + x * (
            1.0 / 7560.0 + x / 201600.0
        )
    half = 0.5 * math.sqrt(x)
    g = half / math.tan(half)
    return (1.0 - g) / x, ((half / math.sin(half)) ** 2 + g - 2.0) / (x * x)


@inlined
def chord_inverse(theta: Vec3) -> Mat3:
    """``J_l(theta)^-1 = I - [theta]x / 2 + a [theta]x^2``, a as in `curvature`; its transpose is that of Log."""
    x = theta @ theta
    return rodrigues(theta, x, -0.5, curvature(x)[0])


def diagonal_blocks(A: Floats, size: int) -> Floats:
    """The m blocks on the diagonal of a matrix, shape (m, size, size)."""
    m = len(A) // size
    return A.reshape(m, size, m, size)[np.arange(m), :, np.arange(m)]


def running_rotations(turns: Floats) -> Floats:
    """``I, Exp(turns[0]), Exp(turns[0]) Exp(turns[1]), ...`` of n rotation vectors, (n + 1, 3, 3), by doubling."""
    products = Rotation.from_rotvec(
        np.concatenate([np.zeros((1, 3)), turns])
    ).as_matrix()
    span = 1
    while span <= len(turns):  # each product spans so many turns, or all before it
        products[span:] = products[:-span] @ products[span:]
        span *= 2
    return products
