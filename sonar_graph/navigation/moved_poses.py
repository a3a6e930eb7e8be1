"""Poses moved on from an earlier instant i to the newest row of the IMU, in one compiled call.

    x_T_j = x_T_i i_T_j,    P_j = A P_i A^T + C,    A = Ad(i_T_j^-1)

The motion i_T_j and its covariance C are those of `Odometry.motion` without a gyro bias: sums that are final up to the
newest epoch are kept, and continued by what is new. Over a gap of the Doppler log they are taken from there.
"""

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.dvl_gaps import Sensors
from sonar_graph.navigation.imu_gaps import Turns
from sonar_graph.navigation.odometry import ZERO, Odometry, epochs_between
from sonar_graph.navigation.samples import LATEST_NS
from sonar_graph.navigation.steps import Rows, has_gap, put, row, rows_until, value_at
from sonar_graph.navigation.sums import NOWHERE, START, write_motions
from sonar_graph.numerics import O3, Mat6, Vec3, compiled, cross, mat, mat6, skew, store, store6, vec


class MovedPoses:
    """Poses of the body in several frames, and the covariance that they share, from an instant on.

    Parameters
    ----------
    odometry
        Source of the motion, which goes on to take in rows.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph import Odometry
    >>> from sonar_graph.navigation import MovedPoses
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> odometry = Odometry(world.calibration)
    >>> is_out_of_date = odometry.add(world.imu, world.dvl)
    >>> poses = MovedPoses(odometry)
    >>> poses.begin(world.start_ns, np.eye(4)[None], np.zeros((6, 6)))
    >>> x_T_j, covariance, velocity = poses.at(world.start_ns + 1_000_000_000)
    >>> x_T_j.shape, covariance.shape, velocity.shape
    ((1, 4, 4), (6, 6), (3,))
    """

    def __init__(self, odometry: Odometry) -> None:
        sensors = Sensors.of(odometry.calibration)
        dvl_p_imu = sensors.body_p_imu - sensors.body_p_dvl
        self._odometry = odometry
        self._sensors = sensors.longest_ns, sensors.gyro_density, sensors.body_p_dvl, dvl_p_imu
        self._x_T_i, self._P_i = np.eye(4), np.zeros((6, 6))
        self._start_ns, self._summed_ns, self._end_ns = 0, np.zeros(1, np.int64), np.zeros(1, np.int64)
        self._sums = START.copy()
        """From the start to the newest epoch, `_summed_ns`."""

    def begin(self, start_ns: int, x_T_i: Floats, covariance: Floats) -> None:
        """Begin at an instant with poses, shape (n, 4, 4), and the covariance of [rotation, translation], (6, 6)."""
        self._x_T_i, self._P_i = np.ascontiguousarray(x_T_i.reshape(-1, 4)), np.ascontiguousarray(covariance)
        self._start_ns = start_ns
        self.sum_anew()

    def sum_anew(self) -> None:
        """Forget the sums, since rows were placed before others."""
        self._summed_ns[0], self._sums[:] = self._start_ns, START

    def at(self, end_ns: int) -> tuple[Floats, Floats, Floats]:
        """Poses at an instant, shape (n, 4, 4), their covariance, (6, 6), and the newest velocity.

        The velocity is that of the IMU's point at the newest epoch, body axes, shape (3,), m/s; NaN before the first.
        """
        if end_ns < self._end_ns[0]:
            self.sum_anew()
        self._end_ns[0] = end_ns
        start, x_T_i, P_i = self._start_ns, self._x_T_i, self._P_i
        rows, span = self._odometry.rows(), (start, self._summed_ns, self._end_ns)
        x_T_j, P_j, velocity = np.empty((len(x_T_i), 4)), np.empty((6, 6)), np.empty(3)
        if not _move_on(*rows[:8], *rows.turns, *self._sensors, *span, self._sums, x_T_i, P_i, x_T_j, P_j, velocity):
            motion = self._odometry.motion(start, end_ns, ZERO)
            i_T_j, C = np.ascontiguousarray(motion.i_T_j.matrix()), np.ascontiguousarray(motion.covariance)
            moved(x_T_i, P_i, i_T_j, C, x_T_j, P_j)
        return x_T_j.reshape(-1, 4, 4), P_j, velocity


@compiled
def _move_on(
    imu_ns: Ints, rate: Floats, force: Floats, dvl_ns: Ints, velocity: Floats, cov: Floats, known_ns: Ints,
    hold_past: bool, is_modelled: bool, sigma: Floats, time_s: Floats, turn_density: float,
    longest_ns: int, gyro_density: float, body_p_dvl: Floats, dvl_p_imu: Floats,
    start_ns: int, summed_ns: Ints, end_ns: Ints, sums: Floats,
    x_T_i: Floats, P_i: Floats, x_T_j: Floats, P_j: Floats, velocity_j: Floats,
) -> bool:  # fmt: skip
    """Fill in what is at the end; where a gap lies before, the velocity alone, and return False."""
    turns = Turns(is_modelled, sigma, time_s, turn_density)
    rows = Rows(imu_ns, rate, force, dvl_ns, velocity, cov, known_ns, hold_past, turns)
    _, last = epochs_between(dvl_ns[0] - 1, end_ns[0], imu_ns, dvl_ns, known_ns)
    newest_ns, v = np.empty(1, np.int64), NOWHERE
    newest_ns[0] = start_ns
    if last > 0:
        epoch_ns, known = dvl_ns[last - 1], rows_until(imu_ns, end_ns[0])
        w = value_at(imu_ns, rate, known, rows_until(imu_ns, epoch_ns - 1), epoch_ns, hold_past)
        v = row(velocity, last - 1) + cross(w, vec(dvl_p_imu))
        newest_ns[0] = max(start_ns, epoch_ns)
    velocity_j[0], velocity_j[1], velocity_j[2] = v
    since = min(rows_until(dvl_ns, start_ns - 1), last - 1)
    if last > 0 and has_gap(dvl_ns, last, since + 1, dvl_ns[since], end_ns[0], longest_ns):
        return False
    bias, C, D = np.zeros(3), np.empty((1, 6, 6)), np.empty((1, 6, 3))
    i_T_j, provisional = np.empty((4, 4)), np.empty((20, 3))
    noise = LATEST_NS, bias, bias, body_p_dvl, gyro_density, False
    write_motions(rows, summed_ns, newest_ns, end_ns, *noise, sums, C, D)
    summed_ns[0] = newest_ns[0]
    for k in range(len(sums)):
        put(row(sums, k), provisional, k)
    write_motions(rows, newest_ns, end_ns, end_ns, *noise, provisional, C, D)
    store(mat(provisional), i_T_j)
    i_T_j[0, 3], i_T_j[1, 3], i_T_j[2, 3] = row(provisional, 3)
    moved(x_T_i, P_i, i_T_j, C[0], x_T_j, P_j)
    return True


@compiled
def moved(x_T_i: Floats, P_i: Floats, i_T_j: Floats, C: Floats, x_T_j: Floats, P_j: Floats) -> None:
    """Fill in ``x_T_i i_T_j``, of poses one below the other, and ``A P_i A^T + C``."""
    R, p = mat(i_T_j), Vec3(i_T_j[0, 3], i_T_j[1, 3], i_T_j[2, 3])
    A = Mat6(R.T, O3, -1.0 * (R.T @ skew(p)), R.T)
    store6(A @ mat6(P_i) @ A.T + mat6(C), P_j)
    for k in range(0, len(x_T_i), 4):
        x_R_i, x_p_i = mat(x_T_i, (k, 0)), Vec3(x_T_i[k, 3], x_T_i[k + 1, 3], x_T_i[k + 2, 3])
        store(x_R_i @ R, x_T_j, (k, 0))
        x_T_j[k, 3], x_T_j[k + 1, 3], x_T_j[k + 2, 3] = x_p_i + x_R_i @ p
        x_T_j[k + 3, 0] = x_T_j[k + 3, 1] = x_T_j[k + 3, 2] = 0.0
        x_T_j[k + 3, 3] = 1.0
