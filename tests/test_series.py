"""Laws of running integrals and of columns in between, against functions whose integrals are known."""

import numpy as np
import pytest

from sonar_graph.numerics import columns_at, running_integral

T = np.array([0.0, 0.5, 0.7, 2.0, 3.5])


def test_lines_are_integrated_exactly_column_by_column():
    lines = np.column_stack([2.0 * T, 3.0 - T, np.ones(5)])
    areas = np.column_stack([T**2, 3.0 * T - T**2 / 2, T])
    assert running_integral(T, lines) == pytest.approx(areas)
    level = lines[:, 0] + 1j * lines[:, 1]
    assert running_integral(T, level) == pytest.approx(areas[:, 0] + 1j * areas[:, 1])


def test_held_values_count_for_the_time_before_them():
    held = running_integral(T, np.array([9.0, 1.0, 2.0, 0.0, 1.0]), is_held=True)
    assert held == pytest.approx([0.0, 0.5, 0.9, 0.9, 2.4])


def test_columns_in_between_are_linear():
    lines = np.column_stack([2.0 * T, 3.0 - T])
    at = np.array([0.1, 1.0, 3.0])
    expected = np.column_stack([2.0 * at, 3.0 - at])
    assert columns_at(at, T, lines) == pytest.approx(expected)
