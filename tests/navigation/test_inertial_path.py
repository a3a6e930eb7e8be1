"""Integrals of an IMU against integrating again with other readings."""

from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.measurements import Imu
from sonar_graph.navigation.alignment.dvl_imu import InertialPath

T_S = np.arange(0, 20, 0.02)
STAMPS_NS = np.round(T_S * 1e9).astype(np.int64)
RATE = np.column_stack([0.2 * np.sin(T_S), 0.1 * np.cos(0.7 * T_S), 0.3 + 0.2 * np.sin(0.4 * T_S)])
FORCE = np.column_stack([np.sin(0.5 * T_S), 0.3 * np.cos(T_S), 9.8 + 0.1 * T_S])


def path_with(gyro_bias: np.ndarray, accel_bias: np.ndarray) -> InertialPath:
    return InertialPath.of(Imu(STAMPS_NS, RATE + gyro_bias, FORCE + accel_bias))


@pytest.mark.parametrize("axis", range(3))
def test_impulse_changes_with_biases_as_its_derivatives_say(axis):
    bias, none = 1e-5 * np.eye(3)[axis], np.zeros(3)
    path = path_with(none, none)
    by_accel = path_with(none, bias).impulse - path.impulse
    by_gyro = 0.5 * (path_with(bias, none).impulse - path_with(-bias, none).impulse)
    assert by_accel == pytest.approx(path.turned_time @ bias, abs=1e-12)
    assert by_gyro == pytest.approx(-path.tilted_impulse @ bias, abs=5e-4 * np.abs(by_gyro).max())
    assert np.abs(by_gyro[-1]).max() > 3e-4


def test_integrals_at_samples_are_those_of_the_samples():
    path = path_with(np.zeros(3), np.zeros(3))
    rows = np.array([3, 500, 700])
    assert path.rotations_at(T_S[rows]) == pytest.approx(path.rotations[rows])
    assert path.tilted_impulse_at(T_S[rows]) == pytest.approx(path.tilted_impulse[rows])
    between = 0.5 * (path.rotations[3] + path.rotations[4])
    assert path.rotations_at(T_S[3:4] + 0.01)[0] == pytest.approx(between, abs=1e-4)


def test_a_hole_ends_a_part_and_what_is_about_it_is_not_covered():
    """Between 5 s and 7 s there is no sample; 80 ms are no hole."""
    kept = ((T_S <= 5.001) | (T_S >= 6.999)) & ((T_S <= 12.001) | (T_S >= 12.079))
    path = InertialPath.of(Imu(STAMPS_NS[kept], RATE[kept], FORCE[kept]))
    assert np.flatnonzero(np.diff(path.parts)).tolist() == [250]
    assert path.parts_at(np.array([0.0, 5.0, 6.9, 7.0, 19.9])).tolist() == [0, 0, 0, 1, 1]
    asked = np.array([-0.1, 0.0, 5.0, 5.01, 6.99, 7.0, 12.04, 19.98, 20.0])
    assert path.covers(asked).tolist() == [False, True, True, False, False, True, True, True, False]
    assert path.covers(np.array([0.9, 3.99, 4.01, 7.99, 8.01, 18.99]), 1.0).tolist() == [
        False,
        True,
        False,
        False,
        True,
        False,
    ]
