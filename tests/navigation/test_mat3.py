import importlib
import sys

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sonar_graph.numerics import jit as kernels
from sonar_graph.numerics.mat3 import SMALL_ANGLE_RAD, left_jacobian, rotation_exp, skew

ANGLES_RAD = [0.0, 1e-9, 0.99 * SMALL_ANGLE_RAD, 1.01 * SMALL_ANGLE_RAD, 0.01, 1.0, np.pi - 1e-6, np.pi, 5.0]


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_rotation_is_the_matrix_exponential_and_the_left_jacobian_its_mean(angle_rad):
    """Gauss-Legendre quadrature of Exp(s phi) over s in [0, 1]; the skew matrix is that of the cross product."""
    phi = angle_rad * np.array([0.48, -0.6, 0.64])
    nodes, weights = np.polynomial.legendre.leggauss(20)
    mean = sum(w / 2 * expm((1 + s) / 2 * skew(phi)) for s, w in zip(nodes, weights, strict=True))
    assert np.allclose(skew(phi) @ [0.5, 4.0, -1.0], np.cross(phi, [0.5, 4.0, -1.0]))
    assert np.allclose(rotation_exp(phi), expm(skew(phi)), rtol=0, atol=1e-14)
    assert np.allclose(left_jacobian(phi), mean, rtol=0, atol=2e-12)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_constant_twist_moves_as_the_exponential_of_se3(phi, rho):
    motion = gtsam.Pose3.Expmap(np.array(phi + rho))
    assert np.allclose(rotation_exp(np.array(phi)), motion.rotation().matrix(), atol=1e-9)
    assert np.allclose(left_jacobian(np.array(phi)) @ np.array(rho), motion.translation(), atol=1e-9)


CALLEE = """
{imported}


@{decorator}
def inner(x):
    return x + {offset}
"""
CALLER = """
from callee import inner

{imported}


@{decorator}
def outer(x):
    return 10.0 * inner(x)
"""
CHECKED = {"imported": "from sonar_graph.numerics.jit import compiled", "decorator": "compiled"}
UNCHECKED = {"imported": "import numba", "decorator": "numba.njit(cache=True, error_model='numpy')"}


@pytest.fixture
def answer(tmp_path, monkeypatch):
    """A compiled function that calls another in another file, imported afresh as a new interpreter would."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def ask(how: dict[str, str], offset: float) -> float:
        for name, text in (("callee.py", CALLEE.format(**how, offset=offset)), ("caller.py", CALLER.format(**how))):
            if not (tmp_path / name).exists() or (tmp_path / name).read_text() != text:
                (tmp_path / name).write_text(text)
        monkeypatch.setattr(kernels, "_sources", set())
        for name in ("callee", "caller"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        return importlib.import_module("caller").outer(1.0)

    yield ask
    for name in ("callee", "caller"):
        sys.modules.pop(name, None)


def test_cached_code_does_not_outlive_a_callee_in_another_file(answer, tmp_path):
    """Nor is it dropped while nothing changes: the index then keeps its time."""
    assert answer(CHECKED, 1.0) == 20.0
    (index,) = (tmp_path / "__pycache__").glob("caller.outer-*.nbi")
    made_ns = index.stat().st_mtime_ns
    assert answer(CHECKED, 1.0) == 20.0
    assert index.stat().st_mtime_ns == made_ns
    assert answer(CHECKED, 2.5) == 35.0
    assert index.stat().st_mtime_ns > made_ns


def test_without_the_check_the_old_answer_comes_from_the_cache(answer):
    """Negative control."""
    assert answer(UNCHECKED, 1.0) == answer(UNCHECKED, 2.5) == 20.0
