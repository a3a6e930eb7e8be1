"""Keyframes, and the factors that odometry, depth and gravity give each of them.

A keyframe sits at an epoch of the odometry (a DVL stamp). One is due ``max_interval_s`` after the last, and sooner when
landmarks are seen and the noise of the motion since then would blur them (docs/theory/isam2.md). The gyro bias is
constant over stretches of ``bias_interval_s`` and walks between them.

Rows that cannot be measurements are refused: variances not above zero, covariances not positive definite, impossible
ranges. NaN is sound: the log does not know the noise, and the calibration does.
"""

from bisect import bisect_left
from dataclasses import dataclass, field, replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Calibration, Section
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, LandmarkDetections, possible_ranges
from sonar_graph.motion import MotionSource, PreintegratedMotion
from sonar_graph.navigation.alignment import gravity_direction
from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother import Changed, Smoother
from sonar_graph.states import Refusal, RefusedRow

ROUNDING = 1e-13
"""Share of a determinant below which it is taken for zero."""
Flags = NDArray[np.bool_]


def sound_detections(frame: LandmarkDetections) -> Flags:
    """Rows that a sonar can have measured, shape (n,)."""
    a, b, c, d = frame.range_azimuth_cov.reshape(-1, 4).T
    with np.errstate(all="ignore"):
        is_definite = (a > 0) & (a * d - (0.5 * (b + c)) ** 2 > ROUNDING * a * d)
    return possible_ranges(frame.range_m) & (is_definite | np.isnan(frame.range_azimuth_cov).any(axis=(1, 2)))


S_PER_NS = 1e-9
CARRIED_IN_GAP_NS = 300_000_000
"""Longest time over which a depth sample is carried straight on over the end of a gap."""
EARLIEST_NS, LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max


class KeyframeParams(Section):
    """Settings of the keyframes."""

    max_interval_s: float = Field(5.0, gt=0)
    """Time since the last keyframe after which the next is due in any case."""
    motion_noise_share: float = Field(0.1, ge=0)
    """While landmarks are seen, a keyframe is set as soon as the variance of the motion since the last one exceeds this
    share of the sonar's variance. 0: at every frame with a landmark."""
    bias_interval_s: float = Field(60.0, gt=0)
    """Time between two gyro bias variables in the graph; the bias is constant from one to the next."""


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
    """Key of the gyro bias that holds from each keyframe on."""
    advanced_ns: int = EARLIEST_NS
    """Latest instant that was advanced to."""

    def __post_init__(self) -> None:
        self._estimates_bias = self.calibration.imu.gyro_bias_sigma > 0
        self._bias_since_ns = 0
        self._latest: tuple[int, PreintegratedMotion] | None = None
        self._linearised: tuple[Floats, Floats] = np.zeros(3), np.eye(3)
        self._depths: list[Depth] = []
        self._told = 0
        self._refused: list[RefusedRow] = []

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

    def add(self, imu: Imu | None, dvl: Dvl | None, depth: Depth | None) -> None:
        """Take in rows; refuse unsound depths, and those older than others that wait."""
        if depth is not None:
            is_sound = np.isnan(depth.variance_m2) | ((depth.variance_m2 > 0) & np.isfinite(depth.variance_m2))
            unsound = depth.stamps_ns[~is_sound].tolist()
            self._refused += [RefusedRow("depth", stamp_ns, Refusal.UNSOUND, np.nan) for stamp_ns in unsound]
            depth = depth if not unsound else depth.rows(is_sound) if is_sound.any() else None
        self.odometry.add(imu, dvl)
        self._latest = None
        newest_ns = self._depths[-1].stamps_ns[-1] if self._depths else EARLIEST_NS
        if depth is not None and depth.stamps_ns[0] <= newest_ns:
            late = depth.stamps_ns[depth.stamps_ns < newest_ns]
            self._refused += [RefusedRow("depth", stamp_ns, Refusal.LATE, np.nan) for stamp_ns in late.tolist()]
            depth = depth.between(newest_ns, LATEST_NS)
        if depth is not None:
            self._depths.append(depth)

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows of IMU, Doppler log and depth that are not used, and why."""
        return self.odometry.refused + self._refused

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
            self._bias_since_ns = start_ns
            self.smoother.add_pose(X(0), self.calibration.start.pose(), start_ns * S_PER_NS)
            self.smoother.add({"start prior": factors.start_prior(X(0), self.calibration)})
            self.bias_keys.append(B(0))
            if self._estimates_bias:
                self.smoother.add_bias(B(0), np.zeros(3))
                self.smoother.add({"bias prior": factors.bias_prior(B(0), self.calibration.imu.gyro_bias_sigma)})
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
            sonar, bias_sigma = self.calibration.sonar, self.calibration.imu.gyro_bias_sigma
            variances = (motion.covariance.diagonal() + bias_sigma**2 * (motion.D_bias**2).sum(axis=1)).tolist()
            share = max(variances[:3]) / sonar.azimuth_sigma_rad**2, max(variances[3:]) / sonar.range_sigma_m**2
            if max(share) > self.params.motion_noise_share:
                self._set(node_ns, stamp_ns)
                self._linearise()
                motion = self.motion_since_newest(stamp_ns)
        if not self.odometry.is_gap(node_ns or self.stamps_ns[-1], stamp_ns):
            self._told = 0
            return motion
        # Frames tied to one keyframe over the same gap share its error. With k (k + 1) times the covariance of the k-th
        # their information stays below that of one exact frame: sum 1 / (k (k + 1)) = 1.
        self._told += 1
        return replace(motion, covariance=motion.covariance * (self._told * (self._told + 1)))

    def motion_since_newest(self, until_ns: int) -> PreintegratedMotion:
        """Provisional motion from the newest keyframe to an instant not before that of any earlier call."""
        if self._latest is None or self._latest[0] != until_ns:
            self._latest = until_ns, self.odometry.motion(self.stamps_ns[-1], until_ns, *self._linearised)
        return self._latest[1]

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
        """Newest estimate of the gyro bias that holds from a keyframe on, shape (3,), rad/s."""
        return self.smoother.values.atPoint3(self.bias_keys[index]) if self._estimates_bias else np.zeros(3)

    def bias_key(self, index: int) -> int | None:
        """Key of the bias that holds from a keyframe on, -1 the newest; None when there is none to estimate."""
        return self.bias_keys[index] if self._estimates_bias else None

    def _set(self, node_ns: int, known_ns: int) -> None:
        """Set a keyframe at an epoch that is reached at an instant."""
        i, j = len(self.stamps_ns) - 1, len(self.stamps_ns)
        start_ns, bias, world_T_i = self.stamps_ns[-1], self.bias(i), self.smoother.values.atPose3(X(i))
        motion = self.odometry.motion(start_ns, node_ns, bias, world_T_i.rotation().matrix(), known_ns)
        self.smoother.add_pose(X(j), world_T_i.compose(motion.i_T_j), node_ns * S_PER_NS)
        if self._estimates_bias:
            between = factors.odometry_with_bias(X(i), X(j), self.bias_keys[i], motion)
        else:
            between = factors.odometry(X(i), X(j), motion)
        self.smoother.add({"odometry": between})
        self._add_gravity(j, node_ns, motion)
        self._add_depth(j, start_ns, node_ns, known_ns, bias)
        self.bias_keys.append(self._next_bias_key(i, node_ns))
        self.stamps_ns.append(node_ns)
        self._constrain(j)
        self.odometry.forget_before(node_ns)

    def _add_gravity(self, j: int, node_ns: int, motion: PreintegratedMotion) -> None:
        if not self.calibration.use_gravity:
            return
        (v_i, variance_i), (v_j, variance_j) = map(self.odometry.velocity_at_imu, (self.stamps_ns[-1], node_ns))
        sigma = float(np.sqrt(0.5 * (variance_i + variance_j)))
        up = gravity_direction(motion, v_i, v_j, sigma, self.calibration)
        if up:
            self.smoother.add({"gravity": factors.gravity_direction(X(j), *up)})

    def _add_depth(self, j: int, start_ns: int, node_ns: int, known_ns: int, bias: Floats) -> None:
        """One factor for the samples since the last keyframe, carried to this one by odometry and averaged there.

        Samples are carried over no gap of the Doppler log. The port at sample k lies at ``k_T_j^-1 port`` in frame j.
        """
        if not self._depths:
            return
        columns = zip(*((block.stamps_ns, block.z_m, block.variance_m2) for block in self._depths), strict=True)
        stamps_ns, z_m, variance_m2 = map(np.concatenate, columns)
        later = [block for block in self._depths if block.stamps_ns[-1] > node_ns]
        self._depths = [rest for block in later if (rest := block.between(node_ns, LATEST_NS))]
        epochs_ns = [start_ns, *self.odometry.epochs(start_ns, node_ns).tolist()]
        found_ns = [b for a, b in pairwise(epochs_ns) if self.odometry.is_gap(a, b)]
        after_ns = found_ns[-1] - CARRIED_IN_GAP_NS if found_ns else start_ns
        first, end = stamps_ns.searchsorted([after_ns, node_ns], side="right").tolist()
        until_ns = np.append(stamps_ns[first + 1 : end], node_ns)[: end - first]
        motions = self.odometry.motions(stamps_ns[first:end], until_ns, np.full(end - first, known_ns), bias)
        lost = np.flatnonzero(np.isnan(motions.dp[:, 0]))  # a gap shorter than what samples are carried over
        kept = int(lost[-1]) + 1 if len(lost) else 0
        if kept == end - first:
            return
        backwards_R, backwards_p = [np.eye(3)], [np.zeros(3)]
        for dR, dp in zip(motions.dR[kept:][::-1], motions.dp[kept:][::-1], strict=True):
            backwards_R.append(dR.dot(backwards_R[-1]))
            backwards_p.append(dp + dR.dot(backwards_p[-1]))
        k_R_j, k_p_j = np.array(backwards_R[::-1]), np.array(backwards_p[::-1])
        ups = k_R_j[1:] @ self.smoother.values.atPose3(X(j)).rotation().matrix()[2]
        wander_m2 = np.einsum("ka,kab,kb->k", ups, motions.C[kept:, 3:, 3:], ups)
        used = slice(first + kept, end)
        variance_m2 = np.where(np.isnan(variance_m2[used]), self.calibration.depth.sigma_m**2, variance_m2[used])
        weights, mean_variance = weights_at_end(variance_m2, wander_m2)
        ports = np.einsum("kba,kb->ka", k_R_j[:-1], np.array(self.calibration.depth.port_m) - k_p_j[:-1])
        height_m = float(weights @ z_m[used])
        self.smoother.add({"depth": factors.depth(X(j), height_m, weights @ ports, mean_variance**0.5)})

    def _constrain(self, j: int) -> None:
        if self.calibration.planar:
            self.smoother.add(factors.planar(X(j), self.calibration.planar))

    def _next_bias_key(self, i: int, node_ns: int) -> int:
        elapsed_s = (node_ns - self._bias_since_ns) * S_PER_NS
        walk = self.calibration.imu.gyro_bias_walk_density
        if not self._estimates_bias or walk == 0 or elapsed_s < self.params.bias_interval_s:
            return self.bias_keys[i]
        old = self.bias_keys[i]
        new = B(gtsam.Symbol(old).index() + 1)
        self._bias_since_ns = node_ns
        self.smoother.add_bias(new, self.smoother.values.atPoint3(old))
        self.smoother.add({"bias walk": factors.bias_walk(old, new, walk * np.sqrt(elapsed_s))})
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
