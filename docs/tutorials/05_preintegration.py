"""Preintegration in your own GTSAM program: gyro and Doppler log between keyframes, as one factor.

Nothing here reads a log, runs an estimator or knows a landmark: arrays go in, a GTSAM factor comes out.
Run it in any folder: ``python 05_preintegration.py``. It takes a few seconds, half a minute the first time.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import Odometry
from sonar_graph.slam.odometry_factor import OdometryWithBias

NS = 1_000_000_000

# 1. Your samples: stamps in integer nanoseconds, one row each. Here: a vehicle that circles at 0.5 m/s, and surges.
rng = np.random.default_rng(0)
YAW_RATE = 0.1
SWELL = 1.5
BIAS = np.array([0.0, 0.0, 0.01])
imu_ns = np.arange(4201) * (NS // 200)
dvl_ns = np.arange(102) * (NS // 5)


def surge(t):
    """Forward speed, m/s."""
    return 0.5 + 0.2 * np.sin(SWELL * t)


t = imu_ns / NS
rate = (
    np.column_stack([0 * t, 0 * t, YAW_RATE + 0 * t])
    + BIAS
    + 1e-4 * np.sqrt(200) * rng.standard_normal((len(t), 3))
)
force = np.column_stack(
    [0.2 * SWELL * np.cos(SWELL * t), surge(t) * YAW_RATE, 9.81 + 0 * t]
)
force += 1e-3 * np.sqrt(200) * rng.standard_normal((len(t), 3))
velocity = np.column_stack(
    [surge(dvl_ns / NS), 0 * dvl_ns, 0 * dvl_ns]
) + 0.005 * rng.standard_normal((len(dvl_ns), 3))

imu = Imu(imu_ns, rate, force)
# NaN: not measured, the calibration's sigma holds
dvl = Dvl(dvl_ns, velocity, np.full((len(dvl_ns), 3, 3), np.nan))

# 2. Noise and mountings of the sensors. The Earth's rotation is left out, since no latitude is given.
calibration = Calibration(
    imu=ImuCalibration(gyro_noise_density=1e-4, accel_noise_density=1e-3),
    dvl=DvlCalibration(velocity_sigma_m_s=(0.005, 0.005, 0.005)),
)
odometry = Odometry(calibration)
# as often as rows come; outliers and late rows are listed in odometry.refused
odometry.add(imu, dvl)

# 3. Motion between any two instants. The stamps of the Doppler log are epochs: between two epochs motion is final.
no_bias = np.zeros(3)
motion = odometry.motion(0, NS, no_bias, known_ns=2 * NS)
print(
    f"in 1 s: {motion.i_T_j.translation().round(4)} m, turned by {motion.i_T_j.rotation().yaw():.4f} rad"
)
print(f"1 sigma: {np.sqrt(np.diag(motion.covariance)[3:]).round(5)} m")
again = odometry.motion(0, NS, BIAS, known_ns=2 * NS)
print(
    f"another bias to first order: {np.abs(motion.corrected(BIAS).matrix() - again.i_T_j.matrix()).max():.1e} off"
)

# 4. The graph: a keyframe a second, one gyro bias. Without a bias to estimate, gtsam.BetweenFactorPose3 with
#    motion.i_T_j and motion.covariance is faster.
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
pose = gtsam.Pose3()
graph.push_back(
    gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-4))
)
graph.push_back(
    gtsam.PriorFactorVector(B(0), no_bias, gtsam.noiseModel.Isotropic.Sigma(3, 0.02))
)
values.insert(X(0), pose)
values.insert(B(0), no_bias)
for k in range(20):
    motion = odometry.motion(k * NS, (k + 1) * NS, no_bias, known_ns=(k + 2) * NS)
    graph.push_back(OdometryWithBias(X(k), X(k + 1), B(0), motion))
    pose = pose.compose(motion.i_T_j)
    values.insert(X(k + 1), pose)

# Whatever else you have. Here: one compass reading, from which the gyro bias follows.
heading = gtsam.Pose3(gtsam.Rot3.Yaw(YAW_RATE * 20), np.zeros(3))
compass = gtsam.noiseModel.Diagonal.Sigmas(
    np.array([1.0, 1.0, 0.002, 100.0, 100.0, 100.0])
)
graph.push_back(gtsam.PriorFactorPose3(X(20), heading, compass))

solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
found = solution.atVector(B(0))[2]
sigma = np.sqrt(gtsam.Marginals(graph, solution).marginalCovariance(B(0))[2, 2])
print(f"\ngyro bias about z: {found:.5f} ± {sigma:.5f} rad/s, true {BIAS[2]:.5f}")

fine = np.linspace(0, 20, 20001)
path = surge(fine)[:, None] * np.column_stack(
    [np.cos(YAW_RATE * fine), np.sin(YAW_RATE * fine)]
)
true = np.trapezoid(path, fine, axis=0)
print(
    f"position error after 20 s: {np.linalg.norm(solution.atPose3(X(20)).translation()[:2] - true):.4f} m"
)

# 5. Five seconds without bottom lock: the accelerometers carry the velocity, between its last and its next sample.
with_gap = Odometry(calibration)
with_gap.add(imu, dvl.rows((dvl_ns <= 8 * NS) | (dvl_ns > 13 * NS)))
whole = odometry.motion(5 * NS, 15 * NS, BIAS, known_ns=20 * NS)
bridged = with_gap.motion(5 * NS, 15 * NS, BIAS, known_ns=20 * NS)
off = np.linalg.norm(bridged.i_T_j.translation() - whole.i_T_j.translation())
sigma = np.sqrt(bridged.covariance[3, 3])
print(
    f"\nover a gap of 5 s: {off:.3f} m from the motion with all samples, 1 sigma {sigma:.3f} m"
)
