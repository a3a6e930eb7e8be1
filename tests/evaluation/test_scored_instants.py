from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.devices.landmark_designs import OWN_DESIGNS
from sonar_graph.evaluation.metrics import landmark_errors, rmse
from sonar_graph.evaluation.results import RunResult
from sonar_graph.evaluation.scored_instants import (
    DURATION_S,
    ESTIMATED_XY_M,
    IDS,
    MAP_TIMES_S,
    TRUE_XY_M,
    gap_limit_s,
    map_instants,
    published_maps,
    repeats_published,
    rows_at,
    scored_instants,
)
from sonar_graph.simulation.basin import LANDMARKS_XY_M, BasinOptions, simulate_basin
from sonar_graph.states import LandmarkMap, Trajectory
from tests.synthetic import basin_comparison


def trajectory(seconds: list[float]) -> Trajectory:
    stamps = np.round(np.array(seconds) * 1e9).astype(np.int64)
    n = len(stamps)
    positions = np.column_stack([stamps * 1e-9, np.zeros((n, 2))])
    return Trajectory.without_covariances(stamps, positions, np.tile([0.0, 0, 0, 1], (n, 1)))


def seconds(*values: float) -> np.ndarray:
    return np.round(np.array(values) * 1e9).astype(np.int64)


DENSE = np.arange(0, 3.01, 0.1).tolist()


def test_instants_outside_the_truth_are_left_out_and_counted():
    scored = scored_instants(seconds(-0.5, 0, 1, 3, 3.5), trajectory(DENSE), [])
    np.testing.assert_array_equal(scored.stamps_ns, seconds(0, 1, 3))
    assert (scored.asked, scored.outside_truth, scored.in_truth_gap) == (5, 2, 0)
    assert str(scored) == "3 of 5 instants (left out: 2 outside the truth's time span)"


def test_instants_in_a_gap_of_the_truth_are_left_out_but_not_its_edges():
    occluded = [t for t in DENSE if not 1.0 < t < 1.95]
    scored = scored_instants(seconds(0.5, 1.0, 1.5, 2.0), trajectory(occluded), [])
    np.testing.assert_array_equal(scored.stamps_ns, seconds(0.5, 1.0, 2.0))
    assert scored.in_truth_gap == 1
    assert "1 in gaps of the truth longer than 0.5 s" in str(scored)


def test_a_short_gap_is_interpolated():
    occluded = [t for t in DENSE if not 1.05 < t < 1.45]
    assert len(scored_instants(seconds(1.25), trajectory(occluded), [])) == 1


def test_a_sparse_truth_is_no_gap_throughout():
    reference = trajectory([0.0, 1.0, 2.0, 3.0, 6.0, 7.0])
    assert gap_limit_s(reference) == pytest.approx(1.5)
    scored = scored_instants(seconds(0.5, 1.5, 4.0, 6.5), reference, [])
    np.testing.assert_array_equal(scored.stamps_ns, seconds(0.5, 1.5, 6.5))


def test_an_instant_that_one_run_lacks_is_left_out_for_all():
    runs = [
        RunResult("a", {}, "ok", causal=trajectory([0.5, 1.0, 1.5])),
        RunResult("b", {}, "ok", causal=trajectory([1.0, 1.5])),
        RunResult("c", {}, "failed", "raised"),
    ]
    scored = scored_instants(seconds(0.5, 1.0, 1.5), trajectory(DENSE), runs)
    np.testing.assert_array_equal(scored.stamps_ns, seconds(1.0, 1.5))
    assert scored.not_estimated == 1


def test_every_instant_asked_for_is_scored_or_left_out_for_one_reason():
    """The run lacks an instant before the truth, one in its gap and one that it covers: only the last is its fault."""
    occluded = [t for t in DENSE if not 1.0 < t < 1.95]
    runs = [RunResult("a", {}, "ok", causal=trajectory([2.5, 3.0, 3.5]))]
    scored = scored_instants(seconds(-0.5, 0.5, 1.5, 2.5, 3.0, 3.5), trajectory(occluded), runs)
    np.testing.assert_array_equal(scored.stamps_ns, seconds(2.5, 3.0))
    assert (scored.outside_truth, scored.in_truth_gap, scored.not_estimated) == (2, 1, 1)
    assert len(scored) + scored.outside_truth + scored.in_truth_gap + scored.not_estimated == scored.asked


def test_rows_are_found_by_stamp():
    rows = rows_at(trajectory(DENSE), seconds(0.5, 2.0))
    np.testing.assert_allclose(rows.positions[:, 0], [0.5, 2.0])


@pytest.mark.parametrize("duration_s", [2039.0, 203.9])
def test_maps_are_kept_at_the_published_times_or_the_same_fractions(duration_s):
    scale = duration_s / 2039.0
    asked = seconds(*(7.0 + np.linspace(0, duration_s, 4079)[1:]))
    kept = map_instants(asked, int(seconds(7.0)[0]))
    assert set(kept.tolist()) <= set(asked.tolist())
    np.testing.assert_allclose(
        (kept - seconds(7.0)) * 1e-9, np.array([833.1, 1369.4, 2039.0]) * scale, atol=0.26 * scale
    )
    assert kept[-1] == asked[-1]


def test_few_instants_are_each_kept_once():
    np.testing.assert_array_equal(map_instants(seconds(1.0), 0), seconds(1.0))
    assert len(map_instants(seconds(), 0)) == 0


DIFFERENCES_M = [[-0.19, -0.07], [-0.26, -0.01], [-0.15, 0.15], [-0.14, 0.18]]
"""As Table I prints them, in brackets."""


def complex_rms(differences: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.abs(differences) ** 2)))


def test_published_errors_are_those_of_the_published_table():
    """Against plane geometry in complex numbers: a shift removes the mean, the best turn has the phase of a sum."""
    np.testing.assert_allclose(ESTIMATED_XY_M - TRUE_XY_M, DIFFERENCES_M, atol=1e-12)
    estimated, true = (xy @ [1, 1j] for xy in (ESTIMATED_XY_M, TRUE_XY_M))
    shifted = (estimated - estimated.mean()) - (true - true.mean())
    turn = np.vdot(estimated - estimated.mean(), true - true.mean())
    aligned = (estimated - estimated.mean()) * turn / abs(turn) - (true - true.mean())
    errors = landmark_errors(*published_maps())
    assert rmse(errors.horizontal_m) == pytest.approx(complex_rms(estimated - true))
    assert errors.aligned_rmse_m == pytest.approx(complex_rms(aligned))
    stated = complex_rms(estimated - true), complex_rms(shifted), complex_rms(aligned)
    assert stated == pytest.approx((0.227, 0.115, 0.093), abs=5e-4)


def test_only_the_same_landmarks_of_its_design_repeat_the_published_experiment():
    """The simulated basin does; height does not matter."""
    assert 0 < MAP_TIMES_S[0] < MAP_TIMES_S[1] < MAP_TIMES_S[2] == DURATION_S
    np.testing.assert_array_equal(LANDMARKS_XY_M, TRUE_XY_M)
    assert repeats_published(simulate_basin(BasinOptions(duration_s=120, laps=1)))
    true, run = published_maps()[1], basin_comparison(4).sequence
    for change, repeats in (
        ({}, True),
        ({"positions": true.positions + np.array([0.0, 0.0, -1.7])}, True),
        ({"positions": true.positions + np.array([0.0, 0.005, 0.0])}, False),
        ({"ids": IDS + 1}, False),
    ):
        assert repeats_published(replace(run, true_landmarks=replace(true, **change))) == repeats, change
    assert not repeats_published(replace(run, true_landmarks=None))
    assert not repeats_published(
        replace(run, true_landmarks=LandmarkMap(np.arange(1, 6), np.zeros((5, 3)), np.zeros((5, 3, 3))))
    )
    assert not repeats_published(replace(run, true_landmarks=true, notes={OWN_DESIGNS: "1: ring, of mine.toml"}))
