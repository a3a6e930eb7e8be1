"""Both filters behind one interface: states and their errors, motions, detections; from numpy, scipy and gtsam."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import gtsam
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.linalg import expm

from baselines import ekf_equations, invariant_equations
from baselines.invariant_equations import InvariantState
from baselines.sonar_update import Frame, SonarModel, no_outcomes
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration.dvl_gaps import GapMotion
from sonar_graph.navigation.preintegration.recursion import Integral
from sonar_graph.numerics.mat3 import ZERO, euler_from_rotation, matrix, vector
from sonar_graph.slam.landmarks.association import gate_threshold

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
BODY_M, LANDMARKS = np.array([1.0, -2.0, 0.5]), np.array([[4.0, -1.0, -1.7], [-2.0, 6.0, -2.5]])
LEVEL, NO_XI = np.zeros(3), np.zeros(6)
BIAS, D_BIAS = np.array([1e-3, -2e-3, 3e-3]), np.random.default_rng(11).normal(size=(6, 3))
TWIST, MOTION_SIGMA = np.array([0.02, -0.01, 0.05, 0.1, 0.02, -0.01]), 1e-3
MOTION_COV, NOISE = MOTION_SIGMA**2 * np.eye(6), np.diag([0.02**2, 0.01**2])
ROOM, IN_ROOM = 9, 7.0
"""Numbers that arrays of EKF-SLAM have beyond the state, and what stands there."""


def triples(*parts: Any) -> Any:
    return st.builds(lambda *v: np.array(v), *parts)


half_turn = st.builds(lambda off, side: side * (np.pi - off), st.floats(0.0, 1e-3), st.sampled_from([-1, 1]))
tiny = st.floats(-1e-7, 1e-7)
attitudes = st.one_of(
    triples(st.floats(-3.1, 3.1), st.floats(-1.3, 1.3), st.floats(-3.1, 3.1)),
    triples(tiny, tiny, tiny),
    triples(st.one_of(tiny, half_turn), tiny, half_turn),
)
"""Roll, pitch and yaw: random, near the identity, and about half a turn."""
twists = triples(*[st.floats(-0.5, 0.5)] * 6)
views = triples(st.floats(1.0, 10.0), st.floats(-math.pi, math.pi), st.floats(-0.8, 0.8))


def rotation(vector: Floats) -> Floats:
    return np.ascontiguousarray(gtsam.Rot3.Expmap(np.asarray(vector)).matrix())


def motion_of(twist: Floats, C: Floats = MOTION_COV) -> Integral:
    """A motion by rotation vector and displacement, with the covariance of its perturbation [theta_i, eps]."""
    dR = matrix(rotation(twist[:3]))
    return Integral(dR, vector(twist[3:]), ZERO, matrix(C[:3, :3]), matrix(C[3:, :3]), matrix(C[3:, 3:]))


def gap_motion_of(twist: Floats, C: Floats = MOTION_COV, D: Floats = D_BIAS) -> GapMotion:
    """A motion with the derivative D (6, 3) of its perturbation by the bias."""
    return GapMotion(motion_of(twist, C), matrix(D[:3]), matrix(D[3:]))


def derivative(function: Callable[[Floats], Floats], size: int, step: float = 1e-6) -> Floats:
    """By central differences, one column an argument."""
    return np.array([(function(step * u) - function(-step * u)) / (2 * step) for u in np.eye(size)]).T


def unwrapped(difference: Floats, *angles: int) -> Floats:
    for k in angles:
        difference[k] = math.remainder(difference[k], 2 * math.pi)
    return difference


class Seen:
    """Detections of a frame, and their outcomes."""

    def __init__(self, slots: list[int], z: Any, sonar: SonarModel, noise: Floats, was_lost: bool) -> None:
        range_m, azimuth = np.array(z, float).reshape(-1, 2).T.copy()
        columns = np.array(slots), range_m, azimuth, np.array([noise] * len(slots))
        self.sonar, told = sonar, no_outcomes(len(slots))
        self.rows = Frame(columns, 0, len(slots), told, was_lost)
        self.outcomes, self.innovations, self.covs = told


class EkfState(NamedTuple):
    x: Floats
    full_P: Floats
    n: int

    @property
    def P(self) -> Floats:
        return self.full_P[: self.n, : self.n]


class Ekf:
    """EKF-SLAM; its error is a difference of the state's numbers."""

    @staticmethod
    def state(angles: Floats, landmarks: Any = LANDMARKS, scale: float = 0.03, seed: int = 0) -> EkfState:
        """A state with a covariance that correlates everything."""
        n = 6 + np.size(landmarks)
        x, P = np.full(n + ROOM, IN_ROOM), np.full((n + ROOM, n + ROOM), IN_ROOM)
        x[:n] = np.concatenate([BODY_M, angles, np.ravel(landmarks)])
        A = scale * np.random.default_rng(seed).normal(size=(n, n))
        P[:n, :n] = A @ A.T
        return EkfState(x, P, n)

    @staticmethod
    def changed(state: EkfState, change: Callable[..., int | None]) -> EkfState:
        """What a function makes of a copy of the state; it leaves the room beyond it as it was."""
        x, P = state.x.copy(), state.full_P.copy()
        n = change(x, P, state.n) or state.n
        assert (x[n:] == IN_ROOM).all()
        assert (P[n:] == IN_ROOM).all()
        assert (P[:, n:] == IN_ROOM).all()
        return EkfState(x, P, n)

    @staticmethod
    def world(state: EkfState) -> tuple[Floats, Floats, Floats, Floats]:
        """Rotation and position of the body, the landmarks, and what the bias adds to a motion."""
        x = state.x
        return gtsam.Rot3.RzRyRx(x[3:6]).matrix(), x[:3], x[6 : state.n].reshape(-1, 3), NO_XI

    @staticmethod
    def posed(state: EkfState, R: Floats, X: Floats) -> EkfState:
        return state._replace(x=np.concatenate([X, euler_from_rotation(matrix(R)), state.x[6:]]))

    @staticmethod
    def appended(state: EkfState, point: Floats) -> EkfState:
        x = state.x.copy()
        x[state.n : state.n + 3] = point
        return state._replace(x=x, n=state.n + 3)

    @staticmethod
    def moved(state: EkfState, xi: Floats) -> EkfState:
        """The state whose error against the given one is xi."""
        x = state.x.copy()
        x[: state.n] += xi
        return state._replace(x=x)

    @staticmethod
    def error(true: EkfState, estimate: EkfState) -> Floats:
        return unwrapped(true.x[: true.n] - estimate.x[: true.n], 3, 4, 5)

    @staticmethod
    def covariance(state: EkfState, k: int) -> Floats:
        """Covariance of the body's position (k = 0) or a landmark's."""
        at = 0 if k == 0 else 3 + 3 * k
        return state.P[at : at + 3, at : at + 3]

    @classmethod
    def predicted(cls, state: EkfState, twist: Floats, C: Floats) -> EkfState:
        return cls.changed(state, lambda x, P, n: ekf_equations.predict(x, P, n, motion_of(twist, C)))

    @staticmethod
    def pose_after(state: EkfState, twist: Floats, C: Floats) -> Any:
        return ekf_equations.pose_after(state.x, state.full_P, motion_of(twist, C))

    @classmethod
    def corrected(cls, state: EkfState, H: Floats, R: Floats, e: Floats) -> EkfState:
        """By m numbers: one, two and more have functions of their own."""
        cross_cov, S = H @ state.P, H @ state.P @ H.T + R

        def change(x: Floats, P: Floats, n: int) -> None:
            if len(e) == 1:
                ekf_equations.correct(x, P, n, cross_cov[0], S[0, 0], e[0])
            else:
                update = ekf_equations.correct_pair if len(e) == 2 else ekf_equations.correct_by
                update(x, P, n, cross_cov, S, e)

        return cls.changed(state, change)

    @classmethod
    def corrected_by_depth(cls, state: EkfState, twist: Floats, C: Floats, *measured: Any) -> EkfState:
        return cls.changed(state, lambda x, P, n: ekf_equations.correct_depth(x, P, n, motion_of(twist, C), *measured))

    @staticmethod
    def observation(state: EkfState, k: int, twist: Floats) -> tuple[Floats, Floats, Floats]:
        """Range and azimuth, H (2, n) and H_m (2, 6)."""
        at, moment = 3 + 3 * k, ekf_equations.moment_after(state.x, motion_of(twist))
        z, *rows = ekf_equations.observation(moment, vector(state.x[at:]), SONAR)
        H = np.zeros((2, state.n))
        H[:, :6] = [row.by_X + row.by_angles for row in rows]
        H[:, at : at + 3] = -H[:, :3]
        return z, H, np.array([row.by_theta + row.by_eps for row in rows])

    @staticmethod
    def location(state: EkfState, twist: Floats, view: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        moment, (*z, elevation) = ekf_equations.moment_after(state.x, motion_of(twist)), view.tolist()
        point, rows, G_z = ekf_equations.location(moment, SONAR, tuple(z), elevation)
        G = np.hstack([[row.by_X + row.by_angles for row in rows], np.zeros((3, state.n - 6))])
        return np.array(point), G, np.array([row.by_theta + row.by_eps for row in rows]), np.array(G_z)

    @classmethod
    def observed(cls, state: EkfState, seen: Seen, twist: Floats, C: Floats) -> EkfState:
        motion = motion_of(twist, C)
        return cls.changed(state, lambda x, P, n: ekf_equations.observe_rows(x, P, n, motion, seen.sonar, seen.rows))


class Invariant:
    """The invariant filter, with the same functions."""

    @staticmethod
    def state(angles: Floats, landmarks: Any = LANDMARKS, scale: float = 0.03, seed: int = 0) -> InvariantState:
        points = np.vstack([BODY_M, np.reshape(landmarks, (-1, 3))])
        n = 6 + 3 * len(points)
        A = scale * np.random.default_rng(seed).normal(size=(n, n))
        return InvariantState(np.ascontiguousarray(gtsam.Rot3.RzRyRx(angles).matrix()), points, BIAS.copy(), A @ A.T)

    @staticmethod
    def changed(state: InvariantState, change: Callable[..., object], *arguments: Any) -> InvariantState:
        copy = InvariantState(*(part.copy() for part in state))
        change(copy, *arguments)
        return copy

    @staticmethod
    def world(state: InvariantState) -> tuple[Floats, Floats, Floats, Floats]:
        return state.R, state.points[0], state.points[1:], D_BIAS @ (state.bias - BIAS)

    @staticmethod
    def posed(state: InvariantState, R: Floats, X: Floats) -> InvariantState:
        return state._replace(R=R, points=np.vstack([X, state.points[1:]]))

    @staticmethod
    def appended(state: InvariantState, point: Floats) -> InvariantState:
        return state._replace(points=np.vstack([state.points, point]))

    @staticmethod
    def moved(state: InvariantState, xi: Floats) -> InvariantState:
        """By the matrix exponential of the group."""
        size = 3 + len(state.points)
        algebra, element = np.zeros((size, size)), np.eye(size)
        algebra[:3, :3] = gtsam.SO3.Hat(xi[:3])
        algebra[:3, 3:] = xi[6:].reshape(-1, 3).T
        element[:3, :3], element[:3, 3:] = state.R, state.points.T
        moved = expm(algebra) @ element
        return InvariantState(moved[:3, :3].copy(), moved[:3, 3:].T.copy(), state.bias + xi[3:6], state.P.copy())

    @staticmethod
    def error(true: InvariantState, estimate: InvariantState) -> Floats:
        """First-order xi of a state close to an estimate: the logarithm's chord is left out."""
        turn = true.R @ estimate.R.T
        theta = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        xi = true.points - estimate.points @ turn.T
        return np.concatenate([theta, true.bias - estimate.bias, xi.ravel()])

    @staticmethod
    def covariance(state: InvariantState, k: int) -> Floats:
        return invariant_equations.landmark_covariance(state, k)

    @classmethod
    def predicted(cls, state: InvariantState, twist: Floats, C: Floats, walk: float = 0.0) -> InvariantState:
        return cls.changed(state, invariant_equations.predict, gap_motion_of(twist, C), walk)

    @staticmethod
    def pose_after(state: InvariantState, twist: Floats, C: Floats) -> Any:
        return invariant_equations.pose_after(state, gap_motion_of(twist, C))

    @classmethod
    def corrected(cls, state: InvariantState, H: Floats, R: Floats, e: Floats) -> InvariantState:
        return cls.changed(state, invariant_equations.correct, H @ state.P, H @ state.P @ H.T + R, e)

    @classmethod
    def corrected_by_depth(cls, state: InvariantState, twist: Floats, C: Floats, *measured: Any) -> InvariantState:
        return cls.changed(state, invariant_equations.correct_depth, gap_motion_of(twist, C), *measured)

    @staticmethod
    def observation(state: InvariantState, k: int, twist: Floats) -> Any:
        return invariant_equations.observation(state, k, gap_motion_of(twist), SONAR)

    @staticmethod
    def location(state: InvariantState, twist: Floats, view: Floats) -> Any:
        *z, elevation = view.tolist()
        return invariant_equations.location(state, gap_motion_of(twist), SONAR, tuple(z), elevation)

    @staticmethod
    def observed(state: InvariantState, seen: Seen, twist: Floats, C: Floats) -> InvariantState:
        copy = InvariantState(*(part.copy() for part in state))
        return invariant_equations.observe_rows(copy, gap_motion_of(twist, C), seen.sonar, seen.rows)


both = pytest.mark.parametrize("filter_", [Ekf, Invariant], ids=["ekf-slam", "invariant-ekf"])


def body_after(filter_: Any, state: Any, twist: Floats, xi_motion: Floats = NO_XI) -> tuple[Floats, Floats]:
    """True rotation and position after a motion perturbed by [theta_i, eps]; the bias acts through `D_BIAS`."""
    R, X, _, by_bias = filter_.world(state)
    off = xi_motion + by_bias
    return R @ rotation(off[:3]) @ rotation(twist[:3]), X + R @ (twist[3:] + off[3:])


def sonar_pose(filter_: Any, state: Any, twist: Floats = TWIST, xi_motion: Floats = NO_XI) -> gtsam.Pose3:
    R, X = body_after(filter_, state, twist, xi_motion)
    return gtsam.Pose3(gtsam.Rot3(R), X).compose(MOUNTING)


def observed(
    filter_: Any, state: Any, slots: list[int], z: Any, sonar: SonarModel = SONAR, noise: Floats = NOISE,
    twist: Floats = TWIST, C: Floats = MOTION_COV, was_lost: bool = False,
) -> tuple[Any, Seen]:  # fmt: skip
    seen = Seen(slots, z, sonar, noise, was_lost)
    return filter_.observed(state, seen, twist, C), seen
