"""Single Doppler beams in the odometry of all estimators, on a vehicle that turns and speeds up."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.devices.dvl_beams import velocity_of_beams
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes
from sonar_graph.navigation.preintegration.motion import Preintegrator

SIGMA = 0.01
TILT = np.radians(30.0)
JANUS = np.array(
    [
        [np.sin(TILT) * np.cos(azimuth), np.sin(TILT) * np.sin(azimuth), np.cos(TILT)]
        for azimuth in np.radians([45.0, -45.0, -135.0, 135.0])
    ]
)

IMU_HZ, SECONDS, LOST_S = 100, 40.0, (10.0, 30.0)
VEHICLE = Calibration(
    imu=ImuCalibration(mounting=Mounting(translation_m=(0.1, 0.0, 0.05))),
    dvl=DvlCalibration(mounting=Mounting(translation_m=(-0.4, 0.1, -0.1)), velocity_walk_density=0.1),
)


def drive(rng, with_force):
    """IMU at 100 Hz, true velocities of the Doppler log at 5 Hz, and the displacement in the first body frame."""
    fine = np.arange(0.0, SECONDS + 1e-9, 1.0 / (10 * IMU_HZ))
    yaw = 0.5 * np.sin(0.15 * fine)
    surge, sway = 0.8 + 0.4 * np.sin(0.4 * fine), 0.1 * np.sin(0.23 * fine)
    rate = np.zeros((len(fine), 3))
    rate[:, 2] = np.gradient(yaw, fine)
    velocity = np.column_stack([surge, sway, 0.05 * np.sin(0.3 * fine)])
    R = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    arm = np.array(VEHICLE.imu.mounting.translation_m)
    at_imu = R.apply(velocity + np.cross(rate, arm))
    force = R.inv().apply(np.gradient(at_imu, fine, axis=0) + np.array([0.0, 0.0, VEHICLE.gravity_m_s2]))
    every = slice(None, None, 10)
    noise = VEHICLE.imu
    white = np.sqrt(IMU_HZ) * rng.standard_normal((2, len(fine[every]), 3))
    force = force[every] + noise.accel_noise_density * white[1] + noise.accel_bias_sigma * rng.standard_normal(3)
    stamps_ns = np.rint(fine[every] * 1e9).astype(np.int64)
    imu = Imu(stamps_ns, rate[every] + noise.gyro_noise_density * white[0], force if with_force else force * np.nan)
    at_dvl = velocity + np.cross(rate, VEHICLE.dvl.mounting.translation_m)
    path = np.trapezoid(R.apply(velocity), fine, axis=0)
    return imu, np.rint(fine[::200] * 1e9).astype(np.int64), at_dvl[::200], R[0].inv().apply(path)


def displacement(imu, dvl):
    """Of the whole drive, by the odometry of all estimators."""
    odometry = Odometry(VEHICLE)
    odometry.add(imu, dvl)
    total = None
    nodes = odometry.nodes(0, int(imu.stamps_ns[-1]))
    preintegrator = Preintegrator.from_calibration(VEHICLE)
    total = motion_between_nodes(odometry, preintegrator, 0, int(nodes[-1]), np.zeros(3), None)
    R = total.i_T_j.rotation().matrix()
    return total.i_T_j.translation(), R @ total.covariance[3:, 3:] @ R.T


def lose_beams(stamps_ns, rng, count):
    """All four, but for 20 s only some, which ones changes every second."""
    valid = np.ones((len(stamps_ns), 4), dtype=bool)
    for k in np.flatnonzero((stamps_ns > LOST_S[0] * 1e9) & (stamps_ns < LOST_S[1] * 1e9)):
        valid[k] = np.isin(np.arange(4), np.random.default_rng(stamps_ns[k] // 10**9).permutation(4)[:count])
    return valid


@pytest.mark.parametrize("with_force", [False, True])
def test_one_beam_is_better_than_a_gap_and_two_than_one(with_force):
    """Against a plain gap, which the odometry bridges without any beam."""
    runs = 20
    rms = {}
    for count in (0, 1, 2, 4):
        squares, normalised = [], []
        for seed in range(runs):
            rng = np.random.default_rng(seed)
            imu, stamps_ns, truth, path = drive(rng, with_force)
            along = truth @ JANUS.T + SIGMA * rng.standard_normal((len(truth), 4))
            valid = lose_beams(stamps_ns, rng, count)
            velocity, cov = velocity_of_beams(JANUS, along, valid, SIGMA)
            some = valid.any(axis=1)
            found, P = displacement(imu, Dvl(stamps_ns[some], velocity[some], cov[some]))
            squares.append(np.sum((found - path) ** 2))
            normalised.append((found - path) @ np.linalg.solve(P, found - path) / 3)
        rms[count] = np.sqrt(np.mean(squares))
        print(f"{count} beams: rms {rms[count]:.3f} m, NEES over 3 {np.mean(normalised):.2f}")
        assert 0.2 < np.mean(normalised) < 1.6
    assert rms[4] < rms[2] < rms[1] < 0.5 * rms[0]


def test_four_beams_of_equal_noise_are_the_velocity_that_a_driver_makes_of_them():
    rng = np.random.default_rng(0)
    imu, stamps_ns, truth, _ = drive(rng, True)
    along = truth @ JANUS.T + SIGMA * rng.standard_normal((len(truth), 4))
    by_beams = Dvl(stamps_ns, *velocity_of_beams(JANUS, along, np.ones_like(along, dtype=bool), SIGMA))
    across, down = SIGMA**2 / (2 * np.sin(TILT) ** 2), SIGMA**2 / (4 * np.cos(TILT) ** 2)
    told = Dvl(stamps_ns, along @ np.linalg.pinv(JANUS).T, np.tile(np.diag([across, across, down]), (len(truth), 1, 1)))
    for one, other in zip(displacement(imu, by_beams), displacement(imu, told), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_the_odometry_of_beams_does_not_depend_on_how_the_log_is_cut():
    rng = np.random.default_rng(5)
    imu, stamps_ns, truth, _ = drive(rng, True)
    along = truth @ JANUS.T + SIGMA * rng.standard_normal((len(truth), 4))
    dvl = Dvl(stamps_ns, *velocity_of_beams(JANUS, along, lose_beams(stamps_ns, rng, 2), SIGMA))
    piecewise, whole = Odometry(VEHICLE), Odometry(VEHICLE)
    whole.add(imu, dvl)
    for begin_ns in range(-1, int(imu.stamps_ns[-1]), 3_700_000_000):
        piecewise.add(imu.between(begin_ns, begin_ns + 3_700_000_000), dvl.between(begin_ns, begin_ns + 3_700_000_000))
    for one, other in zip(whole.columns()[3:6], piecewise.columns()[3:6], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
