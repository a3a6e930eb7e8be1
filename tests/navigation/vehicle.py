"""A vehicle that surges and sways while it turns, with a gap of its Doppler log from 6 to 16 s."""

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes, motion_since_node
from sonar_graph.navigation.preintegration.motion import Preintegrator

from .rows import T0_NS, at, stamps

IMU_HZ, DVL_HZ, GRAVITY = 50.0, 5.0, np.array([0.0, 0.0, -9.8])
LOST_S, FOUND_S = 6.0, 16.0
GYRO, ACCEL, SIGMA = 2e-4, 1e-3, 0.005
QUIET = ImuCalibration(
    gyro_noise_density=0.0,
    gyro_bias_sigma=0.0,
    accel_noise_density=0.0,
    accel_bias_sigma=0.0,
    mounting=Mounting(translation_m=(0.2, -0.1, 0.1)),
)
NOISY = QUIET.model_copy(update={"gyro_noise_density": GYRO, "accel_noise_density": ACCEL, "accel_bias_sigma": 5e-3})
DVL = DvlCalibration(velocity_sigma_m_s=(SIGMA,) * 3, mounting=Mounting(translation_m=(-0.3, 0.2, -0.1)))


class Vehicle:
    """Surging and swaying while it turns, by hand: x(t), v(t), a(t) and a constant rate about a tilted axis."""

    axis = np.array([0.05, -0.04, 0.12])

    def attitude(self, t):
        return Rotation.from_rotvec(np.outer(t, self.axis))

    def position(self, t):
        return np.column_stack([0.3 * t + 0.5 * np.sin(0.4 * t), 0.8 * np.cos(0.3 * t), 0.2 * np.sin(0.5 * t)])

    def velocity(self, t):
        return np.column_stack([0.3 + 0.2 * np.cos(0.4 * t), -0.24 * np.sin(0.3 * t), 0.1 * np.cos(0.5 * t)])

    def acceleration(self, t):
        return np.column_stack([-0.08 * np.sin(0.4 * t), -0.072 * np.cos(0.3 * t), -0.05 * np.sin(0.5 * t)])

    def imu(self, at_ns):
        t = (at_ns - T0_NS) * 1e-9
        lever, body_R_world = np.array(QUIET.mounting.translation_m), self.attitude(t).inv()
        force = body_R_world.apply(self.acceleration(t) - GRAVITY)
        force += np.cross(self.axis, np.cross(self.axis, lever))
        return Imu(at_ns, np.tile(self.axis, (len(t), 1)), force)

    def dvl(self, at_ns):
        t = (at_ns - T0_NS) * 1e-9
        velocity = self.attitude(t).inv().apply(self.velocity(t)) + np.cross(self.axis, DVL.mounting.translation_m)
        return Dvl(at_ns, velocity, np.full((len(t), 3, 3), np.nan))

    def displacement(self, start_s, end_s):
        ends = np.array([start_s, end_s])
        return self.attitude(np.array([start_s])).inv().apply(np.diff(self.position(ends), axis=0))[0]


def rows():
    """Of 20 s but the Doppler log's gap; a row before its end, to confirm that."""
    vehicle, dvl_ns = Vehicle(), stamps(DVL_HZ, 20.0)
    t = (dvl_ns - T0_NS) * 1e-9
    return vehicle.imu(stamps(IMU_HZ, 20.1)), vehicle.dvl(dvl_ns[(t <= LOST_S) | (t > FOUND_S - 0.3)])


def motion(imu, dvl, known, start_s, until_s, bias=(0.0, 0.0, 0.0), earth=None):
    """From a node; to a node by the final motion, to anywhere else by the provisional one, which sees no later row."""
    odometry, preintegrator = Odometry(known), Preintegrator.from_calibration(known)
    odometry.add(imu, dvl)
    function = motion_between_nodes if at(until_s) in dvl.stamps_ns else motion_since_node
    return function(odometry, preintegrator, at(start_s), at(until_s), np.array(bias), earth)
