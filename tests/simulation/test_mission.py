"""The mission shows the same landmarks again and again, all mission long."""

import numpy as np
import pytest

from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission


@pytest.fixture(scope="module")
def mission() -> Sequence:
    return simulate_mission(
        MissionOptions(duration_s=400, landmarks=20, false_detections_per_frame=0)
    )


def test_vehicle_goes_round_and_round_at_the_stated_speed_heading_along_its_path(
    mission: Sequence,
):
    positions = mission.truth.positions
    velocity = np.diff(positions, axis=0) * 50
    assert np.linalg.norm(velocity, axis=1).mean() == pytest.approx(0.5, rel=0.02)
    forward = mission.truth.rotations()[:-1].inv().apply(velocity)
    assert np.median(forward[:, 0]) == pytest.approx(0.5, rel=0.05)
    assert np.abs(forward[:, 1:]).max() < 0.15
    assert np.hypot(*positions[:, :2].T).max() < 8
    near_start = np.linalg.norm(positions - positions[0], axis=1) < 0.6
    # arrivals
    assert np.sum(np.diff(near_start.astype(int)) == 1) == int(400 * 0.5 / 41.5)


def test_up_to_ten_landmarks_are_in_view_and_all_come_back(mission: Sequence):
    found = mission.detections
    _, counts = np.unique(found.stamps_ns, return_counts=True)
    assert 2 < counts.mean() < 6
    assert counts.max() <= 10
    ids, _ = found.most_probable()
    seconds = (found.stamps_ns - mission.start_ns) * 1e-9
    early, late = ids[seconds < 200], ids[seconds >= 200]
    assert set(early) == set(late) == set(range(1, 21))


def test_sonar_options_bound_what_is_seen():
    narrow = MissionOptions(
        duration_s=60,
        range_max_m=9.0,
        azimuth_aperture_rad=0.6,
        false_detections_per_frame=0,
    )
    found = simulate_mission(narrow).detections
    assert found.range_m.max() < 9 + 5 * narrow.range_sigma_m
    assert np.abs(found.azimuth_rad).max() < 0.3 + 5 * narrow.azimuth_sigma_rad


@pytest.mark.parametrize("landmarks", [1, 20])
def test_number_of_landmarks_is_the_one_asked_for(landmarks: int):
    run = simulate_mission(MissionOptions(duration_s=20, landmarks=landmarks))
    assert run.true_landmarks.ids.tolist() == list(range(1, landmarks + 1))
    assert np.hypot(*run.true_landmarks.positions[:, :2].T).max() <= 11
