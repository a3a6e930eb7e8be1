"""Both filters with any estimate and covariance, and what is true of a vehicle; from numpy, scipy and gtsam."""

import math
from typing import Any, NamedTuple

import gtsam
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.linalg import expm

from baselines.ekf_slam import EkfSlam
from baselines.events import DEPTH, EPOCH, Events, Motion, Order, Views
from baselines.filter import NO_VIEWS, FilterShell
from baselines.invariant_ekf import InvariantEkf, InvariantState
from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    Mounting,
    PositionCalibration,
    SonarCalibration,
)
from sonar_graph.measurements import Floats
from sonar_graph.models import ACCEPTED
from sonar_graph.motion import Motions
from sonar_graph.navigation import Odometry

SONAR = Mounting(translation_m=(0.4, 0.1, -0.2), rpy_rad=(0.1, 0.5, -0.2))
PORT = np.array([0.1, 0.2, -0.3])
ANTENNA = -2.0 * PORT
CALIBRATION = Calibration(
    sonar=SonarCalibration(mounting=SONAR, range_sigma_m=0.02, azimuth_sigma_rad=0.01),
    depth=DepthCalibration(port_m=tuple(PORT)),
    positions=PositionCalibration(antenna_m=tuple(ANTENNA)),
)
NOISE = np.diag([0.02**2, 0.01**2])
BODY_M = np.array([1.0, -2.0, 0.5])
LANDMARKS = np.array([[4.0, -1.0, -1.7], [-2.0, 6.0, -2.5]])
BIAS = np.array([1e-3, -2e-3, 3e-3, 2e-3, 1e-3, -3e-3, 0.02, 0.01, -0.03, 0.04, 0.0])
D_BIAS = np.random.default_rng(11).normal(size=(6, 3))
NOTHING = np.zeros(6)
TWIST = np.array([0.02, -0.01, 0.05, 0.1, 0.02, -0.01])
MOTION_COV = 1e-6 * np.eye(6)


def triples(*parts: Any) -> Any:
    return st.builds(lambda *v: np.array(v), *parts)


half_turn = st.builds(
    lambda off, side: side * (np.pi - off),
    st.floats(0.0, 1e-3),
    st.sampled_from([-1, 1]),
)
tiny = st.floats(-1e-7, 1e-7)
attitudes = st.one_of(
    triples(st.floats(-3.1, 3.1), st.floats(-1.3, 1.3), st.floats(-3.1, 3.1)),
    triples(tiny, tiny, tiny),
    triples(st.one_of(tiny, half_turn), tiny, half_turn),
)
"""Roll, pitch and yaw: random, near the identity, and about half a turn."""
twists = triples(*[st.floats(-0.5, 0.5)] * 6)
views = triples(
    st.floats(1.0, 10.0), st.floats(-math.pi, math.pi), st.floats(-0.8, 0.8)
)


def rotation(vector: Floats) -> Floats:
    return np.ascontiguousarray(gtsam.Rot3.Expmap(np.asarray(vector)).matrix())


class World(NamedTuple):
    """Truth or estimate."""

    R: Floats
    X: Floats
    landmarks: Floats
    bias: Floats = BIAS


def world_at(angles: Any, landmarks: Any = LANDMARKS) -> World:
    return World(
        gtsam.Rot3.RzRyRx(np.array(angles)).matrix(),
        BODY_M,
        np.reshape(landmarks, (-1, 3)),
    )


def motion_of(twist: Floats, C: Floats = MOTION_COV, D: Floats = D_BIAS) -> Motion:
    """A motion by rotation vector and displacement."""
    return Motion(rotation(twist[:3]), np.array(twist[3:]), C, D, np.full(3, np.nan))


STILL = motion_of(np.zeros(6), np.zeros((6, 6)))


def pose_after(world: World, motion: Motion, eps: Floats = NOTHING) -> gtsam.Pose3:
    """True pose after a motion perturbed by [theta, rho] in its last frame, to which the biases add.

    The gyros' turns about the world's vertical by the second, all else by the first; a scale error shortens level ways.
    """
    off = world.bias - BIAS
    tilting = off[:3]
    turning = off[3:6]
    scale = off[10]
    up_i = world.R.T @ [0.0, 0.0, 1.0]
    up_j = motion.dR.T @ up_i
    theta = motion.D[:3] @ tilting + up_j * (up_j @ motion.D[:3] @ (turning - tilting))
    rho = motion.D[3:] @ (tilting + up_i * (up_i @ (turning - tilting)))
    rho -= scale * motion.dR.T @ (motion.dp - up_i * (up_i @ motion.dp))
    eps = eps + np.concatenate([theta, rho])
    i_T_j = gtsam.Pose3(
        gtsam.Rot3(motion.dR @ rotation(eps[:3])), motion.dp + motion.dR @ eps[3:]
    )
    return gtsam.Pose3(gtsam.Rot3(world.R), world.X).compose(i_T_j)


def sonar_after(world: World, motion: Motion, eps: Floats = NOTHING) -> gtsam.Pose3:
    return pose_after(world, motion, eps).compose(SONAR.pose())


def carried(world: World, motion: Motion, eps: Floats = NOTHING) -> World:
    pose = pose_after(world, motion, eps)
    return world._replace(R=pose.rotation().matrix(), X=pose.translation())


def random_covariance(n: int, scale: float = 0.03, seed: int = 0) -> Floats:
    """One that correlates everything."""
    A = scale * np.random.default_rng(seed).normal(size=(n, n))
    return A @ A.T


class Ekf:
    """EKF-SLAM; its error is a difference of the state's numbers, whose only bias is that of the compass."""

    kind = EkfSlam
    bare = 7

    @staticmethod
    def begin(slam: Any, world: World, P: Floats) -> None:
        slam._x = np.concatenate(
            [
                world.X,
                gtsam.Rot3(world.R).rpy(),
                world.bias[9:10],
                world.landmarks.ravel(),
            ]
        )
        slam._P = P.copy()

    @staticmethod
    def estimate(slam: Any) -> tuple[World, Floats]:
        _, x, P = slam.state()
        bias = np.concatenate([BIAS[:9], x[6:7], BIAS[10:]])
        return World(
            gtsam.Rot3.RzRyRx(x[3:6]).matrix(), x[:3], x[7:].reshape(-1, 3), bias
        ), P

    @staticmethod
    def moved(world: World, xi: Floats) -> World:
        """The world whose error against the given one is xi."""
        angles = gtsam.Rot3(world.R).rpy() + xi[3:6]
        R = gtsam.Rot3.RzRyRx(angles).matrix()
        bias = world.bias + xi[6] * np.eye(11)[9]
        return World(R, world.X + xi[:3], world.landmarks + xi[7:].reshape(-1, 3), bias)

    @staticmethod
    def error(true: World, estimate: World) -> Floats:
        turn = gtsam.Rot3(true.R).rpy() - gtsam.Rot3(estimate.R).rpy()
        turn = [math.remainder(angle, 2 * math.pi) for angle in turn]
        compass = (true.bias - estimate.bias)[9:10]
        return np.concatenate(
            [
                true.X - estimate.X,
                turn,
                compass,
                (true.landmarks - estimate.landmarks).ravel(),
            ]
        )


class Invariant:
    """The invariant filter; its error moves the world, by the matrix exponential of the group."""

    kind = InvariantEkf
    bare = 17

    @staticmethod
    def begin(slam: Any, world: World, P: Floats) -> None:
        slam._state = Invariant.state(world, P)

    @staticmethod
    def state(world: World, P: Floats) -> InvariantState:
        points = np.vstack([world.X, world.landmarks])
        return InvariantState(
            world.R.copy(),
            points,
            world.bias.copy(),
            P.copy(),
            np.zeros(3),
            is_level=True,
        )

    @staticmethod
    def estimate(slam: Any) -> tuple[World, Floats]:
        _, state = slam.state()
        return World(state.R, state.points[0], state.points[1:], state.bias), state.P

    @staticmethod
    def moved(world: World, xi: Floats) -> World:
        points = np.vstack([world.X, world.landmarks])
        size = 3 + len(points)
        algebra = np.zeros((size, size))
        element = np.eye(size)
        algebra[:3, :3] = gtsam.SO3.Hat(xi[:3])
        algebra[:3, 3:] = xi[14:].reshape(-1, 3).T
        element[:3, :3], element[:3, 3:] = world.R, points.T
        moved = (expm(algebra) @ element)[:3]
        return World(moved[:, :3], moved[:, 3], moved[:, 4:].T, world.bias + xi[3:14])

    @staticmethod
    def error(true: World, estimate: World) -> Floats:
        """First-order xi of a world close to an estimate: the logarithm's chord is left out."""
        turn = true.R @ estimate.R.T
        theta = (
            np.array(
                [
                    turn[2, 1] - turn[1, 2],
                    turn[0, 2] - turn[2, 0],
                    turn[1, 0] - turn[0, 1],
                ]
            )
            / 2
        )
        shifts = [np.vstack([world.X, world.landmarks]) for world in (true, estimate)]
        return np.concatenate(
            [theta, true.bias - estimate.bias, (shifts[0] - shifts[1] @ turn.T).ravel()]
        )


both = pytest.mark.parametrize(
    "filter_", [Ekf, Invariant], ids=["ekf-slam", "invariant-ekf"]
)


def begun(
    filter_: Any,
    world: World,
    P: Floats | None = None,
    calibration: Calibration = CALIBRATION,
    gate: float = 0.999,
    kernel_width: float = 0.0,
) -> FilterShell:
    """A filter with an estimate and a covariance, by default `random_covariance`."""
    params = filter_.kind.Params(gate_probability=gate, kernel_width=kernel_width)
    slam = filter_.kind(calibration, Odometry(calibration), params)
    n = filter_.bare + world.landmarks.size
    filter_.begin(slam, world, random_covariance(n) if P is None else P)
    return slam


def observe_one(
    slam: FilterShell, motion: Motion, slot: int, z: Floats, R_z: Floats
) -> tuple[int, Floats, Floats]:
    """Update by one known landmark: its outcome, innovation and the covariance of that."""
    first = np.zeros(1, np.int64)
    views = Views(
        stamp_ns=first,
        ids=first,
        slot=np.array([slot]),
        gate=np.array([slam.sonar.gate]),
        z=z[None],
        R_z=R_z[None],
        outcome=np.full(1, ACCEPTED, np.int8),
        e=np.zeros((1, 2)),
        S=np.zeros((1, 2, 2)),
    )
    slam.observe(motion, views, 0)
    return int(views.outcome[0]), views.e[0], views.S[0]


def follow_one(
    slam: FilterShell, kind: int, motion: Motion, end_ns: int, *depth: float
) -> None:
    """Let one epoch or depth (height, variance) happen; the motion to it has no gyro bias any more, as over a gap."""
    instants = [
        np.array([number], np.int64) for number in (end_ns, 0, end_ns, kind, 0, 0)
    ]
    motions = Motions(*(np.array([column]) for column in motion))
    value = np.zeros((1, 3))
    noise = np.zeros((1, 3, 3))
    if depth:
        value[0, 2], noise[0, 2, 2] = depth
    is_reduced = np.array([True])
    # what follows an event ends the run of events
    order = Order(*(np.append(column, 5) for column in instants))
    is_gap = np.append(is_reduced, True)
    slam.follow(Events(order, motions, is_gap, value, noise, NO_VIEWS), 0)


def predict(slam: FilterShell, motion: Motion, duration_s: float = 0.0) -> None:
    """Carry the state over a motion."""
    follow_one(slam, EPOCH, motion, round(duration_s * 1e9))


def update_depth(
    slam: FilterShell, motion: Motion, z_m: float, variance_m2: float
) -> None:
    """Update by a depth, a motion after the state."""
    follow_one(slam, DEPTH, motion, 0, z_m, variance_m2)
