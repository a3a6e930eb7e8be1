from __future__ import annotations

import re

import numpy as np
import pytest

from sonar_graph.devices.dvl_beams import UNMEASURED_M_S
from sonar_graph.errors import LogError
from sonar_graph.logs.reading import require_use, unsaid_noise
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, LandmarkDetections

SECOND = 1_000_000_000


def stamps(first_s: int, rows: int = 5) -> np.ndarray:
    return (first_s + np.arange(rows)) * SECOND


def imu(first_s: int) -> Imu:
    return Imu(stamps(first_s), np.zeros((5, 3)), np.zeros((5, 3)))


def dvl(first_s: int, cov: Floats | None = None) -> Dvl:
    return Dvl(stamps(first_s), np.zeros((5, 3)), np.tile(1e-4 * np.eye(3), (5, 1, 1)) if cov is None else cov)


@pytest.mark.parametrize(("imu_s", "dvl_s"), [(100, 3700), (1_400_000_000, 1_400_000)])
def test_sensors_without_a_common_time_are_refused_with_the_times_of_both(imu_s: int, dvl_s: int) -> None:
    spans = f"IMU from {imu_s}.000 to {imu_s + 4}.000 s, DVL from {dvl_s}.000 to {dvl_s + 4}.000 s"
    with pytest.raises(LogError, match=re.escape(f"log.mcap: {spans}: no common time")):
        require_use("log.mcap", imu(imu_s), dvl(dvl_s))


def test_one_common_instant_is_enough() -> None:
    require_use("log.mcap", imu(100), dvl(104))


def test_a_log_without_one_whole_velocity_is_refused() -> None:
    cov = np.tile(np.diag([UNMEASURED_M_S**2, 1e-4, 1e-4]), (5, 1, 1))
    with pytest.raises(LogError, match=r"log\.mcap: DVL: too few valid beams in all 5 rows"):
        require_use("log.mcap", imu(100), dvl(100, cov))
    cov[3] = 1e-4 * np.eye(3)
    require_use("log.mcap", imu(100), dvl(100, cov))


def test_rows_that_do_not_say_their_noise_are_counted() -> None:
    cov = np.tile(1e-4 * np.eye(3), (5, 1, 1))
    depth = Depth(stamps(0), np.zeros(5), np.full(5, 1e-4))
    detections = LandmarkDetections(
        stamps(0), np.ones(5), np.zeros(5), np.tile(np.eye(2), (5, 1, 1)), np.ones((5, 1), dtype=int), np.ones((5, 1))
    )
    assert list(unsaid_noise(dvl(0, cov), depth, detections)) == []
    cov[1:3, 2, 2] = np.nan
    depth.variance_m2[0] = np.nan
    detections.range_azimuth_cov[:] = np.nan
    assert list(unsaid_noise(dvl(0, cov), depth, detections)) == [
        "dvl: 2 of 5 rows say no covariance, dvl.velocity_sigma_m_s of the calibration count",
        "depth: 1 of 5 rows say no covariance, depth.sigma_m of the calibration count",
        "detections: 5 of 5 rows say no covariance, sonar.range_sigma_m and azimuth_sigma_rad of the calibration count",
    ]
