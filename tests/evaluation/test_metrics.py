from __future__ import annotations

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import metrics
from sonar_graph.states import LandmarkMap, Trajectory

seeds = st.integers(0, 2**32 - 1)
STEP_NS = 500_000_000


def random_walk(seed: int, n: int = 60) -> Trajectory:
    rng = np.random.default_rng(seed)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.1, size=(n, 3)), axis=0))
    positions = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    return Trajectory.without_covariances(np.arange(n) * STEP_NS, positions, rotations.as_quat())


def disturbed(truth: Trajectory, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    positions = truth.positions + rng.normal(scale=0.3, size=truth.positions.shape)
    rotations = truth.rotations() * Rotation.from_rotvec(rng.normal(scale=0.05, size=(len(truth), 3)))
    return Trajectory.without_covariances(truth.stamps_ns, positions, rotations.as_quat())


def moved(trajectory: Trajectory, turn: Rotation, shift: tuple[float, float, float]) -> Trajectory:
    return Trajectory.without_covariances(
        trajectory.stamps_ns, turn.apply(trajectory.positions) + shift, (turn * trajectory.rotations()).as_quat()
    )


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        positions_xyz=trajectory.positions,
        orientations_quat_wxyz=trajectory.quaternions_xyzw[:, [3, 0, 1, 2]],
        timestamps=trajectory.stamps_ns * 1e-9,
    )


def evo_rmse(metric: APE | RPE, truth: PoseTrajectory3D, estimate: PoseTrajectory3D) -> float:
    metric.process_data((truth, estimate))
    return metric.get_statistic(StatisticsType.rmse)


@settings(max_examples=20)
@given(seeds)
def test_ate_agrees_with_evo(seed):
    truth = random_walk(seed)
    estimate = moved(disturbed(truth, seed + 1), Rotation.from_euler("z", 0.4), (1.0, 2.0, 3.0))
    raw = evo_rmse(APE(PoseRelation.translation_part), as_evo(truth), as_evo(estimate))
    assert metrics.ate_raw_m(estimate, truth) == pytest.approx(raw, abs=1e-9)
    aligned = as_evo(estimate)
    aligned.align(as_evo(truth))
    se3 = evo_rmse(APE(PoseRelation.translation_part), as_evo(truth), aligned)
    assert metrics.ate_se3_m(estimate, truth) == pytest.approx(se3, abs=1e-9)
    assert se3 < raw / 2


def flat(trajectory: Trajectory) -> Trajectory:
    level = Rotation.from_euler("z", trajectory.rotations().as_euler("ZYX")[:, :1])
    return Trajectory.without_covariances(trajectory.stamps_ns, trajectory.positions * [1, 1, 0], level.as_quat())


@settings(max_examples=20)
@given(seeds)
def test_errors_on_a_plane_agree_with_evo(seed):
    truth = flat(random_walk(seed))
    estimate = moved(flat(disturbed(truth, seed + 1)), Rotation.from_euler("z", 0.4), (1.0, 2.0, 0.0))
    aligned = as_evo(estimate)
    aligned.align(as_evo(truth))
    se2 = evo_rmse(APE(PoseRelation.translation_part), as_evo(truth), aligned)
    assert metrics.ate_se2_m(estimate, truth) == pytest.approx(se2, abs=1e-9)
    turns = RPE(PoseRelation.rotation_angle_rad, delta=2, delta_unit=Unit.frames, all_pairs=True)
    expected = evo_rmse(turns, as_evo(truth), as_evo(estimate))
    assert metrics.rmse(metrics.relative_errors(estimate, truth, 1).yaw_rad) == pytest.approx(expected, abs=1e-9)
    assert expected > 0.01


@settings(max_examples=20)
@given(seeds, st.sampled_from([1, 10]))
def test_relative_error_agrees_with_evo(seed, delta_s):
    truth = random_walk(seed)
    estimate = disturbed(truth, seed + 1)
    frames = delta_s * 1_000_000_000 // STEP_NS
    evo = RPE(PoseRelation.translation_part, delta=frames, delta_unit=Unit.frames, all_pairs=True)
    expected = evo_rmse(evo, as_evo(truth), as_evo(estimate))
    relative = metrics.relative_errors(estimate, truth, delta_s)
    assert metrics.rmse(relative.translation_m) == pytest.approx(expected, abs=1e-9)
    assert len(relative) == len(truth) - frames


@settings(max_examples=20)
@given(seeds, st.floats(-3, 3))
def test_aligned_and_relative_errors_do_not_depend_on_the_world(seed, angle):
    truth = random_walk(seed)
    estimate = disturbed(truth, seed + 1)
    elsewhere = moved(estimate, Rotation.from_euler("z", angle), (10.0, -5.0, 1.0))
    for metric in (metrics.ate_yaw_m, metrics.ate_se2_m, metrics.ate_se3_m):
        assert metric(elsewhere, truth) == pytest.approx(metric(estimate, truth), abs=1e-9)
    there, here = (metrics.relative_errors(t, truth, 10.0).translation_m for t in (elsewhere, estimate))
    np.testing.assert_allclose(there, here, atol=1e-9)
    assert metrics.ate_raw_m(elsewhere, truth) > 3.0


def line(yaws: list[float], positions: list[list[float]]) -> Trajectory:
    quaternions = Rotation.from_euler("z", np.array(yaws)[:, None]).as_quat()
    return Trajectory.without_covariances(np.arange(len(yaws)) * STEP_NS, np.array(positions, dtype=float), quaternions)


def test_planar_errors_by_hand():
    truth = line([0.0] * 4, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    estimate = line([0.0] * 4, [[0, 0, 1], [1, 0, 1], [1, 1, -1], [0, 1, -1]])
    assert metrics.ate_raw_m(estimate, truth) == pytest.approx(1.0)
    assert metrics.ate_yaw_m(estimate, truth) == pytest.approx(1.0)
    assert metrics.ate_se2_m(estimate, truth) == pytest.approx(0.0, abs=1e-12)


def test_return_error_is_the_error_of_the_displacement():
    truth = line([0.0] * 3, [[0, 0, 0], [5, 0, 0], [0, 0, 0]])
    estimate = line([0.0] * 3, [[1, 1, 0], [9, 9, 9], [1.3, 1.4, 0]])
    assert metrics.return_error_m(estimate, truth) == pytest.approx(0.5)


def test_yaw_error_wraps():
    truth = line([np.pi - 0.01], [[0, 0, 0]])
    estimate = line([-np.pi + 0.02], [[0, 0, 0]])
    np.testing.assert_allclose(metrics.yaw_errors_rad(estimate, truth), [0.03], atol=1e-12)


def test_a_constant_heading_error_is_in_yaw_but_not_in_relative_yaw():
    truth = random_walk(3)
    estimate = moved(truth, Rotation.from_euler("z", 0.2), (0.0, 0.0, 0.0))
    assert metrics.rmse(metrics.yaw_errors_rad(estimate, truth)) == pytest.approx(0.2)
    assert metrics.rmse(metrics.relative_errors(estimate, truth, 1.0).yaw_rad) == pytest.approx(0.0, abs=1e-9)


def test_pairs_skip_instants_without_a_partner():
    stamps = np.array([0.0, 0.5, 1.0, 1.5, 4.0, 5.0]) * 1e9
    first, second = metrics.pairs_apart(stamps.astype(np.int64), 1.0)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(0, 2), (1, 3), (4, 5)]


def test_pairs_forgive_the_rounding_of_a_third_of_a_second():
    stamps = np.arange(10, dtype=np.int64) * 333_333_333
    first, second = metrics.pairs_apart(stamps, 1.0)
    np.testing.assert_array_equal(second - first, 3)
    assert len(first) == 7


def test_no_pairs_in_a_single_instant():
    assert not len(metrics.pairs_apart(np.array([5]), 1.0)[0])


def landmark_map(ids: list[int], positions: list[list[float]]) -> LandmarkMap:
    return LandmarkMap(np.array(ids), np.array(positions, dtype=float), np.full((len(ids), 3, 3), np.nan))


def test_landmarks_of_the_seed_experiment_by_hand():
    true = landmark_map([1, 2, 3, 4], [[5, 0, 0], [7, -5, 0], [2, -7, 0], [0, -2, 0]])
    estimated = landmark_map(
        [1, 2, 3, 4, 8], [[4.81, -0.07, 9], [6.74, -5.01, 9], [1.85, -6.85, 9], [-0.14, -1.82, 9], [0, 0, 0]]
    )
    errors = metrics.landmark_errors(estimated, true)
    assert len(errors) == 4
    assert metrics.rmse(errors.horizontal_m) == pytest.approx(0.227, abs=5e-4)
    assert errors.aligned_rmse_m == pytest.approx(0.093, abs=5e-4)


def test_landmarks_are_matched_by_identity_not_by_row():
    true = landmark_map([6, 8, 20], [[0, 0, 0], [1, 0, 0], [0, 5, 0]])
    estimated = landmark_map([8, 20, 30], [[1, 0.5, 0], [0, 5, 0], [7, 7, 7]])
    errors = metrics.landmark_errors(estimated, true)
    np.testing.assert_array_equal(errors.ids, [8, 20])
    np.testing.assert_allclose(errors.horizontal_m, [[0, 0.5], [0, 0]])


def test_one_landmark_cannot_be_aligned():
    one = landmark_map([1], [[0, 0, 0]])
    assert np.isnan(metrics.landmark_errors(one, one).aligned_rmse_m)


def test_trajectories_at_different_instants_are_refused():
    truth = random_walk(0)
    with pytest.raises(EvaluationError, match=r"Trajectory\.at"):
        metrics.ate_raw_m(truth.rows(slice(1, None)), truth)
