from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.cli.settings import check_rate
from sonar_graph.errors import EvaluationError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.sequence import Sequence


def measured_at(stamps_s: list[float]) -> Sequence:
    stamps_ns = np.round(np.array(stamps_s) * 1e9).astype(np.int64)
    vectors = np.zeros((len(stamps_ns), 3))
    dvl = Dvl(stamps_ns, vectors, np.full((len(stamps_ns), 3, 3), np.nan))
    return Sequence("dive", Calibration(), Imu(stamps_ns, vectors, vectors), dvl)


def test_estimates_are_asked_for_at_most_as_often_as_the_imu_measures() -> None:
    dive = measured_at(np.arange(0, 10.01, 0.05).tolist())
    check_rate(20.0, dive, 2.0)
    with pytest.raises(EvaluationError, match=r"--rate-hz 21: the IMU of dive .* at most 20\.1"):
        check_rate(21.0, dive, 2.0)


def test_the_default_rate_is_never_refused() -> None:
    slow = measured_at([0.0, 1.0, 2.0])
    check_rate(2.0, slow, 2.0)
    with pytest.raises(EvaluationError, match=r"give at most 2$"):
        check_rate(3.0, slow, 2.0)
    check_rate(2.0, replace(slow, imu=slow.imu.between(0, 10**9)), 2.0)  # one row
