"""The mission shows the same landmarks again and again, all mission long."""

import numpy as np
import pytest

from sonar_graph.simulation import MissionOptions, simulate_mission


def test_the_vehicle_goes_round_at_the_stated_speed():
    truth = simulate_mission(MissionOptions(duration_s=400)).truth
    positions = truth.positions
    velocity = np.diff(positions, axis=0) * 50
    assert np.linalg.norm(velocity, axis=1).mean() == pytest.approx(0.5, rel=0.02)
    forward = truth.rotations()[:-1].inv().apply(velocity)
    assert np.median(forward[:, 0]) == pytest.approx(0.5, rel=0.05)
    assert np.abs(forward[:, 1:]).max() < 0.15
    assert np.hypot(*positions[:, :2].T).max() < 8
    is_near = np.linalg.norm(positions - positions[0], axis=1) < 0.6
    # arrivals
    assert np.sum(np.diff(is_near.astype(int)) == 1) == int(400 * 0.5 / 41.5)
