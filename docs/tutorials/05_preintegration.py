"""Preintegration in your own GTSAM program: gyro, accelerometer and Doppler log between keyframes, as one factor.

Nothing here reads a log, runs an estimator or knows a landmark: arrays go in, a GTSAM factor comes out.
Run it in any folder: ``python 05_preintegration.py``. It takes a few seconds, half a minute the first time.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import JointPreintegrator
from sonar_graph.slam.inertial_factors import doppler_odometry, inertial_doppler_odometry

NS = 1_000_000_000
GRAVITY = np.array([0.0, 0.0, -9.81])

# 1. Your samples: stamps in integer nanoseconds, one row each. Here: a vehicle that circles at 0.5 m/s, and surges.
rng = np.random.default_rng(0)
YAW_RATE, SWELL, BIAS = 0.1, 1.5, np.array([0.0, 0.0, 0.01])
imu_ns, dvl_ns = np.arange(-1, 4002) * (NS // 200), np.arange(101) * (NS // 5)


def surge(t):
    """Forward speed, m/s."""
    return 0.5 + 0.2 * np.sin(SWELL * t)


t = imu_ns / NS
rate = np.column_stack([0 * t, 0 * t, YAW_RATE + 0 * t]) + BIAS + 1e-4 * np.sqrt(200) * rng.standard_normal((len(t), 3))
force = np.column_stack([0.2 * SWELL * np.cos(SWELL * t), surge(t) * YAW_RATE, 9.81 + 0 * t])
force += 1e-3 * np.sqrt(200) * rng.standard_normal((len(t), 3))
velocity = np.column_stack([surge(dvl_ns / NS), 0 * dvl_ns, 0 * dvl_ns]) + 0.005 * rng.standard_normal((len(dvl_ns), 3))

imu = Imu(imu_ns, rate, force)
dvl = Dvl(dvl_ns, velocity, np.full((len(dvl_ns), 3, 3), np.nan))  # NaN: the log does not say, the sigma below holds

# 2. What the sensors are: noise densities and where they sit. Keyframes lie at stamps of the Doppler log.
sensors = JointPreintegrator(
    gyro_noise_density=1e-4,
    accel_noise_density=1e-3,
    velocity_sigma_m_s=(0.005, 0.005, 0.005),
    body_T_imu=gtsam.Pose3(),
    body_T_dvl=gtsam.Pose3(),
)
motion = sensors.integrate(imu, dvl, 0, NS)
print(f"in 1 s: {motion.displacement.round(4)} m by the Doppler log, the accelerometer between its samples")
print(f"1 sigma: {np.sqrt(np.diag(motion.covariance)[9:]).round(5)} m")

# Other people's rules, to compare with (never to use): a held velocity is late. Names, and whose rule is whose:
# docs/theory/preintegration.md.
held = JointPreintegrator(1e-4, 1e-3, (0.005,) * 3, rule="zoh-previous").integrate(imu, dvl, 0, NS)
print(f"a held velocity: {1e3 * np.linalg.norm(held.displacement - motion.displacement):.1f} mm away")

# 3. The graph. `after` tells a motion which Doppler sample it shares with the one before.
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
tight, loose = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
pose, start_velocity = gtsam.Pose3(), np.array([0.5, 0.0, 0.0])
graph.push_back(gtsam.PriorFactorPose3(X(0), pose, tight))
graph.push_back(gtsam.PriorFactorPoint3(V(0), start_velocity, loose))
graph.push_back(
    gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
)
values.insert(X(0), pose)
values.insert(V(0), start_velocity)
values.insert(B(0), gtsam.imuBias.ConstantBias())
before = None
for k in range(20):
    motion = sensors.integrate(imu, dvl, k * NS, (k + 1) * NS)
    motion = motion if before is None else motion.after(before)
    graph.push_back(inertial_doppler_odometry(X(k), V(k), X(k + 1), V(k + 1), B(0), motion, GRAVITY))
    pose, before = pose.compose(motion.relative_pose().i_T_j), motion
    values.insert(X(k + 1), pose)
    values.insert(V(k + 1), pose.rotation().rotate(start_velocity))

# Whatever else you have. Here: one compass reading, from which the gyro bias follows.
heading = gtsam.Pose3(gtsam.Rot3.Yaw(YAW_RATE * 20), np.zeros(3))
compass = gtsam.noiseModel.Diagonal.Sigmas(np.array([9.0, 9.0, 0.002, 1e3, 1e3, 1e3]))
graph.push_back(gtsam.PriorFactorPose3(X(20), heading, compass))

solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
found = solution.atConstantBias(B(0)).gyroscope()[2]
sigma = np.sqrt(gtsam.Marginals(graph, solution).marginalCovariance(B(0))[5, 5])
print(f"\ngyro bias about z: {found:.5f} ± {sigma:.5f} rad/s, true {BIAS[2]:.5f}")

fine = np.linspace(0, 20, 20001)
path = surge(fine)[:, None] * np.column_stack([np.cos(YAW_RATE * fine), np.sin(YAW_RATE * fine)])
true = np.trapezoid(path, fine, axis=0)
print(f"position error after 20 s: {np.linalg.norm(solution.atPose3(X(20)).translation()[:2] - true):.4f} m")

# 4. Gyro and Doppler log alone: no accelerometer, no velocities. Scale and mounting of the log can be states as well.
planar = JointPreintegrator(1e-4, 0.0, (0.005,) * 3, rule="linear")
unfelt = Imu(imu_ns, rate, np.full_like(force, np.nan))
factor = doppler_odometry(X(0), X(1), B(0), planar.integrate(unfelt, dvl, 0, NS))
print(f"\nwithout an accelerometer: {factor.dim()} rows instead of {graph.at(3).dim()}")
