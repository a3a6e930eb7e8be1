"""What a whole run tells, by its linearisation: the null space of the observability matrix at changing estimates.

A run of 12 steps with height, up direction and two landmarks at each. Three directions are unobservable, the world's x,
y and heading, and a filter must not think otherwise because its estimates change.
"""

import numpy as np
import pytest

from baselines.ekf_equations import moment_after, observation
from baselines.invariant_equations import InvariantState, by_bias, height_of_body_point, motion_jacobian, up_innovation
from baselines.invariant_equations import observation as invariant_observation
from sonar_graph.navigation.preintegration.recursion import NO_MOTION
from sonar_graph.numerics.mat3 import euler_from_rotation, matrix, rotation_from_euler, vector

from .invariant import LANDMARKS, SONAR, derivative, gap_motion_of, gauge, rotation

STEPS = 12
TWIST = np.array([0.05, -0.03, 0.25, 0.5, 0.1, -0.05])
D = 0.2 * np.random.default_rng(3).normal(size=(6, 3))


def estimates(wander):
    """Attitude, position and map at each step: the truth, and as far off as corrections throw estimates about."""
    rng = np.random.default_rng(1)
    R, X = rotation(np.array([0.1, -0.2, 0.5])), np.array([0.5, -0.5, 0.3])
    for _ in range(STEPS):
        off = wander * rng.normal(size=(2 + len(LANDMARKS), 3))
        yield rotation(off[0]) @ R, X + off[1], LANDMARKS + off[2:]
        R, X = R @ rotation(TWIST[:3]), X + R @ TWIST[3:]


def invariant(wander):
    """Rows H F ... F of the invariant filter, with the bias."""
    rows, F = [], np.eye(6 + 3 * 3)
    for R, X, landmarks in estimates(wander):
        state = InvariantState(R, np.vstack([X, landmarks]), np.zeros(3), np.eye(len(F)))
        still = gap_motion_of(np.zeros(6), np.zeros((6, 6)), np.zeros((6, 3)))
        seen = [invariant_observation(state, k, still, SONAR)[1] for k in (1, 2)]
        others = height_of_body_point(state, still, (0.0, 0.0, 0.0))[1], up_innovation(state, vector(R[2]))[1]
        rows += [H @ F for H in (*seen, *others)]
        after = np.vstack([X + R @ TWIST[3:], landmarks])
        step = np.eye(len(F))
        step[:, 3:6] += by_bias(motion_jacobian(after, matrix(R)), gap_motion_of(TWIST, np.zeros((6, 6)), D))
        F = step @ F
    return np.vstack(rows)


def plain(wander):
    """The same of the plain filter, whose state has Euler angles and no bias."""
    rows, F = [], np.eye(6 + 3 * 2)
    for R, X, landmarks in estimates(wander):
        x = np.concatenate([X, euler_from_rotation(matrix(R)), landmarks.ravel()])
        H = np.zeros((7, len(x)))
        for k, p in enumerate(landmarks):
            _, *seen = observation(moment_after(x, NO_MOTION), vector(p), SONAR)
            for r, row in enumerate(seen):
                H[2 * k + r, :6], H[2 * k + r, 6 + 3 * k : 9 + 3 * k] = row.by_X + row.by_angles, np.negative(row.by_X)
        H[4:, 2:5] = np.eye(3)
        rows.append(H @ F)
        F = derivative(lambda d, x=x: carried(x + d) - carried(x), len(x)) @ F
    return np.vstack(rows)


def carried(x):
    R = np.array(rotation_from_euler(vector(x[3:])))
    angles = euler_from_rotation(matrix(R @ rotation(TWIST[:3])))
    return np.concatenate([x[:3] + R @ TWIST[3:], angles, x[6:]])


def unobservable(rows):
    singular = np.linalg.svd(rows, compute_uv=False)
    return int(np.sum(singular < 1e-6 * singular[0]))


@pytest.mark.parametrize("wander", [0.0, 0.1])
def test_the_invariant_filter_leaves_three_directions_open_at_any_estimates(wander):
    rows = invariant(wander)
    assert unobservable(rows) == 3
    assert np.abs(rows @ gauge(3)).max() < 1e-9


def test_the_plain_filter_does_so_at_the_truth_only():
    assert unobservable(plain(0.0)) == 3
    assert unobservable(plain(0.1)) == 2
