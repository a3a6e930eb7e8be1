from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.devices.landmark_designs import OWN_DESIGNS
from sonar_graph.evaluation.metrics import landmark_errors, rmse
from sonar_graph.evaluation.scored_instants import (
    DURATION_S,
    ESTIMATED_XY_M,
    IDS,
    MAP_TIMES_S,
    TRUE_XY_M,
    published_maps,
    repeats_published,
)
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.basin import LANDMARKS_XY_M, BasinOptions, simulate_basin
from sonar_graph.states import LandmarkMap
from tests.synthetic import basin_comparison

DIFFERENCES_M = [[-0.19, -0.07], [-0.26, -0.01], [-0.15, 0.15], [-0.14, 0.18]]
"""As Table I prints them, in brackets."""


def complex_rms(differences: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.abs(differences) ** 2)))


def sequence(true: LandmarkMap | None) -> Sequence:
    return replace(basin_comparison(4).sequence, true_landmarks=true)


def test_the_table_has_the_differences_that_it_prints_in_brackets():
    np.testing.assert_allclose(ESTIMATED_XY_M - TRUE_XY_M, DIFFERENCES_M, atol=1e-12)


def test_published_errors_are_those_of_the_published_table():
    """Against plane geometry in complex numbers: a shift removes the mean, the best turn has the phase of a sum."""
    estimated, true = (xy @ [1, 1j] for xy in (ESTIMATED_XY_M, TRUE_XY_M))
    shifted = (estimated - estimated.mean()) - (true - true.mean())
    turn = np.vdot(estimated - estimated.mean(), true - true.mean())
    aligned = (estimated - estimated.mean()) * turn / abs(turn) - (true - true.mean())
    errors = landmark_errors(*published_maps())
    assert rmse(errors.horizontal_m) == pytest.approx(complex_rms(estimated - true))
    assert errors.aligned_rmse_m == pytest.approx(complex_rms(aligned))
    stated = complex_rms(estimated - true), complex_rms(shifted), complex_rms(aligned)
    assert stated == pytest.approx((0.227, 0.115, 0.093), abs=5e-4)


def test_times_of_the_maps_lie_in_the_run_and_the_last_is_its_end():
    assert 0 < MAP_TIMES_S[0] < MAP_TIMES_S[1] < MAP_TIMES_S[2] == DURATION_S


def test_the_simulated_basin_repeats_the_published_experiment():
    np.testing.assert_array_equal(LANDMARKS_XY_M, TRUE_XY_M)
    assert repeats_published(simulate_basin(BasinOptions(duration_s=120, laps=1)))


@pytest.mark.parametrize("change", ["moved", "renamed", "one more", "unknown"])
def test_another_arrangement_does_not_repeat_it(change):
    true = published_maps()[1]
    assert repeats_published(sequence(true))
    changed = {
        "moved": replace(true, positions=true.positions + np.array([0.0, 0.005, 0.0])),
        "renamed": replace(true, ids=IDS + 1),
        "one more": LandmarkMap(np.arange(1, 6), np.zeros((5, 3)), np.zeros((5, 3, 3))),
        "unknown": None,
    }[change]
    assert not repeats_published(sequence(changed))


def test_landmarks_of_ones_own_design_do_not_repeat_it():
    own = replace(sequence(published_maps()[1]), notes={OWN_DESIGNS: "1: ring, of mine.toml"})
    assert not repeats_published(own)


def test_height_does_not_matter():
    true = published_maps()[1]
    assert repeats_published(sequence(replace(true, positions=true.positions + np.array([0.0, 0.0, -1.7]))))
