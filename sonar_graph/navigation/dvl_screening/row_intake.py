"""Rows of IMU, Doppler log and depth sensor that are used, and the reasons why others are refused.

A row is turned into body axes and placed by its stamp. A velocity whose covariance is not positive definite is unsound,
a row of a motion that was already used is late. A velocity that no vehicle reaches is an outlier, and one with none
before it waits until others confirm it (`sonar_graph.navigation.dvl_screening.dvl_gate`). One of too few beams waits
until it can be completed (`sonar_graph.navigation.dvl_screening.partial_beams`). An angular rate or a specific force
beyond `MOST_RATE_RAD_S` and `MOST_FORCE_M_S2` is measured by no sensor.

Depths. Between samples t seconds apart the height changes by at most V t, V `VERTICAL_M_S`. The squared distance of a
sample of variance r from an earlier one of r_0, gated at `DEPTH_GATE`, with what logs do not say, u `UNSAID_M`::

    d = max(|z - z_0| - V t, 0)^2 / (r + r_0 + u^2)

A sample is used if it is within the gate of the last one used, at the start of the calibration's pose, with t at most
`LONG_NS` and `LONG_INTERVALS` of the log's own. Else it is refused, but forms a chain with refused ones that it can be
reached from. A chain is used from its last sample on when it has `FEWEST` samples and its first could be reached from
the last one used, or else has more than that one's chain. That of a start that the calibration states is never
overruled. Nothing waits: a sample is judged by those stamped before it. docs/theory/gaps.md.

A row is known from its own stamp on, one that waited from that of the row that completed or confirmed it. So what is
known at an instant follows from stamps, not from the calls in which rows came.
"""

from typing import NamedTuple, TypeVar

import numpy as np

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, Ints
from sonar_graph.navigation.dvl_screening.dvl_gate import (
    GATE,
    LONG_INTERVALS,
    LONG_NS,
    GateResult,
    VelocityConfirmation,
    gate_velocities,
)
from sonar_graph.navigation.dvl_screening.partial_beams import InertialRows, PartialVelocities, Rows
from sonar_graph.navigation.samples import EARLIEST_NS, LATEST_NS, StampedRows, in_numbers
from sonar_graph.numerics import compiled
from sonar_graph.states import Refusal, RefusedRow

_Rows = TypeVar("_Rows", Imu, Dvl)
ROUNDING = 1e-13
"""Share of the largest variance below which the smallest is taken for zero."""
MOST_RATE_RAD_S = 35.0
"""Full scale of the gyros of vehicles is 2000 deg/s and less."""
MOST_FORCE_M_S2 = 1000.0
"""Full scale of the accelerometers of vehicles is 100 g and less."""
VERTICAL_M_S = 3.0
"""A survey vehicle at 5 m/s with the bow 35 deg down; waves of 1 m and 5 s heave with 1.3 m/s."""
UNSAID_M = 0.1
"""Sigma of a sample's error that its variance leaves out: resolution, waves over the port, pressure of the stream."""
DEPTH_GATE = 37.3
"""Chi-square quantile of 1 - 1e-9, 1 degree of freedom."""
FEWEST = 3
"""Least number of samples of a chain: of samples of which one in 20 is wrong, and alike, 3 in succession are wrong once
in 8000 times."""
MOST_CHAINS = 10
"""Number of refused chains that are remembered."""


class DepthChain(NamedTuple):
    """Depth samples of which each can be reached from the one before: the last one, and their number."""

    stamp_ns: int
    z_m: float
    variance_m2: float
    length: int
    is_reachable: bool = False
    """True where a vehicle could get from the last sample used to the first of these."""

    def distance(self, to: "DepthChain", longest_ns: int = LATEST_NS) -> float:
        """Squared distance d of the module's equation, with t at most ``longest_ns``."""
        t = min(to.stamp_ns - self.stamp_ns, longest_ns) * 1e-9
        beyond_m = max(abs(to.z_m - self.z_m) - VERTICAL_M_S * t, 0.0)
        return beyond_m * beyond_m / (self.variance_m2 + to.variance_m2 + UNSAID_M**2)


class DepthGate:
    """Judges depth samples in the order of their stamps."""

    def __init__(self, calibration: Calibration) -> None:
        start, port_m = calibration.start, np.array(calibration.depth.port_m)
        z_m, is_stated = float(start.pose().transformFrom(port_m)[2]), "position_m" in start.model_fields_set
        length = LATEST_NS if is_stated else FEWEST - 1
        self._used = DepthChain(EARLIEST_NS, z_m, start.position_sigma_m[2] ** 2, length)
        self._refused: list[DepthChain] = []
        self.newest_ns: int = EARLIEST_NS
        """Stamp of the last sample that was judged."""
        self._interval_ns: int | None = None

    def distance(self, stamp_ns: int, z_m: float, variance_m2: float) -> float | None:
        """None for a sample that is used, else its squared distance from the last one used."""
        longest_ns = max(LONG_NS, LONG_INTERVALS * (self._interval_ns or 0))
        if self.newest_ns > EARLIEST_NS:
            self._interval_ns = min(self._interval_ns or LATEST_NS, stamp_ns - self.newest_ns)
        else:
            self._used = self._used._replace(stamp_ns=stamp_ns - LONG_NS)
        self.newest_ns, sample, used = stamp_ns, DepthChain(stamp_ns, z_m, variance_m2, 1), self._used
        distance = used.distance(sample, longest_ns)
        if distance <= DEPTH_GATE:
            self._used, self._refused = sample._replace(length=used.length + 1), []
            return None
        near = [chain for chain in self._refused if chain.distance(sample) <= DEPTH_GATE]
        if near:
            before = max(near, key=lambda chain: chain.length)
            self._refused.remove(before)
            sample = sample._replace(length=before.length + 1, is_reachable=before.is_reachable)
        else:
            sample = sample._replace(is_reachable=used.distance(sample) <= DEPTH_GATE)
        if sample.length > (FEWEST - 1 if sample.is_reachable else used.length):
            self._used, self._refused = sample, []
            return None
        self._refused = [*self._refused, sample][-MOST_CHAINS:]
        return distance


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
        self._depth_gate, self._depth_variance = DepthGate(calibration), calibration.depth.sigma_m**2
        self._gyro_bias, self._scale = np.array(calibration.imu.gyro_bias_rad_s), 1.0 + calibration.dvl.scale_error
        self._default_cov = np.diag(np.square(calibration.dvl.velocity_sigma_m_s))
        self._gate = np.inf if is_held else GATE
        self._walk = calibration.dvl.velocity_walk_density
        self._confirmation = None if is_held else VelocityConfirmation(self._walk)
        self._partial = PartialVelocities(calibration)
        self.imu = StampedRows(np.empty((0, 3)), np.empty((0, 3)))
        """Angular rate and specific force, body axes."""
        self.dvl = StampedRows(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.int64))
        """Velocity of the DVL's origin and its covariance, body axes, and the stamp from which they are known."""
        self.settled_ns: int = EARLIEST_NS
        """Stamp up to which motion is used and final."""
        self._refused: list[RefusedRow] = []

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows that are not used, and why; includes rows that may still be completed or confirmed."""
        waiting = self._confirmation.waiting_ns if self._confirmation else []
        return [
            *self._refused,
            *(RefusedRow("dvl", at_ns, Refusal.INCOMPLETE, np.nan) for at_ns in self._partial.not_completed_ns),
            *(RefusedRow("dvl", at_ns, Refusal.UNCONFIRMED, np.nan) for at_ns in waiting),
        ]

    def add_imu(self, imu: Imu) -> bool:
        """Take in rows; True where some were placed before others that were there already."""
        rows = self._in_time(imu, self.imu.stamps_ns, "imu")
        if rows is None:
            return False
        rate, force = rows.angular_velocity, rows.specific_force
        beyond = (np.abs(rate) > MOST_RATE_RAD_S) | (np.abs(force) > MOST_FORCE_M_S2)
        if beyond.any():
            is_used = np.asarray(~beyond.any(axis=1))
            self._refuse("imu", rows.stamps_ns[~is_used], Refusal.BEYOND_SENSOR)
            if not is_used.any():
                return False
            rows, rate, force = rows.rows(is_used), rate[is_used], force[is_used]
        if self._gyro_bias.any():
            rate = rate - self._gyro_bias
        if self._body_R_imu is not None:
            rate, force = _turned(self._body_R_imu, rate), _turned(self._body_R_imu, force)
        return self.imu.insert(rows.stamps_ns, rate, force)

    def refuse_imu_before(self, stamp_ns: int) -> None:
        """Drop rows, which no motion has used yet, of a clock that was set later."""
        first = int(np.searchsorted(self.imu.stamps_ns, stamp_ns))
        self._refuse("imu", self.imu.stamps_ns[:first], Refusal.CLOCK)
        self.imu.forget_before(stamp_ns, -1)

    def used_depths(self, depth: Depth) -> Depth | None:
        """Samples that pass, each stamp once; None without any."""
        is_used, gate = np.zeros(len(depth), np.bool_), self._depth_gate
        variance_m2 = np.where(np.isnan(depth.variance_m2), self._depth_variance, depth.variance_m2)
        rows = zip(depth.stamps_ns.tolist(), depth.z_m.tolist(), variance_m2.tolist(), strict=True)
        for k, (stamp_ns, z_m, variance) in enumerate(rows):
            distance: float | None = np.nan
            if not 0.0 < variance < np.inf:
                reason = Refusal.UNSOUND
            elif stamp_ns <= gate.newest_ns:
                reason = Refusal.LATE
            else:
                reason, distance = Refusal.OUT_OF_REACH, gate.distance(stamp_ns, z_m, variance)
            is_used[k] = distance is None
            if distance is not None and (reason is not Refusal.LATE or stamp_ns < gate.newest_ns):
                self._refused.append(RefusedRow("depth", stamp_ns, reason, distance))
        return depth if is_used.all() else depth.rows(is_used) if is_used.any() else None

    def add_dvl(self, dvl: Dvl) -> bool:
        """Take in rows, with those that have waited for them; True as for `add_imu`."""
        rows = self._in_time(dvl, self.dvl.stamps_ns, "dvl")
        if rows is None:
            return False
        cov = rows.velocity_cov
        if not _is_dominant(cov):
            cov = in_numbers(cov, self._default_cov)
            variances = np.linalg.eigvalsh(cov)
            is_symmetric = (np.abs(cov - cov.transpose(0, 2, 1)) <= 1e-6 * variances[:, 2, None, None]).all(axis=(1, 2))
            is_sound = is_symmetric & (variances[:, 0] > ROUNDING * variances[:, 2])
            is_sound |= np.isnan(rows.velocity_cov[:, 0, 0])
            self._refuse("dvl", rows.stamps_ns[~is_sound], Refusal.UNSOUND)
            if not is_sound.any():
                return False
            rows, cov = rows.rows(is_sound), cov[is_sound]
        velocity = rows.velocity
        if self._scale != 1.0:
            velocity, cov = velocity / self._scale, cov / self._scale**2
        if self._body_R_dvl is not None:
            velocity, cov = _turned(self._body_R_dvl, velocity), self._body_R_dvl @ cov @ self._body_R_dvl.T
        block, confirmation = (rows.stamps_ns, velocity, cov), self._confirmation
        result = self._gated(block)
        if confirmation is None:
            return self._place(block, result)
        whole_ns = rows.stamps_ns if result.is_plain else rows.stamps_ns[~(result.is_outlier | result.is_partial)]
        if confirmation.lets_all_pass(rows.stamps_ns, whole_ns):
            confirmation.accept(whole_ns)
            return self._place(block, result)
        was_placed_before = False
        for stamp_ns, v, v_cov, is_partial in zip(*block, result.is_partial, strict=True):
            confirmed, refused = confirmation.confirm(int(stamp_ns), v, v_cov, is_partial=bool(is_partial))
            self._refused += refused
            if len(confirmed[0]):
                again = self._gated(confirmed)
                confirmation.accept(confirmed[0][~(again.is_outlier | again.is_partial)])
                was_placed_before |= self._place(confirmed, again, int(stamp_ns))
        return was_placed_before

    def _refuse(self, sensor: str, stamps_ns: Ints, reason: Refusal) -> None:
        self._refused += [RefusedRow(sensor, stamp_ns, reason, np.nan) for stamp_ns in stamps_ns.tolist()]

    def _gated(self, rows: Rows) -> GateResult:
        """Compare rows with those placed already."""
        velocity, cov, _ = self.dvl.values
        return gate_velocities(*rows, self.dvl.stamps_ns, velocity, cov, self._walk, self._gate)

    def _place(self, rows: Rows, result: GateResult, confirmed_ns: int = EARLIEST_NS) -> bool:
        """Complete and place rows that are no outliers; True as for `add_imu`."""
        known_ns = rows[0]
        if result.is_plain and not self._partial.is_waiting:
            self._partial.remember(*rows)
        else:
            outlier, (stamps_ns, velocity, cov) = result.is_outlier, rows
            for stamp_ns, distance in zip(stamps_ns[outlier].tolist(), result.distance[outlier].tolist(), strict=True):
                self._refused.append(RefusedRow("dvl", stamp_ns, Refusal.OUTLIER, distance))
            inertial = InertialRows(self.imu.stamps_ns, *self.imu.values)
            accepted = stamps_ns[~outlier], velocity[~outlier], cov[~outlier]
            rows = self._partial.completed(*accepted, result.is_partial[~outlier], inertial)
            whole_ns = accepted[0][~result.is_partial[~outlier]]
            known_ns = whole_ns[whole_ns.searchsorted(rows[0])]
        if not len(rows[0]):
            return False
        if confirmed_ns > EARLIEST_NS:
            known_ns = np.maximum(known_ns, confirmed_ns)
        was_placed_before = self.dvl.insert(*rows, known_ns)
        if was_placed_before:  # a row is known no earlier than those before it
            np.maximum.accumulate(self.dvl.values[2], out=self.dvl.values[2])
        return was_placed_before

    def _in_time(self, rows: _Rows, known_ns: Ints, sensor: str) -> _Rows | None:
        """Rows that are not late, each stamp once."""
        if rows.stamps_ns[0] <= self.settled_ns:
            late = rows.between(EARLIEST_NS, self.settled_ns)
            if late is not None:
                self._refuse(sensor, np.setdiff1d(late.stamps_ns, known_ns), Refusal.LATE)
            later = rows.between(self.settled_ns, LATEST_NS)
            if later is None:
                return None
            rows = later
        if len(rows.stamps_ns) > 1 and _repeated(rows.stamps_ns):
            rows = rows.rows(np.unique(rows.stamps_ns, return_index=True)[1])
        return rows


@compiled
def _is_dominant(cov: Floats) -> bool:
    """True where each variance (n, 3, 3) exceeds the rest of its row: then all are finite and positive definite."""
    for k in range(len(cov)):
        for i in range(3):
            variance, rest = cov[k, i, i], 0.0
            for j in range(3):
                rest += abs(cov[k, i, j]) if j != i else 0.0
            if not rest < variance < np.inf:
                return False
    return True


@compiled
def _repeated(stamps_ns: Ints) -> int:
    """Number of rows that have the stamp of the row before."""
    count = 0
    for k in range(1, len(stamps_ns)):
        count += int(stamps_ns[k] == stamps_ns[k - 1])
    return count


def _turned(R: Floats, rows: Floats) -> Floats:
    """``R v`` of each row; a product of matrices would round differently for blocks of different length."""
    return np.einsum("ij,nj->ni", R, rows)


def _rotation(mounting: Mounting) -> Floats | None:
    """body_R_sensor, None for a sensor whose axes are the body's."""
    return mounting.pose().rotation().matrix() if any(mounting.rpy_rad) else None
