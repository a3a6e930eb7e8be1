"""The pieces one at a time: read a log, preintegrate, build a graph by hand, run the smoother, ask for marginals.

Run it in any folder: ``python 02_library.py``. It takes a few seconds.
"""

from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from sonar_graph.logs import read_log, write_log
from sonar_graph.navigation import Odometry
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2, Isam2Params, KeyframeParams, factors

# 1. A log: blocks of columns, stamps in integer nanoseconds. `help(sonar_graph)` states frames and units.
log = Path("basin.mcap")
write_log(log, simulate_basin(BasinOptions(seed=2, duration_s=120.0, laps=1)))
sequence = read_log(log)
calibration = sequence.calibration
print(
    f"IMU: angular velocity {sequence.imu.angular_velocity.shape} rad/s, from {sequence.imu.stamps_ns[0]} ns"
)

# 2. Preintegration between two instants. Gyro and Doppler rows are merged into steps, the steps into one motion with
# one joint covariance. Between epochs, the stamps of the Doppler log, a motion is final once rows after them are known.
odometry = Odometry(calibration)
odometry.add(sequence.imu, sequence.dvl)
epochs = odometry.epochs(sequence.start_ns, sequence.end_ns)
start_ns, end_ns = int(epochs[70]), int(epochs[140])
motion = odometry.motion(start_ns, end_ns, bias=np.zeros(3), known_ns=sequence.end_ns)
moved_m = np.linalg.norm(motion.i_T_j.translation())
sigmas = np.sqrt(np.diag(motion.covariance))
print(f"\nin {motion.duration_s:.2f} s: {moved_m:.3f} m")
print(f"1 sigma: rotation {sigmas[:3]} rad, translation {sigmas[3:]} m")

# The covariance is that of a perturbation [rotation, translation] in the frame at the end, GTSAM's order. Another gyro
# bias needs no second integration:
bias = np.array([0.0, 0.0, 1e-4])
turned_rad = motion.i_T_j.rotation().between(motion.corrected(bias).rotation()).yaw()
print(f"a gyro bias of 1e-4 rad/s turns it by {turned_rad:.6f} rad")

# The truth agrees within the covariance:
true = sequence.truth.at(np.array([start_ns, end_ns]))
R_i = true.rotations()[0]
error_m = motion.i_T_j.translation() - R_i.inv().apply(
    true.positions[1] - true.positions[0]
)
print(f"error: {error_m} m")

# 3. A graph by hand: a start, two motions, one landmark seen from each end. The factors are GTSAM's own, so that any of
# its solvers takes them.
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
pose = calibration.start.pose()
graph.push_back(factors.start_prior(X(0), calibration))
values.insert(X(0), pose)
for index, (before_ns, after_ns) in enumerate(
    [(int(epochs[0]), start_ns), (start_ns, end_ns)]
):
    step = odometry.motion(
        before_ns, after_ns, bias=np.zeros(3), known_ns=sequence.end_ns
    )
    pose = pose.compose(step.i_T_j)
    graph.push_back(factors.odometry(X(index), X(index + 1), step))
    values.insert(X(index + 1), pose)

sonar_mounting = calibration.sonar.mounting.pose()
noise = np.diag(
    [calibration.sonar.range_sigma_m**2, calibration.sonar.azimuth_sigma_rad**2]
)
landmark = pose.transformFrom(np.array([2.0, 0.3, -1.0]))
values.insert(L(1), landmark)
graph.push_back(factors.floor_prior(L(1), landmark[2], sigma_m=0.01))
for index in (1, 2):
    q = values.atPose3(X(index)).compose(sonar_mounting).transformTo(landmark)
    z = np.array([np.linalg.norm(q), np.arctan2(q[1], q[0])])
    sighting = factors.landmark_sighting(X(index), L(1), sonar_mounting, z, noise)
    for factor in sighting.values():
        graph.push_back(factor)

solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
marginals = gtsam.Marginals(graph, solution)
print(
    f"\nby hand: {graph.size()} factors, landmark at {solution.atPoint3(L(1)).round(3)}"
)
print(f"its 1 sigma: {np.sqrt(np.diag(marginals.marginalCovariance(L(1)))).round(4)} m")

# 4. The smoother, as on a vehicle: each call passes the measurements since the last one, and the instant of the
# estimate. `replay` cuts a log that way; a live program passes blocks of one row.
smoother = Isam2(
    calibration,
    Odometry(calibration),
    Isam2Params(keyframes=KeyframeParams(max_interval_s=3.0)),
)
for measurements in sequence.replay(sequence.instants(rate_hz=1.0)):
    estimate = smoother.process(measurements)

position_sigma_m = np.sqrt(np.diag(estimate.covariance)[3:])
print(
    f"\ncausal, at the end: {estimate.world_T_body.translation().round(3)}, 1 sigma {position_sigma_m.round(4)} m"
)

# 5. Marginals. Of the trajectory and of the map they come with the result:
trajectory, landmarks = smoother.trajectory(), smoother.landmarks()
print(f"smoothed: {len(trajectory)} poses; landmarks {landmarks.ids.tolist()}")

# Of anything else, from the graph: here the correlation of two landmarks, which an EKF calls P_mm.
joint = gtsam.Marginals(smoother.graph, smoother.values).jointMarginalCovariance(
    [L(i) for i in landmarks.ids[:2]]
)
first, second = (L(i) for i in landmarks.ids[:2])
scale = np.sqrt(joint.at(first, first)[0, 0] * joint.at(second, second)[0, 0])
print(
    f"correlation of x of landmarks {landmarks.ids[:2].tolist()}: {joint.at(first, second)[0, 0] / scale:.3f}"
)

# The outcome of each detection:
journal = smoother.detections()
print(
    f"detections: {len(journal)}, of which used {sum(outcome.value == 'used' for outcome in journal.outcomes)}"
)
