"""What alignment in motion claims, against how every reading and every bias moves what it finds."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.alignment.dvl_imu import InertialPath
from sonar_graph.navigation.alignment.in_motion import _Doppler, align_in_motion

from .test_moving_alignment import EARTH, LATITUDE, G, acceleration, attitude, velocity

HZ, DVL_EVERY, LENGTH_S, FINE_S = 10, 2, 2.4, 1e-4
T = np.arange(round(LENGTH_S * HZ) + 1) / HZ
YAW = 0.8
IMU_AT, DVL_AT = np.array([0.4, -0.1, 0.2]), np.array([-0.5, 0.3, -0.2])
IMU_RPY, DVL_RPY = (0.2, -0.4, 1.0), (0.1, 0.5, -0.8)
ROOT = np.array([[0.006, 0.0, 0.0], [0.002, 0.003, 0.0], [-0.001, 0.002, 0.008]])
"""Of the covariance of every velocity."""


def calibration(
    gyro: float,
    gyro_bias: float,
    accel: float,
    accel_bias: float,
    latitude: float | None = None,
    dvl_at: Floats = DVL_AT,
) -> Calibration:
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=gyro,
            gyro_bias_sigma=gyro_bias,
            accel_noise_density=accel,
            accel_bias_sigma=accel_bias,
            mounting=Mounting(translation_m=tuple(IMU_AT), rpy_rad=IMU_RPY),
        ),
        dvl=DvlCalibration(mounting=Mounting(translation_m=tuple(dvl_at), rpy_rad=DVL_RPY)),
        earth_rate_latitude_rad=latitude,
    )


def turned_by(rpy: tuple[float, float, float], vectors: Floats) -> Floats:
    """From the body into a sensor's axes."""
    return Rotation.from_euler("xyz", rpy).inv().apply(vectors)


def readings(known: Calibration, earth: float) -> tuple[Floats, Floats, Floats]:
    """Rates, forces and velocities without noise, in body axes, the last of the Doppler log's point."""
    body_R_world = attitude(T, YAW).inv()
    rate = (attitude(T - FINE_S, YAW).inv() * attitude(T + FINE_S, YAW)).as_rotvec() / (2 * FINE_S)
    force = body_R_world.apply(acceleration(T) + np.array([0, 0, G]))
    lever = IMU_AT - known.dvl.mounting.translation_m
    at_dvl = (body_R_world.apply(velocity(T)) - np.cross(rate, lever))[::DVL_EVERY]
    felt = body_R_world.apply(earth * np.array([0.0, np.cos(LATITUDE), np.sin(LATITUDE)]))
    return rate + felt, force, at_dvl


def found_from(rate: Floats, force: Floats, at_dvl: Floats, known: Calibration):
    stamps_ns = np.round(T * 1e9).astype(np.int64)
    cov = np.tile(ROOT @ ROOT.T, (len(at_dvl), 1, 1))
    return align_in_motion(
        Imu(stamps_ns, turned_by(IMU_RPY, rate), turned_by(IMU_RPY, force)),
        Dvl(stamps_ns[::DVL_EVERY], turned_by(DVL_RPY, at_dvl), cov),
        known,
    )


def error_spread(known: Calibration, earth: float) -> Floats:
    """``J Q J^T`` of what is found less what is true, of all white noises, both biases and the unknown heading."""
    base, sensors = readings(known, earth), known.imu

    def numbers(*moved: Floats) -> Floats:
        found = found_from(*moved, known)
        return np.array([found.roll_rad, found.pitch_rad, *found.gyro_bias])

    unmoved, share = numbers(*base), 0.1

    def spread(column: int, delta: Floats, truth: Floats | float = 0.0) -> Floats:
        moved = [values + (share * delta if k == column else 0.0) for k, values in enumerate(base)]
        error = (numbers(*moved) - unmoved) / share - truth
        return np.outer(error, error)

    body_R_dvl = Rotation.from_euler("xyz", DVL_RPY).as_matrix()
    white = np.eye(3) * np.sqrt(HZ)
    roots = (sensors.gyro_noise_density * white, sensors.accel_noise_density * white, body_R_dvl @ ROOT)
    total = np.zeros((5, 5))
    for column, root in enumerate(roots):
        single = np.zeros_like(base[column])
        for row, direction in product(range(len(single)), root.T[root.any(axis=0)]):
            single[:] = 0.0
            single[row] = direction
            total += spread(column, single)
    level = earth * np.cos(LATITUDE) / np.sqrt(2)
    body_R_world, always = attitude(T, YAW).inv(), np.ones((len(T), 1))
    for axis in np.eye(3):
        total += spread(0, sensors.gyro_bias_sigma * axis * always, np.r_[0, 0, sensors.gyro_bias_sigma * axis])
        total += spread(1, sensors.accel_bias_sigma * axis * always)
        total += spread(0, body_R_world.apply(level * axis * [1, 1, 0]))
    return total


@pytest.mark.parametrize(
    ("known", "earth", "tolerance"),
    [
        (calibration(1e-3, 1e-3, 0.0, 1e-5, dvl_at=IMU_AT), 0.0, 0.05),
        (calibration(1e-3, 1e-3, 0.0, 1e-5), 0.0, 0.07),  # that a rate's noise also turns the path is left out
        (calibration(0.0, 1e-2, 2e-3, 1e-2), 0.0, 0.003),
        (calibration(0.0, 1e-7, 0.0, 1e-5, LATITUDE), EARTH, 0.003),
    ],
    ids=["gyros in one place", "gyros at a lever", "accelerometers", "the Earth"],
)
def test_the_covariance_is_that_of_every_reading_and_bias(known, earth, tolerance):
    truth, found = error_spread(known, earth), found_from(*readings(known, earth), known)
    size = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    assert found.covariance / size == pytest.approx(truth / size, abs=tolerance)


def test_noise_of_a_rate_moves_no_velocity_along_the_lever():
    """However the vehicle has turned since the first sample."""
    known = calibration(1e-3, 0.0, 0.0, 0.0)
    rate, force, at_dvl = readings(known, 0.0)
    path = InertialPath.of(Imu(np.round(T * 1e9).astype(np.int64), rate, force))
    seconds, lever = T[::DVL_EVERY], IMU_AT - DVL_AT
    fresh = _Doppler.along(path, seconds, at_dvl, np.zeros((len(seconds), 3, 3)), known).R
    along = path.rotations_at(seconds) @ lever
    size = 1e-6 * HZ * lever @ lever
    assert np.einsum("ki,kij,kj->k", along, fresh, along) == pytest.approx(0.0 * seconds, abs=1e-9 * size)
    assert np.trace(fresh, axis1=1, axis2=2) == pytest.approx(0.0 * seconds + 2 * size)
