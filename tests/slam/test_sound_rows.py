"""What can be a covariance, against eigenvalues by numpy."""

import numpy as np
import pytest

from sonar_graph.slam.keyframes import positive_definite


@pytest.mark.parametrize("k", [2, 3])
def test_positive_definite_are_those_whose_eigenvalues_are_above_zero(k):
    rng = np.random.default_rng(k)
    roots = rng.normal(size=(2000, k, k))
    matrices = roots @ roots.transpose(0, 2, 1) - rng.uniform(0, 1, 2000)[:, None, None] * np.eye(k)
    matrices *= 10.0 ** rng.uniform(-8, 8, 2000)[:, None, None]
    expected = np.linalg.eigvalsh(matrices)[:, 0] > 0
    assert 200 < expected.sum() < 1800
    assert np.array_equal(positive_definite(matrices), expected)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_singular_ones_are_not(scale):
    rng = np.random.default_rng(0)
    roots = rng.uniform(0.5, 2.0, size=(500, 3, 1))
    assert not positive_definite(scale * (roots @ roots.transpose(0, 2, 1))).any()
    assert not positive_definite(scale * np.diag([1.0, 0.0, 1.0])[None]).any()
    assert positive_definite(scale * np.eye(3)[None]).all()
    assert positive_definite(np.diag([1e6, 1e-6, 1.0])[None]).all()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_not(wrong):
    for i in range(3):
        for j in range(3):
            matrix = np.eye(3)
            matrix[i, j] = matrix[j, i] = wrong
            assert not positive_definite(np.stack([np.eye(3), matrix]))[1]
            assert positive_definite(np.stack([np.eye(3), matrix]))[0]
