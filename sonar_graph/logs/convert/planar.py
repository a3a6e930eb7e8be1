"""Planar robots as vehicles whose Doppler log measures (v_x, v_y, 0) and whose gyro measures (0, 0, ω).

A step of odometry ``(dx, dy, dθ)`` becomes the constant twist that makes it in the step's duration T, the logarithm of
SE(2). With ``p = V(dθ) v T`` and ``V`` the left Jacobian of SO(2)::

    ω = dθ / T
    v = V(dθ)^-1 (dx, dy) / T,    V(θ)^-1 = [[h, θ/2], [-θ/2, h]],    h = (θ/2) / tan(θ/2)

Held over the step, it composes to the step exactly. See ``docs/theory/datasets.md``.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, FloorPrior, ImuCalibration, PlanarMotion
from sonar_graph.measurements import Dvl, Floats, Imu, Ints, LandmarkDetections
from sonar_graph.sequence import NS_PER_S
from sonar_graph.states import Trajectory

FLOOR_SIGMA_M = 1e-3
"""Sigma of a landmark's height over the plane in which it was measured."""
SMALL_ANGLE_RAD = 1e-4
"""Angle below which the series for h is exact to 1e-18."""
VERTICAL_VELOCITY_SIGMA_M_S = 1e-3
"""Sigma of the vertical velocity, which is zero by construction; the planar prior does the rest."""


def inverse_left_jacobian(angle_rad: Floats) -> Floats:
    """V(θ)^-1 for angles within (-2π, 2π), shape (n, 2, 2)."""
    half = 0.5 * angle_rad
    small = np.abs(angle_rad) < SMALL_ANGLE_RAD
    h = np.where(small, 1.0 - angle_rad**2 / 12.0, half / np.tan(np.where(small, 1.0, half)))
    return np.stack([np.stack([h, half], -1), np.stack([-half, h], -1)], -2)


def twists_of_steps(steps: Floats, duration_s: float) -> tuple[Floats, Floats]:
    """Velocity (n, 2), m/s, and rate (n,), rad/s, that held for ``duration_s`` make the steps (dx, dy, dθ), (n, 3)."""
    V_inverse = inverse_left_jacobian(steps[:, 2])
    return np.einsum("nij,nj->ni", V_inverse, steps[:, :2]) / duration_s, steps[:, 2] / duration_s


def velocity_cov_of_steps(steps: Floats, covs: Floats, duration_s: float) -> Floats:
    """Covariance of the steps' velocity given their turn, shape (n, 2, 2), m²/s².

    ``V^-1 S V^-T / T²`` with S the covariance of (dx, dy). The correlation with the turn is left out, since the two
    sensors are independent.
    """
    V_inverse = inverse_left_jacobian(steps[:, 2]) / duration_s
    return V_inverse @ covs[:, :2, :2] @ np.swapaxes(V_inverse, -1, -2)


def step_stamps_ns(steps: int, step_s: int) -> Ints:
    """Stamps 0, step, 2 step, ... of the poses before, between and after the steps, shape (steps + 1,)."""
    return np.arange(steps + 1, dtype=np.int64) * (step_s * NS_PER_S)


def stepped_odometry(steps: Floats, covs: Floats, step_s: int) -> tuple[Imu, Dvl]:
    """Sensor rows at the end of each step, after a row without motion at 0.

    Parameters
    ----------
    steps
        (dx, dy, dθ) in the frame before the step (x forward, y left), shape (n, 3), metres and radians.
    covs
        Covariances of the steps, shape (n, 3, 3).
    step_s
        Duration of a step.
    """
    velocity, rate = twists_of_steps(steps, float(step_s))
    velocity_cov = velocity_cov_of_steps(steps, covs, float(step_s))
    stamps_ns = step_stamps_ns(len(steps), step_s)
    return (
        planar_imu(stamps_ns, np.concatenate([[0.0], rate])),
        planar_dvl(stamps_ns, np.vstack([np.zeros(2), velocity]), np.concatenate([velocity_cov[:1], velocity_cov])),
    )


def planar_imu(stamps_ns: Ints, rate_rad_s: Floats) -> Imu:
    """Rows (0, 0, ω) without specific force."""
    angular_velocity = np.zeros((len(stamps_ns), 3))
    angular_velocity[:, 2] = rate_rad_s
    return Imu(stamps_ns, angular_velocity, np.full((len(stamps_ns), 3), np.nan))


def planar_dvl(stamps_ns: Ints, velocity: Floats, velocity_cov: Floats) -> Dvl:
    """Rows (v_x, v_y, 0) from velocities (n, 2) and their covariances (n, 2, 2)."""
    n = len(stamps_ns)
    cov = np.zeros((n, 3, 3))
    cov[:, :2, :2] = velocity_cov
    cov[:, 2, 2] = VERTICAL_VELOCITY_SIGMA_M_S**2
    return Dvl(stamps_ns, np.column_stack([velocity, np.zeros(n)]), cov)


def planar_trajectory(stamps_ns: Ints, poses: Floats) -> Trajectory:
    """Poses (x, y, θ), shape (n, 3), in the plane z = 0."""
    positions = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    return Trajectory.without_covariances(stamps_ns, positions, Rotation.from_euler("z", poses[:, 2:]).as_quat())


def range_azimuth(points: Floats, covs: Floats) -> tuple[Floats, Floats, Floats]:
    """Points (n, 2) with covariances (n, 2, 2) as range (n,), azimuth (n,) and their covariances (n, 2, 2).

    First order: ``J S J^T`` with ``J = [[x/r, y/r], [-y/r², x/r²]]``.
    """
    x, y = points.T
    r = np.hypot(x, y)
    J = np.stack([np.stack([x / r, y / r], -1), np.stack([-y / r**2, x / r**2], -1)], -2)
    return r, np.arctan2(y, x), J @ covs @ np.swapaxes(J, -1, -2)


def point_detections(
    stamps_ns: Ints, points: Floats, covs: Floats, candidate_ids: Ints, id_probability: Floats
) -> LandmarkDetections:
    """Detections from points (n, 2) in the body frame (x forward, y left) and their covariances (n, 2, 2)."""
    ranges, azimuths, polar_covs = range_azimuth(points, covs)
    return LandmarkDetections(stamps_ns, ranges, azimuths, polar_covs, candidate_ids, id_probability)


def stepped_calibration(dvl: Dvl, step_covs: Floats, step_s: int) -> Calibration:
    """Calibration of a planar vehicle from the covariances of its steps, without gyro bias.

    The turn's noise is one density whose integral over a step has the mean variance of dθ,
    ``sqrt(mean(c_θθ) / T)``; that of the velocity is in the rows, and here their root mean square.
    """
    x, y, z = np.sqrt(np.mean(np.diagonal(dvl.velocity_cov, axis1=1, axis2=2), axis=0)).tolist()
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=float(np.sqrt(np.mean(step_covs[:, 2, 2]) / step_s)),
            gyro_bias_sigma=0.0,
            gyro_bias_walk_density=0.0,
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=(x, y, z)),
        floor=FloorPrior(z_m=0.0, sigma_m=FLOOR_SIGMA_M),
        planar=PlanarMotion(),
        use_gravity=False,
        odometry_interpolation="hold-past",
    )


def symmetric(entries: Floats, places: list[list[int]]) -> Floats:
    """Matrices (n, size, size) whose element (i, j) is the column ``places[i][j]`` of ``entries``."""
    matrices: Floats = entries[:, places]
    return matrices
