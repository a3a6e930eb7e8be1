"""What a wrong first sighting of a landmark costs: the limits that the theory pages state."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2

from .made import isam2_params

LANDMARK, BEFORE = 2, 1


@cache
def basin() -> Sequence:
    return simulate_basin(BasinOptions(seed=2, duration_s=130.0, laps=1))


def sightings_of(landmark: int) -> tuple[LandmarkDetections, list[int]]:
    detections = basin().detections
    assert detections is not None
    ids, posterior = detections.most_probable()
    return detections, np.flatnonzero((ids == landmark) & (posterior > 0.7)).tolist()


def named_wrongly() -> LandmarkDetections:
    """One sighting of the landmark before, called by the name of one that has not been seen yet."""
    detections, rows = sightings_of(BEFORE)
    ids = detections.candidate_ids.copy()
    row = ids[rows[5]]
    ids[rows[5]] = np.select([row == BEFORE, row == LANDMARK], [LANDMARK, BEFORE], row)
    return replace(detections, candidate_ids=ids)


def ranged_wrongly(by_m: float) -> LandmarkDetections:
    """The first of the landmark's sightings is too long."""
    detections, rows = sightings_of(LANDMARK)
    range_m = detections.range_m.copy()
    range_m[rows[0]] += by_m
    return replace(detections, range_m=range_m)


def error_and_sigma_m(detections: LandmarkDetections, **settings: str) -> tuple[float, float]:
    """Of the landmark at the end: how far it is from where it lies, horizontally, and what is said of that."""
    sequence = replace(basin(), detections=detections)
    estimator = Isam2(sequence.calibration, isam2_params(**settings))
    for step in sequence.replay(sequence.instants(1.0)):
        estimator.process(step)
    found, true = estimator.landmarks(), sequence.true_landmarks
    assert true is not None
    at, truly = int(np.argmax(found.ids == LANDMARK)), int(np.argmax(true.ids == LANDMARK))
    offset = (found.positions[at] - true.positions[truly])[:2]
    return float(np.linalg.norm(offset)), float(np.sqrt(np.trace(found.covariances[at][:2, :2])))


def test_a_whole_history_takes_a_wrong_first_identity_back_and_a_bounded_one_keeps_it_and_is_sure():
    whole_m, _ = error_and_sigma_m(named_wrongly(), history__policy="whole")
    bounded_m, sigma_m = error_and_sigma_m(named_wrongly(), history__policy="bounded")
    assert whole_m < 0.05
    assert bounded_m == pytest.approx(5.4, abs=0.2)
    assert sigma_m < 0.06


def test_the_kernel_outvotes_a_first_range_that_is_wrong_by_a_metre_but_not_by_three():
    """Although twenty-two right sightings follow: what they say has no pull so far away."""
    assert len(sightings_of(LANDMARK)[1]) == 23
    assert error_and_sigma_m(ranged_wrongly(1.0))[0] < 0.05
    error_m, sigma_m = error_and_sigma_m(ranged_wrongly(3.0))
    assert error_m == pytest.approx(2.6, abs=0.2)
    assert sigma_m < 0.25
