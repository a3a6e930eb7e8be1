import os
import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

import sonar_graph
from sonar_graph.navigation.kernels import SMALL_ANGLE_RAD, left_jacobian, rotation_exp, skew

ANGLES_RAD = [0.0, 1e-9, 0.99 * SMALL_ANGLE_RAD, 1.01 * SMALL_ANGLE_RAD, 0.01, 1.0, np.pi - 1e-6, np.pi, 5.0]


def vector(angle_rad: float) -> np.ndarray:
    return angle_rad * np.array([0.48, -0.6, 0.64])


def test_skew_is_the_cross_product():
    v, w = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    assert np.allclose(skew(v) @ w, np.cross(v, w))


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_rotation_is_the_matrix_exponential(angle_rad):
    assert np.allclose(rotation_exp(vector(angle_rad)), expm(skew(vector(angle_rad))), rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_left_jacobian_is_the_mean_rotation(angle_rad):
    """Gauss-Legendre quadrature of Exp(s phi) over s in [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    mean = sum(w / 2 * expm((1 + s) / 2 * skew(vector(angle_rad))) for s, w in zip(nodes, weights, strict=True))
    assert np.allclose(left_jacobian(vector(angle_rad)), mean, rtol=0, atol=2e-12)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_constant_twist_moves_as_the_exponential_of_se3(phi, rho):
    motion = gtsam.Pose3.Expmap(np.array(phi + rho))
    assert np.allclose(rotation_exp(np.array(phi)), motion.rotation().matrix(), atol=1e-9)
    assert np.allclose(left_jacobian(np.array(phi)) @ np.array(rho), motion.translation(), atol=1e-9)


CALLEE = """
from sonar_graph.navigation.kernels import compiled


@compiled
def inner(x):
    return x + 1.0
"""
CALLER = """
from callee import inner

from sonar_graph.navigation.kernels import compiled


@compiled
def outer(x):
    return 10.0 * inner(x)
"""


def answer(folder: Path) -> float:
    """What the caller says in a fresh interpreter."""
    command = [sys.executable, "-c", "import caller; print(caller.outer(1.0))"]
    python_path = os.pathsep.join([str(folder), str(Path(sonar_graph.__file__).parents[1])])
    environment = os.environ | {"PYTHONPATH": python_path}
    return float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)


@pytest.mark.parametrize("changed", [True, False])
def test_cached_code_does_not_outlive_a_callee_in_another_file(tmp_path, changed):
    """Nor is it dropped when nothing changed: then the index keeps its time."""
    (tmp_path / "callee.py").write_text(CALLEE)
    (tmp_path / "caller.py").write_text(CALLER)
    assert answer(tmp_path) == 20.0
    (index,) = (tmp_path / "__pycache__").glob("caller.outer-*.nbi")
    made_ns = index.stat().st_mtime_ns
    if changed:
        (tmp_path / "callee.py").write_text(CALLEE.replace("1.0", "2.5"))
        os.utime(tmp_path / "callee.py", ns=(made_ns + 1, made_ns + 1))
    assert answer(tmp_path) == (35.0 if changed else 20.0)
    assert (index.stat().st_mtime_ns != made_ns) is changed


def test_numba_alone_would_keep_it(tmp_path):
    """Negative control: without the check for a newer callee the old answer comes from the cache."""
    plain = CALLER.replace("from sonar_graph.navigation.kernels import compiled", "from numba import njit").replace(
        "@compiled", "@njit(cache=True, error_model='numpy')"
    )
    (tmp_path / "callee.py").write_text(CALLEE)
    (tmp_path / "caller.py").write_text(plain)
    assert answer(tmp_path) == 20.0
    (tmp_path / "callee.py").write_text(CALLEE.replace("1.0", "2.5"))
    assert answer(tmp_path) == 20.0
