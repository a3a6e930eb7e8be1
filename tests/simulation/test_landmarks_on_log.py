from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.errors import SimulationError
from sonar_graph.simulation import (
    LandmarkOptions,
    MissionOptions,
    add_landmarks,
    simulate_mission,
)

RECORDED = replace(
    simulate_mission(MissionOptions(seed=5, duration_s=120)),
    detections=None,
    true_landmarks=None,
)
CLEAN = LandmarkOptions(
    spacing_m=5.0,
    detection_probability=1.0,
    wrong_id_rate=0.0,
    false_detections_per_frame=0.0,
    height_sigma_m=0.2,
)


def residuals(run):
    """Of right identities: (range, azimuth) errors over their sigmas, by the recorded reference alone."""
    found = run.detections
    ids, _ = found.most_probable()
    frames, frame = np.unique(found.stamps_ns, return_inverse=True)
    pose = run.truth.at(frames)
    place = run.true_landmarks.positions[np.searchsorted(run.true_landmarks.ids, ids)]
    seen = pose.rotations()[frame].inv().apply(place - pose.positions[frame])
    range_m = np.linalg.norm(seen, axis=1)
    azimuth_rad = np.arctan2(seen[:, 1], seen[:, 0])
    errors = [found.range_m - range_m, found.azimuth_rad - azimuth_rad]
    sonar = run.calibration.sonar
    return np.transpose(errors) / [sonar.range_sigma_m, sonar.azimuth_sigma_rad]


def added(**rates):
    return add_landmarks(RECORDED, CLEAN.model_copy(update=rates))


def test_detections_fit_the_reference_and_err_at_their_rates():
    clean = residuals(added())
    assert len(clean) > 100
    assert clean.std(axis=0) == pytest.approx(1.0, abs=0.15)
    wrong = residuals(added(wrong_id_rate=0.2))
    assert 0.1 < np.mean(np.abs(wrong).max(axis=1) > 6) < 0.3
    fewer = added(detection_probability=0.5).detections
    assert 0.4 < len(fewer) / len(clean) < 0.6


def test_what_cannot_be_done_is_said():
    with pytest.raises(SimulationError, match="no reference trajectory"):
        add_landmarks(replace(RECORDED, truth=None))
    with pytest.raises(SimulationError, match="range_min_m = 50"):
        add_landmarks(RECORDED, LandmarkOptions(range_min_m=50.0))
