"""Shell of both landmark filters: the contract, the way through the events of a call, and outcomes of detections.

A subclass adds the mathematics. Order and meaning of the events: `baselines.event_order`; gate, kernel and landmarks
that are far from where they are predicted: `baselines.sonar_update`. Choices that the paper leaves open:
docs/theory/ekf_slam.md.
"""

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import gtsam
import numpy as np
from pydantic import Field

from baselines.event_order import (
    DEPTH,
    END,
    FIX,
    FRAME,
    GRAVITY,
    HEADING,
    LONG_AGO,
    NO_BIAS,
    NO_DEPTH,
    NO_GRAVITY,
    NO_SAMPLES,
    NO_STAMPS,
    NO_VIEWS,
    NOT_STARTED,
    PLANE,
    Events,
    Motion,
    Views,
    accepted_rows,
    in_order,
    remove_rate,
)
from baselines.sonar_update import JUDGED_TOGETHER, NEW, Gate, SonarModel, read
from sonar_graph.calibration import Calibration, PlanarMotion, Section, require_params
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import (
    Depth,
    Floats,
    Heading,
    Ints,
    LandmarkDetections,
    Measurements,
    PositionFixes,
    require_measurements,
)
from sonar_graph.models import MINIMUM_PROBABILITY, Contradictions, identify, wrap_angle, yaw_and_derivative
from sonar_graph.motion import MotionSource, require_source
from sonar_graph.navigation.alignment import earth_rate_in_world, tilt_sigma
from sonar_graph.numerics import cross_matrix
from sonar_graph.states import (
    OUTCOME_NUMBERS,
    CausalEstimates,
    DetectionJournal,
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    Refusal,
    RefusedRow,
    Trajectory,
)

KEPT_NS = 20_000_000_000
"""Age of a position fix up to which rows for it are kept: the smoother's window by default. Up to twice as many are
kept, since dropping them costs as much as keeping a few."""


class FilterParams(Section):
    """Settings of both filters; the paper gives none of them, and neither gate nor kernel."""

    gate_probability: float = Field(1.0, gt=0, le=1)
    """Probability with which a right detection passes the gate (chi-square); 1: no gate, as published."""
    kernel_width: float = Field(0.0, ge=0)
    """Width in standard deviations of a Cauchy kernel by which outlying ranges and azimuths pull less, that of
    `sonar_graph.slam.RobustKernel`; 0: no kernel, as published."""
    minimum_id_probability: float = Field(MINIMUM_PROBABILITY, ge=0, le=1)
    """Least posterior of the most probable identity with which a detection is used; the smoother's default too."""
    gravity_interval_s: float = Field(1.0, gt=0)
    """Time over which the specific force is averaged for one correction of roll and pitch."""


class FilterShell(ABC):
    """Estimator around the mathematics of a filter, which a subclass adds; `name` stands in messages."""

    name: str
    Params: ClassVar[type[Section]]

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: FilterParams) -> None:
        require_source(odometry, calibration, f"{type(self).__name__}(calibration, odometry, params)")
        require_params(params, self.Params, self.name)
        self.calibration, self.odometry = calibration, odometry
        self.sonar = SonarModel.of(calibration, Gate.of(params.gate_probability, params.kernel_width))
        self.port = np.array(calibration.depth.port_m)
        self._minimum_id_probability, earth = params.minimum_id_probability, earth_rate_in_world(calibration)
        self.earth, self._has_rate = np.zeros(3) if earth is None else earth, self.has_bias or earth is not None
        self._plane, self.depth_variance = calibration.planar, calibration.depth.sigma_m**2
        self._interval_ns = round(params.gravity_interval_s * 1e9) if calibration.use_gravity else 0
        self.node_ns = 0
        """Stamp of the newest epoch, that of the state."""
        self._reached_ns, self._done_ns = NOT_STARTED, LONG_AGO
        self._opened_ns, self._opened_velocity, self._kept_ns = 0, (np.zeros(3), 0.0), 0
        self.turned, self.impulse = np.eye(3), np.zeros(3)
        self._in_gap: dict[tuple[int, int], int] = {}
        self._was_lost = False
        self._slots: dict[int, int] = {}
        self._journal, self._estimates = DetectionJournal(), CausalEstimates()
        self._refused: list[RefusedRow] = []
        self._contradictions = Contradictions()

    # ---------------------------------------------------------------- mathematics of a filter

    @abstractmethod
    def advance(self, events: Events, k: int) -> int:
        """Predict over epochs and continue the interval of gravity (`add_force`), correct by gravity and depth.

        From event k to one over a gap or of another kind, whose number is returned; frames may be used, `Views` filled.
        """

    @abstractmethod
    def correct_plane(self, plane: PlanarMotion) -> None:
        """Update by the plane on which the vehicle stays."""

    @abstractmethod
    def correct_heading(self, motion: Motion, yaw_rad: float, variance_rad2: float) -> None:
        """Update by the yaw of the body and the compass' bias, a motion after the state; robust (`doubted`)."""

    @abstractmethod
    def correct_position(self, motion: Motion, point: Floats, position_m: Floats, cov_m2: Floats) -> None:
        """Update by the world position of a point of the body (3,), a motion after the state; robust (`doubted`)."""

    @abstractmethod
    def observe(
        self, motion: Motion, slot: int, z: Floats, R_z: Floats, *, may_be_far: bool
    ) -> tuple[int, Floats, Floats]:
        """Update by range and azimuth of a known landmark, a motion after the state, where `admit` does.

        Returns the outcome's number, the innovation (2,) and its covariance (2, 2). ``may_be_far``: the Doppler log has
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

    has_bias = False
    """True where the state has a gyro bias."""

    def gyro_bias(self) -> Floats:
        """Estimated gyro bias, shape (3,), rad/s; zero where the state has none."""
        return NO_BIAS

    # ---------------------------------------------------------------- contract of an estimator

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements and return the causal estimate at ``measurements.end_ns``.

        None before the first epoch that IMU rows cover from both sides.

        Raises
        ------
        EstimatorError
            When the state has no meaning any more, or a variance makes an innovation's covariance not positive.
        """
        require_measurements(measurements, self.name)
        end_ns, detections = measurements.end_ns, measurements.detections
        self.odometry.add(measurements.imu, measurements.dvl)
        depth = self.odometry.used_depths(measurements.depth)
        if self._reached_ns == NOT_STARTED:
            self._start(end_ns)
        since_ns, self._done_ns = max(self._done_ns, self._reached_ns), max(self._done_ns, end_ns)
        ids, views = self._views(detections, since_ns)
        estimate = None
        try:
            samples = self._samples(measurements, depth, since_ns)
            if end_ns >= max(self._reached_ns, self.node_ns):
                estimate = self._use(end_ns, samples, since_ns, ids, views)
                self._estimates.keep(estimate)
        except np.linalg.LinAlgError as error:
            raise EstimatorError(
                f"{self.name}: between {self.node_ns} and {end_ns} ns the expected covariance of a measurement is"
                " not positive definite; give variances above zero in log and calibration"
            ) from error
        if detections is not None:
            self._journal.extend(detections.stamps_ns, ids, views.outcome, views.e, views.S)
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

    def withheld(self) -> list[str]:
        """Messages about headings and fixes that the state contradicts, and detections outside the gate (`admit`)."""
        log = self.detections()
        let_in = [
            stamp for stamp, why in zip(log.stamps_ns.tolist(), log.outcomes, strict=True) if why is Outcome.LET_IN
        ]
        if not let_in:
            return self._contradictions.messages()
        return [
            *self._contradictions.messages(),
            f"most of {JUDGED_TOGETHER} detections in a row, of landmarks that had agreed, were outliers, first at"
            f" {let_in[0] * 1e-9:.3f} s, so {len(let_in)} were used outside the gate: the filter was wrong, not they,"
            " and the gate may be the cause; give gate_probability = 1, or larger noise",
        ]

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of all sensors but the sonar that are not used, with the reason."""
        return self.odometry.refused + self._refused

    # ---------------------------------------------------------------- events

    def _start(self, end_ns: int) -> None:
        """Set the state's epoch to the first one, if it is reached."""
        if (start_ns := self.odometry.start_by(end_ns)) is None:
            return
        self._reached_ns = self.odometry.reached_ns(start_ns)
        self.node_ns = self._opened_ns = self._kept_ns = start_ns
        self._opened_velocity = self.odometry.velocity_at_imu(start_ns)

    def _views(self, detections: LandmarkDetections | None, since_ns: int) -> tuple[Ints, Views]:
        """Most probable identities of detections, and their views.

        Rows before the first epoch is reached, or older than those done, are refused.
        """
        if detections is None:
            return NO_STAMPS, NO_VIEWS
        n, stamps_ns = len(detections), detections.stamps_ns
        ids, outcome = identify(detections, self._minimum_id_probability)
        if stamps_ns[0] < since_ns:
            outcome[stamps_ns < since_ns] = OUTCOME_NUMBERS[Outcome.LATE]
            outcome[stamps_ns < self._reached_ns] = OUTCOME_NUMBERS[Outcome.UNLOCATED]
        landmark = np.array([-1 if self._was_lost else self._slots.get(i, -1) for i in ids.tolist()])
        z, R_z = read(detections.range_m, detections.azimuth_rad, detections.range_azimuth_cov, self.sonar.R_z)
        e, S = np.empty((n, 2)), np.empty((n, 2, 2))
        e[:] = S[:] = math.nan
        return ids, Views(stamps_ns, landmark, z, R_z, outcome, e, S)

    def _samples(self, measurements: Measurements, depth: Depth | None, since_ns: int) -> dict[int, Any]:
        """Samples of a call, a block for each kind. Unsound and late rows are refused, but a late fix is used.

        Rows before the first epoch is reached are passed over.
        """
        samples: dict[int, Any] = {}
        heading, fixes = measurements.heading, measurements.positions
        given: list[tuple[int, str, Any]] = [(DEPTH, "depth", depth), (HEADING, "heading", heading)]
        for kind, sensor, block in [*given, (FIX, "positions", fixes)]:
            if block is None:
                continue
            is_sound = np.ones(len(block), np.bool_) if kind == DEPTH else block.are_sound()
            is_late = block.stamps_ns < since_ns
            for row in np.flatnonzero((~is_sound | is_late) & (block.stamps_ns >= self._reached_ns)).tolist():
                if not (is_sound[row] and kind == FIX and self._use_late(block, row, since_ns)):
                    reason = Refusal.LATE if is_sound[row] else Refusal.UNSOUND
                    self._refused.append(RefusedRow(sensor, int(block.stamps_ns[row]), reason, math.nan))
            if (is_used := is_sound & ~is_late).any():
                samples[kind] = block.rows(is_used)
        return samples

    def _use_late(self, fixes: PositionFixes, row: int, since_ns: int) -> bool:
        """Update by a fix of an earlier instant i, by the motion backwards; False where rows of its time are gone.

        From epoch j the antenna was then at ``j_T_i l``, with covariance ``Ad(i_T_j) C Ad(i_T_j)^T``. The state
        shares the error of this motion, which is left out: the fix tells rather too little.
        """
        stamp_ns, node_ns = int(fixes.stamps_ns[row]), self.node_ns
        if stamp_ns < node_ns - KEPT_NS:
            return False
        first_ns, last_ns = min(stamp_ns, node_ns), max(stamp_ns, node_ns)
        bias, attitude = self.gyro_bias(), self.attitude()
        between = self.odometry.motion(first_ns, last_ns, bias, attitude, since_ns)
        if stamp_ns < node_ns:  # the attitude is that of its end
            attitude = attitude @ between.i_T_j.rotation().matrix().T
            between = self.odometry.motion(first_ns, last_ns, bias, attitude, since_ns)
        T, C, D = between.i_T_j, between.covariance, between.D_bias
        if stamp_ns < node_ns:
            A = T.AdjointMap()
            T, C, D = T.inverse(), A @ C @ A.T, -A @ D
        self._fix(Motion(np.ascontiguousarray(T.rotation().matrix()), T.translation(), C, D, NO_BIAS), fixes, row)
        return True

    def _fix(self, motion: Motion, fixes: PositionFixes, row: int) -> None:
        """Update by a position fix, with the calibration's noise where it has none."""
        cov_m2, known = fixes.covariance_m2[row], self.calibration.positions
        cov_m2 = np.diag(np.square(known.sigma_m)) if np.isnan(cov_m2).any() else cov_m2
        antenna, (R, X, P) = np.array(known.antenna_m), self.pose_after(motion)
        e, H = fixes.position_m[row] - X - R @ antenna, R @ np.hstack((-cross_matrix(antenna), np.eye(3)))
        self._contradictions.judge("positions", math.sqrt(e @ np.linalg.solve(H @ P @ H.T + cov_m2, e)))
        self.correct_position(motion, antenna, fixes.position_m[row], cov_m2)

    def _turn(self, motion: Motion, heading: Heading, row: int) -> None:
        """Update by a heading, with the calibration's noise where it has none."""
        sigma_rad = float(heading.sigma_rad[row])
        sigma_rad = self.calibration.heading.sigma_rad if math.isnan(sigma_rad) else sigma_rad
        yaw_rad, (R, _, P) = float(heading.yaw_rad[row]), self.pose_after(motion)
        predicted_rad, by_turn = yaw_and_derivative(R)
        variance_rad2 = by_turn @ P[:3, :3] @ by_turn + sigma_rad**2 + self.calibration.heading.bias_sigma_rad**2
        self._contradictions.judge("heading", abs(wrap_angle(yaw_rad - predicted_rad)) / math.sqrt(variance_rad2))
        self.correct_heading(motion, yaw_rad, sigma_rad**2)

    def _use(self, end_ns: int, samples: dict[int, Any], since_ns: int, ids: Ints, views: Views) -> Estimate:
        """Carry the state to the newest epoch reached at the end of the call, with all measurements on the way."""
        events = self._events(end_ns, samples, since_ns, views)
        kinds, k = events.kind.tolist(), 0
        while kinds[k] != END:
            if kinds[k] == PLANE and self._plane is not None:
                self.correct_plane(self._plane)
            else:
                if math.isnan(events.dp[k, 0]):
                    self._bridge(events, k)
                used_until = self.advance(events, k)
                if used_until > k:
                    k = used_until
                    continue
                motion, row = self.motion_to(events, k), int(events.row[k])
                if kinds[k] == FRAME:
                    self._see(ids, motion, views, row)
                elif kinds[k] == HEADING:
                    self._turn(motion, samples[HEADING], row)
                elif kinds[k] == FIX:
                    self._fix(motion, samples[FIX], row)
                else:
                    raise EstimatorError(f"{self.name}: the motion to {events.end_ns[k]} ns over a gap is not finite")
            k += 1
        if math.isnan(events.dp[k, 0]):
            self._bridge(events, k)
        self.node_ns = int(events.start_ns[k])
        R, X, covariance = self.pose_after(self.motion_to(events, k))
        self.odometry.settle(self.node_ns)
        if self.node_ns > self._kept_ns + KEPT_NS:
            self.odometry.forget_before(self.node_ns - KEPT_NS)
            self._kept_ns = self.node_ns
        return Estimate(end_ns, gtsam.Pose3(gtsam.Rot3(R), X), covariance)

    def _events(self, end_ns: int, samples: dict[int, Any], since_ns: int, views: Views) -> Events:
        """What happens up to the end of a call, from the state's epoch on."""
        epochs_ns, reached_ns = self.odometry.epochs_reached(self.node_ns, end_ns)
        depth, ordered = samples.get(DEPTH), NO_SAMPLES
        z_m, variance_m2 = (NO_DEPTH, NO_DEPTH) if depth is None else (depth.z_m, depth.variance_m2)
        if samples:
            rows = [(block.stamps_ns, [kind] * len(block), range(len(block))) for kind, block in samples.items()]
            ordered = np.concatenate([np.array(columns) for columns in rows], axis=1)
            ordered = np.take(ordered, np.argsort(ordered[0], kind="stable"), axis=1)
        columns = np.empty((5, 3 * len(epochs_ns) + ordered.shape[1] + len(views.stamp_ns) + 1), np.int64)
        n = in_order(
            epochs_ns, reached_ns, ordered, views.stamp_ns, views.outcome, since_ns, end_ns,
            self.node_ns, self._opened_ns, self._interval_ns, self._plane is not None, columns,
        )  # fmt: skip
        stamp_ns, start_ns, until_ns, kind, row = columns[:, :n]
        motions = self.odometry.motions(start_ns, until_ns, stamp_ns, NO_BIAS)
        gravity, has_rate = NO_GRAVITY, np.ones(n, np.bool_) if self._has_rate else np.zeros(n, np.bool_)
        if GRAVITY in kind.tolist():
            gravity = self._gravity(until_ns[kind == GRAVITY].tolist())
        happening = stamp_ns, start_ns, until_ns, kind, row, *motions, has_rate
        return Events(*happening, z_m, variance_m2, gravity, *views)

    def _gravity(self, epochs_ns: list[int]) -> Floats:
        """Intervals of gravity that end at epochs, as `Events.gravity`."""
        intervals = []
        for epoch_ns in epochs_ns:
            duration_s, (velocity_i, variance_i) = (epoch_ns - self._opened_ns) * 1e-9, self._opened_velocity
            velocity_j, variance_j = self._opened_velocity = self.odometry.velocity_at_imu(epoch_ns)
            velocity_sigma = math.sqrt(0.5 * (variance_i + variance_j))
            sigma = tilt_sigma(duration_s, velocity_sigma, self.calibration, has_bias=not self.has_bias)
            intervals.append((*velocity_i.tolist(), *velocity_j.tolist(), duration_s, sigma))
            self._opened_ns = epoch_ns
        return np.array(intervals)

    def motion_to(self, events: Events, k: int) -> Motion:
        """Motion to an event, without the gyro bias of the state and the Earth's rate."""
        motion = Motion(*(column[k] for column in events[5:10]))
        if events.has_rate[k]:
            dR, dp, _, D, impulse = motion
            remove_rate(dR, dp, D, impulse, self.gyro_bias(), self.attitude().T @ self.earth)
            events.has_rate[k] = False
        return motion

    def _bridge(self, events: Events, k: int) -> None:
        """Write the motion over a gap, with the share of its error that the measurements of one more event may have.

        A state without bias has no place for what an unknown one does in a gap, where it tilts gravity: it is added to
        the covariance of the displacement. Elsewhere its drift is left out, as published.
        """
        stamp_ns, start_ns, end_ns, kind, row = (int(column[k]) for column in events[:5])
        over = self.odometry.motion(start_ns, end_ns, self.gyro_bias(), self.attitude(), stamp_ns)
        C, D = over.covariance.copy(), over.D_bias
        if not self.has_bias:
            C[3:, 3:] += self.calibration.imu.gyro_bias_sigma**2 * D[3:] @ D[3:].T
        if DEPTH <= kind <= FRAME:
            more = len(accepted_rows(events.seen_ns, events.outcome, row)) if kind == FRAME else 1
            self._in_gap[start_ns, kind] = count = self._in_gap.get((start_ns, kind), 0) + more
            C *= count * (count + 1)
        events.has_rate[k] = False
        if kind != END:  # asking for an estimate changes nothing
            self._was_lost, events.landmark[:] = True, -1
        events.dR[k], events.dp[k] = over.i_T_j.rotation().matrix(), over.i_T_j.translation()
        events.C[k], events.D[k], events.impulse[k] = C, D, over.mean_specific_force * over.duration_s

    def _see(self, ids: Ints, motion: Motion, views: Views, first: int) -> None:
        """Update by the landmarks of a frame, or append them at first sight."""
        for row in accepted_rows(views.stamp_ns, views.outcome, first):
            landmark_id, z, R_z = int(ids[row]), views.z[row], views.R_z[row]
            if landmark_id not in self._slots:
                self.augment(motion, z, R_z)
                self._slots[landmark_id], views.outcome[row] = len(self._slots), NEW
                continue
            slot = self._slots[landmark_id]
            told = self.observe(motion, slot, z, R_z, may_be_far=self._was_lost)
            views.outcome[row], views.e[row], views.S[row] = told
