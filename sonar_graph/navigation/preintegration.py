"""Preintegration of gyros and Doppler log: mean, covariance and bias derivative of a motion, as sums over steps.

Time is cut at every stamp of either sensor. Step k has length dt, rate w, velocity v of the Doppler log at l in the
body, and noise densities n_g (gyros) and Q_k (velocity). ``linear``: w and v are the values in the middle of the step,
linear between samples, held after the last known one. ``hold-past``: the sample that ends the interval. With E the
Earth's rate in frame i, b the gyro bias, `Exp` and its mean `J_l`::

    w_k = w - b - R^T E                                                                     (2)
    R_k = R J_l(w_k dt)                                                                     (3)
    s   = dt R_k (v - w_k x l)                                                              (4)
    p  <- p + s,    R <- R Exp(w_k dt)                                                      (5, 6)
    c   = p + s / 2 + R_k l,    A_k = Ad(R_k, c) = [R_k 0; [c]x R_k  R_k]                   (7)
    C_i = sum_k dt A_k diag(N_g, Q_k) A_k^T,    D_i = -sum_k dt A_k[:, :3]                  (8)

with ``R_k N_g R_k^T = N = n_g^2 I``, and more in holes of the IMU (`sonar_graph.navigation.imu_gaps`). Doppler noise is
white in time: between samples T apart with covariances R_1, R_2 its density is ``Q = T (R_1 + R_2) / 2``.

Errors are kept in frame i: they are not transported from step to step. One adjoint at the end takes both sums to frame
j, ``C = Ad(j_T_i) C_i Ad(j_T_i)^T``. Sums can be continued; the number of calls that made them changes no bit.
docs/theory/preintegration.md has the derivation and the same equation numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, Ints
from sonar_graph.motion import Motions, PreintegratedMotion
from sonar_graph.navigation.imu_gaps import (
    SHORTEST_NS,
    UNFELT_NS,
    Turns,
    error_in_hole,
    hole_ns,
)
from sonar_graph.navigation.samples import LATEST_NS, longest_interval_ns
from sonar_graph.numerics import (
    I3,
    LOWER_LEFT,
    O3,
    ZERO,
    Mat3,
    Mat6,
    Vec3,
    compilable,
    compiled,
    cross,
    diagonal,
    exp_and_mean,
    inlined,
    mat,
    row_of,
    skew,
    store,
    store6,
    store_vector,
    vec,
)


class Rows(NamedTuple):
    """Rows of IMU and Doppler log in body axes, each in the order of their stamps."""

    imu_ns: Ints
    rate: Floats
    """Shape (n, 3), rad/s."""
    force: Floats
    """Specific force, shape (n, 3), m/s²; NaN where not measured."""
    dvl_ns: Ints
    velocity: Floats
    """Velocity of the DVL's origin, shape (m, 3), m/s."""
    cov: Floats
    """Its covariance, shape (m, 3, 3), m²/s²."""
    known_ns: Ints
    """Stamp from which a DVL row is known: its own, or that of the row that completed or confirmed it; in order."""
    hold_past: bool
    """True where a sample is the mean over the interval that ends at its stamp; else linear."""
    turns: Turns
    """Model of the turn in holes of the IMU."""

    def known(self, at_ns: int) -> Rows:
        """Rows that are known at an instant, and always the first DVL row."""
        i = self.imu_ns.searchsorted(at_ns, side="right")
        k = max(self.known_ns.searchsorted(at_ns, side="right"), 1)
        return Rows(
            self.imu_ns[:i],
            self.rate[:i],
            self.force[:i],
            self.dvl_ns[:k],
            self.velocity[:k],
            self.cov[:k],
            self.known_ns[:k],
            self.hold_past,
            self.turns,
        )


class Sensors(NamedTuple):
    """Noise and places of the sensors."""

    longest_ns: int
    """Longest interval between Doppler samples that is no gap."""
    gyro_density: float
    """rad/s/√Hz."""
    gyro_bias_sigma: float
    """rad/s."""
    accel_density: float
    """m/s²/√Hz."""
    accel_bias_sigma: float
    """m/s²."""
    velocity_walk_density: float
    """m/s/√s."""
    gravity_m_s2: float
    body_p_imu: Floats
    """Shape (3,), m."""
    body_p_dvl: Floats
    """Shape (3,), m."""

    @classmethod
    def of(cls, calibration: Calibration) -> Sensors:
        """Pick the numbers from a calibration."""
        imu = calibration.imu
        dvl = calibration.dvl
        return cls(
            longest_ns=longest_interval_ns(calibration),
            gyro_density=imu.gyro_noise_density,
            gyro_bias_sigma=imu.gyro_bias_sigma,
            accel_density=imu.accel_noise_density,
            accel_bias_sigma=imu.accel_bias_sigma,
            velocity_walk_density=dvl.velocity_walk_density,
            gravity_m_s2=calibration.gravity_m_s2,
            body_p_imu=np.array(imu.mounting.translation_m),
            body_p_dvl=np.array(dvl.mounting.translation_m),
        )


class Removed(NamedTuple):
    """Constant rates that are taken off the gyros."""

    bias: Floats
    """Gyro bias in body axes, shape (3,), rad/s."""
    earth: Floats
    """Earth's rotation in frame i, shape (3,), rad/s."""

    def after(self, motion: PreintegratedMotion | None) -> Removed:
        """The same, with the Earth's rotation in the last frame of a motion."""
        if motion is None:
            return self
        return Removed(self.bias, motion.i_T_j.rotation().unrotate(self.earth))


class Intervals(NamedTuple):
    """Intervals of time to integrate over, n of them."""

    start_ns: Ints
    end_ns: Ints
    known_ns: Ints
    """Only rows that are known at this instant are used."""
    longest_ns: int
    """Longest time between Doppler samples: over intervals with a longer one everything is NaN."""


SIZE = 20
"""Rows of the sums of one interval, each a vector of three: R (3), p, impulse, then three rows each of the blocks
tt, rt and rr of C_i (rotation, lower left, translation) and of the two blocks of D_i."""
P = 3
IMPULSE = 4
TT = 5
RT = 8
RR = 11
D_T = 14
D_R = 17


def no_steps(n: int) -> Floats:
    """Sums of n intervals before their first step, shape (n, 20, 3)."""
    sums = np.zeros((n, SIZE, 3))
    sums[:, 0, 0] = 1.0
    sums[:, 1, 1] = 1.0
    sums[:, 2, 2] = 1.0
    return sums


START = no_steps(1)


def add_to(
    sums: Floats,
    rows: Rows,
    intervals: Intervals,
    sensors: Sensors,
    removed: Removed,
    *,
    are_chained: bool = False,
) -> tuple[Floats, Floats]:
    """Add the steps of intervals to their sums, shape (n, 20, 3); returns covariances and derivatives by the bias.

    ``are_chained``: each interval continues the sums of the one before it.
    """
    n = len(sums)
    C = np.empty((n, 6, 6))
    D = np.empty((n, 6, 3))
    constants = (sensors.body_p_dvl, *removed)
    found = (sums.reshape(-1, 3), C, D)
    add_steps(rows, intervals, sensors.gyro_density, constants, found, are_chained)
    return C, D


def motions_over(
    rows: Rows, intervals: Intervals, sensors: Sensors, removed: Removed
) -> Motions:
    """Motions over intervals, each from its own known rows."""
    sums = no_steps(len(intervals.start_ns))
    C, D = add_to(sums, rows, intervals, sensors, removed)
    # numba compiles another version for arrays that are views
    dR = np.ascontiguousarray(sums[:, :3])
    dp = np.ascontiguousarray(sums[:, P])
    impulse = np.ascontiguousarray(sums[:, IMPULSE])
    return Motions(dR, dp, C, D, impulse)


class Stretch(NamedTuple):
    """Sums of the steps from one instant to another, to be continued, and the motion before them."""

    start_ns: int
    until_ns: int
    bias: Floats
    """Gyro bias that is removed, shape (3,), rad/s."""
    before: PreintegratedMotion | None
    """Motion until the start of the sums; None for a motion that begins there."""
    sums: Floats
    """Shape (1, 20, 3)."""
    C: Floats
    """Covariance over the sums, shape (6, 6)."""
    D: Floats
    """Derivative by the bias over the sums, shape (6, 3)."""

    @classmethod
    def begin(
        cls, start_ns: int, bias: Floats, before: PreintegratedMotion | None = None
    ) -> Stretch:
        """A stretch without steps."""
        return cls(
            start_ns, start_ns, bias, before, START, np.zeros((6, 6)), np.zeros((6, 3))
        )

    def continued(
        self,
        rows: Rows,
        sensors: Sensors,
        removed: Removed,
        ends_ns: list[int],
    ) -> list[Stretch]:
        """The stretch until each of later instants, in order.

        Velocities are linear or held however far apart the samples are: gaps are for the caller to find.
        """
        n = len(ends_ns)
        intervals = Intervals(
            np.array([self.until_ns, *ends_ns[:-1]]),
            np.array(ends_ns),
            np.array([LATEST_NS] * n),
            LATEST_NS,
        )
        sums = np.empty((n, SIZE, 3))
        sums[0] = self.sums[0]
        # the Earth's rotation is known in the frame where the motion begins
        here = removed.after(self.before)
        C, D = add_to(sums, rows, intervals, sensors, here, are_chained=True)
        return [
            self._replace(until_ns=end_ns, sums=sums[k : k + 1], C=C[k], D=D[k])
            for k, end_ns in enumerate(ends_ns)
        ]

    @property
    def motion(self) -> PreintegratedMotion:
        """The motion before the sums and over them."""
        sums = self.sums[0]
        i_T_j = gtsam.Pose3(gtsam.Rot3(sums[:3]), sums[P])
        T = (self.until_ns - self.start_ns) * 1e-9
        # over no time there is no mean
        mean_force = sums[IMPULSE] / T if T > 0 else np.full(3, np.nan)
        motion = PreintegratedMotion(i_T_j, self.C, self.D, self.bias, T, mean_force)
        return motion if self.before is None else self.before.then(motion)


def motion_over(
    rows: Rows, sensors: Sensors, removed: Removed, start_ns: int, end_ns: int
) -> PreintegratedMotion:
    """Motion between two instants by linear or held velocities, however far apart the samples are."""
    return (
        Stretch.begin(start_ns, removed.bias)
        .continued(rows, sensors, removed, [end_ns])[0]
        .motion
    )


class Step(NamedTuple):
    """Measured motion between two successive stamps; no bias is removed."""

    until_ns: int
    dt: float
    """Seconds."""
    w: Vec3
    """rad/s."""
    v: Vec3
    """Velocity of the DVL's origin, body axes, m/s."""
    Q: Mat3
    """Spectral density of its noise, m²/s."""
    force: Vec3
    """Specific force, m/s²; NaN where not measured."""


class ImuHole(NamedTuple):
    """A hole of the IMU, or a stretch without one."""

    until_ns: int
    turn_psd: Vec3
    """Spectral density of the turn that the rates miss, rad²/s; zero without a hole."""
    unfelt: Vec3
    """NaN where the specific force is not to be used, else zero."""


NOWHERE = Vec3(np.nan, np.nan, np.nan)


@compiled
def add_steps(
    rows: Rows,
    intervals: Intervals,
    gyro_density: float,
    constants: tuple[Floats, Floats, Floats],
    found: tuple[Floats, Floats, Floats],
    are_chained: bool,
) -> None:
    """Add steps to the sums of n intervals, shape (20 n, 3), and fill in C, shape (n, 6, 6), and D, (n, 6, 3).

    ``constants`` are ``body_p_dvl``, and bias and Earth's rotation of `Removed`. Arrays that are returned cost microseconds.
    """
    body_p_dvl, bias, earth = constants
    sums, C, D = found
    n = len(intervals.start_ns)
    b = vec(bias)
    E = vec(earth)
    lever = vec(body_p_dvl)
    n2 = gyro_density**2 * I3
    for e in range(n):
        t = intervals.start_ns[e]
        end = intervals.end_ns[e]
        known = intervals.known_ns[e]
        i = rows_until(rows.imu_ns, t)
        k = rows_until(rows.dvl_ns, t)
        imu_rows = rows_until(rows.imu_ns, known)
        dvl_rows = max(rows_until(rows.known_ns, known), 1)
        at = SIZE * e
        since = at - SIZE if are_chained and e > 0 else at
        R = mat(sums, (since, 0))
        p = row_of(sums, since + P)
        impulse = row_of(sums, since + IMPULSE)
        tt = mat(sums, (since + TT, 0))
        rt = mat(sums, (since + RT, 0))
        rr = mat(sums, (since + RR, 0))
        D_t = mat(sums, (since + D_T, 0))
        D_r = mat(sums, (since + D_R, 0))
        # NaN marks the interval for the caller, who bridges the gap
        if has_gap(rows.dvl_ns, dvl_rows, k, t, end, intervals.longest_ns):
            t = end
            R = np.nan * I3
            p = NOWHERE
            impulse = NOWHERE
        while t < end:
            # a call inside the loop over steps would make it twice as slow: holes are looked up outside of it
            hole = hole_from(rows, imu_rows, dvl_rows, i, k, t, end)
            impulse += hole.unfelt
            is_hole = hole.turn_psd @ hole.turn_psd > 0.0
            while t < hole.until_ns:
                step = step_from(rows, imu_rows, dvl_rows, i, k, t, hole.until_ns)
                t = step.until_ns
                dt = step.dt
                i += int(i < imu_rows and rows.imu_ns[i] <= t)
                k += int(k < dvl_rows and rows.dvl_ns[k] <= t)
                w_k = step.w - b - R.T @ E  # (2)
                turn, mean = exp_and_mean(dt * w_k)
                R_k = R @ mean  # (3)
                s = dt * (R_k @ (step.v - cross(w_k, lever)))  # (4)
                c = skew(p + 0.5 * s + R_k @ lever)  # (7)
                # (8) in blocks; N = n2 commutes with R_k
                tt += dt * n2
                rt += dt * (c @ n2)
                rr += dt * (R_k @ step.Q @ R_k.T - c @ n2 @ c)
                if is_hole:
                    N = R_k @ diagonal(hole.turn_psd) @ R_k.T
                    tt += dt * N
                    rt += dt * (c @ N)
                    rr -= dt * (c @ N @ c)
                D_t -= dt * R_k
                D_r -= dt * (c @ R_k)
                impulse += dt * (R_k @ step.force)
                p += s  # (5)
                R = R @ turn  # (6)
        store(R, sums, (at, 0))
        store_vector(p, sums[at + P], 0)
        store_vector(impulse, sums[at + IMPULSE], 0)
        store(tt, sums, (at + TT, 0))
        store(rt, sums, (at + RT, 0))
        store(rr, sums, (at + RR, 0))
        store(D_t, sums, (at + D_T, 0))
        store(D_r, sums, (at + D_R, 0))
        to_j = Mat6(R.T, O3, -1.0 * (R.T @ skew(p)), R.T)  # Ad of the inverse of (R, p)
        store6(to_j @ Mat6(tt, rt.T, rt, rr) @ to_j.T, C[e])
        store(to_j.a @ D_t, D[e])
        store(to_j.c @ D_t + to_j.d @ D_r, D[e], LOWER_LEFT)


@inlined
def step_from(
    rows: Rows, imu_rows: int, dvl_rows: int, i: int, k: int, t: int, end_ns: int
) -> Step:
    """Step from t to the next stamp or the end, by the first rows of each sensor; rows i and k follow t."""
    # cut at the next stamp of either sensor
    until = end_ns
    if i < imu_rows:
        until = min(until, rows.imu_ns[i])
    if k < dvl_rows:
        until = min(until, rows.dvl_ns[k])
    middle = t + (until - t) // 2
    # past the last row its own noise holds, and the interval before it
    last = min(k, dvl_rows - 1)
    other = last if rows.hold_past or k >= dvl_rows or last == 0 else last - 1
    interval_s = (rows.dvl_ns[last] - rows.dvl_ns[last - 1]) * 1e-9 if last > 0 else 0.0
    return Step(
        until,
        (until - t) * 1e-9,
        value_at(rows.imu_ns, rows.rate, imu_rows, i, middle, rows.hold_past),
        value_at(rows.dvl_ns, rows.velocity, dvl_rows, k, middle, rows.hold_past),
        interval_s * (0.5 * (covariance(rows.cov, last) + covariance(rows.cov, other))),
        value_at(rows.imu_ns, rows.force, imu_rows, i, middle, rows.hold_past),
    )


@inlined
def value_at(
    stamps: Ints, values: Floats, n: int, i: int, t: int, hold_past: bool
) -> Vec3:
    """Value at t from the first n rows, where ``stamps[i - 1] < t <= stamps[i]``; outside them the nearest row's."""
    if i >= n:
        return row_of(values, n - 1)
    if hold_past or i == 0:
        return row_of(values, i)
    before = row_of(values, i - 1)
    share = (t - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
    return before + share * (row_of(values, i) - before)


@compilable
def hole_from(
    rows: Rows, imu_rows: int, dvl_rows: int, i: int, k: int, t: int, end_ns: int
) -> ImuHole:
    """The hole at t until its end (an open one: until the next stamp), or the stretch until the next hole.

    i and k are the first rows after t.
    """
    imu_ns = rows.imu_ns
    if not rows.turns.is_modelled:
        return ImuHole(end_ns, ZERO, ZERO)
    # an open hole grows from DVL stamp to DVL stamp, so that cutting at them changes nothing
    until = end_ns
    if i < imu_rows:
        until = min(until, imu_ns[i])
    elif k < dvl_rows:
        until = min(until, rows.dvl_ns[k])
    length_ns = hole_ns(imu_ns, imu_rows, i, until)
    if length_ns > 0:
        unfelt = NOWHERE if length_ns > UNFELT_NS else ZERO
        return ImuHole(
            until, error_in_hole(rows.turns, imu_ns, imu_rows, i, t, until), unfelt
        )
    # no hole before the next interval that is long enough to be one
    while (
        i + 1 < imu_rows
        and imu_ns[i] < end_ns
        and imu_ns[i + 1] - imu_ns[i] <= SHORTEST_NS
    ):
        i += 1
    return ImuHole(min(end_ns, imu_ns[i]) if i < imu_rows else until, ZERO, ZERO)


@inlined
def has_gap(
    dvl_ns: Ints, n: int, k: int, start_ns: int, end_ns: int, longest_ns: int
) -> bool:
    """True where an interval has a longer time without any of the first n DVL rows; row k is its first."""
    while k < n and dvl_ns[k] < end_ns:
        if dvl_ns[k] - start_ns > longest_ns:
            return True
        start_ns = dvl_ns[k]
        k += 1
    return end_ns - start_ns > longest_ns


@inlined
def rows_until(stamps: Ints, instant_ns: int) -> int:
    """Number of rows stamped at or before an instant (numpy's search with a side is slow to compile)."""
    low = 0
    high = len(stamps)
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] <= instant_ns:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def covariance(A: Floats, k: int) -> Mat3:
    """Matrix k of an array of shape (n, 3, 3)."""
    return Mat3(
        Vec3(A[k, 0, 0], A[k, 0, 1], A[k, 0, 2]),
        Vec3(A[k, 1, 0], A[k, 1, 1], A[k, 1, 2]),
        Vec3(A[k, 2, 0], A[k, 2, 1], A[k, 2, 2]),
    )
