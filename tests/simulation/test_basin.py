"""The basin run is the published experiment, as far as it is published."""

import numpy as np
import pytest

from sonar_graph.errors import SimulationError
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, cruise_speed, simulate_basin


@pytest.fixture(scope="module")
def published() -> Sequence:
    return simulate_basin()


def test_landmarks_are_where_the_paper_puts_them(published):
    assert published.true_landmarks.ids.tolist() == [1, 2, 3, 4]
    np.testing.assert_array_equal(
        published.true_landmarks.positions[:, :2], [[5, 0], [7, -5], [2, -7], [0, -2]]
    )
    np.testing.assert_allclose(
        published.true_landmarks.positions[:, 2], -1.7, atol=0.05
    )


def test_the_vehicle_drives_three_laps_in_the_published_time(
    published,
):
    truth = published.truth
    assert published.duration_s == pytest.approx(2039, abs=0.2)
    assert np.linalg.norm(truth.positions[-1] - truth.positions[0]) < 0.6
    assert (
        np.degrees((truth.rotations()[0].inv() * truth.rotations()[-1]).magnitude())
        < 15
    )
    yaw = np.unwrap(truth.rotations().as_euler("ZYX")[:, 0])
    assert yaw[-1] - yaw[0] == pytest.approx(-3 * 2 * np.pi, abs=0.3)
    quarter = np.rint(yaw / (np.pi / 2))
    assert min(np.sum(quarter == -q) / 50 for q in range(12)) > 60  # seconds


def test_every_landmark_is_seen_each_lap_at_the_published_distance(
    published,
):
    ids, probability = published.detections.most_probable()
    found = published.detections.rows(probability > 0.9)
    ids = ids[probability > 0.9]
    visits = np.concatenate([[0], np.flatnonzero(np.diff(ids)) + 1])
    assert ids[visits].tolist() == [1, 2, 3, 4] * 3
    lap = (found.stamps_ns[visits] - published.start_ns) * 1e-9 // (2039 / 3)
    assert lap.tolist() == np.repeat(range(3), 4).tolist()
    distance = found.range_m
    assert np.mean((distance > 1.7) & (distance < 2.3)) > 0.9
    assert 1.25 - 0.1 < distance.min() < distance.max() < 2.5 + 0.1
    assert np.abs(found.azimuth_rad).max() < np.radians(14.4) + 5 * 0.007


def test_speed_is_as_asked_and_too_short_a_run_is_refused():
    assert cruise_speed(BasinOptions()) == 0.15
    assert cruise_speed(BasinOptions(duration_s=300, laps=1)) == 0.15
    # 28 m in what 4 turns (8 s) and 8 ramps (3 s) leave of 120 s.
    assert cruise_speed(BasinOptions(duration_s=120, laps=1)) == pytest.approx(
        28 / (120 - 4 * 8 - 8 * 3)
    )
    with pytest.raises(
        SimulationError,
        match=r"duration_s = 100 is too short for laps = 1; give at least 119 s",
    ):
        simulate_basin(BasinOptions(duration_s=100, laps=1))
    simulate_basin(BasinOptions(duration_s=119, laps=1))
