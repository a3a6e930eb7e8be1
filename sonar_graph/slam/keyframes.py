"""Keyframes, and the factors that odometry, gravity, depth, heading and position fixes give each of them.

A keyframe sits at an epoch of the odometry (a DVL stamp). One is due ``max_interval_s`` after the last, and sooner when
landmarks are seen and the noise of the motion since then would blur them (docs/theory/isam2.md). The biases are
constant over stretches of ``bias_interval_s`` and walk between them.

Samples of depth and heading since the last keyframe are averaged at the next one. A position fix hangs on the keyframe
before it, by the motion between them; a late one on that of its time, while that is in the window.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X
from pydantic import Field

from sonar_graph.calibration import Calibration, Section
from sonar_graph.measurements import Depth, Dvl, Floats, Heading, Imu, Ints
from sonar_graph.models import (
    BIASES,
    COMPASS,
    HEADING,
    HUBER_WIDTHS,
    TILT,
    Contradictions,
    bias_sigmas,
    by_biases,
    gyro_bias_of,
    wrap_angle,
)
from sonar_graph.motion import MotionSource, PreintegratedMotion
from sonar_graph.navigation.alignment import gravity_direction
from sonar_graph.numerics import cross_matrix
from sonar_graph.slam import factors
from sonar_graph.slam.odometry_factor import OdometryWithBias
from sonar_graph.slam.smoother import Changed, Smoother
from sonar_graph.states import Refusal, RefusedRow

S_PER_NS = 1e-9
CARRIED_IN_GAP_NS = 300_000_000
"""Longest time over which a sample of depth or heading is carried straight on over the end of a gap."""
LONGEST_LATE_NS = 60_000_000_000
"""Age of a position fix up to which rows for it are kept, where the window is longer."""
FIX_GAIN = 50.0
"""Weight of what a position fix has to tell beside what a sighting has: with the default ``waiting_gain`` of 5, fixes
that would take less than a tenth of the position's variance together wait for the next keyframe."""
EARLIEST_NS, LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max


class KeyframeParams(Section):
    """Settings of the keyframes.

    Examples
    --------
    >>> from sonar_graph.slam import Isam2Params, KeyframeParams
    >>> Isam2Params(keyframes=KeyframeParams(max_interval_s=2.0)).keyframes.motion_noise_share
    0.1
    """

    max_interval_s: float = Field(5.0, gt=0)
    """Time since the last keyframe after which the next is due in any case."""
    motion_noise_share: float = Field(0.1, ge=0)
    """While landmarks are seen, a keyframe is set as soon as the variance of the motion since the last one exceeds this
    share of the sonar's variance. 0: at every frame with a landmark."""
    bias_interval_s: float = Field(60.0, gt=0)
    """Time between two gyro bias variables in the graph; the bias is constant from one to the next."""


class Carried(NamedTuple):
    """Motions from samples k to the keyframe j after them."""

    first: int
    """Number of the first sample that is carried."""
    k_R_j: Floats
    """Of each sample, and of j itself, shape (n + 1, 3, 3)."""
    k_p_j: Floats
    """Shape (n + 1, 3), m."""
    C: Floats
    """Covariance of the motion from each sample to the next, and from the last to j, shape (n, 6, 6)."""


@dataclass
class Keyframes:
    """Sets keyframes along the odometry and adds their factors to a smoother."""

    calibration: Calibration
    odometry: MotionSource
    params: KeyframeParams
    smoother: Smoother
    stamps_ns: list[int] = field(default_factory=list)
    """Stamps of the keyframes; the key of each is ``X(index)``."""
    bias_keys: list[int] = field(default_factory=list)
    """Key of the biases that hold from each keyframe on."""
    advanced_ns: int = EARLIEST_NS
    """Latest instant that was advanced to."""

    def __post_init__(self) -> None:
        self._bias_sigmas, self._walks = bias_sigmas(self.calibration)
        self._has_accel_bias = self.calibration.use_gravity and self.calibration.imu.accel_bias_sigma > 0
        self._body_p_dvl = np.array(self.calibration.dvl.mounting.translation_m)
        self._bends = self.calibration.imu.gyro_bias_sigma > 0 or self.calibration.dvl.scale_sigma > 0
        self._bias_since_ns = 0
        self._latest: tuple[int, PreintegratedMotion] | None = None
        self._linearised: tuple[Floats, Floats] = np.zeros(BIASES), np.eye(3)
        self._waiting: dict[str, list[Any]] = {"depth": [], "heading": []}
        self._lag_ns = min(round(min(self.smoother.params.lag_s, 1e9) / S_PER_NS), LONGEST_LATE_NS)
        self._newest_heading_ns, self._reached_ns = EARLIEST_NS, LATEST_NS
        self._told = 0
        self._refused: list[RefusedRow] = []
        self.contradictions = Contradictions()
        """Headings and fixes that the estimate contradicts at the keyframe after theirs."""
        self._unjudged: list[tuple[str, Callable[[gtsam.Values], Floats]]] = []

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest keyframe; None before the first."""
        return self.stamps_ns[-1] if self.stamps_ns else None

    @property
    def newest_s(self) -> float:
        """Stamp of the newest keyframe in seconds, as the smoother counts them."""
        return self.stamps_ns[-1] * S_PER_NS

    @property
    def newest_key(self) -> int:
        """Key of the newest keyframe."""
        return X(len(self.stamps_ns) - 1)

    def oldest_key(self, age_s: float) -> int:
        """Key of the first keyframe that is not older than the newest by more than an age (s)."""
        if not self.stamps_ns:
            return X(0)
        return X(bisect_left(self.stamps_ns, self.stamps_ns[-1] - round(age_s / S_PER_NS)))

    def add(self, imu: Imu | None, dvl: Dvl | None, depth: Depth | None = None, heading: Heading | None = None) -> None:
        """Take in rows; the source of motion says which depths are used.

        Unsound headings are refused, and depths and headings that come after their keyframe was set.
        """
        self.odometry.add(imu, dvl)
        self._latest = None
        set_ns = self.stamps_ns[-1] if self.stamps_ns else EARLIEST_NS
        if (depth := self.odometry.used_depths(depth)) is not None:
            for stamp_ns in depth.stamps_ns[depth.stamps_ns <= set_ns].tolist():
                self.refuse("depth", stamp_ns, Refusal.LATE)
            if (depth := depth.between(set_ns, LATEST_NS)) is not None:
                self._waiting["depth"].append(depth)
        if heading is None:
            return
        is_sound = heading.are_sound()
        is_new = (heading.stamps_ns > set_ns) & (heading.stamps_ns >= self._newest_heading_ns)
        for stamp_ns, sound, new in zip(heading.stamps_ns.tolist(), is_sound.tolist(), is_new.tolist(), strict=True):
            if not sound or not new:
                self.refuse("heading", stamp_ns, Refusal.LATE if sound else Refusal.UNSOUND)
        if (is_sound & is_new).any():
            self._waiting["heading"].append(rows := heading.rows(np.flatnonzero(is_sound & is_new)))
            self._newest_heading_ns = int(rows.stamps_ns[-1])

    def refuse(self, sensor: str, stamp_ns: int, reason: Refusal) -> None:
        """Take note of a row that is not used."""
        self._refused.append(RefusedRow(sensor, stamp_ns, reason, np.nan))

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows of all sensors but the sonar that are not used, and why; none is late that is from before the start."""
        own = [row for row in self._refused if row.reason is not Refusal.LATE or row.stamp_ns >= self._reached_ns]
        return self.odometry.refused + own

    def advance(self, until_ns: int) -> list[Changed]:
        """Set the keyframes that are due from epochs reached at an instant; the first starts the graph.

        Each has an update of its own, so that a result does not depend on how a log is cut; returns what these changed.
        """
        self.advanced_ns = max(self.advanced_ns, until_ns)
        changes = []
        if not self.stamps_ns:
            start_ns = self.odometry.start_by(until_ns)
            if start_ns is None:
                return []
            self.stamps_ns.append(start_ns)
            self._bias_since_ns, self._reached_ns = start_ns, self.odometry.reached_ns(start_ns)
            self.smoother.add_pose(X(0), self.calibration.start.pose(), start_ns * S_PER_NS)
            self.smoother.add({"start prior": factors.start_prior(X(0), self.calibration)})
            self.bias_keys.append(B(0))
            self.smoother.add_bias(B(0), np.zeros(BIASES))
            self.smoother.add({"bias prior": factors.bias_prior(B(0), self._bias_sigmas)})
            self._constrain(0)
            changes.append(self.smoother.update(self.newest_s))
            self._linearise()
        interval_ns = round(self.params.max_interval_s / S_PER_NS)
        while len(due_ns := self.odometry.epochs(self.stamps_ns[-1] + interval_ns - 1, until_ns)):
            self._set(int(due_ns[0]), until_ns)
            changes.append(self.smoother.update(self.newest_s))
            self._linearise()
        return changes

    def set_for_frame(self, stamp_ns: int, motion: PreintegratedMotion) -> PreintegratedMotion:
        """Set a keyframe if a frame needs a newer one; the motion from the then newest keyframe to the frame."""
        epochs_ns = self.odometry.epochs(self.stamps_ns[-1], stamp_ns)
        node_ns = int(epochs_ns[-1]) if len(epochs_ns) else None
        if node_ns is not None:
            sonar = self.calibration.sonar
            variances = (motion.covariance.diagonal() + motion.D_bias**2 @ self._bias_sigmas**2).tolist()
            share = max(variances[:3]) / sonar.azimuth_sigma_rad**2, max(variances[3:]) / sonar.range_sigma_m**2
            if max(share) > self.params.motion_noise_share:
                self._set(node_ns, stamp_ns)
                self._linearise()
                motion = self.motion_since_newest(stamp_ns)
        return self._over_gap(stamp_ns, motion)

    def _over_gap(self, stamp_ns: int, motion: PreintegratedMotion) -> PreintegratedMotion:
        """The motion from the newest keyframe, with the share of its error over a gap that one more frame may have.

        Frames and fixes tied to one keyframe over the same gap share its error. With k (k + 1) times the covariance of
        the k-th their information stays below that of one exact frame: sum 1 / (k (k + 1)) = 1.
        """
        epochs_ns = self.odometry.epochs(self.stamps_ns[-1], stamp_ns)
        if not self.odometry.is_gap(int(epochs_ns[-1]) if len(epochs_ns) else self.stamps_ns[-1], stamp_ns):
            self._told = 0
            return motion
        self._told += 1
        return replace(motion, covariance=motion.covariance * (self._told * (self._told + 1)))

    def motion_since_newest(self, until_ns: int) -> PreintegratedMotion:
        """Provisional motion from the newest keyframe to an instant not before that of any earlier call."""
        if self._latest is None or self._latest[0] != until_ns:
            biases, attitude = self._linearised
            self._latest = until_ns, self._motion(self.stamps_ns[-1], until_ns, biases, attitude, until_ns)
        return self._latest[1]

    def _motion(
        self, start_ns: int, end_ns: int, biases: Floats, attitude: Floats, known_ns: int
    ) -> PreintegratedMotion:
        """Motion of the odometry, with derivatives by all biases."""
        up = self._up(attitude)
        bias = gyro_bias_of(biases, up)
        motion = self.odometry.motion(start_ns, end_ns, bias, attitude, known_ns)
        dR, dp = motion.i_T_j.rotation().matrix(), motion.i_T_j.translation()
        D = by_biases(motion.D_bias, dR, dp, up, attitude[2], self._body_p_dvl)
        motion = replace(motion, D_bias=D, bias=np.concatenate((bias, bias, np.zeros(BIASES - 6))))
        return replace(motion, i_T_j=motion.corrected(biases), bias=biases)

    def _up(self, attitude: Floats) -> Floats:
        """The world's up in the body as it splits the gyros' bias, shape (3,)."""
        return np.asarray(attitude[2]) if self.calibration.use_gravity else np.zeros(3)

    def _linearise(self) -> None:
        """Fix bias and attitude for the motions from a new keyframe, at its estimate when it is set.

        At the first question they would depend on who asks.
        """
        attitude = self.smoother.values.atPose3(self.newest_key).rotation().matrix()
        self._linearised, self._latest = (self.bias(len(self.stamps_ns) - 1), attitude), None

    def update_if_due(self) -> Changed | None:
        """Bring the smoother up to date when what was added since it last was matters."""
        return self.smoother.update(self.newest_s) if self.smoother.is_due else None

    def bias(self, index: int) -> Floats:
        """Newest estimate of the biases that hold from a keyframe on, shape (9,)."""
        return np.asarray(self.smoother.values.atVector(self.bias_keys[index]))

    def _set(self, node_ns: int, known_ns: int) -> None:
        """Set a keyframe at an epoch that is reached at an instant."""
        for sensor, distances in self._unjudged:
            self.contradictions.judge(sensor, distances(self.smoother.values))
        self._unjudged.clear()
        i, j = len(self.stamps_ns) - 1, len(self.stamps_ns)
        start_ns, bias, world_T_i = self.stamps_ns[-1], self.bias(i), self.smoother.values.atPose3(X(i))
        attitude = world_T_i.rotation().matrix()
        motion = self._motion(start_ns, node_ns, bias, attitude, known_ns)
        self.smoother.add_pose(X(j), world_T_i.compose(motion.i_T_j), node_ns * S_PER_NS)
        between: gtsam.NonlinearFactor
        if self._bends:
            up_j = self._up(attitude) @ motion.i_T_j.rotation().matrix()
            between = OdometryWithBias(X(i), X(j), self.bias_keys[i], motion, up_j)
        else:
            between = factors.odometry(X(i), X(j), motion)
        self.smoother.add({"odometry": between})
        self._add_gravity(j, node_ns, motion)
        gyro_bias = gyro_bias_of(bias, self._up(attitude))
        if (samples := self._samples("depth", start_ns, node_ns)) is not None:
            self._add_depth(j, samples, self._carried(samples.stamps_ns, start_ns, node_ns, known_ns, gyro_bias))
        if (samples := self._samples("heading", start_ns, node_ns)) is not None:
            carried = self._carried(samples.stamps_ns, start_ns, node_ns, known_ns, gyro_bias)
            self._add_heading(j, samples, carried, bias[COMPASS])
        self.bias_keys.append(self._next_bias_key(i, node_ns))
        self.stamps_ns.append(node_ns)
        self._constrain(j)
        self.odometry.settle(node_ns)
        self.odometry.forget_before(self.stamps_ns[bisect_left(self.stamps_ns, node_ns - self._lag_ns)])

    def _add_gravity(self, j: int, node_ns: int, motion: PreintegratedMotion) -> None:
        if not self.calibration.use_gravity:
            return
        (v_i, variance_i), (v_j, variance_j) = map(self.odometry.velocity_at_imu, (self.stamps_ns[-1], node_ns))
        sigma = float(np.sqrt(0.5 * (variance_i + variance_j)))
        told = gravity_direction(motion, v_i, v_j, sigma, self.calibration, has_bias=False)
        if told is None:
            return
        up, sigma_rad = told
        gravity = factors.gravity_direction(X(j), up, sigma_rad)
        if self._has_accel_bias:
            # D by the gyro bias is -T times the mean rotation to frame j
            by_gyro = motion.D_bias[:3, TILT] + motion.D_bias[:3, HEADING]
            by_accel = by_gyro / (-motion.duration_s * self.calibration.gravity_m_s2)
            gravity = factors.gravity_with_bias(X(j), self.bias_keys[-1], up, by_accel, sigma_rad)
        self.smoother.add({"gravity": gravity})

    def _samples(self, name: str, start_ns: int, node_ns: int) -> Any:
        """Samples that wait, after one keyframe and up to another, as one block; None without any."""
        taken = [rows for block in self._waiting[name] if (rows := block.between(start_ns, node_ns))]
        later = [block for block in self._waiting[name] if block.stamps_ns[-1] > node_ns]
        self._waiting[name] = [rest for block in later if (rest := block.between(node_ns, LATEST_NS))]
        return type(taken[0]).concatenate(taken) if taken else None

    def _carried(self, stamps_ns: Ints, start_ns: int, node_ns: int, known_ns: int, bias: Floats) -> Carried | None:
        """Motions from samples to the keyframe after them, over no gap of the Doppler log; None where none is left."""
        epochs_ns = [start_ns, *self.odometry.epochs(start_ns, node_ns).tolist()]
        found_ns = [b for a, b in pairwise(epochs_ns) if self.odometry.is_gap(a, b)]
        after_ns = found_ns[-1] - CARRIED_IN_GAP_NS if found_ns else start_ns
        first = int(stamps_ns.searchsorted(after_ns, side="right"))
        from_ns, until_ns = stamps_ns[first:], np.append(stamps_ns[first + 1 :], node_ns)[: len(stamps_ns) - first]
        motions = self.odometry.motions(from_ns, until_ns, np.full(len(from_ns), known_ns), bias)
        lost = np.flatnonzero(np.isnan(motions.dp[:, 0]))  # a gap shorter than what samples are carried over
        kept = int(lost[-1]) + 1 if len(lost) else 0
        if kept == len(from_ns):
            return None
        backwards_R, backwards_p = [np.eye(3)], [np.zeros(3)]
        for dR, dp in zip(motions.dR[kept:][::-1], motions.dp[kept:][::-1], strict=True):
            backwards_R.append(dR.dot(backwards_R[-1]))
            backwards_p.append(dp + dR.dot(backwards_p[-1]))
        return Carried(first + kept, np.array(backwards_R[::-1]), np.array(backwards_p[::-1]), motions.C[kept:])

    def _add_depth(self, j: int, depth: Depth, carried: Carried | None) -> None:
        """One factor for samples that are averaged; the port at sample k lies at ``k_T_j^-1 port`` in frame j."""
        if carried is None:
            return
        ups = carried.k_R_j[1:] @ self.smoother.values.atPose3(X(j)).rotation().matrix()[2]
        wander_m2 = np.einsum("ka,kab,kb->k", ups, carried.C[:, 3:, 3:], ups)
        variance_m2, z_m = depth.variance_m2[carried.first :], depth.z_m[carried.first :]
        variance_m2 = np.where(np.isnan(variance_m2), self.calibration.depth.sigma_m**2, variance_m2)
        weights, mean_variance = weights_at_end(variance_m2, wander_m2)
        port = np.array(self.calibration.depth.port_m)
        ports = np.einsum("kba,kb->ka", carried.k_R_j[:-1], port - carried.k_p_j[:-1])
        height_m = float(weights @ z_m)
        self.smoother.add({"depth": factors.depth(X(j), height_m, weights @ ports, mean_variance**0.5)})

    def _add_heading(self, j: int, heading: Heading, carried: Carried | None, compass_rad: float) -> None:
        """One factor for samples that are averaged, as depths are, by what they miss of the predicted headings.

        A sample far from the median of what they all miss counts less, after Huber.
        """
        if carried is None:
            return
        R_j = self.smoother.values.atPose3(X(j)).rotation().matrix()
        R_k = R_j @ carried.k_R_j.transpose(0, 2, 1)
        yaw_rad = np.arctan2(R_k[:, 1, 0], R_k[:, 0, 0])
        ups = carried.k_R_j[1:] @ R_j[2]
        wander = np.einsum("ka,kab,kb->k", ups, carried.C[:, :3, :3], ups)
        missed = wrap_angle(heading.yaw_rad[carried.first :] - yaw_rad[:-1] - compass_rad)
        sigma = heading.sigma_rad[carried.first :]
        sigma = np.where(np.isnan(sigma), self.calibration.heading.sigma_rad, sigma)
        off = np.abs(wrap_angle(missed - np.median(missed))) / (HUBER_WIDTHS[1] * sigma)
        weights, mean_variance = weights_at_end(sigma**2 * np.maximum(1.0, off), wander)
        measured = float(yaw_rad[-1] + compass_rad + weights @ missed)
        key = self.bias_keys[-1]
        self.smoother.add({"heading": factors.heading(X(j), key, measured, mean_variance**0.5)})

        def distances(values: gtsam.Values) -> Floats:
            x, y, _ = values.atPose3(X(j)).matrix()[:3, 0]
            off = wrap_angle(missed + compass_rad + yaw_rad[-1] - np.arctan2(y, x))
            return np.asarray(np.abs(off) / np.hypot(sigma, self.calibration.heading.bias_sigma_rad))

        self._unjudged.append(("heading", distances))

    def add_fix(self, stamp_ns: int, position_m: Floats, cov_m2: Floats) -> None:
        """Hang a position fix on the keyframe before it; refuse one before the window, or before rows that are kept.

        It enters the estimate at once, unless it has next to nothing to tell (`FIX_GAIN`).
        """
        i = bisect_right(self.stamps_ns, stamp_ns) - 1
        if i < 0 or self.stamps_ns[i] < self.stamps_ns[-1] - self._lag_ns or not self.smoother.in_window([X(i)]):
            self.refuse("positions", stamp_ns, Refusal.LATE)
            return
        values, start_ns = self.smoother.values, self.stamps_ns[i]
        R_i = values.atPose3(X(i)).rotation().matrix()
        if stamp_ns >= self.advanced_ns:
            motion = self._over_gap(stamp_ns, self.motion_since_newest(stamp_ns))
        else:
            motion = self._motion(start_ns, stamp_ns, self.bias(i), R_i, self.advanced_ns)
        antenna = np.array(self.calibration.positions.antenna_m)
        by_motion = R_i @ motion.i_T_j.rotation().matrix() @ np.hstack((-cross_matrix(antenna), np.eye(3)))
        cov_m2 = cov_m2 + by_motion @ motion.covariance @ by_motion.T
        arm, gain = motion.i_T_j.transformFrom(antenna), np.inf
        factor = factors.position(X(i), position_m, arm, cov_m2)
        if i == len(self.stamps_ns) - 1 and not self.smoother.is_due:
            by_pose = R_i @ np.hstack((-cross_matrix(arm), np.eye(3)))
            predicted = by_pose @ self.smoother.joint_covariance([X(i)]).at(X(i), X(i)) @ by_pose.T
            gain = FIX_GAIN * float((predicted.diagonal() / cov_m2.diagonal()).max())
        self.smoother.add({"position": factor}, gain=gain)

        def distance(values: gtsam.Values) -> Floats:
            e = values.atPose3(X(i)).transformFrom(arm) - position_m
            return np.sqrt(e @ np.linalg.solve(cov_m2, e))

        self._unjudged.append(("positions", distance))

    def _constrain(self, j: int) -> None:
        if self.calibration.planar:
            self.smoother.add(factors.planar(X(j), self.calibration.planar))

    def _next_bias_key(self, i: int, node_ns: int) -> int:
        elapsed_s = (node_ns - self._bias_since_ns) * S_PER_NS
        if not self._walks.any() or elapsed_s < self.params.bias_interval_s:
            return self.bias_keys[i]
        old = self.bias_keys[i]
        new = B(gtsam.Symbol(old).index() + 1)
        self._bias_since_ns = node_ns
        self.smoother.add_bias(new, self.smoother.values.atVector(old))
        walked = np.where(self._walks > 0, self._walks * np.sqrt(elapsed_s), factors.STEADY * self._bias_sigmas)
        self.smoother.add({"bias walk": factors.bias_walk(old, new, walked)})
        return new


def weights_at_end(variance_m2: Floats, wander_m2: Floats) -> tuple[Floats, float]:
    """Weights of depth samples in the height at the end of an interval, and that height's variance.

    Samples are carried to the end by odometry, whose error is a random walk that all older samples share; a sample's
    own noise is white. The best weights are those of a Kalman filter for a random walk, started from nothing::

        K = P / (P + r_k),    w <- (1 - K) w,  w_k = K,    P <- (1 - K) P + q_k

    Parameters
    ----------
    variance_m2
        r of each sample, in order of time, shape (n,), n >= 1.
    wander_m2
        q: vertical variance of the odometry from each sample to the next, and from the last to the end, shape (n,).

    Returns
    -------
    Weights with sum 1, shape (n,), and the variance, m².
    """
    weights = np.zeros(len(variance_m2))
    P = np.inf
    for k, (r, q) in enumerate(zip(variance_m2.tolist(), wander_m2.tolist(), strict=True)):
        gain = P / (P + r) if k else 1.0
        weights *= 1.0 - gain
        weights[k] = gain
        P = ((1.0 - gain) * P if k else r) + q
    return weights, P
