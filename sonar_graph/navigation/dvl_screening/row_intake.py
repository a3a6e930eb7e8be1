"""Rows of IMU, Doppler log and depth sensor that are used, and the reasons why others are refused.

A row is turned into body axes and placed by its stamp. A velocity whose covariance is not positive definite is unsound,
a row of a motion that was already used is late. A velocity that no vehicle reaches is an outlier, and one with none
before it waits until others confirm it (`sonar_graph.navigation.dvl_screening.dvl_gate`). One of too few beams, which
leaves a direction unmeasured, is refused: the gap is bridged better without it. An angular rate or a specific force
beyond `MOST_RATE_RAD_S` and `MOST_FORCE_M_S2` is measured by no sensor. Depths:
`sonar_graph.navigation.dvl_screening.depth_gate`.

A row is known from its own stamp on, one that waited from that of the row that confirmed it. So what is known at an
instant follows from stamps, not from the calls in which rows came.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.devices import PARTIAL_M2_S2, is_partial
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, Ints
from sonar_graph.navigation.dvl_screening.depth_gate import USED, DepthGate
from sonar_graph.navigation.dvl_screening.dvl_gate import (
    GATE,
    GateResult,
    VelocityConfirmation,
    gate_velocities,
)
from sonar_graph.navigation.samples import (
    EARLIEST_NS,
    LATEST_NS,
    StampedRows,
    VelocityRow,
    VelocityRows,
    in_numbers,
)
from sonar_graph.numerics import compiled
from sonar_graph.states import Refusal, RefusedRow

_Rows = TypeVar("_Rows", Imu, Dvl)
ROUNDING = 1e-13
"""Share of the largest variance below which the smallest is taken for zero."""
MOST_RATE_RAD_S = 35.0
"""Full scale of the gyros of vehicles is 2000 deg/s and less."""
MOST_FORCE_M_S2 = 1000.0
"""Full scale of the accelerometers of vehicles is 100 g and less."""


class RowIntake:
    """Screens and stores rows of both sensors of motion, and screens depths.

    Parameters
    ----------
    calibration
        Mountings, DVL noise where the log has none, and the interpolation between samples. Held velocities
        (``hold-past``) may jump: they pass no gate and need no confirmation.
    """

    def __init__(self, calibration: Calibration) -> None:
        is_held = calibration.odometry_interpolation == "hold-past"
        self._body_R_imu = _rotation(calibration.imu.mounting)
        self._body_R_dvl = _rotation(calibration.dvl.mounting)
        gyro_bias = np.array(calibration.imu.gyro_bias_rad_s)
        self._gyro_bias = gyro_bias if gyro_bias.any() else None
        accel_bias = np.array(calibration.imu.accel_bias_m_s2)
        self._accel_bias = accel_bias if accel_bias.any() else None
        self._scale = 1.0 + calibration.dvl.scale_error
        self._default_cov = np.diag(np.square(calibration.dvl.velocity_sigma_m_s))
        self._depth_gate = DepthGate(calibration)
        self._gate = np.inf if is_held else GATE
        self._walk = calibration.dvl.velocity_walk_density
        self._confirmation = None if is_held else VelocityConfirmation(self._walk)
        self.imu = StampedRows(np.empty((0, 3)), np.empty((0, 3)))
        """Angular rate and specific force, body axes."""
        self.dvl = StampedRows(
            np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.int64)
        )
        """Velocity of the DVL's origin and its covariance, body axes, and the stamp from which they are known."""
        self.settled_ns: int = EARLIEST_NS
        """Stamp up to which motion is used and final."""
        self._refused: list[RefusedRow] = []

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, and why; includes rows that may still be confirmed."""
        unconfirmed = self._confirmation.unconfirmed if self._confirmation else []
        return [*self._refused, *unconfirmed]

    def add_imu(self, imu: Imu) -> bool:
        """Add rows; True where some were placed before others that were there already."""
        rows = self._in_time(imu, self.imu.stamps_ns, "imu")
        if rows is None:
            return False
        rate = rows.angular_velocity
        force = rows.specific_force
        # a fault of the transmission: the row is refused whole
        is_used = np.ones(len(rate), np.bool_)
        if not _write_within(rate, force, is_used):
            self._refuse("imu", rows.stamps_ns[~is_used], Refusal.BEYOND_SENSOR)
            if not is_used.any():
                return False
            rows = rows.rows(is_used)
            rate = rate[is_used]
            force = force[is_used]
        # the calibration's biases are along the sensor's axes
        if self._gyro_bias is not None:
            rate = rate - self._gyro_bias
        if self._accel_bias is not None:
            force = force - self._accel_bias
        if self._body_R_imu is not None:
            rate = _turned(self._body_R_imu, rate)
            force = _turned(self._body_R_imu, force)
        return self.imu.insert(rows.stamps_ns, rate, force)

    def refuse_imu_before(self, stamp_ns: int) -> None:
        """Drop rows, which no motion has used yet, of a clock that was set later."""
        first = int(np.searchsorted(self.imu.stamps_ns, stamp_ns))
        self._refuse("imu", self.imu.stamps_ns[:first], Refusal.CLOCK)
        self.imu.forget_before(stamp_ns, -1)

    def used_depths(self, depth: Depth) -> Depth | None:
        """Samples that pass, each stamp once; None without any."""
        samples = self._depth_gate.judge(depth)
        if not samples.treatment.any():
            return depth
        # refused, or a stamp that repeats
        self._refused += samples.refused()
        is_used = samples.treatment == USED
        return depth.rows(is_used) if is_used.any() else None

    def add_dvl(self, dvl: Dvl) -> bool:
        """Add rows, with those that have waited for them; True as for `add_imu`."""
        rows = self._sound_velocities(dvl)
        if rows is None:
            return False
        confirmation = self._confirmation
        # the whole block first: only where a row may have to wait they go one by one
        result = self._gated(rows)
        if confirmation is None:
            return self._place(rows, result)
        accepted_ns = rows.stamps_ns
        if result.has_outliers:
            accepted_ns = rows.stamps_ns[~result.is_outlier]
        if confirmation.lets_all_pass(rows.stamps_ns, accepted_ns):
            confirmation.accept(accepted_ns)
            return self._place(rows, result)
        was_placed_before = False
        for stamp_ns, velocity, cov in zip(*rows, strict=True):
            row = VelocityRow(int(stamp_ns), velocity, cov)
            confirmed, refused = confirmation.confirm(row)
            self._refused += refused
            if len(confirmed.stamps_ns):
                again = self._gated(confirmed)
                confirmation.accept(confirmed.stamps_ns[~again.is_outlier])
                was_placed_before |= self._place(confirmed, again, row.stamp_ns)
        return was_placed_before

    def _sound_velocities(self, dvl: Dvl) -> VelocityRows | None:
        """Whole rows in time with a positive definite covariance, in body axes, without the scale error, if any."""
        rows = self._in_time(dvl, self.dvl.stamps_ns, "dvl")
        if rows is None:
            return None
        velocity = rows.velocity
        cov = rows.velocity_cov
        # most covariances are diagonal: no eigenvalues needed
        if not _is_dominant(cov):
            is_sound, cov = self._judged(cov)
            if not is_sound.all():
                self._refuse("dvl", rows.stamps_ns[~is_sound], Refusal.UNSOUND)
            incomplete = is_sound & is_partial(cov)
            self._refuse("dvl", rows.stamps_ns[incomplete], Refusal.INCOMPLETE)
            is_used = is_sound & ~incomplete
            if not is_used.any():
                return None
            rows = rows.rows(is_used)
            velocity = rows.velocity
            cov = cov[is_used]
        if self._scale != 1.0:
            velocity = velocity / self._scale
            cov = cov / self._scale**2
        if self._body_R_dvl is not None:
            velocity = _turned(self._body_R_dvl, velocity)
            cov = self._body_R_dvl @ cov @ self._body_R_dvl.T
        return VelocityRows(rows.stamps_ns, velocity, cov)

    def _judged(self, given: Floats) -> tuple[NDArray[np.bool_], Floats]:
        """Which covariances are positive definite, or unknown, shape (n,), and all of them in numbers, (n, 3, 3)."""
        n = len(given)
        if np.isnan(given).all():
            return np.ones(n, np.bool_), np.tile(self._default_cov, (n, 1, 1))
        cov = in_numbers(given, self._default_cov)
        variances = np.linalg.eigvalsh(cov)
        asymmetry = np.abs(cov - cov.transpose(0, 2, 1))
        largest = variances[:, 2]
        is_symmetric = (asymmetry <= 1e-6 * largest[:, None, None]).all(axis=(1, 2))
        is_sound = is_symmetric & (variances[:, 0] > ROUNDING * variances[:, 2])
        return is_sound | np.isnan(given[:, 0, 0]), cov

    def _refuse(self, sensor: str, stamps_ns: Ints, reason: Refusal) -> None:
        self._refused += [
            RefusedRow(sensor, stamp_ns, reason) for stamp_ns in stamps_ns.tolist()
        ]

    def _gated(self, rows: VelocityRows) -> GateResult:
        """Compare rows with those placed already."""
        velocity, cov, _ = self.dvl.values
        known = VelocityRows(self.dvl.stamps_ns, velocity, cov)
        return gate_velocities(rows, known, self._walk, self._gate)

    def _place(
        self, rows: VelocityRows, result: GateResult, confirmed_ns: int = EARLIEST_NS
    ) -> bool:
        """Place rows that are no outliers; True as for `add_imu`."""
        if result.has_outliers:
            outlier = result.is_outlier
            outlier_ns = rows.stamps_ns[outlier].tolist()
            distances = result.distance[outlier].tolist()
            for stamp_ns, distance in zip(outlier_ns, distances, strict=True):
                self._refused.append(
                    RefusedRow("dvl", stamp_ns, Refusal.OUTLIER, distance)
                )
            rows = rows.where(~outlier)
        if not len(rows.stamps_ns):
            return False
        known_ns = rows.stamps_ns
        if confirmed_ns > EARLIEST_NS:
            known_ns = np.maximum(known_ns, confirmed_ns)
        was_placed_before = self.dvl.insert(*rows, known_ns)
        if was_placed_before:  # a row is known no earlier than those before it
            known_ns = self.dvl.values[2]
            np.maximum.accumulate(known_ns, out=known_ns)
        return was_placed_before

    def _in_time(self, rows: _Rows, known_ns: Ints, sensor: str) -> _Rows | None:
        """Rows that are not late, each stamp once."""
        if rows.stamps_ns[0] <= self.settled_ns:
            late = rows.between(EARLIEST_NS, self.settled_ns)
            if late is not None:
                self._refuse(
                    sensor, np.setdiff1d(late.stamps_ns, known_ns), Refusal.LATE
                )
            later = rows.between(self.settled_ns, LATEST_NS)
            if later is None:
                return None
            rows = later
        stamps_ns = rows.stamps_ns
        if len(stamps_ns) > 1 and (stamps_ns[1:] == stamps_ns[:-1]).any():
            rows = rows.rows(np.unique(stamps_ns, return_index=True)[1])
        return rows


@compiled
def _write_within(rate: Floats, force: Floats, is_within: NDArray[np.bool_]) -> bool:
    """Write False for rows whose angular rate or specific force no sensor can measure; shape (n,). True without any."""
    are_within = True
    for k in range(len(rate)):
        for i in range(3):
            # NaN is not beyond
            if abs(rate[k, i]) > MOST_RATE_RAD_S or abs(force[k, i]) > MOST_FORCE_M_S2:
                is_within[k] = False
                are_within = False
    return are_within


@compiled
def _is_dominant(cov: Floats) -> bool:
    """True where each variance (n, 3, 3) exceeds the rest of its row and all are whole: then they are sound."""
    for k in range(len(cov)):
        for i in range(3):
            variance = cov[k, i, i]
            rest = 0.0
            for j in range(3):
                rest += abs(cov[k, i, j]) if j != i else 0.0
            if not rest < variance < PARTIAL_M2_S2 / 3.0:
                return False
    return True


def _turned(R: Floats, rows: Floats) -> Floats:
    """``R v`` of each row; a product of matrices would round differently for blocks of different length."""
    return np.einsum("ij,nj->ni", R, rows)


def _rotation(mounting: Mounting) -> Floats | None:
    """body_R_sensor, None for a sensor whose axes are the body's."""
    return mounting.pose().rotation().matrix() if any(mounting.rpy_rad) else None
