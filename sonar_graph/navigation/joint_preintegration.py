"""Joint preintegration of gyro, accelerometer and Doppler log between two keyframes.

From body frame i to body frame j, t seconds later, with world gravity g, a the IMU's point and d the Doppler log's::

    R = i_R_j                                           rotation
    v = i_R_world (v_a,j - v_a,i - g t)                 velocity that the accelerometer gained
    p = i_R_world (a_j - a_i - v_a,i t - g t^2 / 2)     position that it gained
    s = i_R_world (d_j - d_i)                           displacement by the Doppler log

with one covariance of all twelve errors; each measurement enters once. With the rule "inertial" the accelerometer
shapes s between the Doppler samples, also over long intervals, where samples are taken to the IMU's point by the gyros,
``z - w x l``, and the log's way about it, ``(R_j - R_i) l``, is added. All other rules refuse long intervals, and all
refuse holes of the IMU. After Forster et al., TRO 2017, section VI. docs/theory/preintegration.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal, NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import SHORTEST_HOLE_S, Calibration
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation.imu_gaps import UNTURNED, row_after_hole
from sonar_graph.navigation.inertial import Line, hat, spread, sums_along
from sonar_graph.navigation.samples import (
    finite_vector,
    is_partial,
    no_doppler_stamp,
    require_covariances,
    require_distinct_stamps,
    require_nanoseconds,
    require_noise,
    require_order,
)
from sonar_graph.navigation.steps import Rows

DopplerRule = Literal["inertial", "linear", "hold-previous", "zoh-previous", "zoh-current", "trapezoid"]


class Rule(NamedTuple):
    """Velocity between two Doppler samples where the accelerometer does not shape it."""

    shares: tuple[float, float]
    """The later sample's share at the beginning of the interval and at its end."""
    turned_at: float | None = None
    """Rotation that turns the velocity, as a share of the interval; None: that of every step."""


RULES: dict[DopplerRule, Rule | None] = {
    "inertial": None,
    "linear": Rule((0.0, 1.0)),
    "hold-previous": Rule((0.0, 0.0)),
    "zoh-previous": Rule((0.0, 0.0), turned_at=0.5),
    "zoh-current": Rule((1.0, 1.0), turned_at=1.0),
    "trapezoid": Rule((0.5, 0.5), turned_at=0.5),
}
"""Others than "inertial" and "linear" are those of other projects, for comparison (docs/theory/preintegration.md)."""
LONG_S = 0.4
"""Interval of Doppler samples above which "inertial" takes the log's way about the IMU's point from the gyros."""


ROTATION, VELOCITY, POSITION, DISPLACEMENT = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""Rows of a covariance and of derivatives."""
GYRO, ACCEL, SCALE, MOUNTING = slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 10)
"""Columns of derivatives."""


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Motion from body frame i to body frame j, with a Doppler sample at either end; made by `JointPreintegrator`.

    Errors are ``[theta, dv, dp, ds]``: theta in frame j (``R Exp(theta)``), the others added in frame i. Where the
    specific force was not measured, velocity, position, and their covariances and derivatives are NaN.

    Examples
    --------
    A gyro bias that is known later, to first order:

    >>> import numpy as np
    >>> from sonar_graph.measurements import Dvl, Imu
    >>> from sonar_graph.navigation import JointPreintegrator
    >>> imu_ns, dvl_ns = np.arange(201) * 5_000_000, np.arange(6) * 200_000_000
    >>> imu = Imu(imu_ns, np.zeros((201, 3)), np.tile([0.0, 0.0, 9.81], (201, 1)))
    >>> dvl = Dvl(dvl_ns, np.tile([0.5, 0.0, 0.0], (6, 1)), np.full((6, 3, 3), np.nan))
    >>> sensors = JointPreintegrator(gyro_noise_density=1e-4, accel_noise_density=1e-3)
    >>> motion = sensors.integrate(imu, dvl, 0, 1_000_000_000)
    >>> change = np.zeros(10)
    >>> change[2] = 0.01
    >>> round(motion.corrected(change).i_R_j.yaw(), 4)
    -0.01
    """

    i_R_j: gtsam.Rot3
    velocity: Floats
    """v, shape (3,), m/s."""
    position: Floats
    """p, shape (3,), m."""
    displacement: Floats
    """s, shape (3,), m."""
    inner_covariance: Floats
    """Shape (12, 12), without the noise of the two Doppler samples at the ends."""
    D_parameters: Floats
    """Derivatives of the errors by gyro bias, accelerometer bias, scale and mounting, shape (12, 10)."""
    end_weights: tuple[Floats, Floats]
    """Derivative of s by the velocity (body axes) of the first and of the last Doppler sample, shape (3, 3), s."""
    end_covariances: tuple[Floats, Floats]
    """Covariances of these two samples, shape (3, 3), m²/s²."""
    shared_covariance: Floats
    """Added to that of s where the first sample is shared with the motion before, shape (3, 3), m²; see `after`."""
    bias: Floats
    """Gyro and accelerometer bias that were removed, body axes, shape (6,), rad/s and m/s²."""
    start_ns: int
    """Stamp of the first Doppler sample."""
    end_ns: int
    """Stamp of the last."""
    body_p_imu: Floats
    """Shape (3,), m."""
    body_p_dvl: Floats
    """Shape (3,), m."""

    @property
    def duration_s(self) -> float:
        """Time from the first to the last Doppler sample."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def covariance(self) -> Floats:
        """Covariance of the errors, shape (12, 12)."""
        P = self.inner_covariance.copy()
        for W, Q in zip(self.end_weights, self.end_covariances, strict=True):
            P[DISPLACEMENT, DISPLACEMENT] += W @ Q @ W.T
        P[DISPLACEMENT, DISPLACEMENT] += self.shared_covariance
        return P

    def after(self, before: JointMotion) -> JointMotion:
        """The same motion in a chain, after the one before.

        Both hold the Doppler sample between them, so that their errors are correlated. Adding all of that to the later
        one, ``C + C^T`` with ``C = R^T W_last Q W_first^T``, lets a graph take them as independent: the covariance of
        the chain's displacement is then that of the samples with their weights, wherever it is cut.

        Raises
        ------
        MeasurementError
            When the motion before does not end where this one begins.
        """
        if before.end_ns != self.start_ns:
            raise MeasurementError(
                f"before: ends at {before.end_ns} ns, this motion begins at {self.start_ns} ns; expected the motion"
                " that ends with the Doppler sample with which this one begins: later.after(earlier)"
            )
        C = before.i_R_j.matrix().T @ before.end_weights[1] @ self.end_covariances[0] @ self.end_weights[0].T
        return replace(self, shared_covariance=C + C.T)

    def corrected(self, change: Floats) -> JointMotion:
        """The motion for other gyro bias, accelerometer bias, scale and mounting, by a change (10,) to first order."""
        error = self.D_parameters @ finite_vector("change", change, 10)
        return replace(
            self,
            i_R_j=self.i_R_j.compose(gtsam.Rot3.Expmap(error[ROTATION])),
            velocity=self.velocity + error[VELOCITY],
            position=self.position + error[POSITION],
            displacement=self.displacement + error[DISPLACEMENT],
            bias=self.bias + change[:6],
        )

    def relative_pose(self, accel_bias_sigma: float = 0.0) -> PreintegratedMotion:
        """Rotation and Doppler displacement alone, as the body's relative pose: the origin moves by ``s - (R - I) d``.

        Parameters
        ----------
        accel_bias_sigma
            Sigma of the accelerometers' bias on each axis, m/s², counted in the covariance. With the rule "inertial"
            the bias moves s by the cube of the time between Doppler samples; with the others not at all.
        """
        R, arm = self.i_R_j.matrix(), self.body_p_dvl
        translation = self.displacement - R @ arm + arm
        J = np.zeros((6, 12))
        J[:3, ROTATION], J[3:, ROTATION] = np.eye(3), gtsam.SO3.Hat(arm)
        J[3:, DISPLACEMENT] = R.T
        used = np.r_[ROTATION, DISPLACEMENT]
        by_bias = J[:, used] @ self.D_parameters[used, ACCEL] * accel_bias_sigma
        cov = J[:, used] @ self.covariance[np.ix_(used, used)] @ J[:, used].T + by_bias @ by_bias.T
        D = J[:, used] @ self.D_parameters[used, GYRO]
        pose = gtsam.Pose3(self.i_R_j, translation)
        return PreintegratedMotion(pose, cov, D, self.bias[:3], self.duration_s, self.velocity / self.duration_s)


@dataclass(frozen=True, eq=False)
class JointPreintegrator:
    """Joint preintegration of IMU and Doppler log, for one set of sensors.

    Raises
    ------
    CalibrationError
        When a number is negative or not finite, or a mounting or the rule is of another kind.

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.measurements import Dvl, Imu
    >>> from sonar_graph.navigation import JointPreintegrator
    >>> imu_ns, dvl_ns = np.arange(401) * 5_000_000, np.arange(11) * 200_000_000
    >>> imu = Imu(imu_ns, np.zeros((401, 3)), np.tile([0.0, 0.0, 9.81], (401, 1)))
    >>> dvl = Dvl(dvl_ns, np.tile([0.5, 0.0, 0.0], (11, 1)), np.full((11, 3, 3), np.nan))
    >>> sensors = JointPreintegrator(gyro_noise_density=1e-4, accel_noise_density=1e-3)
    >>> first = sensors.integrate(imu, dvl, 0, 1_000_000_000)
    >>> second = sensors.integrate(imu, dvl, 1_000_000_000, 2_000_000_000).after(first)
    >>> round(float(second.displacement[0]), 6), round(float(second.relative_pose().i_T_j.x()), 6)
    (0.5, 0.5)
    """

    gyro_noise_density: float
    """rad/s/√Hz."""
    accel_noise_density: float
    """m/s²/√Hz."""
    velocity_sigma_m_s: tuple[float, float, float] = (0.01, 0.01, 0.01)
    """Noise of a Doppler sample along the log's axes, where its covariance is NaN."""
    body_T_imu: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    body_T_dvl: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    rule: DopplerRule = "inertial"
    """Velocity between samples: a name of `RULES`."""
    longest_s: float = 1.5
    """Longest interval between Doppler samples, for all rules but "inertial"."""
    longest_hole_s: float = SHORTEST_HOLE_S
    """Longest interval between inertial rows, or five typical ones if that is longer: no turn is measured in it."""

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise CalibrationError(f"rule: there is no {self.rule!r}; there are {', '.join(RULES)}")
        for name in ("gyro_noise_density", "accel_noise_density", "velocity_sigma_m_s", "longest_s", "longest_hole_s"):
            require_noise(name, getattr(self, name), 3 if name == "velocity_sigma_m_s" else 1)
        for name, mounting in (("body_T_imu", self.body_T_imu), ("body_T_dvl", self.body_T_dvl)):
            if not isinstance(mounting, gtsam.Pose3):
                raise CalibrationError(f"{name}: expected a gtsam.Pose3, not {type(mounting).__name__}")

    @classmethod
    def from_calibration(cls, calibration: Calibration, rule: DopplerRule = "inertial") -> JointPreintegrator:
        """Pick the numbers from a calibration.

        ``earth_rate_latitude_rad`` is not among them: the Earth's rotation in body frame i depends on the attitude
        there, so `integrate` takes it anew, ``world_T_i.rotation().unrotate(earth_rate_in_world(calibration))``.
        """
        imu, dvl = calibration.imu, calibration.dvl
        noise = imu.gyro_noise_density, imu.accel_noise_density, dvl.velocity_sigma_m_s
        return cls(*noise, imu.mounting.pose(), dvl.mounting.pose(), rule, dvl.gap_s)

    def integrate(
        self,
        imu: Imu,
        dvl: Dvl,
        start_ns: int,
        end_ns: int,
        bias: Floats | None = None,
        earth_rate: Floats | None = None,
    ) -> JointMotion:
        """Motion between the stamps of two Doppler samples.

        Parameters
        ----------
        imu, dvl
            Rows that hold the interval; longer blocks cost nothing.
        start_ns, end_ns
            Stamps of rows of ``dvl``.
        bias
            Gyro and accelerometer bias in body axes to remove, shape (6,), rad/s and m/s²; None: zero.
        earth_rate
            Earth's rotation in body frame i, shape (3,), rad/s; None: not removed.

        Raises
        ------
        MeasurementError
            When an end is no Doppler stamp, the inertial rows do not reach both ends or have a hole, stamps repeat, a
            Doppler row in between leaves a direction unmeasured or has no possible covariance, Doppler samples are too
            far apart for the rule, it needs a specific force that was not measured, or bias or Earth rate are not of
            their shapes.
        """
        if not (isinstance(imu, Imu) and isinstance(dvl, Dvl)):
            raise MeasurementError(f"imu, dvl: expected Imu and Dvl, not {type(imu).__name__} and {type(dvl).__name__}")
        require_order(start_ns, end_ns)
        samples = doppler_rows_between(dvl, start_ns, end_ns)
        inertial = imu_rows_around(imu, start_ns, end_ns, self.longest_hole_s)
        body_R_imu, body_R_dvl = self.body_T_imu.rotation().matrix(), self.body_T_dvl.rotation().matrix()
        cov, unsaid = samples.velocity_cov, np.isnan(samples.velocity_cov)
        if unsaid.any():
            cov = np.where(unsaid, np.diag(np.square(self.velocity_sigma_m_s)), cov)
        require_covariances("Dvl.velocity_cov", cov, samples.stamps_ns)
        velocity, cov = samples.velocity @ body_R_dvl.T, body_R_dvl @ cov @ body_R_dvl.T
        arms = self.body_T_imu.translation(), self.body_T_dvl.translation()
        arm, between_ns = arms[1] - arms[0], np.diff(samples.stamps_ns)
        if self.rule == "inertial":
            # Of z - w x l at the ends of long intervals: more by n_g^2 / dt [l]x [l]x^T, dt the mean IMU interval.
            is_long, imu_ns = between_ns > LONG_S * 1e9, inertial.stamps_ns
            at_end = np.append(False, is_long) | np.append(is_long, False)
            turned = self.gyro_noise_density * gtsam.SO3.Hat(arm)
            cov[at_end] += (len(imu_ns) - 1) * 1e9 / (imu_ns[-1] - imu_ns[0]) * turned @ turned.T
        else:
            k = int(between_ns.argmax())
            if between_ns[k] > self.longest_s * 1e9:
                raise MeasurementError(
                    f"Dvl.stamps_ns: no row for {between_ns[k] * 1e-9:.3g} s after {samples.stamps_ns[k]} ns, more than"
                    f' longest_s ({self.longest_s:g} s); use the rule "inertial", or let'
                    " sonar_graph.navigation.odometry.Odometry bridge it"
                )
        bias = np.zeros(6) if bias is None else finite_vector("bias", bias, 6)
        earth = np.zeros(3) if earth_rate is None else finite_vector("earth_rate", earth_rate, 3)
        force = inertial.specific_force @ body_R_imu.T
        if self.rule == "inertial" and not np.isfinite(force).all():
            raise MeasurementError('Imu.specific_force: not measured in every row; use the rule "linear"')
        rate, at_ns = inertial.angular_velocity @ body_R_imu.T, samples.stamps_ns
        rows = Rows(inertial.stamps_ns, rate, force - bias[3:], at_ns, velocity, cov, at_ns, False, UNTURNED)
        with np.errstate(over="ignore", invalid="ignore"):
            R, (v, p, s), P, D, first, last = self._integrated(rows, bias[:3], earth, arm)
        if not isfinite(sum(s.tolist()) + P.item(9, 9) + P.item(10, 10) + P.item(11, 11)):
            raise MeasurementError(
                f"from {start_ns} to {end_ns} ns: the motion is not finite; expected angular velocities in rad/s and"
                " velocities in m/s that are not beyond all bounds"
            )
        ends, span = (cov[0], cov[-1]), (int(start_ns), int(end_ns))
        return JointMotion(gtsam.Rot3(R), v, p, s, P, D, (first, last), ends, np.zeros((3, 3)), bias, *span, *arms)

    def _integrated(
        self, rows: Rows, bias: Floats, earth: Floats, arm: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """R, sums (v, p, s), covariance without the end samples, derivatives, and weights of both end samples."""
        rule, at_ns, z, n = RULES[self.rule], rows.dvl_ns, rows.velocity, len(rows.dvl_ns) - 1
        spans_s, T, cuts_ns = np.diff(at_ns) * 1e-9, (at_ns[-1] - at_ns[0]) * 1e-9, at_ns
        W, jumps, velocity, by_rate_s = np.zeros(n), np.zeros((n + 1, 3)), np.zeros((2, n, 3)), np.zeros(n + 1)
        if rule is None:
            past_s, next_s = np.append(0.0, spans_s), np.append(spans_s, 0.0)
            w, is_long = 0.5 * (past_s + next_s), (past_s > LONG_S, next_s > LONG_S)
            W, jumps = np.cumsum(w)[:-1], w[:, None] * z
            if is_long[0].any():
                by_rate_s = 0.5 * (past_s * is_long[0] + next_s * is_long[1])
                rate = np.column_stack([np.interp(at_ns, rows.imu_ns, column) for column in rows.rate.T]) - bias
                jumps += np.subtract(*is_long, dtype=float)[:, None] * arm - by_rate_s[:, None] * np.cross(rate, arm)
        else:
            velocity = np.array([z[:-1] + share * np.diff(z, axis=0) for share in rule.shares])
        if rule is not None and rule.turned_at is not None:
            turned_ns = at_ns[:-1] + np.floor(rule.turned_at * np.diff(at_ns)).astype(np.int64)
            cuts_ns = np.unique(np.append(at_ns, turned_ns))
            turned = np.searchsorted(cuts_ns, turned_ns)
            jumps = np.zeros((len(cuts_ns), 3))
            jumps[turned] = spans_s[:, None] * velocity[0]
            W, velocity = np.zeros(len(cuts_ns) - 1), np.zeros((2, len(cuts_ns) - 1, 3))
        line = Line(cuts_ns, rule is None, W, jumps, velocity[0], velocity[1], int(at_ns[0]))
        sums = sums_along(rows, len(rows.imu_ns), line, np.eye(3), bias, earth)
        R, errors = sums.R[-1], spread(sums, sums.whole, T, self.gyro_noise_density, self.accel_noise_density)
        if rule is None:
            weights = w[:, None, None] * sums.R
            if by_rate_s.any():
                swung_s = np.tensordot(by_rate_s, sums.R, 1)
                sums.whole[6:] += np.cross(earth, swung_s @ arm)
                errors.D_gyro[6:] -= swung_s @ hat(arm)
        else:
            if rule.turned_at is None:
                whole, rising = sums.turned_s.sum(axis=0), sums.turned_s[1]
            else:
                whole = rising = spans_s[:, None, None] * sums.R[turned]
            later = rule.shares[0] * whole + (rule.shares[1] - rule.shares[0]) * rising
            none = np.zeros((1, 3, 3))
            weights = np.concatenate([whole - later, none]) + np.concatenate([none, later])
        P, D = np.empty((12, 12)), np.zeros((12, 10))
        P[:3, :3], P[3:, :3], P[3:, 3:] = self.gyro_noise_density**2 * T * np.eye(3), errors.C_theta @ R, errors.C
        P[:3, 3:] = P[3:, :3].T
        inner = weights[1:-1]
        P[9:, 9:] += np.sum(inner @ rows.cov[1:-1] @ inner.transpose(0, 2, 1), axis=0)
        D[:3, GYRO], D[3:, GYRO], D[3:, ACCEL] = -R.T @ sums.R_after, errors.D_gyro, errors.D_accel
        D[9:, 6] = np.einsum("kij,kj->i", weights, z)
        D[9:, MOUNTING] = -np.sum(weights @ hat(z), axis=0)
        return R, sums.whole.reshape(3, 3), P, D, weights[0], weights[-1]


def doppler_rows_between(dvl: Dvl, start_ns: int, end_ns: int) -> Dvl:
    """Doppler rows from one stamp to another; raises MeasurementError where they cannot be used."""
    first, last = (int(row) for row in np.searchsorted(dvl.stamps_ns, [start_ns, end_ns]))
    if last == len(dvl) or dvl.stamps_ns[last] != end_ns:
        raise no_doppler_stamp("end_ns", end_ns, dvl.stamps_ns)
    if dvl.stamps_ns[first] != start_ns:
        raise no_doppler_stamp("start_ns", start_ns, dvl.stamps_ns)
    require_distinct_stamps("Dvl", dvl.stamps_ns, first, last)
    samples = dvl.rows(slice(first, last + 1))
    partial = is_partial(samples.velocity_cov)
    if partial.any():
        raise MeasurementError(
            f"Dvl.velocity_cov: the row at {samples.stamps_ns[np.argmax(partial)]} ns leaves a direction unmeasured"
            " (one or two beams); leave such rows out, or let sonar_graph.navigation.odometry.Odometry complete them"
        )
    return samples


def imu_rows_around(imu: Imu, start_ns: int, end_ns: int, longest_hole_s: float) -> Imu:
    """IMU rows from the last at or before the start to the first at or after the end; raises MeasurementError."""
    require_nanoseconds("Imu", imu.stamps_ns)
    first = int(np.searchsorted(imu.stamps_ns, start_ns, side="right")) - 1
    last = int(np.searchsorted(imu.stamps_ns, end_ns))
    if first < 0 or last == len(imu):
        raise MeasurementError(
            f"Imu.stamps_ns: rows from {imu.stamps_ns[0]} to {imu.stamps_ns[-1]} ns do not reach from {start_ns} to"
            f" {end_ns} ns; begin and end at Doppler samples within them"
        )
    require_distinct_stamps("Imu", imu.stamps_ns, first, last)
    row, imu_ns = row_after_hole(imu.stamps_ns, first, last, round(longest_hole_s * 1e9)), imu.stamps_ns
    if row >= 0:
        raise MeasurementError(
            f"Imu.stamps_ns: no row for {(imu_ns[row] - imu_ns[row - 1]) * 1e-9:.3g} s after {imu_ns[row - 1]} ns: the"
            " turn in there is not measured; begin a motion after it, let sonar_graph.navigation.odometry.Odometry"
            f" bridge it, or set longest_hole_s ({longest_hole_s:g} s) higher if the vehicle hardly turns"
        )
    return imu.rows(slice(first, last + 1))
