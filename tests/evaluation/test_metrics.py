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
from sonar_graph.states import FIRST_ANONYMOUS_ID, LandmarkMap, Trajectory

seeds = st.integers(0, 2**32 - 1)
STEP_NS = 500_000_000


def random_walk(seed: int, n: int = 60) -> Trajectory:
    rng = np.random.default_rng(seed)
    turns = np.cumsum(rng.normal(scale=0.1, size=(n, 3)), axis=0)
    positions = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    return path_of(positions, Rotation.from_rotvec(turns))


def path_of(positions: np.ndarray, rotations: Rotation) -> Trajectory:
    stamps_ns = np.arange(len(positions)) * STEP_NS
    return Trajectory.without_covariances(stamps_ns, positions, rotations.as_quat())


def disturbed(truth: Trajectory, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    positions = truth.positions + rng.normal(scale=0.3, size=truth.positions.shape)
    turns = rng.normal(scale=0.05, size=(len(truth), 3))
    return path_of(positions, truth.rotations() * Rotation.from_rotvec(turns))


def moved(
    path: Trajectory, turn: Rotation, shift: tuple[float, float, float]
) -> Trajectory:
    return path_of(turn.apply(path.positions) + shift, turn * path.rotations())


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


def flat(path: Trajectory) -> Trajectory:
    level = Rotation.from_euler("z", path.rotations().as_euler("ZYX")[:, :1])
    return path_of(path.positions * [1, 1, 0], level)


@settings(max_examples=20)
@given(seeds)
def test_scores_of_a_path_agree_with_evo(seed):
    truth = random_walk(seed)
    turn = Rotation.from_euler("z", 0.4)
    estimate = moved(disturbed(truth, seed + 1), turn, (1.0, 2.0, 3.0))
    spatial = scored(estimate, truth)
    part = PoseRelation.translation_part
    apart = {"delta": 20, "delta_unit": Unit.frames, "all_pairs": True}
    for key, metric in (("ate_raw_m", APE(part)), ("rpe_10s_m", RPE(part, **apart))):
        expected = evo_rmse(metric, as_evo(truth), as_evo(estimate))
        assert spatial[key] == pytest.approx(expected, abs=1e-9)
    # on a plane the best motion is that of SE(2), and a rotation is one of heading
    truth = flat(truth)
    estimate = moved(flat(disturbed(truth, seed + 1)), turn, (1.0, 2.0, 0.0))
    planar = scored(estimate, truth)
    aligned = as_evo(estimate)
    aligned.align(as_evo(truth))
    expected = evo_rmse(APE(part), as_evo(truth), aligned)
    assert planar["ate_se2_m"] == pytest.approx(expected, abs=1e-9)
    turns = RPE(PoseRelation.rotation_angle_rad, **apart)
    expected = evo_rmse(turns, as_evo(truth), as_evo(estimate))
    assert planar["rpe_10s_rad"] == pytest.approx(expected, abs=1e-9)
    assert expected > 0.01


def test_errors_by_hand():
    """Height, which the plane leaves out; yaw across half a turn."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    heights = np.outer([1, 1, -1, -1], [0, 0, 1])
    truth, estimate = (
        path_of(places, Rotation.from_euler("z", [[yaw]] * 4))
        for places, yaw in ((square, np.pi - 0.01), (square + heights, 0.02 - np.pi))
    )
    found = scored(estimate, truth)
    assert found["ate_raw_m"] == found["ate_yaw_m"] == pytest.approx(1.0)
    assert found["ate_se2_m"] == pytest.approx(0.0, abs=1e-12)
    assert found["yaw_rmse_rad"] == pytest.approx(0.03)


def test_what_is_not_paired_is_refused():
    path = random_walk(0)
    part = path.rows(slice(1, None))
    with pytest.raises(EvaluationError, match=r"Trajectory\.at"):
        scored(part, path)
    with pytest.raises(EvaluationError, match="at the same instants"):
        metrics.relative_errors(path, part, 1.0)
    for counts in ((0, 0), (4, 5)):
        with pytest.raises(EvaluationError, match="paired points"):
            metrics.umeyama(*(np.zeros((count, 3)) for count in counts))


@pytest.mark.parametrize(
    ("stamps_s", "pairs"),
    [
        # instants without a partner are skipped
        ([0.0, 0.5, 1.0, 1.5, 4.0, 5.0], [(0, 2), (1, 3), (4, 5)]),
        # a third of a second is rounded
        (np.arange(10) * 0.333_333_333, [(k, k + 3) for k in range(7)]),
        ([5.0], []),
    ],
)
def test_pairs_are_a_second_apart(stamps_s, pairs):
    stamps_ns = np.round(np.multiply(stamps_s, 1e9)).astype(np.int64)
    found = np.column_stack(metrics.pairs_apart(stamps_ns, 1.0))
    assert [*map(tuple, found.tolist())] == pairs


def landmark_map(ids: list[int], positions: object) -> LandmarkMap:
    places = np.reshape(np.asarray(positions, dtype=float), (len(ids), 3))
    covs = np.tile(np.eye(3), (len(ids), 1, 1))
    return LandmarkMap(np.array(ids, dtype=np.int64), places, covs)


FARTHEST_M = 1.0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 4), m=st.integers(1, 4))
def test_unnamed_landmarks_are_matched_as_the_best_of_all_matchings_says(seed, n, m):
    rng = np.random.default_rng(seed)
    places, true_places = (
        1.2 * rng.standard_normal((count, 3)) * [1, 1, 0] for count in (n, m)
    )
    estimated = landmark_map([FIRST_ANONYMOUS_ID + k for k in range(n)], places)
    true = landmark_map(list(range(m)), true_places)
    squared = np.sum((places[:, None] - true_places) ** 2, axis=-1)
    best = (0, 0.0)
    for order in permutations([*range(m), *[-1] * n], n):
        costs = [squared[k, j] for k, j in enumerate(order) if j >= 0]
        if all(cost <= FARTHEST_M**2 for cost in costs):
            best = max(best, (len(costs), -float(sum(costs))))
    named = metrics.named_by_place(estimated, true, FARTHEST_M)
    assert np.all(np.diff(named.ids) > 0)
    matched = metrics.landmark_errors(named, true)
    assert len(matched) == best[0]
    assert np.sum(matched.horizontal_m**2) == pytest.approx(-best[1])


def test_landmarks_are_matched_by_identity_not_by_row():
    places = cloud(0, 4)
    true = landmark_map([6, 8, 20, 40], places)
    errors = metrics.landmark_errors(landmark_map([5, 8, 20, 30], places + 1), true)
    np.testing.assert_array_equal(errors.ids, [8, 20])
    np.testing.assert_allclose(errors.horizontal_m, 1.0)
    one = landmark_map([6], places[:1])
    # one landmark cannot be aligned
    assert np.isnan(metrics.landmark_errors(one, true).aligned_rmse_m)


def cloud(seed: int, n: int = 30) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * [5.0, 3.0, 1.0]


@given(seeds, st.sampled_from([2, 3]))
def test_umeyama_agrees_with_evo(seed, dimension):
    points, targets = (cloud(seed + k)[:, :dimension] for k in (0, 1))
    R, t = metrics.umeyama(points, targets)
    expected_R, expected_t, _ = umeyama_alignment(points.T, targets.T)
    np.testing.assert_allclose(R, expected_R, atol=1e-9)
    np.testing.assert_allclose(t, expected_t, atol=1e-9)


def test_yaw_alignment_leaves_a_tilt_that_se3_removes():
    same = metrics.align_se3(np.ones((5, 3)), np.full((5, 3), 3.0))
    np.testing.assert_allclose(same.apply(np.ones((5, 3))), 3.0)
    points = cloud(0)
    tilted = points @ Rotation.from_euler("x", 0.2).as_matrix().T
    se3, yaw = (
        metrics.rmse(align(points, tilted).apply(points) - tilted)
        for align in (metrics.align_se3, metrics.align_yaw)
    )
    assert se3 < 1e-10
    assert yaw > 0.1
