"""Lever arm from the IMU to the Doppler log of A-KIT's vehicle, from accelerations of both.

Part of `akit`. The lever arm in the files' calibration is that from the point whose velocity the reference gives to the
Doppler log; where the IMU is, nothing says. In a turn at rate w, a place that is wrong by d makes the velocity at the
IMU wrong by w x d. With C the attitude by the gyros, F what the accelerometers gained and S the integral of C, ::

    x_k = C_k (v_k - w_k x l) - F_k,     x_{k+1} - x_k = d(C [w]x) dl - d(S) b + gamma T + gamma' T t + noise

holds for dl the correction to the lever arm l from the IMU to the log, b the accelerometers' bias, gamma gravity and
gamma' its slow turning (the Earth's, that of the bias of the gyros). The noise of a sample is in two differences. The
positions and the velocities of the reference are not used.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sonar_graph.measurements import Floats
from sonar_graph.navigation.alignment.dvl_imu import InertialPath, cross_matrices
from sonar_graph.sequence import Sequence

SHOWN = slice(0, 3)
"""Columns of the lever arm."""


@dataclass(frozen=True)
class PlaceFit:
    """Information about the IMU's place on the body, its other parameters projected out."""

    information: Floats
    """Inverse of the covariance, shape (3, 3), 1/m²."""
    body_p_imu: Floats
    """Shape (3,), m."""
    accel_bias: Floats
    """Shape (3,), m/s²; the vertical one is hardly told from gravity."""
    noise_m_s: float
    """Of one Doppler sample along an axis, from what remains."""


def fit_place(sequence: Sequence) -> PlaceFit:
    """From one run, its Doppler log's stamps put right before."""
    dvl, calibration = sequence.dvl, sequence.calibration
    path = InertialPath.of(sequence.imu)
    seconds = path.since_origin(dvl.stamps_ns)
    inside = path.covers(seconds)
    seconds, velocity = seconds[inside], dvl.velocity[inside]
    body_p_dvl = np.array(calibration.dvl.mounting.translation_m)
    body_p_imu = np.array(calibration.imu.mounting.translation_m)
    C = path.rotations_at(seconds)
    turning = C @ cross_matrices(path.linear_at(seconds, path.rate))
    x = (
        np.einsum("nij,nj->ni", C, velocity)
        - turning @ (body_p_dvl - body_p_imu)
        - path.linear_at(seconds, path.impulse)
    )
    slow = seconds[:, None, None] * np.eye(3)
    columns = [
        turning,
        -path.linear_at(seconds, path.turned_time),
        slow,
        seconds[:, None, None] * slow,
    ]
    found, covariance, variance = _least_squares(np.concatenate(columns, axis=2), x)
    place = body_p_imu - found[SHOWN]
    information = np.asarray(np.linalg.inv(covariance[SHOWN, SHOWN]), np.float64)
    return PlaceFit(information, place, found[3:6], float(np.sqrt(variance)))


def _least_squares(A: Floats, x: Floats) -> tuple[Floats, Floats, float]:
    """Least squares on differences with anticorrelated neighbours: parameters, covariance, variance of a sample."""
    n = len(x) - 1
    root = np.linalg.cholesky(2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    both = np.concatenate([np.diff(A, axis=0), np.diff(x, axis=0)[:, :, None]], axis=2)
    white = solve_triangular(root, both.reshape(n, -1), lower=True).reshape(3 * n, -1)
    a, y = white[:, :-1], white[:, -1]
    inverse = np.linalg.inv(a.T @ a)
    found = inverse @ a.T @ y
    variance = float(np.square(y - a @ found).sum() / (len(y) - len(found)))
    return found, variance * inverse, variance


def place_of(fits: list[PlaceFit]) -> Floats:
    """The place that several runs tell together, shape (3,), m."""
    total = sum((fit.information for fit in fits), np.zeros((3, 3)))
    return np.asarray(
        np.linalg.solve(
            total, sum((f.information @ f.body_p_imu for f in fits), np.zeros(3))
        )
    )
