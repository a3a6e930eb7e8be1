import numpy as np
import pytest

from sonar_graph.measurements import Imu
from sonar_graph.navigation.alignment.allan import allan_deviation, degrees_of_freedom, density, noise_densities

RATE_HZ = 50.0


def test_deviation_of_the_handbooks_thousand_points():
    """NIST SP 1065, section 12.4: the generator and the overlapping deviations are printed there."""
    numbers = [1234567890]
    for _ in range(999):
        numbers.append(16807 * numbers[-1] % 2147483647)
    points = np.array(numbers)[:, None] / 2147483647
    found = [float(allan_deviation(points, m)[0]) for m in (1, 10, 100)]
    assert found == pytest.approx([2.922319e-01, 9.159953e-02, 3.241343e-02], rel=1e-6)
    ramp = 0.3 * np.arange(500)[:, None] / RATE_HZ
    assert allan_deviation(ramp, 50) == pytest.approx([0.3 / np.sqrt(2)])  # sigma(tau) = slope tau / sqrt(2)


def test_interval_holds_the_density_at_its_stated_rate():
    """However many samples make a second: at 2.4 Hz two last 0.83 s."""
    true, held = 1.7e-3, []
    for seed in range(200):
        found = density(true * np.sqrt(RATE_HZ) * np.random.default_rng(seed).standard_normal((3000, 1)), RATE_HZ)
        held.append(abs(found.value - true) < 1.96 * found.sigma)
        assert found.sigma < 0.15 * true
    assert 0.90 <= np.mean(held) <= 0.99
    noise = 0.3 * np.sqrt(2.4) * np.random.default_rng(0).standard_normal((20_000, 1))
    assert density(noise, 2.4).value == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize(("count", "together"), [(40, 1), (40, 4), (60, 10)])
def test_degrees_of_freedom_are_those_of_the_quadratic_form(count, together):
    """``(tr Q)^2 / tr Q^2`` of the sum of squares of white noise; the handbook's formula is within two per cent."""
    sums = np.vstack([np.zeros(count), np.tril(np.ones((count, count)))])
    means = (sums[together:] - sums[:-together]) / together
    steps = means[together:] - means[:-together]
    Q = steps @ steps.T
    assert degrees_of_freedom(count, together) == pytest.approx(np.trace(Q) ** 2 / np.trace(Q @ Q), rel=0.02)


def imu_of(still_s: float, moving_s: float, seed: int = 0) -> Imu:
    rng = np.random.default_rng(seed)
    n, still = round((still_s + moving_s) * RATE_HZ), round(still_s * RATE_HZ)
    swaying = 0.2 * np.sin(2 * np.pi * 0.21 * np.arange(n) / RATE_HZ) * (np.arange(n) >= still)
    rate = 1e-3 * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3)) + swaying[:, None]
    force = [0, 0, 9.81] + 2e-3 * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3))
    return Imu((np.arange(n) / RATE_HZ * 1e9).astype(np.int64), rate, force)


def test_only_the_rest_is_looked_at_and_a_moving_log_tells_no_noise():
    found = noise_densities(imu_of(90, 60))
    assert found.still_s == pytest.approx(90, abs=6)
    assert found.gyro.value == pytest.approx(1e-3, abs=4 * found.gyro.sigma)
    assert found.accel.value == pytest.approx(2e-3, abs=4 * found.accel.sigma)
    moving = noise_densities(imu_of(10, 120)).gyro
    assert not moving.is_known
    assert "never still" in moving.reason
