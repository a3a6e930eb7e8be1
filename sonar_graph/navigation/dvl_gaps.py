"""Motion while the Doppler log has no bottom lock, carried by the accelerometers.

An interval between successive DVL rows is a gap where it is longer than the calibration's ``dvl.gap_s``. From epoch i,
the stamp of the row before the gap, with everything in frame i: the velocity of the IMU's point, less what the
accelerometers gain, is a straight line, whose slope is gravity. Doppler samples z_k at t_k measure points of it, and
weights w_k of their sum T give its integral over the gap. With W(t) the sum of the weights up to t::

    s = sum_k w_k R_k z_k + sum dt (W(t) - max(t, 0)) R f

Closed: the sample that ends the gap is known. The line joins both ends, ``w = T / 2`` each.

Open: nothing stamped later is known. The line is fitted by least squares to the n samples of the last `WINDOW_NS`
before the epoch: ``w_k = T (1 / n + (T / 2 - mean t) (t_k - mean t) / sum (t - mean t)^2)``.

Walk: where a specific force was not measured, or too little precedes the epoch, the velocity is a random walk of root
density q (m/s/√s) between its ends, ``q^2 T^3 / 12`` (closed), or from its last value on, ``q^2 T^3 / 3`` (open). An
open gap is a walk too once the accelerometers are less sure than that (`longest_open_s`).

docs/theory/gaps.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import NS_PER_S, Floats, Ints
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation.inertial import Line, hat, spread, sums_along
from sonar_graph.navigation.samples import LATEST_NS, WINDOW_NS, longest_interval_ns
from sonar_graph.navigation.steps import Rows
from sonar_graph.navigation.sums import START, motions_over

FEWEST, SHORTEST_S = 4, 1.0
"""Fewest samples of a line, and the shortest time that they span."""
ZERO = np.zeros(3)
LATEST = np.array([LATEST_NS])


class Sensors(NamedTuple):
    """Noise and places of the sensors."""

    longest_ns: int
    """Longest interval between Doppler samples that is no gap."""
    gyro_density: float
    accel_density: float
    accel_bias_sigma: float
    velocity_walk_density: float
    longest_open_s: float
    """Time since bottom lock after which the last velocity is worth more than accelerometers."""
    body_p_imu: Floats
    body_p_dvl: Floats

    @classmethod
    def of(cls, calibration: Calibration) -> Sensors:
        """Pick the numbers from a calibration."""
        imu, dvl = calibration.imu, calibration.dvl
        noise = imu.gyro_noise_density, imu.accel_noise_density, imu.accel_bias_sigma, dvl.velocity_walk_density
        places = np.array(imu.mounting.translation_m), np.array(dvl.mounting.translation_m)
        return cls(longest_interval_ns(calibration), *noise, longest_open_s(calibration), *places)


def longest_open_s(calibration: Calibration) -> float:
    """Time T after which an open gap's horizontal error by accelerometers exceeds that of the walk.

    ``n_a^2 T^3 / 3 + g^2 n_g^2 T^5 / 20 + b^2 T^4 / 4 = q^2 T^3 / 3``, of a vehicle that has turned since the slope of
    the line was measured, so that the accelerometer bias b counts in full; infinite for sensors without errors.
    """
    imu, q = calibration.imu, calibration.dvl.velocity_walk_density
    tilting, turned = (calibration.gravity_m_s2 * imu.gyro_noise_density) ** 2 / 20.0, imu.accel_bias_sigma**2 / 4.0
    more = max(q**2 - imu.accel_noise_density**2, 0.0) / 3.0
    root = turned + math.sqrt(turned**2 + 4.0 * tilting * more)
    return 2.0 * more / root if root > 0.0 else math.inf


class Stretch(NamedTuple):
    """Sums of the steps from one instant to another, as in `sonar_graph.navigation.sums`, to be continued."""

    start_ns: int
    until_ns: int
    sums: Floats = START


def motion_over(
    rows: Rows, sensors: Sensors, start_ns: int, end_ns: int, bias: Floats, earth: Floats = ZERO
) -> PreintegratedMotion:
    """Motion by linear or held velocities of all rows, however far apart the samples are."""
    return continued(Stretch(start_ns, start_ns), rows, sensors, end_ns, bias, earth)[1]


def continued(
    so_far: Stretch, rows: Rows, sensors: Sensors, end_ns: int, bias: Floats, earth: Floats
) -> tuple[Stretch, PreintegratedMotion]:
    """Sums continued to an instant, and the motion from their start; the Earth's rotation in the frame there."""
    from_, until, sums = np.array([so_far.until_ns]), np.array([end_ns]), so_far.sums.copy()
    noise = bias, earth, sensors.body_p_dvl, sensors.gyro_density
    dR, dp, C, D, impulse = motions_over(rows, from_, until, LATEST, LATEST_NS, *noise, sums)
    duration_s = (end_ns - so_far.start_ns) * 1e-9
    mean_force = impulse[0] / duration_s if duration_s > 0 else np.full(3, np.nan)
    motion = PreintegratedMotion(gtsam.Pose3(gtsam.Rot3(dR[0]), dp[0]), C[0], D[0], bias, duration_s, mean_force)
    return Stretch(so_far.start_ns, end_ns, sums), motion


def bridge(
    rows: Rows,
    sensors: Sensors,
    start_ns: int,
    end_ns: int,
    is_closed: bool,
    bias: Floats,
    earth: Floats = ZERO,
    asked_ns: int | None = None,
) -> PreintegratedMotion:
    """Motion over a gap from an epoch to the next one (closed), or to an instant before it (open).

    Used are rows known at the end, of a closed gap until an inertial row covers it. Removed are the gyro bias (body
    axes) and the Earth's rotation (frame i), rad/s. ``asked_ns``: end of the whole of which this is the first part,
    which decides whether it is a walk.
    """
    rows = rows if is_closed else rows.known(end_ns)
    dvl_ns, T = rows.dvl_ns, (end_ns - start_ns) * 1e-9
    k = int(np.searchsorted(dvl_ns, start_ns))
    if not is_closed and (dvl_ns[k + 1 : k + 2] - start_ns <= sensors.longest_ns).any():
        # Velocities go on, inertial rows are missing: by velocities as far as they go.
        last_ns = int(dvl_ns[-1])
        sampled = motion_over(rows, sensors, start_ns, last_ns, bias, earth)
        if last_ns == end_ns:
            return sampled
        return sampled.then(_walk(rows, sensors, last_ns, end_ns, bias, sampled.i_T_j.rotation().unrotate(earth)))
    if is_closed:
        before_s = (dvl_ns[k] - dvl_ns[k - 1]) * 1e-9 if k > 0 else 0.0
        after_s = before_s if before_s * 1e9 <= sensors.longest_ns else 0.0
        # Each end also ends or begins a neighbouring interval, of length d, and errors add up:
        # ((T + d) / 2)^2 = (T / 2)^2 (1 + 2 d / T) + (d / 2)^2, of which the last is the neighbour's own. The interval
        # after the gap is not known yet and taken as long as the one before. Of two successive gaps the later one
        # counts what they share.
        squares_s2 = 0.25 * T * (T + 2.0 * np.array([before_s, after_s]))
        motion = _inertial(rows, sensors, np.array([k, k + 1]), np.full(2, 0.5 * T), squares_s2, end_ns, bias, earth)
        if np.isfinite(motion.i_T_j.translation()).all():
            return motion
        doppler_psd = np.tensordot(squares_s2 / T, rows.cov[k : k + 2], 1)
        return _walk(rows, sensors, start_ns, end_ns, bias, earth, doppler_psd)
    if ((asked_ns or end_ns) - start_ns) * 1e-9 > sensors.longest_open_s:
        return _walk(rows, sensors, start_ns, end_ns, bias, earth)
    samples = np.arange(np.searchsorted(dvl_ns, max(start_ns - WINDOW_NS, rows.imu_ns[0])), k + 1)
    t = (dvl_ns[samples] - start_ns) * 1e-9
    if len(t) >= FEWEST and -t[0] >= SHORTEST_S:
        off = t - t.mean()
        weights_s = T * (1.0 / len(t) + (0.5 * T - t.mean()) * off / (off @ off))
        motion = _inertial(rows, sensors, samples, weights_s, weights_s**2, end_ns, bias, earth)
        if np.isfinite(motion.i_T_j.translation()).all():
            return motion
    return _walk(rows, sensors, start_ns, end_ns, bias, earth)


def _inertial(
    rows: Rows,
    sensors: Sensors,
    samples: Ints,
    weights_s: Floats,
    squares_s2: Floats,
    end_ns: int,
    bias: Floats,
    earth: Floats,
) -> PreintegratedMotion:
    """Motion by s of the module's equation; NaN where a specific force was not measured.

    Parameters
    ----------
    samples
        Doppler rows of the line: those until the epoch, or that at the epoch and that at the end.
    weights_s, squares_s2
        w_k, shape (n,), and by how much their noise counts, w_k² or more.
    """
    cuts_ns, jumps = rows.dvl_ns[samples], np.zeros((len(samples) + 1, 3))
    is_closed = cuts_ns[-1] == end_ns
    start_ns, imu_ns = int(cuts_ns[0 if is_closed else -1]), rows.imu_ns
    imu_rows = int(np.searchsorted(imu_ns, end_ns)) + 1 if is_closed else len(imu_ns)
    arm, turn = sensors.body_p_dvl - sensors.body_p_imu, np.eye(3)
    # The turn since the first sample, from which the Earth's rate, known at the epoch, is removed.
    for _ in range(0 if is_closed else 1 + 2 * bool(earth.any())):
        window = motion_over(rows, sensors, int(cuts_ns[0]), start_ns, bias, turn @ earth)
        turn = window.i_T_j.rotation().matrix()
    rate = np.column_stack([np.interp(cuts_ns, imu_ns[:imu_rows], column[:imu_rows]) for column in rows.rate.T])
    jumps[:-1] = weights_s[:, None] * (rows.velocity[samples] - np.cross(rate - bias, arm))
    still = np.zeros((len(samples), 3))
    if is_closed:
        line = Line(cuts_ns, True, weights_s[:1], jumps[:2], still[:1], still[:1], start_ns)
    else:
        line = Line(np.append(cuts_ns, end_ns), True, np.cumsum(weights_s), jumps, still, still, start_ns)
    sums = sums_along(rows, imu_rows, line, np.ascontiguousarray(turn.T), bias, earth)
    R, T = sums.R[-1], (end_ns - start_ns) * 1e-9
    v, _, s = sums.whole.reshape(3, 3)
    at_samples = sums.R[: len(samples)]
    swung_s = np.tensordot(weights_s, at_samples, 1)
    s, swung = s + np.cross(earth, swung_s @ arm), R @ sensors.body_p_imu
    errors = spread(sums, np.concatenate([v, v, s - swung]), T, sensors.gyro_density, sensors.accel_density)
    C, D, C_theta, D_accel = np.empty((6, 6)), np.empty((6, 3)), errors.C_theta[6:], errors.D_accel[6:]
    C[:3, :3], C[3:, :3], C[:3, 3:] = sensors.gyro_density**2 * T * np.eye(3), C_theta, C_theta.T
    C[3:, 3:] = errors.C[6:, 6:] + sensors.accel_bias_sigma**2 * D_accel @ D_accel.T
    C[3:, 3:] += np.tensordot(squares_s2, at_samples @ rows.cov[samples] @ at_samples.transpose(0, 2, 1), 1)
    D[:3], D[3:] = -sums.R_after, errors.D_gyro[6:] - swung_s @ hat(arm)
    to_j = np.kron(np.eye(2), R.T)
    C = to_j @ C @ to_j.T
    i_T_j = gtsam.Pose3(gtsam.Rot3(R), s - swung + sensors.body_p_imu)
    return PreintegratedMotion(i_T_j, 0.5 * (C + C.T), to_j @ D, bias, T, v / T)


def _walk(
    rows: Rows,
    sensors: Sensors,
    start_ns: int,
    end_ns: int,
    bias: Floats,
    earth: Floats,
    doppler_psd: Floats | None = None,
) -> PreintegratedMotion:
    """Motion with a velocity that walks between both ends, or (without a density of their noise) after the last sample.

    It is that of a Doppler log of two rows whose noise between them, or after them, has the density wanted.
    """
    k, T = int(np.searchsorted(rows.dvl_ns, start_ns)), (end_ns - start_ns) * 1e-9
    walked = (sensors.velocity_walk_density * T) ** 2 * np.eye(3)
    if doppler_psd is None:
        dvl_ns, velocity = np.array([start_ns - NS_PER_S, start_ns]), rows.velocity[[k, k]]
        cov = T * rows.cov[k] + walked / 3.0
    else:
        dvl_ns, velocity = np.array([start_ns, end_ns]), rows.velocity[k : k + 2]
        cov = (doppler_psd + walked / 12.0) / T
    log = rows._replace(dvl_ns=dvl_ns, velocity=velocity, cov=np.array([cov, cov]), known_ns=dvl_ns)
    return motion_over(log, sensors, start_ns, end_ns, bias, earth)


def remaining_motion(before: PreintegratedMotion, whole: PreintegratedMotion) -> PreintegratedMotion:
    """The rest of a whole motion after a first part of it, with the growth of its error."""
    motion = before.i_T_j.between(whole.i_T_j)
    adjoint = motion.inverse().AdjointMap()
    grown = whole.covariance - adjoint @ before.covariance @ adjoint.T
    variances, axes = np.linalg.eigh(0.5 * (grown + grown.T))
    duration_s = whole.duration_s - before.duration_s
    impulse = whole.mean_specific_force * whole.duration_s
    if before.duration_s > 0.0:
        impulse = impulse - before.mean_specific_force * before.duration_s
    return replace(
        whole,
        i_T_j=motion,
        covariance=(axes * np.maximum(variances, 0.0)) @ axes.T,
        D_bias=whole.D_bias - adjoint @ before.D_bias,
        duration_s=duration_s,
        mean_specific_force=before.i_T_j.rotation().unrotate(impulse / duration_s),
    )
