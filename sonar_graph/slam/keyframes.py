"""Keyframes, and the factors that odometry, depth and gravity give each of them.

A keyframe sits at an epoch of the odometry (a DVL stamp). One is due ``max_interval_s`` after the last, and sooner when
landmarks are seen and the noise of the motion since then would blur them (docs/theory/isam2.md). The gyro bias is
constant over stretches of ``bias_interval_s`` and walks between them.

Rows that cannot be measurements are refused: variances not above zero, covariances not positive definite, impossible
ranges. NaN is sound: the log does not know the noise, and the calibration does.
"""

from bisect import bisect_left
from dataclasses import dataclass, field, replace
from typing import TypeVar

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, X
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Calibration, Section
from sonar_graph.measurements import Depth, Dvl, Floats, Imu, LandmarkDetections, possible_ranges
from sonar_graph.navigation import (
    Odometry,
    PreintegratedMotion,
    RunningMotion,
    in_numbers,
    motion_between_nodes,
    weights_at_end,
)
from sonar_graph.navigation.alignment import earth_rate_in_world, gravity_direction, velocity_at_imu
from sonar_graph.navigation.preintegration import Preintegrator, Steps
from sonar_graph.numerics import compiled
from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import DetectionJournal, Outcome, Refusal, RefusedRow

ROUNDING = 1e-13
"""Share of the largest variance below which what is left of another is taken for zero."""
Flags = NDArray[np.bool_]


def sound_detections(frame: LandmarkDetections) -> Flags:
    """Rows that a sonar can have measured, shape (n,)."""
    unsaid = np.asarray(np.isnan(frame.range_azimuth_cov).any(axis=(1, 2)))
    return possible_ranges(frame.range_m) & (unsaid | positive_definite(frame.range_azimuth_cov))


def without_unsound(frame: LandmarkDetections, journal: DetectionJournal) -> LandmarkDetections | None:
    """Frame without rows that no sonar can have measured, which go to the journal; None: no row is left."""
    is_sound = sound_detections(frame)
    if is_sound.all():
        return frame
    for landmark_id in frame.most_probable()[0][~is_sound].tolist():
        journal.record(int(frame.stamps_ns[0]), landmark_id, Outcome.UNSOUND)
    return frame.rows(is_sound) if is_sound.any() else None


@compiled
def positive_definite(covs: Floats) -> Flags:
    """Flags of symmetric matrices, shape (n, k, k), that are finite and positive definite, by Cholesky."""
    n, k = covs.shape[:2]
    found = np.ones(n, np.bool_)
    for row in range(n):
        L, largest = np.zeros((k, k)), 0.0
        for i in range(k):
            largest = max(largest, covs[row, i, i])
        for i in range(k):
            for j in range(i + 1):
                rest = covs[row, i, j]
                for m in range(j):
                    rest -= L[i, m] * L[j, m]
                if i > j:
                    L[i, j] = rest / L[j, j]
                elif rest > ROUNDING * largest and rest < np.inf:
                    L[i, i] = np.sqrt(rest)
                else:  # NaN ends here too
                    found[row] = False
                    L[i, i] = 1.0
    return found


S_PER_NS = 1e-9
CARRIED_IN_GAP_NS = 300_000_000
"""Longest time over which a depth sample is carried straight on over the end of a gap."""
Rows = TypeVar("Rows", Dvl, Depth)
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
    params: KeyframeParams
    smoother: Smoother
    stamps_ns: list[int] = field(default_factory=list)
    """Stamps of the keyframes; the key of each is ``X(index)``."""
    bias_keys: list[int] = field(default_factory=list)
    """Key of the gyro bias that holds from each keyframe on."""
    advanced_ns: int = EARLIEST_NS
    """Latest instant that was advanced to."""

    def __post_init__(self) -> None:
        self.odometry = Odometry(self.calibration)
        self._preintegrator = Preintegrator.from_calibration(self.calibration)
        self._estimates_bias = self.calibration.imu.gyro_bias_sigma > 0
        self._bias_since_ns = 0
        self._running: RunningMotion | None = None
        self._latest: tuple[int, PreintegratedMotion] | None = None
        self._depths: list[Depth] = []
        self._told = 0
        self._refused: list[RefusedRow] = []
        self._earth = earth_rate_in_world(self.calibration)

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
        """Take in rows; refuse unsound ones, and depths older than those that wait."""
        if dvl is not None:  # an infinite variance is sound: that axis was not measured
            dvl = self._sound("dvl", dvl, positive_definite(in_numbers(dvl.velocity_cov, np.eye(3))))
        if depth is not None:
            variance = np.where(np.isnan(depth.variance_m2), 1.0, depth.variance_m2)
            depth = self._sound("depth", depth, (variance > 0) & np.isfinite(variance))
        if self.odometry.add(imu, dvl):
            self._running = None
        self._latest = None
        newest_ns = self._depths[-1].stamps_ns[-1] if self._depths else EARLIEST_NS
        if depth is not None and depth.stamps_ns[0] < newest_ns:
            late = depth.stamps_ns[depth.stamps_ns < newest_ns]
            self._refused += [RefusedRow("depth", stamp_ns, Refusal.LATE, np.nan) for stamp_ns in late.tolist()]
        if depth is not None and (in_order := depth.between(newest_ns, LATEST_NS)):
            self._depths.append(in_order)

    def _sound(self, sensor: str, rows: Rows, is_sound: NDArray[np.bool_]) -> Rows | None:
        """Rows that can be measurements; the others are refused."""
        if is_sound.all():
            return rows
        unsound = rows.stamps_ns[~is_sound].tolist()
        self._refused += [RefusedRow(sensor, stamp_ns, Refusal.UNSOUND, np.nan) for stamp_ns in unsound]
        return rows.rows(is_sound) if is_sound.any() else None

    @property
    def refused(self) -> list[RefusedRow]:
        """Rows of IMU, Doppler log and depth that are not used, and why."""
        return self.odometry.refused + self._refused

    def advance(self, until_ns: int) -> None:
        """Set the keyframes that are due from epochs reached at an instant; the first starts the graph."""
        self.advanced_ns = max(self.advanced_ns, until_ns)
        if not self.stamps_ns:
            start_ns = self.odometry.start_by(until_ns)
            if start_ns is None:
                return
            self.stamps_ns.append(start_ns)
            self._bias_since_ns = start_ns
            self.smoother.add_pose(X(0), self.calibration.start.pose(), start_ns * S_PER_NS)
            self.smoother.add([factors.start_prior(X(0), self.calibration)])
            self.bias_keys.append(B(0))
            if self._estimates_bias:
                self.smoother.add_bias(B(0), np.zeros(3))
                self.smoother.add([factors.bias_prior(B(0), self.calibration.imu.gyro_bias_sigma)])
            self._constrain(0)
        interval_ns = round(self.params.max_interval_s / S_PER_NS)
        for node_ns in self.odometry.nodes(self.stamps_ns[-1], until_ns).tolist():
            if node_ns - self.stamps_ns[-1] >= interval_ns:
                self._set(node_ns)

    def set_for_frame(self, stamp_ns: int, motion: PreintegratedMotion) -> PreintegratedMotion:
        """Set a keyframe if a frame needs a newer one; the motion from the then newest keyframe to the frame."""
        node_ns = self.odometry.newest_node(self.stamps_ns[-1], stamp_ns)
        if node_ns is not None:
            sonar, bias_sigma = self.calibration.sonar, self.calibration.imu.gyro_bias_sigma
            turn, shift = largest_variances(motion.covariance, motion.D_bias, bias_sigma)
            share = max(turn / sonar.azimuth_sigma_rad**2, shift / sonar.range_sigma_m**2)
            if share > self.params.motion_noise_share:
                self._set(node_ns)
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
        if self._running is None:
            self._running = RunningMotion(
                self.odometry,
                self._preintegrator,
                self.stamps_ns[-1],
                self.bias(len(self.stamps_ns) - 1),
                self._earth_rate(),
            )
        if self._latest is None or self._latest[0] != until_ns:
            self._latest = until_ns, self._running.until(until_ns)
        return self._latest[1]

    def update_if_due(self) -> None:
        """Bring the smoother up to date when what was added since it last was matters."""
        if self.smoother.is_due:
            self.smoother.update(self.newest_s)

    def bias(self, index: int) -> Floats:
        """Newest estimate of the gyro bias that holds from a keyframe on, shape (3,), rad/s."""
        return self.smoother.values.atPoint3(self.bias_keys[index]) if self._estimates_bias else np.zeros(3)

    def bias_key(self, index: int) -> int | None:
        """Key of the bias that holds from a keyframe on, -1 the newest; None when there is none to estimate."""
        return self.bias_keys[index] if self._estimates_bias else None

    def _earth_rate(self) -> Floats | None:
        if self._earth is None:
            return None
        return self.smoother.values.atPose3(self.newest_key).rotation().matrix().T @ self._earth

    def _set(self, node_ns: int) -> None:
        i, j = len(self.stamps_ns) - 1, len(self.stamps_ns)
        start_ns, bias, earth_rate = self.stamps_ns[-1], self.bias(i), self._earth_rate()
        gaps = self.odometry.gaps(start_ns, node_ns)
        since_ns = gaps[-1][1] - CARRIED_IN_GAP_NS if gaps else start_ns  # depth samples are carried over no gap
        steps = self.odometry.steps_to_node(since_ns, node_ns)
        motion = carried = self._preintegrator.integrate(steps, bias, earth_rate)
        if gaps:
            motion = motion_between_nodes(self.odometry, self._preintegrator, start_ns, node_ns, bias, earth_rate)
        self.smoother.add_pose(X(j), self.smoother.values.atPose3(X(i)).compose(motion.i_T_j), node_ns * S_PER_NS)
        if self._estimates_bias:
            between = factors.odometry_with_bias(X(i), X(j), self.bias_keys[i], motion)
        else:
            between = factors.odometry(X(i), X(j), motion)
        self.smoother.add([between, *self._gravity(j, node_ns, motion)])
        self.smoother.add(self._depth(j, node_ns, since_ns, steps, carried))
        self.bias_keys.append(self._next_bias_key(i, node_ns))
        self.stamps_ns.append(node_ns)
        self._running = self._latest = None
        self._constrain(j)
        self.odometry.forget_before(node_ns)

    def _gravity(self, j: int, node_ns: int, motion: PreintegratedMotion) -> list[gtsam.NonlinearFactor]:
        if not self.calibration.use_gravity:
            return []
        (v_i, cov_i, rate_i), (v_j, cov_j, rate_j) = map(self.odometry.velocity_at_node, (self.stamps_ns[-1], node_ns))
        imu, dvl_m = self.calibration.imu, np.array(self.calibration.dvl.mounting.translation_m)
        imu_m = np.array(imu.mounting.translation_m)
        at_i, at_j = velocity_at_imu(v_i, rate_i, dvl_m, imu_m), velocity_at_imu(v_j, rate_j, dvl_m, imu_m)
        sigma = float(np.sqrt((np.trace(cov_i) + np.trace(cov_j)) / 6))
        up = gravity_direction(motion, at_i, at_j, sigma, imu, self.calibration.gravity_m_s2)
        return [factors.gravity_direction(X(j), *up)] if up else []

    def _depth(
        self, j: int, node_ns: int, start_ns: int, steps: Steps, motion: PreintegratedMotion
    ) -> list[gtsam.NonlinearFactor]:
        """One factor for the samples since an instant, carried by the motion to this keyframe and averaged there."""
        if not self._depths:
            return []
        waiting = Depth.concatenate(self._depths)
        later = waiting.between(node_ns, LATEST_NS)
        self._depths = [later] if later else []
        samples = waiting.between(start_ns, node_ns)
        if samples is None:
            return []
        up = self.smoother.values.atPose3(self.newest_key).rotation().matrix()[2]
        mean_psd = np.average(steps.velocity_psd, axis=0, weights=steps.duration_s)
        wander_m2_s = float(up @ mean_psd @ up)  # spectral density of the vertical velocity noise
        variance = np.where(np.isnan(samples.variance_m2), self.calibration.depth.sigma_m**2, samples.variance_m2)
        offsets_s = np.asarray((samples.stamps_ns - start_ns) * S_PER_NS, dtype=np.float64)
        weights, mean_variance = weights_at_end(variance, motion.duration_s - offsets_s, wander_m2_s)
        port = np.array(self.calibration.depth.port_m)
        mean_port = weights @ self._preintegrator.path_of(port, steps, motion.bias, offsets_s)
        return [
            factors.depth(X(j), float(weights @ samples.z_m), motion.i_T_j.transformTo(mean_port), mean_variance**0.5)
        ]

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
        self.smoother.add([factors.bias_walk(old, new, walk * np.sqrt(elapsed_s))])
        return new


@compiled
def largest_variances(cov: Floats, D_bias: Floats, bias_sigma: float) -> tuple[float, float]:
    """Largest variance of rotation (rad²) and of translation (m²) by noise and an unknown gyro bias."""
    largest = np.zeros(2)
    for r in range(6):
        by_bias = D_bias[r, 0] ** 2 + D_bias[r, 1] ** 2 + D_bias[r, 2] ** 2
        largest[r // 3] = max(largest[r // 3], cov[r, r] + by_bias * bias_sigma**2)
    return largest[0], largest[1]
