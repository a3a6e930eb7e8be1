"""A world that is linear: a vehicle on the x axis that cannot turn, landmarks dead ahead, and its exact solution.

Ranges are differences of two coordinates and displacements are sums of velocities, so that weighted least squares over
x alone (numpy, no linearisation) is the whole truth about mean and covariance along x.
"""

from dataclasses import dataclass

import numpy as np

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    SonarCalibration,
    Start,
)
from sonar_graph.measurements import NS_PER_S, Dvl, Floats, Imu
from sonar_graph.sequence import Sequence

from .made import detected

T0_NS = 1_600_000_000 * NS_PER_S
STEP_S = 0.5
START_SIGMA_M = 0.1
VELOCITY_SIGMA_M_S = 0.03
RANGE_SIGMA_M = 0.05
LANDMARKS_M = {4: 25.0, 7: 40.0}


@dataclass(frozen=True, eq=False)
class Rail:
    """Displacements between nodes and ranges (node, landmark, range), as measured."""

    displacements_m: Floats
    ranges: list[tuple[int, int, float]]

    def solution(self, nodes: int) -> tuple[dict[str, float], dict[str, float]]:
        """Mean and variance of x0, x1, ..., and of the landmarks seen, from what the first nodes measured."""
        ranges = [r for r in self.ranges if r[0] < nodes]
        names = [f"x{k}" for k in range(nodes)] + [
            f"l{i}" for i in sorted({i for _, i, _ in ranges})
        ]
        column = {name: k for k, name in enumerate(names)}
        A = [np.eye(len(names))[0] / START_SIGMA_M]
        b = [0.0]
        for k, moved in enumerate(self.displacements_m[: nodes - 1]):
            sigma = VELOCITY_SIGMA_M_S * STEP_S
            A.append((np.eye(len(names))[k + 1] - np.eye(len(names))[k]) / sigma)
            b.append(moved / sigma)
        for k, i, distance in ranges:
            A.append(
                (np.eye(len(names))[column[f"l{i}"]] - np.eye(len(names))[k])
                / RANGE_SIGMA_M
            )
            b.append(distance / RANGE_SIGMA_M)
        cov = np.linalg.inv(np.transpose(A) @ A)
        mean = cov @ np.transpose(A) @ b
        return dict(zip(names, mean, strict=True)), dict(
            zip(names, np.diag(cov), strict=True)
        )


def calibration() -> Calibration:
    """Rotations are known; azimuth and elevation hold no information about x.

    The azimuth gives where landmarks are sideways, to some metres. By ranges alone y is open at y = 0, and where they do
    not fit yet, curvature makes Gauss-Newton wander off from there: a start of 1e-15 m is enough, with all poses kept.
    """
    return Calibration(
        imu=ImuCalibration(gyro_noise_density=1e-9, gyro_bias_sigma=0.0),
        # one velocity a step, and steady motion between
        dvl=DvlCalibration(
            velocity_sigma_m_s=(VELOCITY_SIGMA_M_S,) * 3, gap_s=1.5 * STEP_S
        ),
        sonar=SonarCalibration(
            range_sigma_m=RANGE_SIGMA_M,
            azimuth_sigma_rad=0.2,
            elevation_aperture_rad=1e-3,
        ),
        start=Start(
            position_sigma_m=(START_SIGMA_M, 1e-3, 1e-3), rpy_sigma_rad=(1e-6,) * 3
        ),
        use_gravity=False,
    )


def rail(nodes: int = 21, seed: int = 0) -> tuple[Sequence, Rail]:
    """A noisy run with sightings at every node but the first, and the same as numbers."""
    rng = np.random.default_rng(seed)
    velocity = 0.6 + VELOCITY_SIGMA_M_S * rng.standard_normal(nodes)
    displacements = STEP_S * (velocity[1:] + velocity[:-1]) / 2
    x = START_SIGMA_M * rng.standard_normal() + 0.6 * STEP_S * np.arange(nodes)
    ranges = [
        (k, i, float(p - x[k] + RANGE_SIGMA_M * rng.standard_normal()))
        for k in range(1, nodes)
        for i, p in LANDMARKS_M.items()
        if k > 5 or i == 4
    ]
    at = T0_NS + np.arange(nodes) * round(STEP_S * NS_PER_S)
    imu_ns = T0_NS + np.arange(5 * (nodes - 1) + 1) * NS_PER_S // 10
    sequence = Sequence(
        name="rail",
        calibration=calibration(),
        imu=Imu(
            imu_ns,
            np.zeros((len(imu_ns), 3)),
            np.tile([0, 0, 9.80665], (len(imu_ns), 1)),
        ),
        dvl=Dvl(at, np.outer(velocity, [1.0, 0, 0]), np.full((nodes, 3, 3), np.nan)),
        detections=detected(
            at[[k for k, _, _ in ranges]],
            [(r, 0.0) for _, _, r in ranges],
            [[i] for _, i, _ in ranges],
            [1.0],
        ),
    )
    return sequence, Rail(displacements, ranges)
