import numpy as np
import pytest

from sonar_graph.evaluation import (
    RunResult,
    landmark_errors,
    map_instants,
    published_maps,
    rmse,
)
from sonar_graph.evaluation.scored_instants import (
    ESTIMATED_XY_M,
    TRUE_XY_M,
    scored_instants,
)
from sonar_graph.states import Trajectory


def trajectory(at_s: list[float]) -> Trajectory:
    stamps = seconds(*at_s)
    positions = np.outer(stamps * 1e-9, [1, 0, 0])
    level = np.tile([0.0, 0, 0, 1], (len(stamps), 1))
    return Trajectory.without_covariances(stamps, positions, level)


def seconds(*values: float) -> np.ndarray:
    return np.round(np.array(values) * 1e9).astype(np.int64)


DENSE = np.arange(0, 3.01, 0.1).tolist()


OCCLUDED, HIDDEN_SHORTLY = (
    [t for t in DENSE if not low < t < high]
    for low, high in ((1.0, 1.95), (1.05, 1.45))
)
SPARSE = [0.0, 1.0, 2.0, 3.0, 6.0, 7.0]
# fmt: off
SCORED = [
    # requested, truth, of each run, scored, (outside truth, in its gaps, not estimated), message
    ([-0.5, 0, 1, 3, 3.5], DENSE, [], [0, 1, 3], (2, 0, 0), "3 of 5 instants (left out: 2 outside the truth's time span"),
    ([0.5, 1.0, 1.5, 2.0], OCCLUDED, [], [0.5, 1.0, 2.0], (0, 1, 0), "1 in gaps of the truth longer than 0.5 s"),
    ([1.25], HIDDEN_SHORTLY, [], [1.25], (0, 0, 0), "1 of 1 instants"),
    ([0.5, 1.5, 4.0, 6.5], SPARSE, [], [0.5, 1.5, 6.5], (0, 1, 0), "1 in gaps of the truth longer than 1.5 s"),
    ([0.5, 1.0, 1.5], DENSE, [[1.0, 1.5], [0.5, 1.0, 1.5], None], [1.0, 1.5], (0, 0, 1), "1 without an estimate"),
    ([-0.5, 0.5, 1.5, 2.5, 3.0, 3.5], OCCLUDED, [[2.5, 3.0, 3.5]], [2.5, 3.0], (2, 1, 1), "2 of 6 instants"),
]
# fmt: on


@pytest.mark.parametrize(("asked", "truth", "runs", "kept", "left_out", "said"), SCORED)
def test_every_instant_is_scored_or_left_out_for_one_reason(
    asked, truth, runs, kept, left_out, said
):
    """Edges of a gap are in the truth; what lies outside the truth or in its gap is no fault of a run."""
    results = [
        RunResult("a", {}, "ok" if of else "failed", causal=of and trajectory(of))
        for of in runs
    ]
    scored = scored_instants(seconds(*asked), trajectory(truth), results)
    np.testing.assert_array_equal(scored.stamps_ns, seconds(*kept))
    found = (scored.outside_truth, scored.in_truth_gap, scored.not_estimated)
    assert found == left_out
    assert scored.asked == len(asked)
    assert said in str(scored)


def test_few_instants_are_each_kept_once():
    np.testing.assert_array_equal(map_instants(seconds(1.0), 0), seconds(1.0))
    assert len(map_instants(seconds(), 0)) == 0


DIFFERENCES_M = [[-0.19, -0.07], [-0.26, -0.01], [-0.15, 0.15], [-0.14, 0.18]]
"""As Table I prints them, in brackets."""


def test_published_errors_are_those_of_the_published_table():
    np.testing.assert_allclose(ESTIMATED_XY_M - TRUE_XY_M, DIFFERENCES_M, atol=1e-12)
    errors = landmark_errors(*published_maps())
    found = rmse(errors.horizontal_m), errors.aligned_rmse_m
    assert found == pytest.approx((0.227, 0.093), abs=5e-4)
