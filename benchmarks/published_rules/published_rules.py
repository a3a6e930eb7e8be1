"""Estimators by the rules of others, re-created from their papers and manuals, for the open bench.

* `PlainIsam2`: the graph of a GTSAM tutorial (`PlanarSLAMExample`, `iSAM2`): Gaussian noise, no gate, no robust kernel,
  no gyro bias, default parameters of ``gtsam.ISAM2``, every frame with detections a pose.
* `HeldVelocity`: iSAM2 as ours, with a Doppler velocity held until the next sample and turned by the rotation of the
  middle of the interval, as coug_fgo integrates it.
* `NewestVelocity`: the same with the sample at the end of each interval, turned by the rotation there, as TURTLMap
  (Song, Nieto-Granda et al., 2024) preintegrates it.

Both rules: docs/theory/preintegration.md. What is not theirs (screening of outliers, gaps of the Doppler log, motion to
instants between its samples, noise of the gyros) is ours in all rows, so that a row differs in its rule alone. Names of
these projects say where a rule was read; the numbers are not theirs.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from scipy.spatial.transform import Rotation

from sonar_graph import Calibration, Odometry
from sonar_graph.calibration import Section
from sonar_graph.measurements import Depth, Floats, LandmarkDetections, Measurements
from sonar_graph.models import (
    ACCEPTED,
    MINIMUM_PROBABILITY,
    elevation_on_floor,
    identify,
    locate,
)
from sonar_graph.motion import MotionSource, PreintegratedMotion
from sonar_graph.navigation.preintegration import Rows, Sensors
from sonar_graph.numerics import running_rotations
from sonar_graph.slam import Isam2, factors
from sonar_graph.states import (
    OUTCOME_NUMBERS,
    CausalEstimates,
    DetectionJournal,
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    RefusedRow,
    Trajectory,
)

NO_BIAS = np.zeros(3)
DEPTH_IS_NEW_NS = 1_000_000_000
LONGEST_HOLE_NS = 50_000_000
OUTCOMES = {number: outcome for outcome, number in OUTCOME_NUMBERS.items()}


class PlainParams(Section):
    """Settings of the plain graph."""

    minimum_id_probability: float = MINIMUM_PROBABILITY


class PlainIsam2:
    """The graph of a GTSAM tutorial under ``gtsam.ISAM2`` as it comes."""

    Params: ClassVar[type[Section]] = PlainParams

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,
        params: PlainParams | None = None,
    ) -> None:
        self._calibration, self._odometry = calibration, odometry
        self._params = params or PlainParams()
        self._isam = gtsam.ISAM2()
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._body_T_sonar = calibration.sonar.mounting.pose()
        self._nodes_ns: list[int] = []
        self._poses: list[tuple[int, int, PreintegratedMotion]] = []
        """Stamp, pose before it, and the motion from there, of every estimate."""
        self._estimates, self._journal = CausalEstimates(), DetectionJournal()
        self._seen: set[int] = set()
        self._depth: Depth | None = None
        self._pose, self._covariance = calibration.start.pose(), np.zeros((6, 6))

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements: a pose and an update for each frame of detections; causal estimate at the end."""
        self._odometry.add(measurements.imu, measurements.dvl)
        self._depth = self._odometry.used_depths(measurements.depth) or self._depth
        if (
            not self._nodes_ns
            and (start_ns := self._odometry.start_by(measurements.end_ns)) is not None
        ):
            self._nodes_ns = [start_ns]
            self._values.insert(X(0), self._pose)
            self._graph.push_back(factors.start_prior(X(0), self._calibration))
            self._constrain(0)
            self._update()
        if not self._nodes_ns or measurements.end_ns < self._nodes_ns[-1]:
            return None
        detections = measurements.detections
        for frame_ns in (
            np.unique(detections.stamps_ns).tolist() if detections is not None else []
        ):
            epochs_ns = self._odometry.epochs(self._nodes_ns[-1], frame_ns)
            if len(epochs_ns):
                self._add_pose(int(epochs_ns[-1]), frame_ns)
            if frame_ns >= self._nodes_ns[-1]:
                self._add_sightings(detections.rows(detections.stamps_ns == frame_ns))
                self._update()
        motion = self._odometry.motion(self._nodes_ns[-1], measurements.end_ns, NO_BIAS)
        A = motion.i_T_j.inverse().AdjointMap()
        self._poses.append((measurements.end_ns, len(self._nodes_ns) - 1, motion))
        pose = self._pose.compose(motion.i_T_j)
        estimate = Estimate(
            measurements.end_ns, pose, A @ self._covariance @ A.T + motion.covariance
        )
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """Smoothed poses at the instants of the estimates."""
        values, marginal = (
            self._isam.calculateEstimate(),
            cache(lambda node: self._isam.marginalCovariance(X(node))),
        )
        smoothed = CausalEstimates()
        for stamp_ns, node, motion in self._poses:
            A = motion.i_T_j.inverse().AdjointMap()
            covariance = A @ marginal(node) @ A.T + motion.covariance
            smoothed.keep(
                Estimate(
                    stamp_ns, values.atPose3(X(node)).compose(motion.i_T_j), covariance
                )
            )
        return smoothed.trajectory()

    def landmarks(self) -> LandmarkMap:
        """The map with marginal covariances."""
        ids, values = sorted(self._seen), self._isam.calculateEstimate()
        positions = np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3)
        covariances = np.array(
            [self._isam.marginalCovariance(L(i)) for i in ids]
        ).reshape(-1, 3, 3)
        return LandmarkMap(np.array(ids, np.int64), positions, covariances)

    def detections(self) -> DetectionLog:
        """Every detection: used, or without an identity."""
        return self._journal.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU, Doppler log and depth that are not used, with the reason."""
        return self._odometry.refused

    def _add_pose(self, node_ns: int, known_ns: int) -> None:
        motion = self._odometry.motion(
            self._nodes_ns[-1], node_ns, NO_BIAS, known_ns=known_ns
        )
        j = len(self._nodes_ns)
        self._graph.push_back(factors.odometry(X(j - 1), X(j), motion))
        self._values.insert(X(j), self._pose.compose(motion.i_T_j))
        self._pose = self._pose.compose(motion.i_T_j)
        self._nodes_ns.append(node_ns)
        self._constrain(j)
        self._odometry.forget_before(node_ns)

    def _constrain(self, j: int) -> None:
        """Depth of the newest sample before the pose, and planar motion where the calibration says so."""
        if self._calibration.planar:
            for factor in factors.planar(X(j), self._calibration.planar).values():
                self._graph.push_back(factor)
        depth = self._depth and self._depth.between(
            self._nodes_ns[j] - DEPTH_IS_NEW_NS, self._nodes_ns[j]
        )
        if depth:
            port, sigma_m = (
                np.array(self._calibration.depth.port_m),
                self._calibration.depth.sigma_m,
            )
            self._graph.push_back(
                factors.depth(X(j), float(depth.z_m[-1]), port, sigma_m)
            )

    def _add_sightings(self, frame: LandmarkDetections) -> None:
        frame_ns, sonar = int(frame.stamps_ns[0]), self._calibration.sonar
        motion = self._odometry.motion(self._nodes_ns[-1], frame_ns, NO_BIAS)
        body_T_sonar = motion.i_T_j.compose(self._body_T_sonar)
        ids, outcomes = identify(frame, self._params.minimum_id_probability)
        for row, (landmark, outcome) in enumerate(
            zip(ids.tolist(), outcomes.tolist(), strict=True)
        ):
            if outcome != ACCEPTED:
                self._journal.record(frame_ns, landmark, OUTCOMES[outcome])
                continue
            z = np.array([frame.range_m[row], frame.azimuth_rad[row]])
            if landmark not in self._seen:
                self._begin(landmark, self._pose.compose(body_T_sonar), z)
            newest, cov = X(len(self._nodes_ns) - 1), frame.range_azimuth_cov[row]
            if np.isnan(cov).any():
                cov = np.diag([sonar.range_sigma_m, sonar.azimuth_sigma_rad]) ** 2
            made = factors.landmark_sighting(
                newest, L(landmark), body_T_sonar, z, cov, lambda noise: noise
            )
            for factor in made.values():
                self._graph.push_back(factor)
            self._journal.record(frame_ns, landmark, Outcome.USED)

    def _begin(self, landmark: int, world_T_sonar: gtsam.Pose3, z: Floats) -> None:
        self._seen.add(landmark)
        floor, aperture = (
            self._calibration.floor,
            self._calibration.sonar.elevation_aperture_rad,
        )
        elevation = (
            elevation_on_floor(world_T_sonar, z[0], z[1], floor.z_m, aperture)
            if floor
            else None
        )
        self._values.insert(
            L(landmark), locate(world_T_sonar, z[0], z[1], elevation or 0.0)
        )
        if floor:
            self._graph.push_back(
                factors.floor_prior(L(landmark), floor.z_m, floor.sigma_m)
            )

    def _update(self) -> None:
        self._isam.update(self._graph, self._values)
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        newest = X(len(self._nodes_ns) - 1)
        self._pose, self._covariance = (
            self._isam.calculateEstimatePose3(newest),
            self._isam.marginalCovariance(newest),
        )


class DopplerRule(NamedTuple):
    """Velocity between two Doppler samples, and the rotation that turns it."""

    later: float
    """Share of the later sample; the rest is that of the earlier one."""
    turned_at: float
    """Instant of the rotation, as a share of the interval."""


ZOH_PREVIOUS = DopplerRule(later=0.0, turned_at=0.5)
ZOH_CURRENT = DopplerRule(later=1.0, turned_at=1.0)
TRAPEZOID = DopplerRule(later=0.5, turned_at=0.5)


def motion_by_rule(
    rows: Rows,
    rule: DopplerRule,
    start_ns: int,
    end_ns: int,
    bias: Floats,
    sensors: Sensors,
) -> PreintegratedMotion:
    """Motion between two epochs by a rule, and its covariance by gyro noise and the samples with their weights.

    ``s = sum_k T_k R_k v_k`` over the Doppler intervals. With x(t) minus what s gains after t, an error theta of the
    gyros at t changes s by ``[x]x theta``.
    """
    k = slice(*np.searchsorted(rows.dvl_ns, [start_ns, end_ns + 1]))
    epochs_ns = rows.dvl_ns[k]
    intervals_ns = np.diff(epochs_ns)
    turned_ns = epochs_ns[:-1] + np.floor(rule.turned_at * intervals_ns).astype(
        np.int64
    )
    within = rows.imu_ns[(rows.imu_ns > start_ns) & (rows.imu_ns < end_ns)]
    cuts_ns = np.unique(np.concatenate([epochs_ns, turned_ns, within]))
    middles_ns = cuts_ns[:-1] + np.diff(cuts_ns) // 2
    dt = np.diff(cuts_ns) * 1e-9
    since = rows.imu_ns - start_ns
    rate = (
        np.column_stack(
            [np.interp(middles_ns - start_ns, since, column) for column in rows.rate.T]
        )
        - bias
    )
    R = running_rotations(rate * dt[:, None])  # at the cuts
    R_mid = R[:-1] @ Rotation.from_rotvec(0.5 * rate * dt[:, None]).as_matrix()

    z = rows.velocity[k]
    v = (1.0 - rule.later) * z[:-1] + rule.later * z[1:]
    used = np.searchsorted(cuts_ns, turned_ns)
    turned = R[used] * (intervals_ns * 1e-9)[:, None, None]
    gains = np.zeros((len(cuts_ns), 3))
    gains[used] = (turned @ v[:, :, None])[:, :, 0]
    s = gains.sum(axis=0)
    x = np.cumsum(gains, axis=0)[:-1] - s
    X = np.array([gtsam.SO3.Hat(one) for one in x])
    weights = np.zeros((len(z), 3, 3))
    weights[:-1] += (1.0 - rule.later) * turned
    weights[1:] += rule.later * turned

    n_g2 = sensors.gyro_density**2
    C, D = np.zeros((6, 6)), np.zeros((6, 3))
    C[:3, :3] = n_g2 * dt.sum() * np.eye(3)
    C[3:, :3] = n_g2 * np.einsum("n,nij->ij", dt, X)
    C[:3, 3:] = C[3:, :3].T
    C[3:, 3:] = n_g2 * np.einsum("n,nij,nkj->ik", dt, X, X) + np.sum(
        weights @ rows.cov[k] @ weights.mT, axis=0
    )
    D[:3] = -np.einsum("n,nij->ij", dt, R_mid)
    D[3:] = -np.einsum("n,nij,njk->ik", dt, X, R_mid)

    # from the log's displacement to the body's: p = s - R l + l
    i_R_j, lever = R[-1], sensors.body_p_dvl
    J = np.eye(6)
    J[3:, :3] = gtsam.SO3.Hat(i_R_j @ lever)
    J = np.kron(np.eye(2), i_R_j.T) @ J
    pose = gtsam.Pose3(gtsam.Rot3(i_R_j), s - i_R_j @ lever + lever)
    return PreintegratedMotion(
        pose, J @ C @ J.T, J @ D, bias, float(dt.sum()), np.full(3, np.nan)
    )


class RuleOdometry(Odometry):
    """Motion with the velocity between Doppler samples by another rule; between other instants, and over gaps, ours."""

    rule: DopplerRule

    def motion(
        self,
        start_ns: int,
        end_ns: int,
        bias: Floats,
        world_R_i: Floats | None = None,
        known_ns: int | None = None,
    ) -> PreintegratedMotion:
        """Motion by the rule where both instants are epochs and neither a gap nor a hole of the IMU lies between."""
        ours = super().motion(start_ns, end_ns, bias, world_R_i, known_ns)
        epochs_ns = self.epochs(start_ns - 1, end_ns if known_ns is None else known_ns)
        epochs_ns = epochs_ns[: np.searchsorted(epochs_ns, end_ns, side="right")]
        are_ends = (
            len(epochs_ns) > 1 and epochs_ns[0] == start_ns and epochs_ns[-1] == end_ns
        )
        if not are_ends or any(
            self.is_gap(a, b) for a, b in pairwise(epochs_ns.tolist())
        ):
            return ours
        rows = self.rows()
        first, last = np.searchsorted(rows.imu_ns, [start_ns, end_ns])
        if (np.diff(rows.imu_ns[max(first - 1, 0) : last + 1]) > LONGEST_HOLE_NS).any():
            return ours
        by_rule = motion_by_rule(
            rows, self.rule, start_ns, end_ns, bias, Sensors.of(self.calibration)
        )
        return replace(by_rule, mean_specific_force=ours.mean_specific_force)


class HeldVelocityOdometry(RuleOdometry):
    """coug_fgo's rule."""

    rule = ZOH_PREVIOUS


class NewestVelocityOdometry(RuleOdometry):
    """TURTLMap's rule."""

    rule = ZOH_CURRENT


class HeldVelocity(Isam2):
    """iSAM2 on `HeldVelocityOdometry`."""

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,  # noqa: ARG002
        params: Any = None,
    ) -> None:
        super().__init__(calibration, HeldVelocityOdometry(calibration), params)


class NewestVelocity(Isam2):
    """iSAM2 on `NewestVelocityOdometry`."""

    def __init__(
        self,
        calibration: Calibration,
        odometry: MotionSource,  # noqa: ARG002
        params: Any = None,
    ) -> None:
        super().__init__(calibration, NewestVelocityOdometry(calibration), params)
