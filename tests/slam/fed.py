"""Smoothers that were fed a run, with every factor that they were given."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.measurements import Floats
from sonar_graph.slam import factors
from sonar_graph.slam.odometry_factor import OdometryWithBias
from sonar_graph.slam.smoother import Factors

from .graphs import block_of, dense_covariance
from .made import motion_of, plain, polar, smoother_with
from .rail import RANGE_SIGMA_M, STEP_S, VELOCITY_SIGMA_M_S, Rail, calibration, rail

FOREVER_S = 1e9
NEVER_M = 1e9
SONAR = gtsam.Pose3(gtsam.Rot3.Ry(0.4), np.array([0.3, 0.0, -0.1]))


class Fed:
    """A smoother, and on the side every factor that it was given."""

    def __init__(
        self, lag_s: float, stale_shift_m: float = NEVER_M, *, is_bounded: bool = False
    ) -> None:
        self.smoother = smoother_with(lag_s, 1e-6, stale_shift_m, is_bounded=is_bounded)
        self.groups: dict[int, Factors] = {}

    def add(self, new: Factors) -> None:
        self.groups[self.smoother.add(new)] = new

    @property
    def given(self) -> list[gtsam.NonlinearFactor]:
        return [factor for group in self.groups.values() for factor in group.values()]

    def handles_on(self, *keys: int) -> list[int]:
        """Of the groups on just these variables."""
        return [
            handle
            for handle, group in self.groups.items()
            if {key for factor in group.values() for key in factor.keys()} == set(keys)  # noqa: SIM118
        ]

    def joint(self, *keys: int) -> Floats:
        return block_of(self.smoother.joint_covariance(list(keys)), list(keys))

    def dense(self, values: gtsam.Values, *keys: int) -> Floats:
        """The same from all factors that were given, by numpy."""
        return dense_covariance(self.given, values, list(keys))


def on_the_rail(
    nodes: int,
    lag_s: float,
    stale_shift_m: float = NEVER_M,
    held: dict[int, float] | None = None,
    *,
    is_bounded: bool = False,
) -> Fed:
    _, numbers = rail(nodes)
    fed = Fed(lag_s, stale_shift_m, is_bounded=is_bounded)
    seen = set()
    fed.smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    fed.add({"start prior": factors.start_prior(X(0), calibration())})
    cov = np.diag([1e-12] * 3 + [(VELOCITY_SIGMA_M_S * STEP_S) ** 2] * 3)
    for k in range(1, nodes):
        moved = gtsam.Pose3(
            gtsam.Rot3(), np.array([numbers.displacements_m[k - 1], 0, 0])
        )
        pose = fed.smoother.values.atPose3(X(k - 1)).compose(moved)
        fed.smoother.add_pose(X(k), pose, k * STEP_S)
        if held and X(k) in held:
            fed.smoother.hold(held)
        fed.add({"odometry": factors.odometry(X(k - 1), X(k), motion_of(moved, cov))})
        for _, i, distance in (r for r in numbers.ranges if r[0] == k):
            if i not in seen:
                fed.smoother.add_landmark(
                    L(i), pose.translation() + distance * np.eye(3)[0]
                )
            fed.add(ranged(k, i, distance, None if i in seen else 3e-4))
            seen.add(i)
        fed.smoother.update(k * STEP_S)
    return fed


def ranged(
    k: int, i: int, distance: float, elevation_sigma: float | None = None
) -> Factors:
    """Factors of a range on the rail."""
    z = np.array([distance, 0.0])
    R = np.diag([RANGE_SIGMA_M**2, 1e-2])
    return factors.landmark_sighting(
        X(k), L(i), gtsam.Pose3(), z, R, plain, elevation_sigma
    )


def assert_is_least_squares(
    fed: Fed, numbers: Rail, nodes: int, landmarks: tuple[int, ...] = (4, 7)
) -> None:
    """The window's newest pose and its landmarks along x, with their variances, are those of numpy."""
    mean, variance = numbers.solution(nodes)
    newest = X(nodes - 1)
    assert fed.smoother.values.atPose3(newest).translation()[0] == pytest.approx(
        mean[f"x{nodes - 1}"], abs=1e-8
    )
    assert fed.joint(newest)[3, 3] == pytest.approx(variance[f"x{nodes - 1}"], abs=1e-8)
    for i in landmarks:
        assert fed.smoother.values.atPoint3(L(i))[0] == pytest.approx(
            mean[f"l{i}"], abs=1e-8
        )
        assert fed.smoother.marginals.marginalCovariance(L(i))[0, 0] == pytest.approx(
            variance[f"l{i}"], abs=1e-8
        )


def in_the_basin(
    steps: int,
    lag_s: float,
    stale_shift_m: float = NEVER_M,
    seed: int = 0,
    kernel=plain,
) -> Fed:
    """Circles past three landmarks with a constant gyro bias; nothing about it is linear."""
    rng = np.random.default_rng(seed)
    turn = gtsam.Pose3(gtsam.Rot3.Rz(0.25), np.array([0.5, 0.0, 0.0]))
    landmarks = {
        3: np.array([3.0, 1.0, -1.0]),
        5: np.array([2.0, 4.0, -0.8]),
        8: np.array([-1.0, 2.5, -1.2]),
    }
    sigmas = np.array([0.01] * 3 + [0.02] * 3)
    start = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    by_gyro = -np.eye(6, 11) * (np.arange(11) < 3)
    R = np.diag([4e-4, 8e-5])
    fed = Fed(lag_s, stale_shift_m)
    truth = gtsam.Pose3()
    fed.smoother.add_pose(X(0), truth, 0.0)
    fed.smoother.add_bias(B(0), np.zeros(11))
    fed.add({"start prior": gtsam.PriorFactorPose3(X(0), truth, start)})
    fed.add({"bias prior": factors.bias_prior(B(0), np.full(11, 0.01))})
    for k in range(1, steps):
        truth = truth.compose(turn)
        moved = turn.compose(gtsam.Pose3.Expmap(sigmas * rng.standard_normal(6)))
        motion = motion_of(moved, np.diag(sigmas**2), by_gyro)
        before = fed.smoother.values.atPose3(X(k - 1))
        fed.smoother.add_pose(X(k), before.compose(moved), float(k))
        fed.add({"odometry": OdometryWithBias(X(k - 1), X(k), B(0), motion)})
        for i, p in landmarks.items():
            z = polar(truth.compose(SONAR), p) + [0.02, 0.009] * rng.standard_normal(2)
            elevation_sigma = 0.3 if k == 1 else None
            if k == 1:
                fed.smoother.add_landmark(L(i), p + 0.3 * rng.standard_normal(3))
            fed.add(
                factors.landmark_sighting(
                    X(k), L(i), SONAR, z, R, kernel, elevation_sigma
                )
            )
        fed.smoother.update(float(k))
    return fed
