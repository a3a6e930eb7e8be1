import numpy as np
import pytest

from baselines.sonar_update import correct_jointly


@pytest.mark.parametrize("m", [1, 2, 5])
def test_a_joint_correction_is_the_textbooks_and_symmetric_to_the_last_bit(m):
    """``K = P H^T S^-1``, ``P - K S K^T`` and ``K e`` by numpy's solver; room beyond the state is left alone."""
    rng, n, room = np.random.default_rng(m), 7, 9
    A, H = rng.standard_normal((n, n)), rng.standard_normal((m, n))
    before = np.full((room, room), 3.0)
    before[:n, :n] = A @ A.T
    before[:n, :n] = 0.5 * (before[:n, :n] + before[:n, :n].T)
    P, shifted, e = before.copy(), np.arange(float(room)), rng.standard_normal(m)
    S = H @ before[:n, :n] @ H.T + np.eye(m)
    K = np.linalg.solve(S, H @ before[:n, :n]).T
    correct_jointly(P, n, H @ before[:n, :n], S, e, shifted)
    np.testing.assert_allclose(P[:n, :n], before[:n, :n] - K @ S @ K.T, atol=1e-11)
    np.testing.assert_allclose(shifted[:n], np.arange(n) + K @ e, atol=1e-11)
    assert np.array_equal(P, P.T)
    assert np.array_equal(P[n:], before[n:])
    assert np.array_equal(shifted[n:], np.arange(n, room))
