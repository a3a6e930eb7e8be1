"""Two vehicles by hand, and every way to a motion: over steps and over gaps.

One rolls, pitches and turns; the other surges and sways, with a gap of its Doppler log from 6 to 16 s.
"""

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


def rows(lever=BODY_P_DVL - BODY_P_IMU, dvl_hz=DVL_HZ, pings_s=None):
    """With velocities at these instants; or without them in two gaps, which end when a row confirms one before it."""
    imu_ns = stamps(IMU_HZ, 16.5)
    dvl_ns = np.union1d(
        stamps(dvl_hz, 16.0), [at(FOUND_S - WAITS_S), at(15.0 - WAITS_S)]
    )
    t, s = ((ns - T0_NS) * 1e-9 for ns in (imu_ns, dvl_ns))
    force = attitude(t).inv().apply(acceleration_at(t) + np.array([0.0, 0.0, 9.8]))
    velocity = attitude(s).inv().apply(velocity_at(s)) + np.cross(rate_at(s), lever)
    kept = ((s <= LOST_S) | (s > FOUND_S - 2 * WAITS_S)) & (
        (s <= 12.0) | (s > 15.0 - 2 * WAITS_S)
    )
    kept = (
        kept if pings_s is None else np.isin(dvl_ns, [at(second) for second in pings_s])
    )
    return Imu(imu_ns, rate_at(t), force), dvl(dvl_ns[kept], velocity[kept])


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


GYRO = 2e-4
ACCEL = 1e-3
SIGMA = 0.005
GRAVITY = np.array([0.0, 0.0, -9.8])
QUIET = ImuCalibration(
    gyro_noise_density=0.0,
    gyro_bias_sigma=0.0,
    accel_noise_density=0.0,
    accel_bias_sigma=0.0,
    mounting=Mounting(translation_m=(0.2, -0.1, 0.1)),
)
NOISY = QUIET.model_copy(
    update={
        "gyro_noise_density": GYRO,
        "accel_noise_density": ACCEL,
        "accel_bias_sigma": 5e-3,
    }
)
DVL = DvlCalibration(
    velocity_sigma_m_s=(SIGMA,) * 3, mounting=Mounting(translation_m=(-0.3, 0.2, -0.1))
)


class Vehicle:
    """Surging and swaying while it turns, by hand: x(t), v(t), a(t) and a constant rate about a tilted axis."""

    IMU_HZ = 50.0
    DVL_HZ = 5.0
    LOST_S = 6.0
    FOUND_S = 16.0
    axis = np.array([0.05, -0.04, 0.12])

    def attitude(self, t):
        return Rotation.from_rotvec(np.outer(t, self.axis))

    def position(self, t):
        return np.column_stack(
            [
                0.3 * t + 0.5 * np.sin(0.4 * t),
                0.8 * np.cos(0.3 * t),
                0.2 * np.sin(0.5 * t),
            ]
        )

    def velocity(self, t):
        return np.column_stack(
            [
                0.3 + 0.2 * np.cos(0.4 * t),
                -0.24 * np.sin(0.3 * t),
                0.1 * np.cos(0.5 * t),
            ]
        )

    def acceleration(self, t):
        return np.column_stack(
            [-0.08 * np.sin(0.4 * t), -0.072 * np.cos(0.3 * t), -0.05 * np.sin(0.5 * t)]
        )

    def imu(self, at_ns):
        t = (at_ns - T0_NS) * 1e-9
        lever = np.array(QUIET.mounting.translation_m)
        body_R_world = self.attitude(t).inv()
        force = body_R_world.apply(self.acceleration(t) - GRAVITY)
        force += np.cross(self.axis, np.cross(self.axis, lever))
        return Imu(at_ns, np.tile(self.axis, (len(t), 1)), force)

    def dvl(self, at_ns):
        t = (at_ns - T0_NS) * 1e-9
        velocity = self.attitude(t).inv().apply(self.velocity(t)) + np.cross(
            self.axis, DVL.mounting.translation_m
        )
        return Dvl(at_ns, velocity, np.full((len(t), 3, 3), np.nan))

    def displacement(self, start_s, end_s):
        ends = np.array([start_s, end_s])
        return (
            self.attitude(np.array([start_s]))
            .inv()
            .apply(np.diff(self.position(ends), axis=0))[0]
        )

    def rows(self):
        """Of 20 s but the Doppler log's gap; a row before its end, to confirm that."""
        dvl_ns = stamps(self.DVL_HZ, 20.0)
        t = (dvl_ns - T0_NS) * 1e-9
        return self.imu(stamps(self.IMU_HZ, 20.1)), self.dvl(
            dvl_ns[(t <= self.LOST_S) | (t > self.FOUND_S - 0.3)]
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
