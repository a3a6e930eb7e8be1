"""Alignment of simulated vehicles that sway and turn; truth by formulas and by differences of attitudes."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.logs.convert import read_akit
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.alignment import InitialTilt, align_in_motion

from .rows import dvl as dvl_rows
from .ways import acceleration_at, attitude, rate_at, velocity_at

T = np.arange(round(15.0 * 100) + 1) / 100
G = 9.80665
DVL_EVERY = 20
EARTH = 7.292115e-5
LATITUDE = np.radians(40.0)
IMU_AT = np.array([0.4, -0.1, 0.2])


def calibration(
    gyro: float,
    gyro_bias: float,
    accel: float,
    accel_bias: float,
    latitude: float | None = None,
    imu_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
    dvl: Mounting | None = None,
) -> Calibration:
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=gyro,
            gyro_bias_sigma=gyro_bias,
            accel_noise_density=accel,
            accel_bias_sigma=accel_bias,
            mounting=Mounting(translation_m=tuple(IMU_AT), rpy_rad=imu_rpy),
        ),
        dvl=DvlCalibration(
            velocity_sigma_m_s=(0.005, 0.005, 0.005), mounting=dvl or Mounting()
        ),
        earth_rate_latitude_rad=latitude,
    )


KNOWN = calibration(1e-4, 1e-3, 1e-3, 1e-2)


def exact_readings(
    t: Floats, known: Calibration, yaw: float, earth: float
) -> tuple[Floats, Floats, Floats]:
    """Rates, forces and velocities at the times of the IMU, in body axes, the last of the Doppler log's point."""
    body_R_world = attitude(t, yaw).inv()
    rate = rate_at(t)
    world_rate = earth * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)])
    coriolis = 2.0 * np.cross(world_rate, velocity_at(t))
    lever = IMU_AT - known.dvl.mounting.translation_m
    force = body_R_world.apply(acceleration_at(t) + coriolis + [0, 0, G])
    return (
        rate + body_R_world.apply(world_rate),
        force,
        body_R_world.apply(velocity_at(t)) - np.cross(rate, lever),
    )


def numbers_of(found: InitialTilt) -> np.ndarray:
    return np.array([found.roll_rad, found.pitch_rad, *found.gyro_bias])


def test_a_noiseless_run_gives_what_was_put_in():
    rate, force, at_dvl = exact_readings(T, KNOWN, 0.0, 0.0)
    stamps_ns = np.round(T * 1e9).astype(np.int64)
    log = dvl_rows(stamps_ns[::DVL_EVERY], at_dvl[::DVL_EVERY])
    _, pitch, roll = attitude(np.zeros(1)).as_euler("ZYX")[0]
    found = align_in_motion(Imu(stamps_ns, rate, force), log, KNOWN)
    assert numbers_of(found) == pytest.approx([roll, pitch, 0, 0, 0], abs=2e-6)


def test_of_a_fast_doppler_log_evenly_spaced_rows_are_enough():
    """1,501 rows in 15 s have a covariance of 4,503 x 4,503: every third of them is taken."""
    rate, force, at_dvl = exact_readings(T, KNOWN, 0.0, 0.0)
    at_dvl = at_dvl + 0.005 * np.random.default_rng(1).standard_normal(at_dvl.shape)
    stamps_ns = np.round(T * 1e9).astype(np.int64)
    imu = Imu(stamps_ns, rate, force)
    whole = align_in_motion(imu, dvl_rows(stamps_ns, at_dvl), KNOWN)
    third = align_in_motion(imu, dvl_rows(stamps_ns[::3], at_dvl[::3]), KNOWN)
    np.testing.assert_array_equal(numbers_of(whole), numbers_of(third))
    np.testing.assert_array_equal(whole.covariance, third.covariance)


@pytest.mark.slow
@pytest.mark.recording
def test_at_sea_it_finds_the_tilt_that_the_reference_has(unpacked):
    """A-KIT, eight stretches of each run, whose reference was moved in time to where it turns as the gyros do."""
    folder = next(unpacked("akit_1-7.tar.xz").rglob("Trajectory1")).parent
    errors = []
    inside = 0
    for trajectory in range(1, 8):
        sea = read_akit(folder, trajectory)
        for row in range(20, 340, 40):
            at_ns = int(sea.truth.stamps_ns[row])
            span = (at_ns - 1, at_ns + 60 * 10**9)
            found = align_in_motion(
                sea.imu.between(*span), sea.dvl.between(*span), sea.calibration
            )
            _, pitch, roll = Rotation.from_quat(
                sea.truth.quaternions_xyzw[row]
            ).as_euler("ZYX")
            errors.append(numbers_of(found)[:2] - [roll, pitch])
            inside += errors[-1] @ np.linalg.solve(
                found.covariance[:2, :2], errors[-1]
            ) < chi2.ppf(0.99, 2)
    roll_deg, pitch_deg = np.degrees(np.sqrt(np.mean(np.square(errors), axis=0)))
    assert len(errors) == 56
    assert inside >= 45
    assert roll_deg < 0.045
    assert pitch_deg < 0.025


SHORT_HZ = 10
SHORT_EVERY = 2
SHORT_T = np.arange(round(2.4 * SHORT_HZ) + 1) / SHORT_HZ
YAW = 0.8
IMU_RPY = (0.2, -0.4, 1.0)
DVL_RPY = (0.1, 0.5, -0.8)
IN_PLACE, APART = (
    {"imu_rpy": IMU_RPY, "dvl": Mounting(translation_m=at, rpy_rad=DVL_RPY)}
    for at in (tuple(IMU_AT), (-0.5, 0.3, -0.2))
)
ROOT = np.array([[0.006, 0.0, 0.0], [0.002, 0.003, 0.0], [-0.001, 0.002, 0.008]])
"""Of the covariance of every velocity."""


def turned_by(rpy: tuple[float, float, float], vectors: Floats) -> Floats:
    """From the body into a sensor's axes."""
    return Rotation.from_euler("xyz", rpy).inv().apply(vectors)


def short_readings(known: Calibration, earth: float) -> tuple[Floats, Floats, Floats]:
    rate, force, velocity = exact_readings(SHORT_T, known, YAW, earth)
    return rate, force, velocity[::SHORT_EVERY]


def found_from(rate: Floats, force: Floats, at_dvl: Floats, known: Calibration):
    stamps_ns = np.round(SHORT_T * 1e9).astype(np.int64)
    cov = np.tile(ROOT @ ROOT.T, (len(at_dvl), 1, 1))
    return align_in_motion(
        Imu(stamps_ns, turned_by(IMU_RPY, rate), turned_by(IMU_RPY, force)),
        Dvl(stamps_ns[::SHORT_EVERY], turned_by(DVL_RPY, at_dvl), cov),
        known,
    )


def error_spread(known: Calibration, earth: float) -> Floats:
    """``J Q J^T`` of what is found less what is true, of all white noises, both biases and the unknown heading."""
    base = short_readings(known, earth)
    sensors = known.imu
    unmoved = found_from(*base, known)
    share = 0.1

    def spread(column: int, delta: Floats, truth: Floats | float = 0.0) -> Floats:
        moved = [
            values + (share * delta if k == column else 0.0)
            for k, values in enumerate(base)
        ]
        change = numbers_of(found_from(*moved, known)) - numbers_of(unmoved)
        error = change / share - truth
        return np.outer(error, error)

    body_R_dvl = Rotation.from_euler("xyz", DVL_RPY).as_matrix()
    white = np.eye(3) * np.sqrt(SHORT_HZ)
    roots = (
        sensors.gyro_noise_density * white,
        sensors.accel_noise_density * white,
        body_R_dvl @ ROOT,
    )
    total = np.zeros((5, 5))
    for column, root in enumerate(roots):
        for row, direction in product(
            range(len(base[column])), root.T[root.any(axis=0)]
        ):
            total += spread(
                column, np.outer(np.arange(len(base[column])) == row, direction)
            )
    level = earth * np.cos(LATITUDE) / np.sqrt(2)
    body_R_world = attitude(SHORT_T, YAW).inv()
    always = np.ones((len(SHORT_T), 1))
    for axis in np.eye(3):
        total += spread(
            0,
            sensors.gyro_bias_sigma * axis * always,
            np.r_[0, 0, sensors.gyro_bias_sigma * axis],
        )
        total += spread(1, sensors.accel_bias_sigma * axis * always)
        total += spread(0, body_R_world.apply(level * axis * [1, 1, 0]))
    return total


@pytest.mark.parametrize(
    ("known", "earth", "tolerance"),
    [
        (calibration(1e-3, 1e-3, 0.0, 1e-5, **IN_PLACE), 0.0, 0.05),
        (
            calibration(1e-3, 1e-3, 0.0, 1e-5, **APART),
            0.0,
            0.07,
        ),  # that a rate's noise also turns the path is left out
        (calibration(0.0, 1e-2, 2e-3, 1e-2, **APART), 0.0, 0.003),
        (calibration(0.0, 1e-7, 0.0, 1e-5, LATITUDE, **APART), EARTH, 0.003),
    ],
    ids=["gyros in one place", "gyros at a lever", "accelerometers", "the Earth"],
)
def test_the_covariance_is_that_of_every_reading_and_bias(known, earth, tolerance):
    truth = error_spread(known, earth)
    found = found_from(*short_readings(known, earth), known)
    size = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    assert found.covariance / size == pytest.approx(truth / size, abs=tolerance)
