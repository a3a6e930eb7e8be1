from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.logs.checks import spike_warning
from sonar_graph.measurements import Floats, Imu


def turning(seed: int = 0) -> Floats:
    """A turn that swells and fades, with noise."""
    at_s = np.arange(3000) * 0.01
    yaw_rate = 0.6 * np.sin(0.9 * at_s)
    rate = np.column_stack([np.zeros((3000, 2)), yaw_rate])
    return np.asarray(rate + 2e-3 * np.random.default_rng(seed).standard_normal(rate.shape))


def found(rate: Floats) -> str | None:
    stamps_ns = 1_400_000_000_000_000_000 + np.arange(len(rate)) * 10_000_000
    return spike_warning(Imu(stamps_ns, rate, np.full(rate.shape, np.nan)))


def test_a_turn_is_no_spike() -> None:
    assert found(turning()) is None


def test_a_single_wild_rate_is_named_with_its_time_and_size() -> None:
    rate = turning()
    rate[2000, 2] += 30.0
    text = found(rate)
    assert text is not None
    assert text.startswith(
        "1 angular rate stands out from both neighbours, by 30 rad/s at most, 20.000 s after the first"
    )


@pytest.mark.parametrize("row", [1, 1500, 2998])
def test_a_spike_is_found_wherever_it_has_two_neighbours(row: int) -> None:
    rate = turning()
    rate[row] -= 4.0
    assert found(rate) is not None


def test_several_are_counted() -> None:
    rate = turning()
    rate[[100, 700, 1900], 0] += [5.0, -9.0, 7.0]
    text = found(rate)
    assert text is not None
    assert text.startswith("3 angular rates stand out")
    assert "7.000 s after the first" in text


def test_a_turn_that_begins_at_once_is_no_spike() -> None:
    rate = turning()
    rate[1000:] += 3.0
    assert found(rate) is None


def test_a_vehicle_that_shakes_has_no_spikes() -> None:
    shaking = 2.0 * np.random.default_rng(3).standard_normal((3000, 3))
    assert found(shaking) is None


def test_two_rows_have_no_spike() -> None:
    assert found(np.array([[0.0, 0, 0], [0, 0, 90]])) is None
