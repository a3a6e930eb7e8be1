"""The invariant filter's error from numpy and gtsam, and states to try it on."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from hypothesis import strategies as st

from baselines.invariant_equations import InvariantState
from baselines.sonar_update import SonarModel
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration.dvl_gaps import GapMotion
from sonar_graph.numerics.mat3 import matrix, vector
from sonar_graph.slam.landmarks.association import gate_threshold

from .motions import motion_of

MOUNTING = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.5, -0.2), np.array([0.4, 0.1, -0.2]))
SONAR = SonarModel(
    body_R_sonar=matrix(MOUNTING.rotation().matrix()),
    body_p_sonar=vector(MOUNTING.translation()),
    gate=gate_threshold(0.999, 2),
    aperture_rad=0.244,
    range_variance_m2=4e-4,
    azimuth_variance=1e-4,
    has_floor=False,
    floor_z_m=0.0,
    floor_variance_m2=1e-4,
)
STEP = 1e-6
LANDMARKS = np.array([[4.0, -1.0, -1.7], [-2.0, 6.0, -2.5]])
WRAP_AROUND = st.builds(lambda axis, off: (np.pi - off) * np.eye(3)[axis], st.integers(0, 2), st.floats(-1e-3, 1e-3))
rotation_vectors = st.one_of(
    st.builds(lambda *v: np.array(v), *[st.floats(-1.7, 1.7)] * 3),
    st.builds(lambda *v: np.array(v), *[st.floats(-1e-7, 1e-7)] * 3),
    WRAP_AROUND,
)
"""Random, near the identity, and about half a turn."""
twists = st.builds(lambda *v: np.array(v), *[st.floats(-0.5, 0.5)] * 6)


def rotation(vector: Floats) -> Floats:
    return np.array(gtsam.Rot3.Expmap(np.asarray(vector)).matrix())


def state_at(attitude: Floats, landmarks: Floats = LANDMARKS, seed: int = 0, scale: float = 0.03) -> InvariantState:
    """A state with a covariance that correlates everything."""
    points = np.vstack([[1.0, -2.0, 0.5], landmarks])
    n = 6 + 3 * len(points)
    A = scale * np.random.default_rng(seed).normal(size=(n, n))
    return InvariantState(rotation(attitude), points, np.array([1e-3, -2e-3, 3e-3]), A @ A.T)


def copied(state: InvariantState) -> InvariantState:
    return InvariantState(*(part.copy() for part in state))


def moved_by(state: InvariantState, xi: Floats) -> InvariantState:
    """The state whose error against the given one is xi, by the matrix exponential of the group."""
    size = 3 + len(state.points)
    algebra, element = np.zeros((size, size)), np.eye(size)
    algebra[:3, :3] = gtsam.SO3.Hat(xi[:3])
    algebra[:3, 3:] = xi[6:].reshape(-1, 3).T
    element[:3, :3], element[:3, 3:] = state.R, state.points.T
    moved = exponential(algebra) @ element
    return InvariantState(moved[:3, :3].copy(), moved[:3, 3:].T.copy(), state.bias + xi[3:6], state.P.copy())


def exponential(A: Floats) -> Floats:
    """By its series, after halving often enough."""
    result = term = np.eye(len(A))
    for k in range(1, 20):
        term = term @ A / (k * 2.0**10)
        result = result + term
    return np.linalg.matrix_power(result, 2**10)


def error(true: InvariantState, estimate: InvariantState) -> Floats:
    """First-order xi of a state close to an estimate: the logarithm's chord is left out."""
    turn = true.R @ estimate.R.T
    theta = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    xi = true.points - estimate.points @ turn.T
    return np.concatenate([theta, true.bias - estimate.bias, xi.ravel()])


def derivative(function: Callable[[Floats], Floats], size: int, step: float = STEP) -> Floats:
    """By central differences, one column an argument."""
    return np.array([(function(step * u) - function(-step * u)) / (2 * step) for u in np.eye(size)]).T


def gap_motion_of(twist: Floats, cov: Floats, D: Floats) -> GapMotion:
    """A motion with the derivative D (6, 3) of its perturbation [theta_i, eps] by the bias."""
    return GapMotion(motion_of(twist, cov), matrix(D[:3]), matrix(D[3:]))


D_BIAS = np.random.default_rng(11).normal(size=(6, 3))


def body_after(state: InvariantState, twist: Floats, xi_motion: Floats) -> tuple[Floats, Floats]:
    """Rotation and position after a motion perturbed by [theta_i, eps]; the bias acts through D_BIAS."""
    dR, dp = rotation(twist[:3]), twist[3:]
    return state.R @ rotation(xi_motion[:3]) @ dR, state.points[0] + state.R @ (dp + xi_motion[3:])


def gauge(points: int, directions: str = "xy-yaw") -> Floats:
    """Moves of the whole world along x and y (and z), and its turn about the vertical, as columns of xi."""
    axes = 3 if directions == "xyz-yaw" else 2
    N = np.zeros((6 + 3 * points, axes + 1))
    N[2, axes] = 1.0
    for k in range(points):
        N[6 + 3 * k : 6 + 3 * k + axes, :axes] = np.eye(axes)
    return N
