"""Two sensors merged into steps, against a straightforward merge with numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.navigation.imu_gaps import NO_TURNS
from sonar_graph.navigation.preintegration.recursion import Columns, cursor_at, merge_rows, next_step

IMU_NS = np.array([0, 10, 20, 32, 40, 50], dtype=np.int64) * 10**7
DVL_NS = np.array([-5, 20, 36, 52], dtype=np.int64) * 10**7
RNG = np.random.default_rng(0)
RATE, FORCE, VELOCITY = RNG.standard_normal((6, 3)), RNG.standard_normal((6, 3)), RNG.standard_normal((4, 3))
ROOTS = RNG.standard_normal((4, 3, 3))
COV = ROOTS @ ROOTS.transpose(0, 2, 1)


def columns(hold_past: bool = False) -> Columns:
    return IMU_NS, RATE, FORCE, DVL_NS, VELOCITY, COV, hold_past, NO_TURNS


def sampled(stamps: np.ndarray, values: np.ndarray, t: np.ndarray, hold_past: bool) -> np.ndarray:
    if hold_past:
        return values[np.minimum(np.searchsorted(stamps, t), len(stamps) - 1)]
    return np.column_stack([np.interp(t, stamps, values[:, axis]) for axis in range(3)])


def density(t: float, rows: int, hold_past: bool) -> np.ndarray:
    """Half of either end's covariance over the interval about t; past the rows that of the last interval."""
    k = int(np.searchsorted(DVL_NS[:rows], t))
    last = min(k, rows - 1)
    if last == 0:
        return np.zeros((3, 3))
    interval_s = (DVL_NS[last] - DVL_NS[last - 1]) * 1e-9
    ends = (last, last) if hold_past or k >= rows else (last, last - 1)
    return interval_s * (COV[ends[0]] + COV[ends[1]]) / 2


@given(st.integers(-8, 60), st.integers(0, 40), st.integers(1, 6), st.integers(1, 4), st.booleans())
def test_steps_end_at_every_stamp_of_either_sensor_with_each_ones_mean(start, length, imu_rows, dvl_rows, hold_past):
    start_ns, end_ns = start * 10**7, (start + length) * 10**7
    known = np.concatenate([IMU_NS[:imu_rows], DVL_NS[:dvl_rows]])
    edges = np.unique(np.concatenate([[start_ns, end_ns], known[(known > start_ns) & (known < end_ns)]]))
    middles = (edges[:-1] + np.diff(edges) // 2).astype(float)
    duration, rate, velocity, psd, force, _ = merge_rows(columns(hold_past), imu_rows, dvl_rows, start_ns, end_ns)
    assert duration == pytest.approx(np.diff(edges) * 1e-9)
    assert rate == pytest.approx(sampled(IMU_NS[:imu_rows], RATE[:imu_rows], middles, hold_past))
    assert force == pytest.approx(sampled(IMU_NS[:imu_rows], FORCE[:imu_rows], middles, hold_past))
    assert velocity == pytest.approx(sampled(DVL_NS[:dvl_rows], VELOCITY[:dvl_rows], middles, hold_past))
    expected = np.array([density(t, dvl_rows, hold_past) for t in middles]).reshape(-1, 3, 3)
    assert psd == pytest.approx(expected)


def test_a_cursor_stands_before_the_first_rows_after_its_instant():
    assert cursor_at(columns(), IMU_NS[2]) == (IMU_NS[2], 3, 2)
    assert cursor_at(columns(), IMU_NS[2] - 1) == (IMU_NS[2] - 1, 2, 1)


def test_a_step_moves_the_cursor_past_the_rows_at_its_end():
    cursor, step = next_step(columns(), 6, 4, cursor_at(columns(), 15 * 10**7), 10**12)
    assert cursor == (20 * 10**7, 3, 2)
    assert step.duration_s == pytest.approx(0.05)
    cursor, _ = next_step(columns(), 6, 4, cursor, 25 * 10**7)
    assert cursor == (25 * 10**7, 3, 2)
    cursor, _ = next_step(columns(), 3, 2, cursor, 10**9)
    assert cursor == (10**9, 3, 2)


def test_noise_of_a_sample_in_the_middle_falls_half_on_either_side():
    """The variance of the displacement over a chain is that of its samples with their weights."""
    duration, _, _, psd, _, _ = merge_rows(columns(), 6, 4, int(DVL_NS[0]), int(DVL_NS[-1]))
    intervals = np.diff(DVL_NS) * 1e-9
    squares = np.concatenate([intervals, [0]]) ** 2 / 2 + np.concatenate([[0], intervals]) ** 2 / 2
    total = np.einsum("n,nij->ij", duration, psd)
    assert total == pytest.approx(np.einsum("n,nij->ij", squares, COV))
