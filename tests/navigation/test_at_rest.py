"""Rests drawn from noise and their limits; gravity in a moving vehicle; roll and pitch; noise densities of a rest."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
)
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Floats, Imu
from sonar_graph.models import gravity_direction
from sonar_graph.motion import earth_rate_in_world
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.navigation.alignment import InitialTilt, align_at_rest, noise_densities
from sonar_graph.navigation.alignment.allan import allan_deviation
from sonar_graph.navigation.alignment.at_rest import (
    angles_by_up,
    earth_up_and_level,
    roll_and_pitch,
)
from sonar_graph.testing import check_consistent, check_derivative
from sonar_graph.testing.numerical import central_differences

from . import ways
from .rows import NS, at, dvl
from .ways import acceleration_at, attitude, rate_at, velocity_at

G = 9.80665
HZ = 50
REST_S = 20.0
EARTH = 7.292115e-5
LATITUDE = np.radians(40.0)
SENSORS = ImuCalibration(
    gyro_noise_density=2e-5,
    gyro_bias_walk_density=0.0,
    accel_noise_density=2e-3,
    accel_bias_sigma=5e-3,
)
ROLL = 0.3
PITCH = -0.4
GYRO_BIAS = np.array([2e-4, -1e-4, 3e-4])
KNOWN = Calibration(imu=SENSORS)


def rest(rng, yaw=0.0, earth=0.0, noise=1.0, rest_s=REST_S) -> Imu:
    """Noisy readings of a body with the attitude above."""
    n = round(rest_s * HZ)
    world_R_body = Rotation.from_euler("ZYX", [yaw, PITCH, ROLL])
    rate = (
        world_R_body.inv().apply(
            earth * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
        )
        + GYRO_BIAS
    )
    force = world_R_body.inv().apply(
        [0, 0, G]
    ) + noise * SENSORS.accel_bias_sigma * rng.standard_normal(3)
    white = noise * np.sqrt(HZ) * rng.standard_normal((2, n, 3))
    stamps_ns = np.arange(n) * (10**9 // HZ)
    return Imu(
        stamps_ns,
        rate + SENSORS.gyro_noise_density * white[0],
        force + SENSORS.accel_noise_density * white[1],
    )


def changed(imu: Imu, force=0.0, times=1.0) -> Imu:
    return replace(imu, specific_force=times * imu.specific_force + force)


def error_of(found: InitialTilt) -> np.ndarray:
    return np.array(
        [found.roll_rad - ROLL, found.pitch_rad - PITCH, *(found.gyro_bias - GYRO_BIAS)]
    )


def nees(found: InitialTilt) -> float:
    return float(error_of(found) @ np.linalg.solve(found.covariance, error_of(found)))


@pytest.mark.parametrize("latitude", [None, LATITUDE])
def test_what_is_claimed_is_what_many_rests_err_by(latitude):
    """With the Earth, at headings all around: its level part is in the covariance alone."""
    rng = np.random.default_rng(3)
    known = Calibration(imu=SENSORS, earth_rate_latitude_rad=latitude)
    earth = 0.0 if latitude is None else EARTH
    found = [
        align_at_rest(rest(rng, rng.uniform(-np.pi, np.pi), earth), known)
        for _ in range(400)
    ]
    check_consistent([nees(one) for one in found], 5, confidence=0.999)


def sway(imu: Imu) -> np.ndarray:
    return np.sin(2 * np.pi * 0.3 * imu.stamps_ns * 1e-9)[:, None]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda imu: changed(imu, force=0.02 * sway(imu)),
            "Imu.specific_force: varies",
        ),
        (lambda imu: changed(imu, times=1 / G), "check its unit"),
        (lambda imu: changed(imu, force=np.nan), "needs accelerometers"),
        (
            lambda imu: imu.rows((imu.stamps_ns < 5e9) | (imu.stamps_ns > 7e9)),
            "without a row",
        ),
        (
            lambda imu: changed(imu, force=np.array([-G, 0, 0]) - imu.specific_force),
            "nose points straight",
        ),
    ],
)
def test_what_is_no_rest_is_refused(spoil, message):
    imu = rest(np.random.default_rng(5))
    assert not refusal(imu)
    assert message in refusal(spoil(imu))


def refusal(imu: Imu) -> str:
    try:
        align_at_rest(imu, KNOWN)
    except AlignmentError as error:
        return str(error)
    return ""


GRAVITY = np.array([0.0, 0.0, G])
IMU = ImuCalibration(
    accel_noise_density=2e-3,
    accel_bias_sigma=5e-3,
    gyro_noise_density=2e-3,
    gyro_bias_sigma=1e-3,
)
MOVING = Calibration(imu=IMU, gravity_m_s2=G)
"""A gyro that drifts so fast that directions a second apart share next to nothing."""
T = 1.0
N = 2000
FROM_S = 2.0


def accelerated() -> tuple[PreintegratedMotion, Floats, Floats, Rotation]:
    """A turning, swaying vehicle's motion over T, its velocities in the body at both ends, and its last attitude."""
    stamps_ns = at(FROM_S) + (np.arange(N + 1) * T / N * NS).astype(np.int64)
    t = (stamps_ns - at(0.0)) * 1e-9
    force = attitude(t).inv().apply(acceleration_at(t) + GRAVITY)
    log = dvl(stamps_ns, attitude(t).inv().apply(velocity_at(t)))
    agile = Calibration(dvl=DvlCalibration(velocity_walk_density=10.0))
    motion = ways.motion(
        Imu(stamps_ns, rate_at(t), force), log, agile, FROM_S, FROM_S + T
    )
    ends = np.array([FROM_S, FROM_S + T])
    return motion, *attitude(ends).inv().apply(velocity_at(ends)), attitude(ends)[1]


def test_stated_sigma_is_that_of_many_noisy_intervals():
    """Two-sided, about both horizontal axes, with noise in force, bias, both velocities, and gyros."""
    motion, v_i, v_j, end = accelerated()
    level = end.inv().apply(np.eye(3)[:2])
    rng = np.random.default_rng(1)
    velocity_sigma = 0.004
    squares = []
    by_gyros = np.hypot(
        IMU.gyro_noise_density * np.sqrt(T / 3), IMU.gyro_bias_sigma * T / 2
    )
    for _ in range(1500):
        force = motion.mean_specific_force + IMU.accel_noise_density / np.sqrt(
            T
        ) * rng.standard_normal(3)
        noisy = replace(
            motion,
            mean_specific_force=force + IMU.accel_bias_sigma * rng.standard_normal(3),
        )
        scatter = velocity_sigma * rng.standard_normal((2, 3))
        up, sigma = gravity_direction(
            noisy, v_i + scatter[0], v_j + scatter[1], velocity_sigma, MOVING
        )
        assert np.linalg.norm(up) == pytest.approx(1.0)
        up = up + np.cross(by_gyros * rng.standard_normal(3), up)
        squares.append(np.sum((level @ up / sigma) ** 2))
    check_consistent(squares, 2, confidence=0.999)


def test_without_forces_there_is_no_direction():
    unfelt = replace(accelerated()[0], mean_specific_force=np.full(3, np.nan))
    assert gravity_direction(unfelt, np.zeros(3), np.zeros(3), 0.01, MOVING) is None


@pytest.mark.parametrize(
    ("latitude_deg", "rate"),
    [(0, [0, 15.04107, 0]), (90, [0, 0, 15.04107]), (-90, [0, 0, -15.04107])],
)
def test_the_earth_turns_north_at_the_equator_and_up_at_the_north_pole(
    latitude_deg, rate
):
    """Degrees an hour."""
    known = Calibration(earth_rate_latitude_rad=np.radians(latitude_deg))
    found = np.degrees(earth_rate_in_world(known)) * 3600
    assert found == pytest.approx(rate, abs=1e-5)
    assert earth_up_and_level(known) == pytest.approx(
        earth_rate_in_world(known)[[2, 1]]
    )
    assert earth_rate_in_world(Calibration()) is None
    assert earth_up_and_level(Calibration()) == (0.0, 0.0)


ATTITUDES = [(0.3, -0.4), (-2.8, 1.2), (0.0, 0.0), (1.5, -1.5)]


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
def test_the_derivative_is_that_of_turning_up_a_little(roll, pitch):
    """Along the sphere; a change of length changes neither angle."""
    up = Rotation.from_euler("ZYX", [0.7, pitch, roll]).inv().apply([0, 0, 1.0])

    def angles(phi: np.ndarray) -> tuple[float, float]:
        return roll_and_pitch(Rotation.from_rotvec(phi).apply(up))

    still = np.zeros(3)
    by_turn = central_differences(
        lambda phi: Rotation.from_rotvec(phi).apply(up), still
    )
    check_derivative(angles, angles_by_up(up) @ by_turn, still)
    assert angles_by_up(up) @ up == pytest.approx([0.0, 0.0], abs=1e-12)


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
    # sigma(tau) = slope tau / sqrt(2)
    assert allan_deviation(ramp, 50) == pytest.approx([0.3 / np.sqrt(2)])


def imu_of(still_s: float, moving_s: float) -> Imu:
    rng = np.random.default_rng(0)
    n = round((still_s + moving_s) * RATE_HZ)
    still = round(still_s * RATE_HZ)
    swaying = (
        0.2
        * np.sin(2 * np.pi * 0.21 * np.arange(n) / RATE_HZ)
        * (np.arange(n) >= still)
    )
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
