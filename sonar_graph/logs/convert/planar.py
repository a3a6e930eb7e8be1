"""Planar robots as vehicles whose Doppler log measures (v_x, v_y, 0) and whose gyro measures (0, 0, ω).

A file of steps has no times: each step ``(dx, dy, dθ)`` takes T = 1 s here, and becomes the constant twist that makes
it, the logarithm of SE(2). With ``p = V(dθ) v T`` and ``V`` the left Jacobian of SO(2)::

    ω = dθ / T
    v = V(dθ)^-1 (dx, dy) / T,    V(θ)^-1 = [[h, θ/2], [-θ/2, h]],    h = (θ/2) / tan(θ/2)

Held over the step, it composes to the step exactly. See ``docs/theory/datasets.md``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    PlanarMotion,
    SonarCalibration,
    Start,
)
from sonar_graph.measurements import (
    NS_PER_S,
    Dvl,
    Floats,
    Imu,
    Ints,
    LandmarkDetections,
)
from sonar_graph.sequence import Sequence

FLOOR_SIGMA_M = 1e-3
"""Sigma of a landmark's height over the plane in which it was measured."""
SMALL_ANGLE_RAD = 1e-4
"""Angle below which the series for h is exact to 1e-18."""
VERTICAL_VELOCITY_SIGMA_M_S = 1e-3
"""Sigma of the vertical velocity, which is zero by construction; the planar prior does the rest."""


def twists_of_steps(steps: Floats, covs: Floats) -> tuple[Floats, Floats, Floats]:
    """Velocity, its covariance, and rate that make the steps in a second.

    The covariance is that of the velocity given the turn, ``V^-1 S V^-T / T²`` with S the covariance of (dx, dy). The
    correlation with the turn is left out, since the two sensors are independent.

    ``steps``: (dx, dy, dθ) in the frame before the step (x forward, y left), shape (n, 3), metres and radians; turns
    within (-2π, 2π); ``covs``: covariances of the steps, shape (n, 3, 3).

    Returns (v_x, v_y), shape (n, 2), m/s; its covariance, shape (n, 2, 2), m²/s²; ω, shape (n,), rad/s.
    """
    angle_rad = steps[:, 2]
    half = 0.5 * angle_rad
    # at zero the tangent's quotient is 0 / 0
    small = np.abs(angle_rad) < SMALL_ANGLE_RAD
    h = np.where(
        small, 1.0 - angle_rad**2 / 12.0, half / np.tan(np.where(small, 1.0, half))
    )
    V_inverse = np.stack([np.stack([h, half], -1), np.stack([-half, h], -1)], -2)
    velocity = np.einsum("nij,nj->ni", V_inverse, steps[:, :2])
    return (
        velocity,
        V_inverse @ covs[:, :2, :2] @ np.swapaxes(V_inverse, -1, -2),
        angle_rad,
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
    # the robot does not leave its plane; zero would make the covariance singular
    cov[:, 2, 2] = VERTICAL_VELOCITY_SIGMA_M_S**2
    return Dvl(stamps_ns, np.column_stack([velocity, np.zeros(n)]), cov)


def planar_calibration(
    gyro: tuple[float, float, float],
    velocity_sigma_m_s: tuple[float, float, float],
    sonar: SonarCalibration | None = None,
    start: Start | None = None,
) -> Calibration:
    """Calibration of a planar robot from its gyro's noise density, bias sigma and bias walk density, and its DVL's."""
    density, bias_sigma, walk_density = gyro
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=density,
            gyro_bias_sigma=bias_sigma,
            gyro_bias_walk_density=walk_density,
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=velocity_sigma_m_s),
        sonar=sonar or SonarCalibration(),
        start=start or Start(),
        floor=FloorPrior(z_m=0.0, sigma_m=FLOOR_SIGMA_M),
        planar=PlanarMotion(),
        # there are no forces, and each row holds over the step before it
        use_gravity=False,
        odometry_interpolation="hold-past",
    )


def range_azimuth(points: Floats, covs: Floats) -> tuple[Floats, Floats, Floats]:
    """Points (n, 2) with covariances (n, 2, 2) as range (n,), azimuth (n,) and their covariances (n, 2, 2).

    First order: ``J S J^T`` with ``J = [[x/r, y/r], [-y/r², x/r²]]``.
    """
    x, y = points.T
    r = np.hypot(x, y)
    J = np.stack(
        [np.stack([x / r, y / r], -1), np.stack([-y / r**2, x / r**2], -1)], -2
    )
    return r, np.arctan2(y, x), J @ covs @ np.swapaxes(J, -1, -2)


@dataclass(frozen=True, eq=False)
class StepRun:
    """Steps of a planar robot, and landmarks seen between them."""

    steps: Floats
    """(dx, dy, dθ) in the frame before the step (x forward, y left), shape (n, 3), metres and radians."""
    step_covs: Floats
    """Covariances of the steps, shape (n, 3, 3)."""
    poses: list[int]
    """Number of steps before each landmark, length m."""
    points: Floats
    """Landmarks in the body frame (x forward, y left), shape (m, 2), metres."""
    point_covs: Floats
    """Their covariances, shape (m, 2, 2)."""
    ids: list[list[int]]
    """Equally probable identities of each landmark, length m; negative ones are left out."""


def stepped_sequence(name: str, run: StepRun, notes: Mapping[str, str]) -> Sequence:
    """Sequence of a run; rows at the end of each step, and at rest at 0.

    The turn's noise is one density whose integral over a step has the mean variance of dθ, ``sqrt(mean(c_θθ) / T)``;
    that of the velocity is in the rows, and in the calibration their root mean square. The gyro has no bias.
    """
    velocity, velocity_cov, rate_rad_s = twists_of_steps(run.steps, run.step_covs)
    stamps_ns = np.arange(len(run.steps) + 1, dtype=np.int64) * NS_PER_S
    # before the first step the robot rests, as uncertain as in that step
    velocities = np.vstack([np.zeros(2), velocity])
    velocity_covs = np.concatenate([velocity_cov[:1], velocity_cov])
    dvl = planar_dvl(stamps_ns, velocities, velocity_covs)
    variances = np.mean(np.diagonal(dvl.velocity_cov, axis1=1, axis2=2), axis=0)
    x, y, z = np.sqrt(variances).tolist()
    gyro_noise_density = float(np.sqrt(np.mean(run.step_covs[:, 2, 2])))
    return Sequence(
        name=name,
        calibration=planar_calibration((gyro_noise_density, 0.0, 0.0), (x, y, z)),
        imu=planar_imu(stamps_ns, np.concatenate([[0.0], rate_rad_s])),
        dvl=dvl,
        detections=_detections(run, stamps_ns) if run.ids else None,
        notes={
            "time": "the file has none: the pose after n steps is at n seconds, so rates and speeds are per step",
            "truth": "none",
            "odometry": "each step as the constant twist that makes it in one second",
        }
        | dict(notes),
    )


def _detections(run: StepRun, stamps_ns: Ints) -> LandmarkDetections:
    """Landmarks as ranges and azimuths, at the end of the step before."""
    most = max(map(len, run.ids))
    candidate_ids = np.full((len(run.ids), most), -1, dtype=np.int64)
    for row, found in enumerate(run.ids):
        known = [identity for identity in found if identity >= 0]
        candidate_ids[row, : len(known)] = known
    # no identity is more probable than another
    is_known = candidate_ids >= 0
    id_probability = is_known / np.maximum(is_known.sum(axis=1, keepdims=True), 1)
    polar = range_azimuth(run.points, run.point_covs)
    return LandmarkDetections(
        stamps_ns[run.poses], *polar, candidate_ids, id_probability
    )
