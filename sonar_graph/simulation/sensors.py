"""Readings of an IMU, a Doppler log and a pressure sensor along a true motion, with noise and faults.

Samples are instantaneous values at their stamps. The Earth's rotation is left out, and the calibration does not require
estimators to remove it. docs/theory/simulation.md
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    DepthCalibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.measurements import NS_PER_S, Depth, Dvl, Floats, Imu, Ints
from sonar_graph.simulation.vehicle import Kinematics, VehiclePath, rotation_from_rpy

EPOCH_NS = 1_400_000_000 * NS_PER_S
"""Stamp of the start of every simulated run: a day in May 2014."""


def regular_stamps(rate_hz: float, duration_s: float, offset_s: float = 0.0) -> Ints:
    """Stamps every 1 / rate from ``offset_s`` after the start of the run to its end, shape (n,), nanoseconds."""
    # the last sample may lie at the very end, in spite of rounding
    count = int(np.floor((duration_s - offset_s) * rate_hz + 1e-9)) + 1
    return EPOCH_NS + np.rint(
        (offset_s + np.arange(count) / rate_hz) * NS_PER_S
    ).astype(np.int64)


def seconds_since_start(stamps_ns: Ints) -> Floats:
    """Time since the start of the run, shape (n,)."""
    return (stamps_ns - EPOCH_NS) / NS_PER_S


def body_R_sensor(mounting: Mounting) -> Rotation:
    """Rotation of a mounting."""
    return rotation_from_rpy(np.array(mounting.rpy_rad))


def imu_readings(
    motion: Kinematics, mounting: Mounting, gravity_m_s2: float
) -> tuple[Floats, Floats]:
    """Exact angular velocity and specific force of an IMU with a lever arm l, in its own frame.

    ::

        omega_imu = imu_R_body omega
        f_imu     = imu_R_body ( body_R_world (a - g) + omega' × l + omega × (omega × l) ),   g = (0, 0, -gravity)

    Shapes (n, 3), rad/s and m/s²; at rest and level the force is (0, 0, +gravity).
    """
    # specific force is what is left when gravity is taken from the acceleration
    imu_R_body = body_R_sensor(mounting).inv()
    lever = np.array(mounting.translation_m)
    omega = motion.angular_velocity
    from_gravity = motion.world_R_body.inv().apply(
        motion.acceleration + np.array([0.0, 0.0, gravity_m_s2])
    )
    from_turning = np.cross(motion.angular_acceleration, lever) + np.cross(
        omega, np.cross(omega, lever)
    )
    return imu_R_body.apply(omega), imu_R_body.apply(from_gravity + from_turning)


def simulate_imu(
    path: VehiclePath,
    stamps_ns: Ints,
    calibration: ImuCalibration,
    gravity_m_s2: float,
    rng: np.random.Generator,
) -> Imu:
    """IMU samples with white noise, constant biases drawn from their sigmas, and a walk of the gyro bias.

    White noise of root spectral density d, sampled every dt, has the standard deviation d / sqrt(dt); the bias
    walks by density * sqrt(dt) a sample.
    """
    omega, force = imu_readings(
        path.at(seconds_since_start(stamps_ns)), calibration.mounting, gravity_m_s2
    )
    dt_s = float(np.diff(stamps_ns).mean()) / NS_PER_S
    first_bias = calibration.gyro_bias_sigma * rng.standard_normal(3)
    steps = (
        calibration.gyro_bias_walk_density
        * np.sqrt(dt_s)
        * rng.standard_normal((len(stamps_ns), 3))
    )
    # the walk begins at the bias of the start
    steps[0] = 0
    gyro_bias = first_bias + np.cumsum(steps, axis=0)
    accel_bias = calibration.accel_bias_sigma * rng.standard_normal(3)
    gyro_noise = (
        calibration.gyro_noise_density
        / np.sqrt(dt_s)
        * rng.standard_normal(omega.shape)
    )
    accel_noise = (
        calibration.accel_noise_density
        / np.sqrt(dt_s)
        * rng.standard_normal(force.shape)
    )
    return Imu(
        stamps_ns, omega + gyro_bias + gyro_noise, force + accel_bias + accel_noise
    )


def dvl_readings(motion: Kinematics, mounting: Mounting) -> Floats:
    """Exact velocity of a DVL with a lever arm l, in its own frame: dvl_R_body (body_R_world v + omega × l)."""
    at_body = motion.world_R_body.inv().apply(motion.velocity)
    at_dvl = at_body + np.cross(
        motion.angular_velocity, np.array(mounting.translation_m)
    )
    return body_R_sensor(mounting).inv().apply(at_dvl)


def simulate_dvl(
    path: VehiclePath,
    stamps_ns: Ints,
    calibration: DvlCalibration,
    rng: np.random.Generator,
    *,
    scale_error: float = 0.0,
    dropouts_per_hour: float = 0.0,
    dropout_s: float = 3.0,
) -> Dvl:
    """DVL samples with white noise, and with faults unknown to estimators.

    The relative ``scale_error`` 0.007 reads 0.7 % too fast. Losses of bottom lock begin as a Poisson process. The first
    and the last row are never lost, so that faults do not change the time that the run covers.
    """
    seconds = seconds_since_start(stamps_ns)
    sigmas = np.array(calibration.velocity_sigma_m_s)
    exact = dvl_readings(path.at(seconds), calibration.mounting) * (1 + scale_error)
    velocity = exact + sigmas * rng.standard_normal(exact.shape)
    covariance = np.broadcast_to(np.diag(sigmas**2), (len(stamps_ns), 3, 3))
    duration_s = float(seconds[-1])
    # a Poisson process: uniform instants, as many as a Poisson draw
    begins = np.sort(
        rng.uniform(0, duration_s, rng.poisson(dropouts_per_hour * duration_s / 3600))
    )
    # last loss before each row
    latest = np.concatenate([[-np.inf], begins])[
        np.searchsorted(begins, seconds, side="right")
    ]
    locked = seconds - latest >= dropout_s
    locked[[0, -1]] = True
    return Dvl(stamps_ns, velocity, covariance).rows(locked)


def simulate_depth(
    path: VehiclePath,
    stamps_ns: Ints,
    calibration: DepthCalibration,
    rng: np.random.Generator,
) -> Depth:
    """Heights of the pressure port, ``(p + world_R_body port)_z``, with white noise."""
    motion = path.at(seconds_since_start(stamps_ns))
    port = motion.position + motion.world_R_body.apply(np.array(calibration.port_m))
    z_m = port[:, 2] + calibration.sigma_m * rng.standard_normal(len(stamps_ns))
    return Depth(stamps_ns, z_m, np.full(len(stamps_ns), calibration.sigma_m**2))
