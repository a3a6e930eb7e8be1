from itertools import permutations

import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import metrics
from sonar_graph.evaluation.consistency import error_series
from sonar_graph.evaluation.scores import ScoredWords, trajectory_scores
from sonar_graph.states import LandmarkMap, Trajectory

seeds = st.integers(0, 2**32 - 1)
STEP_NS = 500_000_000


def random_walk(seed: int, n: int = 60) -> Trajectory:
    rng = np.random.default_rng(seed)
    rotations = Rotation.from_rotvec(
        np.cumsum(rng.normal(scale=0.1, size=(n, 3)), axis=0)
    )
    positions = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    return Trajectory.without_covariances(
        np.arange(n) * STEP_NS, positions, rotations.as_quat()
    )


def disturbed(truth: Trajectory, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    positions = truth.positions + rng.normal(scale=0.3, size=truth.positions.shape)
    rotations = truth.rotations() * Rotation.from_rotvec(
        rng.normal(scale=0.05, size=(len(truth), 3))
    )
    return Trajectory.without_covariances(
        truth.stamps_ns, positions, rotations.as_quat()
    )


def moved(
    path: Trajectory, turn: Rotation, shift: tuple[float, float, float]
) -> Trajectory:
    places = turn.apply(path.positions) + shift
    attitudes = turn * path.rotations()
    return Trajectory.without_covariances(path.stamps_ns, places, attitudes.as_quat())


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        positions_xyz=trajectory.positions,
        orientations_quat_wxyz=trajectory.quaternions_xyzw[:, [3, 0, 1, 2]],
        timestamps=trajectory.stamps_ns * 1e-9,
    )


def evo_rmse(
    metric: APE | RPE, truth: PoseTrajectory3D, estimate: PoseTrajectory3D
) -> float:
    metric.process_data((truth, estimate))
    return metric.get_statistic(StatisticsType.rmse)


def scored(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Values of the scores of a path, as a comparison gives them."""
    errors = error_series(estimate, truth, 3)
    words = ScoredWords("all", "not aligned", "3-D position error")
    scores = trajectory_scores("causal", estimate, truth, errors, words)
    return {key.removeprefix("causal."): one.value for key, one in scores.items()}


def flat(trajectory: Trajectory) -> Trajectory:
    level = Rotation.from_euler("z", trajectory.rotations().as_euler("ZYX")[:, :1])
    return Trajectory.without_covariances(
        trajectory.stamps_ns, trajectory.positions * [1, 1, 0], level.as_quat()
    )


@settings(max_examples=20)
@given(seeds)
def test_scores_of_a_path_agree_with_evo(seed):
    truth = random_walk(seed)
    turn = Rotation.from_euler("z", 0.4)
    estimate = moved(disturbed(truth, seed + 1), turn, (1.0, 2.0, 3.0))
    spatial = scored(estimate, truth)
    apart = {"delta": 20, "delta_unit": Unit.frames, "all_pairs": True}
    for key, metric in (
        ("ate_raw_m", APE(PoseRelation.translation_part)),
        ("rpe_10s_m", RPE(PoseRelation.translation_part, **apart)),
    ):
        expected = evo_rmse(metric, as_evo(truth), as_evo(estimate))
        assert spatial[key] == pytest.approx(expected, abs=1e-9)
    # on a plane the best motion is that of SE(2), and a rotation is one of heading
    truth = flat(truth)
    estimate = moved(flat(disturbed(truth, seed + 1)), turn, (1.0, 2.0, 0.0))
    planar = scored(estimate, truth)
    aligned = as_evo(estimate)
    aligned.align(as_evo(truth))
    expected = evo_rmse(APE(PoseRelation.translation_part), as_evo(truth), aligned)
    assert planar["ate_se2_m"] == pytest.approx(expected, abs=1e-9)
    turns = RPE(PoseRelation.rotation_angle_rad, **apart)
    expected = evo_rmse(turns, as_evo(truth), as_evo(estimate))
    assert planar["rpe_10s_rad"] == pytest.approx(expected, abs=1e-9)
    assert expected > 0.01


def line(yaws: list[float], positions: list[list[float]]) -> Trajectory:
    quaternions = Rotation.from_euler("z", np.array(yaws)[:, None]).as_quat()
    return Trajectory.without_covariances(
        np.arange(len(yaws)) * STEP_NS, np.array(positions, dtype=float), quaternions
    )


def test_errors_by_hand():
    """Height, which the plane leaves out; yaw across half a turn."""
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    truth = line([np.pi - 0.01] * 4, [[*at, 0] for at in square])
    heights = (1, 1, -1, -1)
    estimate = line(
        [-np.pi + 0.02] * 4, [[*at, z] for at, z in zip(square, heights, strict=True)]
    )
    found = scored(estimate, truth)
    assert found["ate_raw_m"] == found["ate_yaw_m"] == pytest.approx(1.0)
    assert found["ate_se2_m"] == pytest.approx(0.0, abs=1e-12)
    assert found["yaw_rmse_rad"] == pytest.approx(0.03)
    with pytest.raises(EvaluationError, match=r"Trajectory\.at"):
        scored(truth.rows(slice(1, None)), truth)


@pytest.mark.parametrize(
    ("stamps_s", "pairs"),
    [
        (
            [0.0, 0.5, 1.0, 1.5, 4.0, 5.0],
            [(0, 2), (1, 3), (4, 5)],
        ),  # instants without a partner are skipped
        (
            [k * 0.333_333_333 for k in range(10)],
            [(k, k + 3) for k in range(7)],
        ),  # a third of a second is rounded
        ([5.0], []),
    ],
)
def test_pairs_are_a_second_apart(stamps_s, pairs):
    first, second = metrics.pairs_apart(
        np.round(np.array(stamps_s) * 1e9).astype(np.int64), 1.0
    )
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == pairs


def landmark_map(ids: list[int], positions: object) -> LandmarkMap:
    places = np.reshape(np.asarray(positions, dtype=float), (len(ids), 3))
    return LandmarkMap(
        np.array(ids, dtype=np.int64), places, np.tile(np.eye(3), (len(ids), 1, 1))
    )


def on_floor(xy: np.ndarray) -> np.ndarray:
    return np.column_stack([xy, np.zeros(len(xy))])


def test_landmarks_are_matched_by_identity_not_by_row():
    true = landmark_map([6, 8, 20], [[0, 0, 0], [1, 0, 0], [0, 5, 0]])
    estimated = landmark_map([8, 20, 30], [[1, 0.5, 0], [0, 5, 0], [7, 7, 7]])
    errors = metrics.landmark_errors(estimated, true)
    np.testing.assert_array_equal(errors.ids, [8, 20])
    np.testing.assert_allclose(errors.horizontal_m, [[0, 0.5], [0, 0]])
    one = landmark_map([1], [[0, 0, 0]])
    assert np.isnan(metrics.landmark_errors(one, one).aligned_rmse_m), (
        "one landmark cannot be aligned"
    )


UNKNOWN = 3_000_000_000
FARTHEST_M = 1.0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 4), m=st.integers(1, 4))
def test_unnamed_landmarks_are_matched_as_the_best_of_all_matchings_says(seed, n, m):
    rng = np.random.default_rng(seed)
    estimated = landmark_map(
        [UNKNOWN + k for k in range(n)], on_floor(1.2 * rng.standard_normal((n, 2)))
    )
    true = landmark_map(list(range(m)), on_floor(1.2 * rng.standard_normal((m, 2))))
    squared = np.sum(
        (estimated.positions[:, None] - true.positions[None]) ** 2, axis=-1
    )
    best = (0, 0.0)
    for order in permutations([*range(m), *[-1] * n], n):
        pairs = [(k, j) for k, j in enumerate(order) if j >= 0]
        if all(squared[pair] <= FARTHEST_M**2 for pair in pairs):
            best = max(best, (len(pairs), -float(sum(squared[pair] for pair in pairs))))
    named = metrics.named_by_place(estimated, true, FARTHEST_M)
    assert np.all(np.diff(named.ids) > 0)
    matched = metrics.landmark_errors(named, true)
    assert len(matched) == best[0]
    assert np.sum(matched.horizontal_m**2) == pytest.approx(-best[1])


def cloud(seed: int, n: int = 30) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * [5.0, 3.0, 1.0]


@given(seeds, st.sampled_from([2, 3]))
def test_umeyama_agrees_with_evo(seed, dimension):
    points = cloud(seed)[:, :dimension]
    targets = cloud(seed + 1)[:, :dimension]
    R, t = metrics.umeyama(points, targets)
    expected_R, expected_t, _ = umeyama_alignment(points.T, targets.T)
    np.testing.assert_allclose(R, expected_R, atol=1e-9)
    np.testing.assert_allclose(t, expected_t, atol=1e-9)


def test_yaw_alignment_leaves_a_tilt_that_se3_removes():
    np.testing.assert_allclose(
        metrics.align_se3(np.ones((5, 3)), np.full((5, 3), 3.0)).apply(np.ones((5, 3))),
        3.0,
    )
    points = cloud(0)
    tilted = points @ Rotation.from_euler("x", 0.2).as_matrix().T
    assert (
        metrics.rmse(metrics.align_se3(points, tilted).apply(points) - tilted) < 1e-10
    )
    assert metrics.rmse(metrics.align_yaw(points, tilted).apply(points) - tilted) > 0.1


@pytest.mark.parametrize("shapes", [((0, 3), (0, 3)), ((4, 3), (5, 3))])
def test_unpaired_points_are_refused(shapes):
    with pytest.raises(EvaluationError, match="paired points"):
        metrics.umeyama(np.zeros(shapes[0]), np.zeros(shapes[1]))


def test_motions_over_a_second_want_a_truth_at_the_same_instants():
    stamps_ns = np.arange(100) * 100_000_000
    path = Trajectory.without_covariances(
        stamps_ns, np.zeros((100, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))
    )
    with pytest.raises(EvaluationError, match="at the same instants"):
        metrics.relative_errors(path, path.rows(np.arange(50)), 1.0)
