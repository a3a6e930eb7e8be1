"""Shell of both landmark filters: the contract, the order of events, and the outcomes of detections.

A filter's state sits at an epoch, a stamp of the Doppler log. Events happen in the order of their stamps, whatever the
calls in which measurements arrive: an epoch when it is reached, a depth sample, then the detections of a frame. What is
measured at an instant is related to the newest epoch reached by then, through a motion from rows stamped no later::

    epoch i --- epoch j          predict; then the plane, and gravity where an interval of it ends here
          i -------- t           depth sample, frame, or estimate at the end of the call

Measurements that are related to one epoch over the same gap of the Doppler log share its error. The k-th gets k (k + 1)
times the motion's covariance: together those of one kind, depths or detections, tell no more than one exact
measurement, ``sum 1 / (k (k + 1)) = 1``.

Far landmarks (`far_view`) and the choices that the paper leaves open: docs/theory/ekf_slam.md, docs/theory/gaps.md.
"""

import math
from abc import ABC, abstractmethod
from bisect import bisect_left
from typing import NamedTuple

import gtsam
import numpy as np
from pydantic import Field

from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.errors import EstimatorError, MeasurementError
from sonar_graph.measurements import Floats, LandmarkDetections, Measurements
from sonar_graph.motion import Motions, MotionSource, require_source
from sonar_graph.navigation.alignment import earth_rate_in_world, tilt_sigma, up_direction
from sonar_graph.numerics import block, compiled, cross, exp_and_mean, mat, store, vec
from sonar_graph.slam.landmarks import gate_threshold, identify
from sonar_graph.slam.models import elevation_on_floor
from sonar_graph.states import (
    CausalEstimates,
    DetectionJournal,
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    RefusedRow,
    Trajectory,
)


class FilterParams(Section):
    """Settings of both filters; the paper gives none of them."""

    gate_probability: float = Field(0.999, gt=0, le=1)
    """Probability with which a right detection passes the gate (chi-square); 1: no gate."""
    minimum_id_probability: float = Field(0.5, ge=0, le=1)
    """Least posterior of the most probable identity with which a detection is used."""
    gravity_interval_s: float = Field(1.0, gt=0)
    """Time over which the specific force is averaged for one correction of roll and pitch."""


# ------------------------------------------------------------------------------------------------- motions and events


class Motion(Motions):
    """One row of `Motions`: i_T_j with covariance C, derivative D by the gyro bias, and impulse."""


@compiled
def corrected(
    dR_: Floats, dp_: Floats, D: Floats, impulse: Floats, bias: Floats, earth: Floats
) -> tuple[Floats, Floats, Floats]:
    """dR, dp and impulse without a gyro bias and the Earth's rate, to first order.

    ``earth`` is the Earth's rate in frame i, rad/s. To gyros it is a bias, the mean of that in both frames, i and j;
    the specific force is turned by half of what the body is.
    """
    dR, dp = mat(dR_), vec(dp_)
    rate = vec(bias) + 0.5 * (vec(earth) + dR.T @ vec(earth))
    theta, rho = block(D, 0, 0) @ rate, block(D, 3, 0) @ rate
    turned, moved, pushed = np.empty((3, 3)), np.empty(3), np.empty(3)
    store(dR @ exp_and_mean(theta)[0], turned, 0, 0)
    moved[0], moved[1], moved[2] = dp + dR @ rho
    pushed[0], pushed[1], pushed[2] = vec(impulse) + 0.5 * cross(dR @ theta, vec(impulse))
    return turned, moved, pushed


EPOCH, DEPTH, FRAME, END, GRAVITY = range(5)
"""Kinds of events; at equal stamps the lower comes first, and `GRAVITY` right after its epoch."""


class Event(NamedTuple):
    """An epoch, a depth sample, the detections of a frame, the end of a call, or of an interval of gravity."""

    stamp_ns: int
    """When it happens; no row stamped later is used."""
    kind: int
    row: int
    """Of the depth sample or frame; the stamp of an epoch."""
    start_ns: int
    """Epoch at which its motion begins."""
    end_ns: int


def in_order(happening: list[tuple[int, int, int]], node_ns: int, opened_ns: int, interval_ns: int) -> list[Event]:
    """Events in their order, each with its motion from the newest epoch; gravity's from the one where it was last used.

    ``happening``: stamp, kind and row, in any order; ``node_ns``, ``opened_ns``: epochs of the state and at which
    the interval of gravity began; ``interval_ns``: least length of such an interval, 0 for none.
    """
    events = []
    for stamp_ns, kind, row in sorted(happening):
        events.append(Event(stamp_ns, kind, row, node_ns, row if kind == EPOCH else stamp_ns))
        if kind == EPOCH:
            node_ns = row
            if 0 < interval_ns <= node_ns - opened_ns:
                events.append(Event(stamp_ns, GRAVITY, row, opened_ns, node_ns))
                opened_ns = node_ns
    return events


# ------------------------------------------------------------------------------------------------- update, detections


@compiled
def correction(P: Floats, U: Floats, S: Floats, e: Floats) -> Floats:
    """``K e`` (n,) of an update by m numbers, ``K = P H^T S^-1``, from ``U = H P`` (m, n); P becomes ``P - K S K^T``.

    With ``S = L L^T`` and ``V = L^-1 U`` that is ``P - V^T V``, row by row. Both factors of every product commute, so
    that P stays symmetric to the last bit. Raises LinAlgError where S is not positive definite.
    """
    n, L, V, y, Ke = len(P), S.copy(), U.copy(), e.copy(), np.zeros(len(P))
    for r in range(len(e)):
        if not L[r, r] > 0.0:
            raise np.linalg.LinAlgError("the covariance of an innovation is not positive definite")
        root = math.sqrt(L[r, r])
        y[r] /= root
        for i in range(n):
            V[r, i] /= root
        for k in range(r + 1, len(e)):
            L[k, r] /= root
            y[k] -= L[k, r] * y[r]
            for i in range(n):
                V[k, i] -= L[k, r] * V[r, i]
            for c in range(r + 1, k + 1):
                L[k, c] -= L[k, r] * L[c, r]
        for i in range(n):
            Ke[i] += V[r, i] * y[r]
            for j in range(n):
                P[i, j] -= V[r, i] * V[r, j]
    return Ke


class SonarModel(NamedTuple):
    """Sonar mounting and noise, gate, and floor."""

    body_R_sonar: Floats
    body_p_sonar: Floats
    gate: float
    """Squared Mahalanobis distance beyond which an innovation is refused."""
    aperture_rad: float
    R_z: Floats
    """Covariance of range and azimuth where the log has none, shape (2, 2)."""
    floor_z_m: float
    """NaN where it is not known."""
    floor_variance_m2: float

    @classmethod
    def of(cls, calibration: Calibration, gate_probability: float) -> "SonarModel":
        """The model of a calibration."""
        sonar, floor = calibration.sonar, calibration.floor
        return cls(
            body_R_sonar=np.ascontiguousarray(sonar.mounting.pose().rotation().matrix()),
            body_p_sonar=np.array(sonar.mounting.translation_m),
            gate=gate_threshold(gate_probability, 2),
            aperture_rad=sonar.elevation_aperture_rad,
            R_z=np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2]),
            floor_z_m=floor.z_m if floor else math.nan,
            floor_variance_m2=floor.sigma_m**2 if floor else math.nan,
        )

    def noise_of(self, detections: LandmarkDetections) -> Floats:
        """Covariances of detections: symmetric, and the calibration's where the log has none, shape (m, 2, 2)."""
        logged = detections.range_azimuth_cov
        R_z = 0.5 * (logged + logged.transpose(0, 2, 1))
        if np.count_nonzero(np.isnan(R_z)):
            R_z[np.isnan(R_z).any(axis=(1, 2))] = self.R_z
        return R_z

    def elevation_of_new(self, R: Floats, X: Floats, z: Floats) -> float:
        """Elevation of a new landmark seen from a body: on the floor, or 0 without a floor within the aperture."""
        body_T_sonar = gtsam.Pose3(gtsam.Rot3(self.body_R_sonar), self.body_p_sonar)
        world_T_sonar = gtsam.Pose3(gtsam.Rot3(R), X).compose(body_T_sonar)
        return elevation_on_floor(world_T_sonar, z[0], z[1], self.floor_z_m, self.aperture_rad) or 0.0


def polar_covariance(R_z: Floats, aperture_rad: float) -> Floats:
    """Covariance of range, azimuth and elevation (3, 3); the latter is uniform in the aperture: ``aperture^2 / 12``."""
    V = np.diag([0.0, 0.0, aperture_rad**2 / 12.0])
    V[:2, :2] = R_z
    return V


@compiled
def is_inside(e: Floats, S: Floats, gate: float) -> bool:
    """True where ``e^T S^-1 e`` of range and azimuth is within a gate."""
    squared = S[1, 1] * e[0] ** 2 - 2.0 * S[0, 1] * e[0] * e[1] + S[0, 0] * e[1] ** 2
    return bool(squared / (S[0, 0] * S[1, 1] - S[0, 1] ** 2) <= gate)


def far_view(
    missed: Floats, cov: Floats, G_z: Floats, sonar: SonarModel, z: Floats, R_z: Floats
) -> tuple[Floats, Floats, Floats] | None:
    """Compare a landmark with the point seen, which is linear in both positions; None where `observe` is linear enough.

    With the variances A along the beam and L across it, in the sonar's plane, the linearisation at the predicted place
    leaves out ``L / (2 r)`` of the range and ``sqrt(L A) / r^2`` of the azimuth. Where that exceeds the noise of the
    detection, its place ``0 = g(x_v, z, elevation) - p`` counts instead, with an elevation variance ``aperture^2 / 12``
    and ``r^2 aperture^4 / 320`` for the length of a beam that is not level. docs/theory/gaps.md.

    Parameters
    ----------
    missed, cov
        The point seen at elevation 0 less the landmark, (3,), and its covariance by state and motion, (3, 3).
    G_z
        Derivative of the point seen by (range, azimuth, elevation), (3, 3).

    Returns
    -------
    The covariance with the noise of the detection (3, 3); the innovation of range and azimuth (2,) and its covariance.
    """
    r, along, across = z[0], G_z[:, 0], G_z[:, 1]
    A, L_r2 = along @ cov @ along, across @ cov @ across
    if L_r2 <= 2.0 * r**3 * math.sqrt(R_z[0, 0]) and A * L_r2 <= r**6 * R_z[1, 1]:
        return None
    V = polar_covariance(R_z, sonar.aperture_rad)
    V[0, 0] += r**2 * sonar.aperture_rad**4 / 320.0
    cov = cov + G_z @ V @ G_z.T
    cov = 0.5 * (cov + cov.T)
    B = np.array([along, across / r**2])  # range and azimuth by the point
    return cov, B @ missed, B @ cov @ B.T


def check_rows(measurements: Measurements) -> None:
    """Refuse detections and depth samples stamped after ``end_ns``, which only a mistake of the caller can explain."""
    end_ns = measurements.end_ns
    for rows in (measurements.detections, measurements.depth):
        if rows is not None and rows.stamps_ns[-1] > end_ns:
            raise MeasurementError(
                f"Measurements: {type(rows).__name__} has a row at {rows.stamps_ns[-1]} ns, after end_ns = {end_ns};"
                " hand it in with the call that reaches it"
            )


# ------------------------------------------------------------------------------------------------- the shell

Told = tuple[Outcome, Floats | None, Floats | None]
"""Outcome of a detection, with innovation (2,) and its covariance (2, 2) where there was a prediction."""
NO_VIEWS = np.empty((0, 2)), np.empty((0, 2, 2))
NOT_STARTED, LONG_AGO = int(np.iinfo(np.int64).max), int(np.iinfo(np.int64).min)
NO_BIAS, NO_RATE = np.zeros(3), np.zeros(3)
KEPT_NS = 10_000_000_000
"""Rows of this time may be kept longer than needed: dropping them costs as much as keeping a few."""


class FilterShell(ABC):
    """Estimator around the mathematics of a filter, which a subclass adds; `name` stands in messages."""

    name: str

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: FilterParams) -> None:
        require_source(odometry, calibration, f"{type(self).__name__}(calibration, odometry, params)")
        self.calibration, self.odometry = calibration, odometry
        self.sonar = SonarModel.of(calibration, params.gate_probability)
        self.port = np.array(calibration.depth.port_m)
        self._minimum_id_probability, self._earth = params.minimum_id_probability, earth_rate_in_world(calibration)
        self._plane, self._depth_variance = calibration.planar, calibration.depth.sigma_m**2
        self._interval_ns = round(params.gravity_interval_s * 1e9) if calibration.use_gravity else 0
        self.node_ns = 0
        """Stamp of the newest epoch, that of the state."""
        self._reached_ns, self._done_ns = NOT_STARTED, LONG_AGO
        self._opened_ns, self._opened_velocity, self._opened_R, self._kept_ns = 0, (np.zeros(3), 0.0), np.eye(3), 0
        self._in_gap = {DEPTH: 0, FRAME: 0}
        self._was_lost = False
        self._slots: dict[int, int] = {}
        self._journal, self._estimates = DetectionJournal(), CausalEstimates()

    # ---------------------------------------------------------------- mathematics of a filter

    @abstractmethod
    def predict(self, motion: Motion, duration_s: float) -> None:
        """Carry the state over the motion to the next epoch."""

    @abstractmethod
    def correct_up(self, up: Floats, sigma: float) -> None:
        """Update by the world's up in the body, shape (3,), with the sigma of its tilt, rad."""

    @abstractmethod
    def correct_plane(self, plane: PlanarMotion) -> None:
        """Update by the plane on which the vehicle stays."""

    @abstractmethod
    def correct_depth(self, motion: Motion, z_m: float, variance_m2: float) -> None:
        """Update by the height of the pressure port a motion after the state."""

    @abstractmethod
    def observe(
        self, motion: Motion, slot: int, z: Floats, R_z: Floats, *, may_be_far: bool
    ) -> tuple[bool, Floats, Floats]:
        """Update by range and azimuth of a known landmark, a motion after the state, where the gate admits it.

        Returns whether it was used, the innovation (2,) and its covariance (2, 2). ``may_be_far``: the Doppler log has
        lost the bottom, and landmarks may be far from where they are predicted (`far_view`).
        """

    @abstractmethod
    def augment(self, motion: Motion, z: Floats, R_z: Floats) -> None:
        """Append a landmark seen for the first time, a motion after the state."""

    @abstractmethod
    def pose_after(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """world_R_body (3, 3), position (3,), and covariance of [theta, rho] (6, 6) a motion after the state."""

    @abstractmethod
    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position in the world (3,) and covariance (3, 3) of the landmark that was appended as number ``slot``."""

    @abstractmethod
    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""

    def gyro_bias(self) -> Floats | None:
        """Estimated gyro bias, shape (3,), rad/s; None where the state has none."""
        return None

    # ---------------------------------------------------------------- contract of an estimator

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements and return the causal estimate at ``measurements.end_ns``.

        None before the first epoch that IMU rows cover from both sides.

        Raises
        ------
        MeasurementError
            When a row is stamped after ``end_ns``.
        EstimatorError
            When the state has no meaning any more, or a variance makes an innovation's covariance not positive.
        """
        end_ns, detections = measurements.end_ns, measurements.detections
        self.odometry.add(measurements.imu, measurements.dvl)
        check_rows(measurements)
        if self._reached_ns == NOT_STARTED:
            self._start(end_ns)
        since_ns, self._done_ns = max(self._done_ns, self._reached_ns), max(self._done_ns, end_ns)
        ids, told, frames = self._sorted_out(detections, since_ns)
        estimate = None
        if end_ns >= max(self._reached_ns, self.node_ns):
            try:
                estimate = self._use(measurements, since_ns, ids, told, frames)
            except np.linalg.LinAlgError as error:
                raise EstimatorError(
                    f"{self.name}: between {self.node_ns} and {end_ns} ns the expected covariance of a measurement is"
                    " not positive definite; give variances above zero in log and calibration"
                ) from error
            self._estimates.keep(estimate)
        if detections is not None:
            for stamp_ns, landmark_id, row in zip(detections.stamps_ns.tolist(), ids, told, strict=True):
                self._journal.record(stamp_ns, landmark_id, *row)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates; a filter does not revise them."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Landmarks in the state, with the covariances of their coordinates."""
        ids = sorted(self._slots)
        read = [self.landmark(self._slots[i]) for i in ids]
        return LandmarkMap(
            ids=np.array(ids, dtype=np.int64),
            positions=np.array([position for position, _ in read]).reshape(-1, 3),
            covariances=np.array([covariance for _, covariance in read]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """Outcome of each detection so far."""
        return self._journal.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, with the reason."""
        return self.odometry.refused

    # ---------------------------------------------------------------- events

    def _start(self, end_ns: int) -> None:
        """Set the state's epoch to the first one, if it is reached."""
        start_ns = self.odometry.start_by(end_ns)
        if start_ns is None:
            return
        waiting = range(start_ns, end_ns)
        self._reached_ns = start_ns + bisect_left(waiting, True, key=lambda t: self.odometry.start_by(t) is not None)
        self.node_ns = self._opened_ns = self._kept_ns = start_ns
        self._opened_velocity, self._opened_R = self.odometry.velocity_at_imu(start_ns), self.attitude()

    def _sorted_out(
        self, detections: LandmarkDetections | None, since_ns: int
    ) -> tuple[list[int], list[Told], dict[int, list[int]]]:
        """Most probable identities and refusals of detections, and rows to be used by the stamps of their frames.

        Rows before the first epoch is reached, or older than those done, are refused.
        """
        if detections is None:
            return [], [], {}
        identities = identify(detections, self._minimum_id_probability)
        told: list[Told] = []
        frames: dict[int, list[int]] = {}
        for row, stamp_ns in enumerate(detections.stamps_ns.tolist()):
            reason = identities.refusals[row]
            if stamp_ns < since_ns:
                reason = Outcome.UNLOCATED if stamp_ns < self._reached_ns else Outcome.LATE
            told.append((reason or Outcome.USED, None, None))
            if reason is None:
                frames.setdefault(stamp_ns, []).append(row)
        return identities.ids.tolist(), told, frames

    def _use(
        self, measurements: Measurements, since_ns: int, ids: list[int], told: list[Told], frames: dict[int, list[int]]
    ) -> Estimate:
        """Carry the state to the newest epoch reached at the end of the call, with all measurements on the way."""
        end_ns, depth, detections = measurements.end_ns, measurements.depth, measurements.detections
        epochs_ns = self.odometry.epochs(self.node_ns, end_ns)
        reached_ns = self.odometry.reached_ns(epochs_ns)
        happening = list(zip(reached_ns.tolist(), [EPOCH] * len(epochs_ns), epochs_ns.tolist(), strict=True))
        happening.append((end_ns, END, 0))
        heights: list[tuple[float, float]] = []
        if depth is not None:
            heights = list(zip(depth.z_m.tolist(), depth.variance_m2.tolist(), strict=True))
            happening += [(t, DEPTH, row) for row, t in enumerate(depth.stamps_ns.tolist()) if t >= since_ns]
        z, R_z = NO_VIEWS
        if detections is not None and frames:
            z = np.array((detections.range_m, detections.azimuth_rad)).T.copy()
            R_z = self.sonar.noise_of(detections)
            happening += [(stamp_ns, FRAME, stamp_ns) for stamp_ns in frames]
        events = in_order(happening, self.node_ns, self._opened_ns, self._interval_ns)
        known_ns, _, _, starts_ns, ends_ns = map(np.array, zip(*events, strict=True))
        motions = self.odometry.motions(starts_ns, ends_ns, known_ns, NO_BIAS)
        has_gap = np.isnan(motions.dp[:, 0]).tolist()
        has_rate = self._earth is not None or self.gyro_bias() is not None
        for event, is_over_gap, motion in zip(events, has_gap, map(Motion, *motions), strict=True):
            stamp_ns, kind, row, _, _ = event
            if is_over_gap:
                motion = self._over_gap(event, len(frames[row]) if kind == FRAME else int(kind == DEPTH))
            elif has_rate:
                motion = self._without_rate(event, motion)
            if kind == EPOCH:
                self.predict(motion, (row - self.node_ns) * 1e-9)
                self.node_ns, self._in_gap = row, {DEPTH: 0, FRAME: 0}
                if self._plane:
                    self.correct_plane(self._plane)
            elif kind == GRAVITY:
                self._use_gravity(event, motion)
            elif kind == DEPTH:
                z_m, variance_m2 = heights[row]
                self.correct_depth(motion, z_m, self._depth_variance if math.isnan(variance_m2) else variance_m2)
            elif kind == FRAME:
                for row in frames[stamp_ns]:
                    told[row] = self._see(ids[row], motion, z[row], R_z[row])
        R, X, covariance = self.pose_after(motion)
        self.odometry.settle(self.node_ns)
        if (needed_ns := self._opened_ns if self._interval_ns else self.node_ns) > self._kept_ns + KEPT_NS:
            self.odometry.forget_before(needed_ns)
            self._kept_ns = needed_ns
        return Estimate(end_ns, gtsam.Pose3(gtsam.Rot3(R), X), covariance)

    def _without_rate(self, event: Event, motion: Motion) -> Motion:
        """The motion without the gyro bias of the state and the Earth's rate."""
        bias, R_i = self.gyro_bias(), self._opened_R if event.kind == GRAVITY else self.attitude()
        earth = NO_RATE if self._earth is None else R_i.T @ self._earth
        dR, dp, C, D, impulse = motion
        dR, dp, impulse = corrected(dR, dp, D, impulse, NO_BIAS if bias is None else bias, earth)
        return Motion(dR, dp, C, D, impulse)

    def _over_gap(self, event: Event, count: int) -> Motion:
        """Motion over a gap of the Doppler log, with the share of its error that so many more measurements may have.

        A state without bias has no place for what an unknown one does in a gap, where it tilts gravity: it is added to
        the covariance of the displacement. Elsewhere its drift is left out, as published.
        """
        bias, R_i = self.gyro_bias(), self._opened_R if event.kind == GRAVITY else self.attitude()
        removed = NO_BIAS if bias is None else bias
        over = self.odometry.motion(event.start_ns, event.end_ns, removed, R_i, event.stamp_ns)
        C, D = over.covariance.copy(), over.D_bias
        if bias is None:
            C[3:, 3:] += self.calibration.imu.gyro_bias_sigma**2 * D[3:] @ D[3:].T
        if count:
            self._in_gap[event.kind] += count
            C *= self._in_gap[event.kind] * (self._in_gap[event.kind] + 1)
        self._was_lost = True
        dR = np.ascontiguousarray(over.i_T_j.rotation().matrix())
        return Motion(dR, over.i_T_j.translation(), C, D, over.mean_specific_force * over.duration_s)

    def _use_gravity(self, event: Event, motion: Motion) -> None:
        """Update by the direction of gravity over an interval that ends at the state's epoch."""
        duration_s, velocity_i, variance_i = (event.end_ns - event.start_ns) * 1e-9, *self._opened_velocity
        velocity_j, variance_j = self.odometry.velocity_at_imu(event.end_ns)
        up = up_direction(motion.impulse / duration_s, motion.dR, velocity_i, velocity_j, duration_s)
        velocity_sigma = math.sqrt(0.5 * (variance_i + variance_j))
        sigma = tilt_sigma(duration_s, velocity_sigma, self.calibration.imu, self.calibration.gravity_m_s2)
        if math.isfinite(up[0]):
            self.correct_up(up, sigma)
        self._opened_ns, self._opened_velocity = event.end_ns, (velocity_j, variance_j)
        if self._earth is not None:
            self._opened_R = self.attitude()

    def _see(self, landmark_id: int, motion: Motion, z: Floats, R_z: Floats) -> Told:
        """Update by a detection of a landmark, or append the landmark at first sight."""
        if landmark_id not in self._slots:
            self.augment(motion, z, R_z)
            self._slots[landmark_id] = len(self._slots)
            return Outcome.NEW, None, None
        is_used, e, S = self.observe(motion, self._slots[landmark_id], z, R_z, may_be_far=self._was_lost)
        return Outcome.USED if is_used else Outcome.GATED, e, S
