"""Missions that several tests share."""

import pytest

from sonar_graph.simulation import MissionOptions, simulate_mission


@pytest.fixture(scope="module")
def mission():
    """With gaps of the Doppler log, wrong heading and noise enough for estimates to differ from the truth."""
    options = MissionOptions(
        duration_s=60.0,
        landmarks=12,
        dvl_dropouts_per_hour=240.0,
        dvl="explorer",
        imu="mti1",
    )
    return simulate_mission(options)
