"""Keyframes, and their factors from odometry, gravity, depth, heading and position fixes.

A keyframe sits at an epoch of the odometry (a DVL stamp). The next one is set ``max_interval_s`` after the last, and
sooner when a landmark is detected and the noise of the motion since the last one is large beside the sonar's noise
(docs/theory/isam2.md). The biases are constant over stretches of ``bias_interval_s`` and walk between them.

The samples of depth and of heading since the last keyframe are averaged at the next one. A position fix is tied to the
keyframe before it by the motion between them.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeVar

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
    body_point_jacobian,
    by_biases,
    gravity_direction,
    gyro_bias_of,
    wrap_angle,
)
from sonar_graph.motion import MotionSource, PreintegratedMotion
from sonar_graph.numerics import I3, ZERO, compiled, mat, store, store_vector, vec
from sonar_graph.slam import factors
from sonar_graph.slam.odometry_factor import OdometryWithBias
from sonar_graph.slam.prediction import Tie
from sonar_graph.slam.smoother import Changed, Known, Smoother
from sonar_graph.states import Refusal, RefusedRow

S_PER_NS = 1e-9
NS_PER_S = 1_000_000_000
Block = TypeVar("Block", Depth, Heading)
LONGEST_LATE_S = 60.0
"""Age of a position fix up to which it is used, where the lag is longer."""
FIX_GAIN = 50.0
"""Weight of the expected information of a fix beside that of a sighting: with the default ``waiting_gain`` of 5, fixes
wait for the next keyframe unless together they would cut the position variance by more than 10 %."""
LEAST_BIAS_SHARE = 0.01
"""Variance of a fix from the biases of the motion to it, as a share of its noise, from which the fix constrains the
biases too. Gaps exceed it. Below it a factor on the keyframe alone is used, which is compiled
(`benchmarks/validation/isam2_constants.py`)."""
EARLIEST_NS = np.iinfo(np.int64).min
LATEST_NS = np.iinfo(np.int64).max


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

    k_R_j: Floats
    """Of each sample, and of j itself, shape (n + 1, 3, 3)."""
    k_p_j: Floats
    """Shape (n + 1, 3), m."""
    C: Floats
    """Covariance of the motion from each sample to the next, and from the last to j, shape (n, 6, 6)."""


@compiled
def until_last(dR: Floats, dp: Floats) -> tuple[Floats, Floats]:
    """Motions from the start of each of n motions to the end of the last, and from there: (n + 1, 3, 3), (n + 1, 3)."""
    n = len(dR)
    k_R_j = np.empty((n + 1, 3, 3))
    k_p_j = np.empty((n + 1, 3))
    R = I3
    p = ZERO
    store(R, k_R_j[n])
    store_vector(p, k_p_j[n], 0)
    for k in range(n - 1, -1, -1):
        step = mat(dR[k])
        p = vec(dp[k]) + step @ p
        R = step @ R
        store(R, k_R_j[k])
        store_vector(p, k_p_j[k], 0)
    return k_R_j, k_p_j


class Linearisation(NamedTuple):
    """Where motions from a keyframe are linearised."""

    biases: Floats
    """b of `sonar_graph.models.aiding`, shape (11,)."""
    attitude: Floats
    """world_R_body, shape (3, 3)."""
    up: Floats
    """World's up in the body, along which the gyros' bias is split, shape (3,); zero without gravity."""
    gyro_bias: Floats
    """Shape (3,), rad/s."""


class Interval(NamedTuple):
    """Interval between two keyframes."""

    start_ns: int
    node_ns: int
    known_ns: int
    """No row stamped later is used."""


def split_at(
    blocks: list[Block], interval: Interval
) -> tuple[Block | None, list[Block]]:
    """Samples of an interval as one block, None without any, and the blocks of later samples."""
    if not blocks:
        return None, []
    together = type(blocks[0]).concatenate(blocks)
    inside = together.between(interval.start_ns, interval.node_ns)
    later = together.between(interval.node_ns, LATEST_NS)
    return inside, [] if later is None else [later]


class Average(NamedTuple):
    """Weighted average of samples at the end of an interval."""

    weights: Floats
    """Their sum is 1, shape (n,)."""
    variance: float


def average_at_end(variance: Floats, wander: Floats) -> Average:
    """Weights of samples in an average at the end of an interval, and its variance.

    Samples are carried to the end by odometry, whose error is a random walk that all older samples share; a sample's
    own noise is white. The best weights are those of a Kalman filter for a random walk without a prior::

        K = P / (P + r_k),    w <- (1 - K) w,  w_k = K,    P <- (1 - K) P + q_k

    Parameters
    ----------
    variance
        r of each sample, in order of time, shape (n,), n >= 1.
    wander
        q: variance of the odometry from each sample to the next, and from the last to the end, shape (n,).
    """
    gains = [1.0]
    P = float(variance[0] + wander[0])
    for r, q in zip(variance[1:].tolist(), wander[1:].tolist(), strict=True):
        K = P / (P + r)
        P = (1.0 - K) * P + q
        gains.append(K)
    # older samples share the odometry's error: they give way together
    weights = np.array(gains)
    weights[:-1] *= np.cumprod(1.0 - weights[:0:-1])[::-1]
    return Average(weights, P)


class Keyframes:
    """Sets keyframes along the odometry and adds their factors to a smoother.

    Parameters
    ----------
    calibration
        Noises, mountings and start.
    odometry
        Source of motion; it takes in the rows of IMU and Doppler log.
    params
        When keyframes are set.
    smoother
        Takes the factors.
    """

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,
        params: KeyframeParams,
        smoother: Smoother,
    ) -> None:
        self.calibration = calibration
        self.odometry = odometry
        self.params = params
        self.smoother = smoother
        self.stamps_ns: list[int] = []
        """Stamps of the keyframes; the key of each is ``X(index)``."""
        self.bias_keys: list[int] = []
        """Key of the biases that hold from each keyframe on."""
        self.advanced_ns = EARLIEST_NS
        """Latest instant that was advanced to."""
        self.contradictions = Contradictions()
        """Headings and fixes that contradict the estimate at the keyframe after theirs."""
        self._bias_sigmas, self._walks = bias_sigmas(calibration)
        self._bias_variances = np.square(self._bias_sigmas)
        self._has_accel_bias = (
            calibration.use_gravity and calibration.imu.accel_bias_sigma > 0
        )
        self._has_motion_biases = (
            calibration.imu.gyro_bias_sigma > 0 or calibration.dvl.scale_sigma > 0
        )
        self._body_p_dvl = np.array(calibration.dvl.mounting.translation_m)
        lag_s = min(smoother.params.lag_s, LONGEST_LATE_S)
        self._lag_ns = round(lag_s * NS_PER_S)
        self._bias_since_ns = 0
        self.newest_key = X(0)
        """Key of the newest keyframe."""
        self._latest: tuple[int, PreintegratedMotion] | None = None
        self._linearised: Linearisation
        self._depths: list[Depth] = []
        self._headings: list[Heading] = []
        self._newest_heading_ns = EARLIEST_NS
        self._reached_ns = LATEST_NS
        self._tied_in_gap = 0
        self._refused: list[RefusedRow] = []
        self._unjudged: list[tuple[str, Callable[[Known], Floats]]] = []

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest keyframe; None before the first."""
        return self.stamps_ns[-1] if self.stamps_ns else None

    @property
    def newest_s(self) -> float:
        """Stamp of the newest keyframe in seconds, as the smoother counts them."""
        return self.stamps_ns[-1] * S_PER_NS

    def tie(self, motion: PreintegratedMotion) -> Tie:
        """An instant that the motion from the newest keyframe leads to."""
        return Tie(self.newest_key, self.bias_keys[-1], motion)

    def oldest_key(self, age_s: float) -> int:
        """Key of the first keyframe that is not older than the newest by more than an age (s)."""
        if not self.stamps_ns:
            return X(0)
        oldest_ns = self.stamps_ns[-1] - round(age_s * NS_PER_S)
        return X(bisect_left(self.stamps_ns, oldest_ns))

    # ---------------------------------------------------------------- rows

    def add(
        self,
        imu: Imu | None,
        dvl: Dvl | None,
        depth: Depth | None = None,
        heading: Heading | None = None,
    ) -> None:
        """Take in rows.

        Refused are depths that the source of motion refuses, invalid headings, and depths and headings that arrive
        after the keyframe of their time was set.
        """
        self.odometry.add(imu, dvl)
        self._latest = None  # rows that come later may change a provisional motion
        set_ns = self.stamps_ns[-1] if self.stamps_ns else EARLIEST_NS
        used_depth = self.odometry.used_depths(depth)
        if used_depth is not None:
            self._add_depths(used_depth, set_ns)
        if heading is not None:
            self._add_headings(heading, set_ns)

    def _add_depths(self, depth: Depth, set_ns: int) -> None:
        for stamp_ns in depth.stamps_ns[depth.stamps_ns <= set_ns].tolist():
            self.refuse("depth", stamp_ns, Refusal.LATE)
        rest = depth.between(set_ns, LATEST_NS)
        if rest is not None:
            self._depths.append(rest)

    def _add_headings(self, heading: Heading, set_ns: int) -> None:
        is_sound = heading.are_sound()
        # depths are judged by the odometry; headings here, in the order of their stamps
        is_late = (heading.stamps_ns <= set_ns) | (
            heading.stamps_ns < self._newest_heading_ns
        )
        for row in np.flatnonzero(~is_sound | is_late).tolist():
            reason = Refusal.LATE if is_sound[row] else Refusal.UNSOUND
            self.refuse("heading", int(heading.stamps_ns[row]), reason)
        used = np.flatnonzero(is_sound & ~is_late)
        if len(used):
            rows = heading.rows(used)
            self._headings.append(rows)
            self._newest_heading_ns = int(rows.stamps_ns[-1])

    def refuse(self, sensor: str, stamp_ns: int, reason: Refusal) -> None:
        """Record a row that is not used."""
        self._refused.append(RefusedRow(sensor, stamp_ns, reason))

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows of all sensors but the sonar that are not used, and why; rows before the start do not count as late."""
        own = [
            row
            for row in self._refused
            if row.reason is not Refusal.LATE or row.stamp_ns >= self._reached_ns
        ]
        return self.odometry.refused + own

    # ---------------------------------------------------------------- keyframes

    def advance(self, until_ns: int) -> list[Changed]:
        """Set the keyframes that are due at the epochs reached by an instant; the first starts the graph.

        Each keyframe has an update of its own, so that results do not depend on how a log is cut into calls. Returns
        the changes of these updates.
        """
        self.advanced_ns = max(self.advanced_ns, until_ns)
        changes = []
        if not self.stamps_ns:
            start_ns = self.odometry.start_by(until_ns)
            if start_ns is None:
                return []
            self._start(start_ns)
            changes.append(self._updated())
        interval_ns = round(self.params.max_interval_s * NS_PER_S)
        while until_ns >= self.stamps_ns[-1] + interval_ns:
            due_ns = self.odometry.epochs(
                self.stamps_ns[-1] + interval_ns - 1, until_ns
            )
            if not len(due_ns):
                break
            self._set(int(due_ns[0]), until_ns)
            changes.append(self._updated())
        return changes

    def _updated(self) -> Changed:
        changed = self.smoother.update(self.newest_s)
        self._linearise()  # at the estimate that contains the new keyframe
        return changed

    def _start(self, start_ns: int) -> None:
        """Set the first keyframe, with the priors of pose and biases."""
        self.stamps_ns.append(start_ns)
        self.bias_keys.append(B(0))
        self._bias_since_ns = start_ns
        self._reached_ns = self.odometry.reached_ns(start_ns)
        self.smoother.add_pose(X(0), self.calibration.start.pose(), start_ns * S_PER_NS)
        self.smoother.add({"start prior": factors.start_prior(X(0), self.calibration)})
        self.smoother.add_bias(B(0), np.zeros(BIASES))
        self.smoother.add({"bias prior": factors.bias_prior(B(0), self._bias_sigmas)})
        self._constrain(0)

    def set_for_frame(
        self, stamp_ns: int, motion: PreintegratedMotion
    ) -> PreintegratedMotion:
        """Set a keyframe if the noise of the motion to a frame requires one.

        Returns the motion from the keyframe that is newest then to the frame.
        """
        epochs_ns = self.odometry.epochs(self.stamps_ns[-1], stamp_ns)
        # without an epoch since the newest keyframe there is no place for another
        if len(epochs_ns) and self._is_blurred(motion):
            self._set(int(epochs_ns[-1]), stamp_ns)
            self._linearise()
            motion = self.motion_since_newest(stamp_ns)
        return self._shared_over_gap(self.stamps_ns[-1], stamp_ns, motion)

    def _is_blurred(self, motion: PreintegratedMotion) -> bool:
        """True when the variance of a motion exceeds ``motion_noise_share`` of the sonar's variance."""
        by_biases = np.square(motion.D_bias) @ self._bias_variances
        variances = (motion.covariance.diagonal() + by_biases).tolist()  # (6,)
        sonar = self.calibration.sonar
        turn_share = max(variances[:3]) / sonar.azimuth_sigma_rad**2
        way_share = max(variances[3:]) / sonar.range_sigma_m**2
        return max(turn_share, way_share) > self.params.motion_noise_share

    def _shared_over_gap(
        self, since_ns: int, stamp_ns: int, motion: PreintegratedMotion
    ) -> PreintegratedMotion:
        """The motion from a keyframe to a frame or fix, with a covariance that measurements over the same gap may share.

        Measurements tied to one keyframe over the same gap share the error of its motion. With k (k + 1) times the
        covariance for the k-th of them, their information stays below that of one exact measurement:
        ``sum 1 / (k (k + 1)) = 1``.
        """
        epochs_ns = self.odometry.epochs(since_ns, stamp_ns)
        known_ns = int(epochs_ns[-1]) if len(epochs_ns) else since_ns
        if not self.odometry.is_gap(known_ns, stamp_ns):
            if stamp_ns >= self.advanced_ns:  # a late one ends no gap
                self._tied_in_gap = 0
            return motion
        self._tied_in_gap += 1
        k = self._tied_in_gap
        return replace(motion, covariance=motion.covariance * (k * (k + 1)))

    def _set(self, node_ns: int, known_ns: int) -> None:
        """Set a keyframe at an epoch, from rows stamped no later than ``known_ns``."""
        self._judge()  # before the new keyframe's factors enter
        i = len(self.stamps_ns) - 1
        j = i + 1
        start_ns = self.stamps_ns[i]
        world_T_i = self.smoother.estimates.atPose3(X(i))
        linearisation = self._linearisation(i)
        motion = self._motion(start_ns, node_ns, linearisation, known_ns)
        self.smoother.add_pose(
            X(j), world_T_i.compose(motion.i_T_j), node_ns * S_PER_NS
        )
        self._add_odometry(i, motion, linearisation)
        self._add_gravity(j, node_ns, motion)
        self._add_averages(j, Interval(start_ns, node_ns, known_ns), linearisation)
        # the factors up to here hold for the biases of keyframe i
        self.bias_keys.append(self._next_bias_key(i, node_ns))
        self.stamps_ns.append(node_ns)
        self.newest_key = X(j)
        self._constrain(j)
        self.odometry.settle(node_ns)
        # a late fix may need the motion from any keyframe of the lag
        oldest = bisect_left(self.stamps_ns, node_ns - self._lag_ns)
        self.odometry.forget_before(self.stamps_ns[oldest])

    def _constrain(self, j: int) -> None:
        if self.calibration.planar:
            self.smoother.add(factors.planar(X(j), self.calibration.planar))

    def _next_bias_key(self, i: int, node_ns: int) -> int:
        """Key of the biases from a new keyframe on: those of keyframe i, or new ones after ``bias_interval_s``."""
        old = self.bias_keys[i]
        elapsed_s = (node_ns - self._bias_since_ns) * S_PER_NS
        if not self._walks.any() or elapsed_s < self.params.bias_interval_s:
            return old
        new = B(gtsam.Symbol(old).index() + 1)
        self._bias_since_ns = node_ns
        self.smoother.add_bias(new, self.smoother.estimates.atVector(old))
        # a random walk: the variance grows with time
        by_walk = self._walks * np.sqrt(elapsed_s)
        walked = np.where(self._walks > 0, by_walk, factors.STEADY * self._bias_sigmas)
        self.smoother.add({"bias walk": factors.bias_walk(old, new, walked)})
        return new

    def update_if_due(self) -> Changed | None:
        """Update the smoother when what was added since its last update would change the estimate."""
        return self.smoother.update(self.newest_s) if self.smoother.is_due else None

    def bias(self, index: int) -> Floats:
        """Newest estimate of the biases that hold from a keyframe on, shape (11,)."""
        return self.smoother.estimates.atVector(self.bias_keys[index])

    # ---------------------------------------------------------------- motion

    def motion_since_newest(self, until_ns: int) -> PreintegratedMotion:
        """Provisional motion from the newest keyframe to an instant not before that of any earlier call."""
        if self._latest is None or self._latest[0] != until_ns:
            motion = self._motion(
                self.stamps_ns[-1], until_ns, self._linearised, until_ns
            )
            self._latest = (until_ns, motion)
        return self._latest[1]

    def _motion(
        self, start_ns: int, end_ns: int, linearisation: Linearisation, known_ns: int
    ) -> PreintegratedMotion:
        """Motion of the odometry, with derivatives by all biases."""
        biases, attitude, up, gyro_bias = linearisation
        motion = self.odometry.motion(start_ns, end_ns, gyro_bias, attitude, known_ns)
        # the odometry differentiates by the gyro bias alone, and has taken away no other
        dR = motion.i_T_j.rotation().matrix()
        D = by_biases(
            motion.D_bias,
            dR,
            motion.i_T_j.translation(),
            up,
            attitude[2],
            self._body_p_dvl,
        )
        # then to first order by the other biases
        others = biases.copy()  # (11,)
        others[TILT] -= gyro_bias
        others[HEADING] -= gyro_bias
        return PreintegratedMotion(
            motion.i_T_j.compose(gtsam.Pose3.Expmap(D @ others)),
            motion.covariance,
            D,
            biases,
            motion.duration_s,
            motion.mean_specific_force,
        )

    def _linearisation(self, i: int) -> Linearisation:
        """Where motions from keyframe i are linearised now."""
        biases = self.bias(i)
        attitude = self.smoother.estimates.atPose3(X(i)).rotation().matrix()
        up = attitude[2] if self.calibration.use_gravity else np.zeros(3)
        gyro_bias = np.array(gyro_bias_of(biases, vec(up)))
        return Linearisation(biases, attitude, up, gyro_bias)

    def _linearise(self) -> None:
        """Fix biases and attitude for the motions from a new keyframe at their estimates when it is set.

        If they were fixed at the first call that needs a motion, results would depend on the calls.
        """
        self._linearised = self._linearisation(len(self.stamps_ns) - 1)
        self._latest = None

    # ---------------------------------------------------------------- factors of a new keyframe

    def _add_odometry(
        self, i: int, motion: PreintegratedMotion, linearisation: Linearisation
    ) -> None:
        between: gtsam.NonlinearFactor
        if self._has_motion_biases:
            # R^T up
            up_j = linearisation.up @ motion.i_T_j.rotation().matrix()
            between = OdometryWithBias(X(i), X(i + 1), self.bias_keys[i], motion, up_j)
        else:
            between = factors.odometry(X(i), X(i + 1), motion)
        self.smoother.add({"odometry": between})

    def _add_gravity(self, j: int, node_ns: int, motion: PreintegratedMotion) -> None:
        if not self.calibration.use_gravity:
            return
        velocity_i, variance_i = self.odometry.velocity_at_imu(self.stamps_ns[-1])
        velocity_j, variance_j = self.odometry.velocity_at_imu(node_ns)
        sigma_m_s = np.sqrt(0.5 * (variance_i + variance_j))
        # the bias is a variable of the graph, or has no sigma: it is no noise of the direction
        direction = gravity_direction(
            motion, velocity_i, velocity_j, sigma_m_s, self.calibration, has_bias=False
        )
        if direction is None:
            return
        up, sigma_rad = direction
        if self._has_accel_bias:
            # D by the gyro bias is -T times the mean rotation to frame j
            by_gyro = motion.D_bias[:3, TILT] + motion.D_bias[:3, HEADING]
            by_accel = by_gyro / (-motion.duration_s * self.calibration.gravity_m_s2)
            gravity = factors.gravity_with_bias(
                X(j), self.bias_keys[-1], up, by_accel, sigma_rad
            )
        else:
            gravity = factors.gravity_direction(X(j), up, sigma_rad)
        self.smoother.add({"gravity": gravity})

    def _add_averages(
        self, j: int, interval: Interval, linearisation: Linearisation
    ) -> None:
        """Add one factor for the depths since the last keyframe, and one for the headings."""
        gyro_bias = linearisation.gyro_bias
        depths, self._depths = split_at(self._depths, interval)
        if depths is not None:
            carried = self._carried(depths.stamps_ns, interval, gyro_bias)
            self._add_depth(j, depths, carried)
        headings, self._headings = split_at(self._headings, interval)
        if headings is not None:
            carried = self._carried(headings.stamps_ns, interval, gyro_bias)
            self._add_heading(j, headings, carried, linearisation.biases[COMPASS])

    def _carried(
        self, stamps_ns: Ints, interval: Interval, gyro_bias: Floats
    ) -> Carried:
        """Motions from samples to the keyframe after them."""
        until_ns = np.append(stamps_ns[1:], interval.node_ns)
        known_ns = np.full(len(stamps_ns), interval.known_ns)
        # the keyframe is an epoch: a gap before it has a velocity on both sides
        motions = self.odometry.motions(
            stamps_ns, until_ns, known_ns, gyro_bias, over_gaps=True
        )
        # what is left of the gyro bias turns old samples more: b^2 t^2, of which each motion has the growth
        age_s = np.append(interval.node_ns - stamps_ns, 0) * S_PER_NS
        by_bias_rad2 = self.calibration.imu.gyro_bias_sigma**2 * -np.diff(age_s**2)
        motions.C[:, :3, :3] += by_bias_rad2[:, None, None] * np.eye(3)
        return Carried(*until_last(motions.dR, motions.dp), motions.C)

    def _add_depth(self, j: int, depth: Depth, carried: Carried) -> None:
        """One factor for the averaged samples; at sample k the port lies at ``k_T_j^-1 port`` in frame j."""
        up_j = self.smoother.estimates.atPose3(X(j)).rotation().matrix()[2]
        # only the part of the odometry's error along the vertical moves a depth
        ups = carried.k_R_j[1:] @ up_j  # (n, 3)
        of_ups = carried.C[:, 3:, 3:] @ ups[:, :, None]  # (n, 3, 1)
        wander_m2 = np.vecdot(ups, of_ups[:, :, 0])
        z_m = depth.z_m
        given_m2 = depth.variance_m2
        variance_m2 = np.where(
            np.isnan(given_m2), self.calibration.depth.sigma_m**2, given_m2
        )
        average = average_at_end(variance_m2, wander_m2)
        port = np.array(self.calibration.depth.port_m)
        ports = ((port - carried.k_p_j[:-1])[:, None] @ carried.k_R_j[:-1])[:, 0]
        height_m = float(average.weights @ z_m)
        sigma_m = average.variance**0.5
        self.smoother.add(
            {"depth": factors.depth(X(j), height_m, average.weights @ ports, sigma_m)}
        )

    def _add_heading(
        self, j: int, heading: Heading, carried: Carried, compass_rad: float
    ) -> None:
        """One factor for the averaged innovations of the samples.

        A sample far from the median innovation has less weight, after Huber.
        """
        R_j = self.smoother.estimates.atPose3(X(j)).rotation().matrix()
        R_k = R_j @ carried.k_R_j.transpose(0, 2, 1)
        yaw_rad = np.arctan2(R_k[:, 1, 0], R_k[:, 0, 0])
        ups = carried.k_R_j[1:] @ R_j[2]  # (n, 3)
        wander_rad2 = np.einsum("ka,kab,kb->k", ups, carried.C[:, :3, :3], ups)
        innovation = wrap_angle(heading.yaw_rad - yaw_rad[:-1] - compass_rad)
        given_rad = heading.sigma_rad
        sigma_rad = np.where(
            np.isnan(given_rad), self.calibration.heading.sigma_rad, given_rad
        )
        off = np.abs(wrap_angle(innovation - np.median(innovation))) / (
            HUBER_WIDTHS[1] * sigma_rad
        )
        # beyond k sigma the noise grows with the error: R d / k
        average = average_at_end(sigma_rad**2 * np.maximum(1.0, off), wander_rad2)
        measured_rad = yaw_rad[-1] + compass_rad + average.weights @ innovation
        factor = factors.heading(
            X(j), self.bias_keys[-1], measured_rad, average.variance**0.5
        )
        self.smoother.add({"heading": factor})
        bias_sigma_rad = self.calibration.heading.bias_sigma_rad

        def distances(values: Known) -> Floats:
            x, y, _ = values.atPose3(X(j)).matrix()[:3, 0]
            missed_rad = wrap_angle(
                innovation + compass_rad + yaw_rad[-1] - np.arctan2(y, x)
            )
            return np.abs(missed_rad) / np.hypot(sigma_rad, bias_sigma_rad)

        self._unjudged.append(("heading", distances))

    def _judge(self) -> None:
        """Compare the headings and fixes since the last keyframe with the estimate that contains them."""
        for sensor, distances in self._unjudged:
            self.contradictions.judge(sensor, distances(self.smoother.estimates))
        self._unjudged.clear()

    # ---------------------------------------------------------------- position fixes

    def add_fix(self, stamp_ns: int, position_m: Floats, cov_m2: Floats) -> None:
        """Tie a position fix to the keyframe before it; refuse one that is too late.

        A fix that would hardly change the estimate waits for the next update (`FIX_GAIN`).
        """
        i = bisect_right(self.stamps_ns, stamp_ns) - 1
        is_late = i < 0 or self.stamps_ns[i] < self.stamps_ns[-1] - self._lag_ns
        if is_late or not self.smoother.in_window([X(i)]):
            self.refuse("positions", stamp_ns, Refusal.LATE)
            return
        world_R_i = self.smoother.estimates.atPose3(X(i)).rotation().matrix()
        if stamp_ns >= self.advanced_ns:
            motion = self.motion_since_newest(stamp_ns)
        else:  # late: from an earlier keyframe, by rows that are known by now
            motion = self._motion(
                self.stamps_ns[i],
                stamp_ns,
                self._linearisation(i),
                self.advanced_ns,
            )
        motion = self._shared_over_gap(self.stamps_ns[i], stamp_ns, motion)
        antenna = np.array(self.calibration.positions.antenna_m)
        arm = motion.i_T_j.transformFrom(antenna)
        world_R_fix = world_R_i @ motion.i_T_j.rotation().matrix()
        by_motion = body_point_jacobian(world_R_fix, antenna)  # (3, 6)
        # the fix hangs on the keyframe: the error of the motion between them is noise
        noise_m2 = cov_m2 + by_motion @ motion.covariance @ by_motion.T  # (3, 3)
        D = by_motion @ motion.D_bias  # (3, 11)
        by_biases_m2 = D * np.square(self._bias_sigmas) @ D.T  # (3, 3)
        # beside the estimate at the keyframe the biases of the motion to the fix are an error too
        spread_m2 = noise_m2 + by_biases_m2
        factor: gtsam.NonlinearFactor
        share = by_biases_m2.diagonal() / noise_m2.diagonal()
        if (share > LEAST_BIAS_SHARE).any():
            keys = (X(i), self.bias_keys[i])
            factor = factors.position_with_biases(
                keys, position_m, motion, antenna, noise_m2
            )
        else:
            factor = factors.position(X(i), position_m, arm, noise_m2)
        gain = np.inf  # enters at once
        if i == len(self.stamps_ns) - 1 and not self.smoother.is_due:
            by_pose = body_point_jacobian(world_R_i, arm)
            P = self.smoother.joint_covariance([X(i)]).at(X(i), X(i))
            predicted_m2 = by_pose @ P @ by_pose.T  # (3, 3)
            gain = FIX_GAIN * (predicted_m2.diagonal() / spread_m2.diagonal()).max()
        self.smoother.add({"position": factor}, gain=gain)

        def distance(values: Known) -> Floats:
            e = values.atPose3(X(i)).transformFrom(arm) - position_m
            return np.sqrt(e @ np.linalg.solve(spread_m2, e))

        self._unjudged.append(("positions", distance))
