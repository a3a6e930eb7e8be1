"""A vehicle by hand that rolls, pitches, turns and surges, and every way to a motion: over steps and over gaps."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import Odometry, PreintegratedMotion

from .rows import T0_NS, at, dvl, stamps

IMU_HZ = 10.0
DVL_HZ = 2.0
LOST_S = 6.0
FOUND_S = 11.0
OPEN_S = 10.8
FOUND_LATE_S = 16.0
WAITS_S = 1e-3
BODY_P_IMU = np.array([0.2, -0.1, 0.1])
BODY_P_DVL = np.array([-0.5, 0.3, -0.2])
SIGMA_M_S = (0.01, 0.02, 0.005)
ANY_VELOCITY = 1e3
STEADY = 1e-9
"""Walks of the velocity, m/s/√s: gaps are bridged by the accelerometers alone, or by a steady velocity."""
NO_NOISE = {
    "gyro_noise_density": 0.0,
    "accel_noise_density": 0.0,
    "accel_bias_sigma": 0.0,
}


def attitude(t, yaw=0.0):
    """world_R_body of a vehicle that rolls, pitches and turns."""
    angles = [
        yaw + 0.2 * t + 0.1 * np.sin(t),
        0.1 * np.sin(0.6 * t),
        0.15 * np.cos(0.5 * t),
    ]
    return Rotation.from_euler("ZYX", np.column_stack(angles))


def rate_at(t):
    return (attitude(t - 1e-4).inv() * attitude(t + 1e-4)).as_rotvec() / 2e-4


def velocity_at(t):
    """Of the IMU's point in the world."""
    return np.column_stack(
        [1.0 + 0.2 * np.sin(t), 0.4 * np.cos(0.5 * t), 0.1 * np.sin(0.8 * t)]
    )


def position_at(t):
    return np.column_stack(
        [t - 0.2 * np.cos(t), 0.8 * np.sin(0.5 * t), -0.125 * np.cos(0.8 * t)]
    )


def acceleration_at(t):
    return np.column_stack(
        [0.2 * np.cos(t), -0.2 * np.sin(0.5 * t), 0.08 * np.cos(0.8 * t)]
    )


class Way(NamedTuple):
    """From a node to a node, or to an instant in a gap."""

    start_s: float
    until_s: float
    is_blind: bool = False
    interpolation: str = "linear"


WAYS = {
    "linear": Way(2.0, 5.5),
    "held": Way(2.0, 5.5, interpolation="hold-past"),
    "closed gap": Way(LOST_S, FOUND_S),
    "open gap": Way(LOST_S, OPEN_S),
    "two gaps": Way(5.0, 16.0),
    "closed walk": Way(LOST_S, FOUND_S, is_blind=True),
    "open walk": Way(LOST_S, OPEN_S, is_blind=True),
    "two walks": Way(5.0, 16.0, is_blind=True),
}


def inertial(at_ns):
    t = (at_ns - T0_NS) * 1e-9
    force = attitude(t).inv().apply(acceleration_at(t) + np.array([0.0, 0.0, 9.8]))
    return Imu(at_ns, rate_at(t), force)


def doppler(at_ns, lever=BODY_P_DVL - BODY_P_IMU):
    t = (at_ns - T0_NS) * 1e-9
    velocity = attitude(t).inv().apply(velocity_at(t))
    return dvl(at_ns, velocity + np.cross(rate_at(t), lever))


def body_moved(start_s, end_s):
    """True turn and displacement of the body from an instant to another, in its first frame."""
    ends = np.array([start_s, end_s])
    world_R_body = attitude(ends)
    step = np.diff(position_at(ends) - world_R_body.apply(BODY_P_IMU), axis=0)
    return world_R_body[0].inv() * world_R_body[1], world_R_body[0].inv().apply(step)[0]


def rows(lever=BODY_P_DVL - BODY_P_IMU, dvl_hz=DVL_HZ, pings_s=None):
    """With velocities at these instants; or without them in two gaps, which end when a row confirms one before it."""
    dvl_ns = np.union1d(
        stamps(dvl_hz, 16.0), [at(FOUND_S - WAITS_S), at(15.0 - WAITS_S)]
    )
    s = (dvl_ns - T0_NS) * 1e-9
    kept = ((s <= LOST_S) | (s > FOUND_S - 2 * WAITS_S)) & (
        (s <= 12.0) | (s > 15.0 - 2 * WAITS_S)
    )
    kept = (
        kept if pings_s is None else np.isin(dvl_ns, [at(second) for second in pings_s])
    )
    return inertial(stamps(IMU_HZ, 16.5)), doppler(dvl_ns[kept], lever)


def with_long_gap():
    """Rows of 20 s, with a gap of the Doppler log that a row before its end confirms."""
    dvl_ns = stamps(5.0, 20.0)
    t = (dvl_ns - T0_NS) * 1e-9
    kept = (t <= LOST_S) | (t > FOUND_LATE_S - 0.3)
    return inertial(stamps(50.0, 20.1)), doppler(dvl_ns[kept])


def calibration(imu=None, body_p_imu=BODY_P_IMU, interpolation="linear", **dvl):
    sensors = ImuCalibration(
        **{**NO_NOISE, **(imu or {})},
        mounting=Mounting(translation_m=tuple(body_p_imu)),
    )
    doppler = {
        "velocity_sigma_m_s": (0.0,) * 3,
        "velocity_walk_density": ANY_VELOCITY,
        "gap_s": 1.5,
        **dvl,
    }
    return Calibration(
        imu=sensors,
        dvl=DvlCalibration(
            **doppler, mounting=Mounting(translation_m=tuple(BODY_P_DVL))
        ),
        odometry_interpolation=interpolation,
    )


def moved_by(
    way: Way, imu: Imu, dvl: Dvl, bias=(0.0, 0.0, 0.0), earth=None, known=None
) -> PreintegratedMotion:
    walk = STEADY if way.is_blind else ANY_VELOCITY
    known = calibration(
        interpolation=way.interpolation,
        **{"velocity_walk_density": walk, **(known or {})},
    )
    return motion(
        blinded(imu) if way.is_blind else imu,
        dvl,
        known,
        way.start_s,
        way.until_s,
        bias,
        earth,
    )


def blinded(imu):
    return Imu(imu.stamps_ns, imu.angular_velocity, np.full((len(imu), 3), np.nan))


def change_of(before, after):
    step = before.i_T_j.between(after.i_T_j)
    return np.r_[step.rotation().rpy(), step.translation()]


def spoilt(imu, dvl, column, delta):
    """Rows with one column changed."""
    if column == "velocity":
        return imu, Dvl(dvl.stamps_ns, dvl.velocity + delta, dvl.velocity_cov)
    rate = imu.angular_velocity
    force = imu.specific_force
    return Imu(
        imu.stamps_ns,
        *((rate + delta, force) if column == "rate" else (rate, force + delta)),
    ), dvl


QUIET = ImuCalibration(
    gyro_noise_density=0.0,
    gyro_bias_sigma=0.0,
    accel_noise_density=0.0,
    accel_bias_sigma=0.0,
    mounting=Mounting(translation_m=tuple(BODY_P_IMU)),
)
NOISY = QUIET.model_copy(
    update={
        "gyro_noise_density": 2e-4,
        "accel_noise_density": 1e-3,
        "accel_bias_sigma": 5e-3,
    }
)
DVL = DvlCalibration(
    velocity_sigma_m_s=(0.005,) * 3, mounting=Mounting(translation_m=tuple(BODY_P_DVL))
)


def motion(imu, dvl, known, start_s, until_s, bias=(0.0, 0.0, 0.0), earth=None):
    """From an epoch; to an epoch by the final motion, to anywhere else by the provisional one, which sees no later row.

    ``earth``: its rotation in the first frame, of any size.
    """
    odometry = Odometry(known)
    odometry.add(imu, dvl)
    odometry._earth = earth
    known_ns = int(imu.stamps_ns[-1]) if at(until_s) in dvl.stamps_ns else at(until_s)
    return odometry.motion(
        at(start_s), at(until_s), np.array(bias), np.eye(3), known_ns
    )
