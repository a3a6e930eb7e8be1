"""Velocities of exactly zero that accelerometers contradict: a Doppler log without bottom lock, not a vehicle at rest.

With C the turn by the gyros, F = int C f dt and the velocity v, the differences x = C v - F are a straight line in time,
whose slope is gravity (`FirstPath`). A line through the rows on one side of a stretch of zeros, extended to its first
zero, predicts -F there. At rest the prediction holds; without lock it is off by the velocity.
"""

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.logs.measured_start import FirstPath
from sonar_graph.measurements import NS_PER_S, Dvl, Imu, Ints

ROWS_BESIDE = 8
FEWEST_BESIDE = 5
LONGEST_BESIDE_S = 12.0
"""Beyond it the bias of a gyro bends the line."""
SURE_SIGMAS = 6.0
LEAST_STEP_M_S = 0.05
"""At such speeds a row of zeros does little harm."""
LEAST_SHARE = 0.5
"""Of the speed of the row beside the zeros: a vehicle that brakes is off by less where stamps are late."""
UNFELT = "with a velocity of 0 that the accelerometers contradict"


def unfelt_zeros(imu: Imu, dvl: Dvl, calibration: Calibration) -> NDArray[np.bool_]:
    """Mask of rows of zeros, shape (n,), in stretches that the vehicle reaches or leaves by a step it does not feel."""
    is_zero: NDArray[np.bool_] = np.asarray(~dvl.velocity.any(axis=1))
    found = np.zeros(len(dvl), bool)
    edges = np.flatnonzero(np.diff(is_zero.astype(int), prepend=0, append=0))
    for begin, end in edges.reshape(-1, 2).tolist():
        before = np.arange(max(begin - ROWS_BESIDE, 0), begin + 1)
        after = np.arange(end - 1, min(end + ROWS_BESIDE, len(dvl)))
        found[begin:end] = any(
            is_unfelt(imu, dvl, calibration, rows, zero)
            for rows, zero in ((before, begin), (after, end - 1))
        )
    return found


def is_unfelt(
    imu: Imu, dvl: Dvl, calibration: Calibration, rows: Ints, zero: int
) -> bool:
    """True where the row ``zero`` leaves the line of the others by far more than they scatter about it."""
    is_beside = (rows == zero) | dvl.velocity[rows].any(axis=1)
    stamps_ns = dvl.stamps_ns[rows]
    is_beside &= np.abs(stamps_ns - dvl.stamps_ns[zero]) <= LONGEST_BESIDE_S * NS_PER_S
    chosen = dvl.rows(rows[is_beside])
    begin_ns = int(chosen.stamps_ns[0])
    samples = imu.between(begin_ns - NS_PER_S, int(chosen.stamps_ns[-1]) + NS_PER_S)
    if samples is None or len(chosen) <= FEWEST_BESIDE:
        return False
    path = FirstPath.of(samples, chosen, calibration, begin_ns)
    x = path.velocity - path.impulse  # (m, 3)
    # a hole of the IMU ends the path
    if len(x) < len(chosen) or not np.isfinite(x).all():
        return False
    at = int(np.flatnonzero(rows[is_beside] == zero)[0])
    A = np.vander(path.seconds - path.seconds[at], 2)  # (m, 2)
    others = np.arange(len(x)) != at
    slope_and_level, *_ = np.linalg.lstsq(A[others], x[others])
    residuals = x[others] - A[others] @ slope_and_level
    freedom = 3 * (len(residuals) - 2)
    variance = float(np.sum(residuals**2)) / freedom
    of_line = np.linalg.inv(A[others].T @ A[others])[1, 1]
    sigma_m_s = float(np.sqrt(variance * (1 + of_line)))
    off_m_s = float(np.linalg.norm(x[at] - slope_and_level[1]))
    beside = 1 if at == 0 else at - 1
    step_m_s = LEAST_SHARE * float(np.linalg.norm(chosen.velocity[beside]))
    return off_m_s > max(LEAST_STEP_M_S, step_m_s, SURE_SIGMAS * sigma_m_s)
