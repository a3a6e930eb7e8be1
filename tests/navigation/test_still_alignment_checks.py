"""What counts as a rest, and what does not."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment.at_rest import align_at_rest

from .test_still_alignment import HZ, NOISELESS, SENSORS, rest

KNOWN = Calibration(imu=SENSORS)


def noisy(seed: int, rest_s: float = 20.0, times: float = 1.0) -> Imu:
    """Noise of so many times the density that is known."""
    imu, quiet = rest(np.random.default_rng(seed), rest_s=rest_s), rest(NOISELESS, noise=0.0, rest_s=rest_s)
    return Imu(
        imu.stamps_ns,
        quiet.angular_velocity + times * (imu.angular_velocity - quiet.angular_velocity),
        quiet.specific_force + times * (imu.specific_force - quiet.specific_force),
    )


def is_rest(imu: Imu, known: Calibration = KNOWN, dvl: Dvl | None = None) -> bool:
    try:
        align_at_rest(imu, known, dvl)
    except AlignmentError:
        return False
    return True


def test_two_seconds_are_enough_and_less_are_not():
    """From the first to the last of the samples."""
    assert is_rest(noisy(0, 2.0 + 1 / HZ))
    with pytest.raises(AlignmentError, match=r"2\.0 s of IMU is too short; give 2 s"):
        align_at_rest(noisy(0, 2.0), KNOWN)


def test_a_quarter_of_a_second_without_a_row_is_no_hole_and_more_is():
    imu = noisy(1)
    seconds = imu.stamps_ns * 1e-9
    assert is_rest(imu.rows((seconds < 5.01) | (seconds > 5.23)))
    with pytest.raises(AlignmentError, match=r"0\.28 s without a row"):
        align_at_rest(imu.rows((seconds < 5.01) | (seconds > 5.27)), KNOWN)


def density_of(imu: Imu) -> float:
    """As the refusal by much too small a density says it."""
    sharp = Calibration(imu=SENSORS.model_copy(update={"accel_noise_density": 1e-9}))
    with pytest.raises(AlignmentError, match=r"Imu.specific_force: varies") as refused:
        align_at_rest(imu, sharp)
    return float(re.search(r"a density of (\S+),", str(refused.value))[1])


@pytest.mark.parametrize(("rest_s", "runs"), [(2.2, 400), (20.0, 60)])
def test_the_density_that_is_said_is_that_of_the_noise(rest_s, runs):
    """Mean of many squares, whatever the number of blocks, and however few rows are left over at the end."""
    squares = [density_of(noisy(seed, rest_s)) ** 2 for seed in range(runs)]
    assert np.mean(squares) == pytest.approx(SENSORS.accel_noise_density**2, rel=0.1)


def test_half_more_noise_than_known_is_let_pass_even_where_chance_adds_to_it():
    """20 s are 39 blocks: 114 squares sum to 1.76 times their number once in a million, and 1.5 sqrt(1.76) is 1.99."""
    assert all(is_rest(noisy(seed, times=1.7)) for seed in range(20))
    assert not any(is_rest(noisy(seed, times=2.5)) for seed in range(20))


def test_a_last_sample_alone_is_no_mean():
    """3.5 sigmas of a single sample would be 18 of a block's mean."""
    imu = rest(NOISELESS, noise=0.0, rest_s=2.0 + 1 / HZ)
    force = imu.specific_force.copy()
    force[-1] += 3.5 * SENSORS.accel_noise_density * np.sqrt(HZ)
    assert is_rest(Imu(imu.stamps_ns, imu.angular_velocity, force))


@pytest.mark.parametrize("block", [0, 7])
def test_a_push_of_half_a_second_is_noticed_in_the_first_block_too(block):
    imu = noisy(2)
    pushed = imu.specific_force + np.where(imu.stamps_ns // 500_000_000 == block, 0.1, 0.0)[:, None] * [1, 0, 0]
    with pytest.raises(AlignmentError, match=r"Imu.specific_force: varies"):
        align_at_rest(Imu(imu.stamps_ns, imu.angular_velocity, pushed), KNOWN)


@pytest.mark.parametrize(("rate", "rests"), [(0.019, True), (0.021, False), (-0.021, False)])
def test_a_rate_may_be_a_bias_up_to_a_fiftieth_of_a_radian(rate, rests):
    imu = rest(NOISELESS, noise=0.0)
    turned = np.tile([0.0, rate, 0.0], (len(imu), 1))
    assert is_rest(Imu(imu.stamps_ns, turned, imu.specific_force)) == rests


@pytest.mark.parametrize(("share", "rests"), [(0.96, True), (1.04, True), (0.94, False), (1.06, False), (9.8, False)])
def test_force_is_gravity_but_for_a_twentieth(share, rests):
    imu = rest(NOISELESS, noise=0.0)
    assert is_rest(Imu(imu.stamps_ns, imu.angular_velocity, share * imu.specific_force)) == rests


def doppler(seconds: list[float], velocity: object) -> Dvl:
    at_ns = np.round(np.array(seconds) * 1e9).astype(np.int64)
    return Dvl(at_ns, np.broadcast_to(velocity, (len(at_ns), 3)), np.full((len(at_ns), 3, 3), np.nan))


def with_sigma(sigma_m_s: float) -> Calibration:
    return Calibration(imu=SENSORS, dvl=DvlCalibration(velocity_sigma_m_s=(sigma_m_s,) * 3))


@pytest.mark.parametrize(
    ("rows", "speed", "rests"), [(3, 0.26, True), (3, 0.28, False), (12, 0.14, True), (12, 0.15, False)]
)
def test_a_speed_is_none_within_five_sigmas_of_its_mean(rows, speed, rests):
    """By hand: 0.02 + 5 sqrt(3) 0.05 / sqrt(n) m/s is 0.27 of three rows and 0.145 of twelve."""
    dvl = doppler(np.linspace(1, 9, rows).tolist(), [0.6 * speed, 0.0, -0.8 * speed])
    assert is_rest(noisy(3), with_sigma(0.05), dvl) == rests


@pytest.mark.parametrize(("speed", "rests"), [(0.019, True), (0.021, False)])
def test_an_exact_doppler_log_may_creep(speed, rests):
    assert is_rest(noisy(3), with_sigma(0.0), doppler([1.0, 2.0], [0.0, speed, 0.0])) == rests


def test_noise_that_averages_out_is_no_speed():
    noise = 0.1 * np.random.default_rng(4).standard_normal((90, 3))
    assert np.linalg.norm(noise, axis=1).mean() > 0.15
    assert is_rest(noisy(3), with_sigma(0.1), doppler((0.2 * np.arange(90)).tolist(), noise))


@pytest.mark.parametrize(("second", "rests"), [(-0.01, True), (0.0, False), (19.98, False), (19.99, True)])
def test_velocities_count_from_the_first_to_the_last_of_the_rest(second, rests):
    assert is_rest(noisy(3), KNOWN, doppler([second], [0.5, 0.0, 0.0])) == rests
