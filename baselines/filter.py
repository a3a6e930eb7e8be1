"""Shell of both landmark filters: the contract of an estimator, events of a call, gaps, outcomes of detections.

A subclass adds the equations. Choices that the paper leaves open: docs/theory/ekf_slam.md.
"""

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from baselines.events import (
    DEPTH,
    END,
    FIX,
    FRAME,
    HEADING,
    LONG_AGO,
    NO_ROW,
    NOT_STARTED,
    UNKNOWN,
    Call,
    Events,
    Felt,
    FilterSetup,
    Motion,
    Order,
    Samples,
    Sonar,
    Views,
    elevation_of_new,
    in_frame,
    in_order,
    remove_rate,
)
from baselines.kalman import (
    GATED,
    NEW,
    Judged,
    covariance_after,
    distance,
    judged_far,
    polar_covariance,
    stands_on_floor,
    symmetric,
)
from sonar_graph.calibration import (
    Calibration,
    KnownMap,
    PlanarMotion,
    Section,
    require_params,
)
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
from sonar_graph.models import (
    MINIMUM_PROBABILITY,
    Contradictions,
    KnownLandmarks,
    Verdict,
    body_point_jacobian,
    huber_scale,
    identify,
    locate_from_body,
    polar_measurements,
    tilt_sigma,
    up_direction,
    wrap_angle,
    yaw_and_derivative,
)
from sonar_graph.motion import MotionSource, PreintegratedMotion, require_source
from sonar_graph.navigation.alignment import earth_rate_in_world
from sonar_graph.numerics import diagonal_blocks, vec
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

NO_STAMPS = np.empty(0, np.int64)
NO_SAMPLES = Samples(NO_STAMPS, NO_STAMPS, np.empty((0, 3)), np.empty((0, 3, 3)))
NO_VIEWS = Views(
    stamp_ns=NO_STAMPS,
    ids=NO_STAMPS,
    slot=NO_STAMPS,
    gate=np.empty(0),
    z=np.empty((0, 2)),
    R_z=np.empty((0, 2, 2)),
    outcome=np.empty(0, np.int8),
    e=np.empty((0, 2)),
    S=np.empty((0, 2, 2)),
)
NO_BIAS = np.zeros(3)


class FilterParams(Section):
    """Settings of both filters; the paper has none of them."""

    gate_probability: float = Field(1.0, gt=0, le=1)
    """Probability with which a right detection passes the gate (chi-square); 1: no gate, as published."""
    kernel_width: float = Field(0.0, ge=0)
    """Width in standard deviations of a Cauchy kernel by which outlying ranges and azimuths pull less, that of
    `sonar_graph.slam.RobustKernel`; 0: no kernel, as published."""
    far_views: bool = False
    """After a gap of the Doppler log, compare a landmark far from where it is predicted with the point seen, where (6)
    and (7) are not linear enough; False: (6) and (7) everywhere, as published."""
    minimum_id_probability: float = Field(MINIMUM_PROBABILITY, ge=0, le=1)
    """Least posterior of the most probable identity with which a detection is used; the smoother's default too."""
    gravity_interval_s: float = Field(1.0, gt=0)
    """Time over which the specific force is averaged for one correction of roll and pitch."""


def sonar_of(calibration: Calibration, params: FilterParams) -> Sonar:
    """Sonar, floor, gate and kernel of a filter."""
    sonar = calibration.sonar
    floor = calibration.floor
    body_R_sonar = np.ascontiguousarray(sonar.mounting.pose().rotation().matrix())
    # the chi-square distribution of two degrees of freedom is 1 - exp(-d^2 / 2)
    has_gate = params.gate_probability < 1
    return Sonar(
        body_R_sonar=body_R_sonar,
        body_p_sonar=np.array(sonar.mounting.translation_m),
        aperture_rad=sonar.elevation_aperture_rad,
        floor_z_m=floor.z_m if floor else math.nan,
        floor_variance_m2=floor.sigma_m**2 if floor else math.nan,
        gate=math.sqrt(-2.0 * math.log(1.0 - params.gate_probability))
        if has_gate
        else math.inf,
        kernel_width=params.kernel_width or math.inf,
    )


class FilterShell(ABC):
    """Estimator around the equations of a filter, which a subclass adds; `name` stands in messages."""

    name: str
    Params: ClassVar[type[Section]]
    has_bias = False
    """True where the state has a gyro bias."""

    def __init__(
        self, calibration: Calibration, odometry: MotionSource, params: FilterParams
    ) -> None:
        require_source(
            odometry,
            calibration,
            f"{type(self).__name__}(calibration, odometry, params)",
        )
        require_params(params, self.Params, self.name)
        self.calibration = calibration
        self.odometry = odometry
        self.params = params
        self.sonar = sonar_of(calibration, params)
        self.antenna = np.array(calibration.positions.antenna_m)
        self.compass_variance_rad2 = calibration.heading.bias_sigma_rad**2
        """Of the constant bias of the compass, at the start."""
        self.node_ns = 0
        """Stamp of the newest epoch, that of the state."""
        self._interval_ns = (
            round(params.gravity_interval_s * 1e9) if calibration.use_gravity else 0
        )
        earth = earth_rate_in_world(calibration)
        self.setup = FilterSetup(
            felt=Felt.nothing(),
            port_m=np.array(calibration.depth.port_m),
            earth_rad_s=np.zeros(3) if earth is None else earth,
            has_rate=self.has_bias or earth is not None,
            walk_density=np.zeros(0),
            sonar=self.sonar,
            follows_frames=calibration.map is None,
        )
        self._reached_ns = NOT_STARTED
        self._done_ns = LONG_AGO
        self._opened_ns = 0
        self._opened_velocity = (np.zeros(3), 0.0)
        self._kept_ns = 0
        self._used_in_gap: dict[tuple[int, int], int] = {}
        self._may_be_far = False
        self._known = KnownLandmarks(calibration.map)
        ids = calibration.map.ids if calibration.map else ()
        self._slots = {landmark_id: slot for slot, landmark_id in enumerate(ids)}
        """Number in the state of each landmark; those of the map come first."""
        self._journal = DetectionJournal()
        self._estimates = CausalEstimates()
        self._refused: list[RefusedRow] = []
        self._contradictions = Contradictions()

    # ---------------------------------------------------------------- equations of a filter

    @abstractmethod
    def follow(self, events: Events, first: int) -> int:
        """Predict to epochs, update by depths and frames, in turn from one event on; the number of the event that is next.

        It stops before an event of another kind, a frame with a new landmark, and after an epoch at which more is
        measured.
        """

    @abstractmethod
    def observe(self, motion: Motion, views: Views, first: int) -> int:
        """Update by range and azimuth of known landmarks, one after the other, a motion after the state.

        From one row of a frame on. Writes outcomes and innovations into the views. Returns the row of the next landmark
        that is not known, `NO_ROW` without any.
        """

    @abstractmethod
    def append(self, place: Floats, P: Floats) -> int:
        """Append a landmark at a place of the world, with the covariance P of the longer state; its number in it."""

    @abstractmethod
    def linearised(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """Pose a motion after the state, (3, 3) and (3,), and J, derivative of its [theta, rho], shape (6, k).

        By the first k numbers of the state, which are those that are no landmarks.
        """

    @abstractmethod
    def height_jacobian(self, slot: int) -> Floats:
        """Derivative of a landmark's height by the state, shape (1, n)."""

    @abstractmethod
    def covariance(self) -> Floats:
        """P, shape (n, n)."""

    @abstractmethod
    def correct(self, H: Floats, e: Floats, R: Floats) -> None:
        """Update by an innovation."""

    @abstractmethod
    def place_of(self, slot: int) -> slice:
        """Place of a landmark in the rows of P."""

    @abstractmethod
    def compass(self) -> tuple[int, float]:
        """Place of the constant bias of the compass in the rows of P, and its estimate, rad."""

    @abstractmethod
    def update_up(self, up: Floats, sigma_rad: float, i_R_j: Floats) -> None:
        """Update by the direction of the world's up in the body, measured over an interval from i to j."""

    @abstractmethod
    def update_plane(self, plane: PlanarMotion) -> None:
        """Update by the plane on which the vehicle stays."""

    @abstractmethod
    def points(self, slots: list[int]) -> tuple[Floats, Floats]:
        """Positions of m landmarks by their numbers in the state, (m, 3), and their joint covariance, (3 m, 3 m)."""

    @abstractmethod
    def attitude(self) -> Floats:
        """world_R_body of the state, shape (3, 3)."""

    def by_point(self, G: Floats) -> Floats:
        """Derivative of the error of a point seen by the state, from G, that of its place, both shape (3, n)."""
        return G

    def check(self, epoch_ns: int) -> None:
        """Look at the state after all measurements at an epoch; nothing by default."""
        del epoch_ns

    def gyro_bias(self) -> Floats:
        """Estimated gyro bias, shape (3,), rad/s; zero where the state has none."""
        return NO_BIAS

    # ---------------------------------------------------------------- pose, and what is seen from there

    def pose_after(self, motion: Motion) -> tuple[Floats, Floats, Floats]:
        """world_R_body (3, 3), position (3,), and covariance of [theta, rho] (6, 6) a motion after the state."""
        R, X, J = self.linearised(motion)
        return R, X, covariance_after(self.covariance(), J, motion.C)

    def augment(self, motion: Motion, z: Floats, R_z: Floats) -> int:
        """Append a landmark ``p = g(x_v, z, elevation)``, seen a motion after the state; its number in the state.

        ``P_pv = G P``,  ``P_pp = G P G^T + G_b C G_b^T + G_z diag(R_z, elevation_sigma^2) G_z^T``. It is put on a floor
        of known height if it is near.
        """
        sonar = self.sonar
        R, X, J = self.linearised(motion)
        elevation_rad = elevation_of_new(R, X, sonar, z)
        p, G_b, G_z = locate_from_body(R, X, sonar.mount, z, elevation_rad)
        P = self.covariance()
        G = self.by_point(self._by_state(G_b, J))
        P_pv = G @ P  # (3, n)
        P_pp = P_pv @ G.T + G_b @ motion.C @ G_b.T
        P_pp += G_z @ polar_covariance(R_z, sonar.aperture_rad) @ G_z.T
        slot = self.append(p, np.block([[P, P_pv.T], [P_pv, symmetric(P_pp)]]))
        H = self.height_jacobian(slot)
        variance_m2 = (H @ self.covariance() @ H.T)[0, 0]
        if stands_on_floor(p[2], variance_m2, sonar):
            off_m = np.array([sonar.floor_z_m - p[2]])
            self.correct(H, off_m, np.array([[sonar.floor_variance_m2]]))
        return slot

    def _by_state(self, H_b: Floats, J: Floats) -> Floats:
        """``H_b J``, by the whole state, shape (m, n)."""
        H = np.zeros((len(H_b), len(self.covariance())))
        H[:, : J.shape[1]] = H_b @ J
        return H

    # ---------------------------------------------------------------- measurements that the paper has not

    def observe_far(
        self, motion: Motion, slot: int, z: Floats, R_z: Floats
    ) -> Judged | None:
        """Update by a landmark far from where it is predicted, ``0 = g(x_v, z) - p``.

        None where range and azimuth, (6) and (7) of the paper, are linear enough.
        """
        R, X, J = self.linearised(motion)
        P = self.covariance()
        g, G_b, G_z = locate_from_body(R, X, self.sonar.mount, z, 0.0)
        e = g - self.points([slot])[0][0]
        H = -self.by_point(self._by_state(G_b, J))
        H[:, self.place_of(slot)] += np.eye(3)  # e is the point seen less p
        noise = G_b @ motion.C @ G_b.T
        found, R_g = judged_far(e, H @ P @ H.T, noise, G_z, self.sonar, z, R_z)
        if found is not None and found.outcome != GATED:
            self.correct(H, e, R_g)
        return found

    def update_heading(
        self, motion: Motion, yaw_rad: float, variance_rad2: float
    ) -> float:
        """Update by a compass, ``psi' + c``, with Huber's kernel, a motion after the state.

        Returns its distance from the yaw in sigmas, in which the bias c of the compass counts as noise.
        """
        R, _, J = self.linearised(motion)
        P = self.covariance()
        yaw, by_turn = yaw_and_derivative(R)
        H_b = np.array([[*by_turn, 0.0, 0.0, 0.0]])
        H = self._by_state(H_b, J)
        noise = H_b @ motion.C @ H_b.T
        e = np.array([wrap_angle(yaw_rad - yaw)])
        # judged without the estimated c: a filter that is wrong takes its error for one of the compass
        off = distance(
            e, H @ P @ H.T + noise + variance_rad2 + self.compass_variance_rad2
        )
        place, bias_rad = self.compass()
        H[0, place] = 1.0
        e = wrap_angle(e - bias_rad)
        scale = huber_scale(e, H @ P @ H.T + noise + variance_rad2)
        self.correct(H, e, noise + scale * variance_rad2)
        return off

    def update_position(
        self, motion: Motion, position_m: Floats, cov_m2: Floats
    ) -> float:
        """Update by the position of the antenna, ``X' + R' q``, with Huber's kernel; its distance in sigmas."""
        R, X, J = self.linearised(motion)
        H_b = body_point_jacobian(R, self.antenna)  # (3, 6)
        H = self._by_state(H_b, J)
        e = position_m - (X + R @ self.antenna)
        noise = H_b @ motion.C @ H_b.T
        S = symmetric(H @ self.covariance() @ H.T + noise + cov_m2)
        self.correct(H, e, noise + huber_scale(e, S) * cov_m2)
        return distance(e, S)

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
        end_ns = measurements.end_ns
        detections = measurements.detections
        self.odometry.add(measurements.imu, measurements.dvl)
        depth = self.odometry.used_depths(measurements.depth)
        if self._reached_ns == NOT_STARTED:
            self._start(end_ns)
        # results depend on stamps alone: what comes later than an estimate for its stamp is late
        since_ns = max(self._done_ns, self._reached_ns)
        self._done_ns = max(self._done_ns, end_ns)
        views = self._views(detections, since_ns)
        estimate = None
        try:
            samples = self._samples(
                depth, measurements.heading, measurements.positions, since_ns
            )
            if end_ns >= max(self._reached_ns, self.node_ns):
                call = Call(
                    end_ns=end_ns,
                    node_ns=self.node_ns,
                    opened_ns=self._opened_ns,
                    interval_ns=self._interval_ns,
                    has_plane=self.calibration.planar is not None,
                )
                estimate = self._run(call, samples, views)
                self._estimates.keep(estimate)
        except np.linalg.LinAlgError as error:
            raise EstimatorError(
                f"{self.name}: between {self.node_ns} and {end_ns} ns the expected covariance of a measurement is"
                " not positive definite; give variances above zero in log and calibration"
            ) from error
        if detections is not None:
            self._journal.extend(
                detections.stamps_ns, views.ids, views.outcome, views.e, views.S
            )
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates; a filter does not revise them."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Landmarks in the state, with the covariances of their coordinates."""
        ids = sorted(self._slots)
        positions, joint = self.points([self._slots[i] for i in ids])
        blocks = diagonal_blocks(joint, 3)
        return self._known.with_given(
            LandmarkMap(np.array(ids, dtype=np.int64), positions, blocks)
        )

    def known_map(self) -> KnownMap:
        """Landmarks in the state with their joint covariance, for another run."""
        ids = sorted(self._slots)
        positions, joint = self.points([self._slots[i] for i in ids])
        return KnownMap.of(ids, positions, covariance_m2=joint)

    def detections(self) -> DetectionLog:
        """Outcome of each detection so far."""
        return self._journal.log()

    def withheld(self) -> list[str]:
        """Messages about headings, fixes and detections that the state contradicts."""
        messages = self._contradictions.messages() + self._known.messages()
        if math.isfinite(self.sonar.gate) or math.isfinite(self.sonar.kernel_width):
            messages += lockout_messages(self.detections())
        return messages

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of all sensors but the sonar that are not used, with the reason."""
        return self.odometry.refused + self._refused

    # ---------------------------------------------------------------- measurements of a call

    def _start(self, end_ns: int) -> None:
        """Set the state's epoch to the first one, if it is reached."""
        start_ns = self.odometry.start_by(end_ns)
        if start_ns is None:
            return
        self._reached_ns = self.odometry.reached_ns(start_ns)
        self.node_ns = start_ns
        self._opened_ns = start_ns
        self._kept_ns = start_ns
        self._opened_velocity = self.odometry.velocity_at_imu(start_ns)

    def _views(self, detections: LandmarkDetections | None, since_ns: int) -> Views:
        """Views of detections, with their most probable identities.

        Rows before the first epoch is reached, or older than those done, are refused.
        """
        if detections is None:
            return NO_VIEWS
        stamps_ns = detections.stamps_ns
        ids, outcome = identify(detections, self.params.minimum_id_probability)
        if stamps_ns[0] < since_ns:
            outcome[stamps_ns < since_ns] = OUTCOME_NUMBERS[Outcome.LATE]
            outcome[stamps_ns < self._reached_ns] = OUTCOME_NUMBERS[Outcome.UNLOCATED]
        z, R_z = polar_measurements(detections, self.calibration.sonar)
        wanted = ids.tolist()
        slot = np.array([self._slots.get(each, UNKNOWN) for each in wanted])
        # the gate of the map also for one that has moved: of two objects with its identity only one is mapped again
        of_map = self._known.held.union(self._known.moved)
        narrow = min(self.sonar.gate, self._known.gate)
        gate = np.array([narrow if i in of_map else self.sonar.gate for i in wanted])
        e = np.full(z.shape, math.nan)
        S = np.full(R_z.shape, math.nan)
        return Views(stamps_ns, ids, slot, gate, z, R_z, outcome, e, S)

    def _samples(
        self,
        depth: Depth | None,
        heading: Heading | None,
        fixes: PositionFixes | None,
        since_ns: int,
    ) -> Samples:
        """Samples of a call with their noise, in order. Unsound and late rows are refused, but a late fix is used.

        Rows before the first epoch is reached are passed over.
        """
        blocks = []
        if depth is not None:  # the odometry has refused its unsound rows
            blocks.append(self._in_time(self._depths(depth), None, since_ns))
        if heading is not None:
            blocks.append(
                self._in_time(self._headings(heading), heading.are_sound(), since_ns)
            )
        if fixes is not None:
            blocks.append(
                self._in_time(self._fixes(fixes), fixes.are_sound(), since_ns)
            )
        if not blocks:
            return NO_SAMPLES
        if len(blocks) == 1:
            return blocks[0]
        samples = Samples._make(map(np.concatenate, zip(*blocks, strict=True)))
        return _rows(samples, np.argsort(samples.stamp_ns, kind="stable"))

    def _depths(self, depth: Depth) -> Samples:
        """Depths, with the calibration's noise where they have none."""
        variance_m2 = np.where(
            np.isnan(depth.variance_m2),
            self.calibration.depth.sigma_m**2,
            depth.variance_m2,
        )
        return _scalars(DEPTH, 2, depth.stamps_ns, depth.z_m, variance_m2)

    def _headings(self, heading: Heading) -> Samples:
        """Headings, with the calibration's noise where they have none."""
        sigma_rad = np.where(
            np.isnan(heading.sigma_rad),
            self.calibration.heading.sigma_rad,
            heading.sigma_rad,
        )
        with np.errstate(over="ignore"):  # of an unsound row, which is refused
            variance_rad2 = np.square(sigma_rad)
        return _scalars(HEADING, 0, heading.stamps_ns, heading.yaw_rad, variance_rad2)

    def _fixes(self, fixes: PositionFixes) -> Samples:
        """Position fixes, with the calibration's noise where they have none."""
        noise = fixes.covariance_m2.copy()
        noise[np.isnan(noise).any(axis=(1, 2))] = np.diag(
            np.square(self.calibration.positions.sigma_m)
        )
        kind = np.full(len(fixes), FIX)
        return Samples(fixes.stamps_ns, kind, fixes.position_m.copy(), noise)

    def _in_time(
        self, samples: Samples, is_sound: NDArray[np.bool_] | None, since_ns: int
    ) -> Samples:
        """The sound rows that are not late; the others are refused, or used if they are late fixes.

        ``is_sound``: None where all are.
        """
        if is_sound is None:
            if samples.stamp_ns[0] >= since_ns:
                return samples
            is_sound = np.ones(len(samples.stamp_ns), np.bool_)
        is_late = samples.stamp_ns < since_ns
        is_used = is_sound & ~is_late
        if is_used.all():
            return samples
        for row in np.flatnonzero(
            ~is_used & (samples.stamp_ns >= self._reached_ns)
        ).tolist():
            kind = int(samples.kind[row])
            stamp_ns = int(samples.stamp_ns[row])
            # USBL fixes come seconds late as a rule; the motion since is still known
            if is_sound[row] and kind == FIX and stamp_ns >= self.node_ns - KEPT_NS:
                self._use_late(
                    stamp_ns, samples.value[row], samples.noise[row], since_ns
                )
            else:
                reason = Refusal.LATE if is_sound[row] else Refusal.UNSOUND
                self._refused.append(RefusedRow(SENSORS[kind], stamp_ns, reason))
        return _rows(samples, is_used)

    # ---------------------------------------------------------------- events of a call

    def _run(self, call: Call, samples: Samples, views: Views) -> Estimate:
        """Carry the state to the newest epoch reached at the end of the call, with all measurements on the way."""
        events = self._events(call, samples, views)
        order = events.order
        kinds = order.kind.tolist()
        last = len(kinds) - 1
        k = 0
        while k < last:
            if events.is_gap[k]:
                self._bridge(events, k, views)
            kind = kinds[k]
            self.check(self.node_ns)
            after = self.follow(events, k)
            newest_ns = int(order.start_ns[after])
            if newest_ns > self.node_ns:
                self._correct_at(newest_ns)
            if after > k:
                k = after
                continue
            motion = self._motion_to(events, k)
            row = int(order.row[k])
            if kind == FRAME:
                self._see(motion, views, row)
            elif kind == HEADING:
                distance = self.update_heading(
                    motion, samples.value[row, 0], samples.noise[row, 0, 0]
                )
                self._contradictions.judge("heading", distance)
            elif kind == FIX:
                distance = self.update_position(
                    motion, samples.value[row], samples.noise[row]
                )
                self._contradictions.judge("positions", distance)
            k += 1
        if events.is_gap[last]:
            self._bridge(events, last, views)
        R, X, covariance = self.pose_after(self._motion_to(events, last))
        self.odometry.settle(self.node_ns)
        # rows that late fixes may still need are kept
        if self.node_ns > self._kept_ns + KEPT_NS:
            self.odometry.forget_before(self.node_ns - KEPT_NS)
            self._kept_ns = self.node_ns
        return Estimate(call.end_ns, gtsam.Pose3(gtsam.Rot3(R), X), covariance)

    def _events(self, call: Call, samples: Samples, views: Views) -> Events:
        """Events of a call, the last of which is its end."""
        epochs_ns, reached_ns = self.odometry.epochs_reached(self.node_ns, call.end_ns)
        order = Order(
            *in_order(
                epochs_ns, reached_ns, samples.stamp_ns, samples.kind, views, call
            )
        )
        motions = self.odometry.motions(
            order.start_ns, order.end_ns, order.stamp_ns, NO_BIAS
        )
        is_gap = np.isnan(motions.dp[:, 0])
        return Events(order, motions, is_gap, samples.value, samples.noise, views)

    def _motion_to(self, events: Events, k: int) -> Motion:
        """Motion to an event without the gyro bias of the state and the Earth's rate."""
        motion = Motion._make([column[k] for column in events.motions])
        if events.is_gap[k] or not self.setup.has_rate:
            return motion
        earth_i = self.attitude().T @ self.setup.earth_rad_s
        return remove_rate(motion, vec(self.gyro_bias()), vec(earth_i))

    def _correct_at(self, epoch_ns: int) -> None:
        """Correct at a new epoch by the plane, and by gravity where an interval of it ends."""
        self.node_ns = epoch_ns
        if self.calibration.planar is not None:
            self.update_plane(self.calibration.planar)
        if 0 < self._interval_ns <= epoch_ns - self._opened_ns:
            self._level(epoch_ns)

    def _level(self, epoch_ns: int) -> None:
        """Update by gravity over the interval that ends at an epoch; the next one begins."""
        duration_s = (epoch_ns - self._opened_ns) * 1e-9
        velocity_i, variance_i = self._opened_velocity
        velocity_j, variance_j = self.odometry.velocity_at_imu(epoch_ns)
        turn, impulse = self.setup.felt
        up = up_direction(
            impulse / duration_s, turn, velocity_i, velocity_j, duration_s
        )
        if not math.isnan(up[0]):
            # one sigma for both ends, so that the noise of the difference is the same
            velocity_sigma = math.sqrt(0.5 * (variance_i + variance_j))
            sigma_rad = tilt_sigma(
                duration_s, velocity_sigma, self.calibration, has_bias=not self.has_bias
            )
            self.update_up(up, sigma_rad, turn)
        self._opened_ns = epoch_ns
        self._opened_velocity = (velocity_j, variance_j)
        self.setup.felt.forget()

    def _see(self, motion: Motion, views: Views, first: int) -> None:
        """Update by the known landmarks of a frame and append the new ones, in the order of their rows."""
        rows = in_frame(views, first).tolist()
        new = first
        while new != NO_ROW:
            if self._may_be_far:
                self._observe_far(motion, views, new)
            new = self.observe(motion, views, new)
            if new != NO_ROW:
                slot = self.augment(motion, views.z[new], views.R_z[new])
                self._place(views, int(views.ids[new]), slot)
                views.outcome[new] = NEW
        # only landmarks of the map are compared with it
        if self._known.held:
            for row in rows:
                self._judge_map(views, row)

    def _place(self, views: Views, landmark_id: int, slot: int) -> None:
        """Give a landmark a number in the state; `UNKNOWN` takes it away."""
        views.slot[views.ids == landmark_id] = slot
        if slot == UNKNOWN:
            del self._slots[landmark_id]
        else:
            self._slots[landmark_id] = slot

    def _observe_far(self, motion: Motion, views: Views, first: int) -> None:
        """Update by the points seen of known landmarks that are far, from a row of a frame on to the next new one."""
        for row in in_frame(views, first).tolist():
            slot = int(views.slot[row])
            if slot == UNKNOWN:
                return
            judged = self.observe_far(motion, slot, views.z[row], views.R_z[row])
            if judged is not None:
                views.outcome[row], views.e[row], views.S[row] = judged

    def _judge_map(self, views: Views, row: int) -> None:
        """Let a landmark of the map go that has moved; its next sighting maps it again."""
        landmark_id = int(views.ids[row])
        if landmark_id not in self._known.held:
            return
        stamp_ns = int(views.stamp_ns[row])
        verdict = self._known.judge(
            landmark_id, stamp_ns, views.e[row].copy(), views.S[row]
        )
        if verdict is Verdict.RELEASE:
            self._place(views, landmark_id, UNKNOWN)

    def _bridge(self, events: Events, k: int, views: Views) -> None:
        """Write the motion over a gap, with the share of its error that the measurements of one more event may have.

        Measurements that are related to one epoch over the same gap of the Doppler log share its error. The k-th gets
        ``k (k + 1)`` times the motion's covariance: together those of one kind, such as depths or detections, inform no
        more than one exact measurement, ``sum 1 / (k (k + 1)) = 1``.

        In a state without bias an unknown one, which tilts gravity, adds to the covariance of the displacement.
        """
        order = events.order
        kind = int(order.kind[k])
        end_ns = int(order.end_ns[k])
        over = self.odometry.motion(
            self.node_ns,
            end_ns,
            self.gyro_bias(),
            self.attitude(),
            int(order.stamp_ns[k]),
        )
        motion = motion_of(over)
        if not np.isfinite(motion.dp).all():
            raise EstimatorError(
                f"{self.name}: the motion to {end_ns} ns over a gap is not finite"
            )
        more = len(in_frame(views, int(order.row[k]))) if kind == FRAME else 1
        if kind != END:  # an estimate alone changes nothing
            self._may_be_far = self.params.far_views
            if self._may_be_far:
                self.setup = self.setup._replace(follows_frames=False)
        shared = self._shared(motion, kind, more)
        for columns, values in zip(events.motions, shared, strict=True):
            columns[k] = values

    def _shared(self, motion: Motion, kind: int, more: int = 1) -> Motion:
        """Motion into the gap after the newest epoch with the share of its error that some more measurements have."""
        C = motion.C.copy()
        if not self.has_bias:
            C[3:, 3:] += (
                self.calibration.imu.gyro_bias_sigma**2 * motion.D[3:] @ motion.D[3:].T
            )
        if kind in (DEPTH, HEADING, FIX, FRAME):
            count = self._used_in_gap.get((self.node_ns, kind), 0) + more
            self._used_in_gap[self.node_ns, kind] = count
            C *= count * (count + 1)
        return motion._replace(C=C)

    def _use_late(
        self, stamp_ns: int, position_m: Floats, noise: Floats, since_ns: int
    ) -> None:
        """Update by a fix of an earlier instant i, by the motion backwards.

        From epoch j the antenna was then at ``j_T_i l``, with covariance ``Ad(i_T_j) C Ad(i_T_j)^T``. The state
        shares the error of this motion, which is left out: the fix informs rather too little.
        """
        first_ns = min(stamp_ns, self.node_ns)
        last_ns = max(stamp_ns, self.node_ns)
        attitude = self.attitude()
        between = self.odometry.motion(
            first_ns, last_ns, self.gyro_bias(), attitude, since_ns
        )
        motion = motion_of(between)
        if self.odometry.is_gap(self.node_ns, stamp_ns):
            motion = self._shared(motion, FIX)
        if stamp_ns < self.node_ns:
            # the attitude is that at the end of the motion: take it back to the start
            attitude = attitude @ motion.dR.T
            between = self.odometry.motion(
                first_ns, last_ns, self.gyro_bias(), attitude, since_ns
            )
            motion = backwards(between)
        self._contradictions.judge(
            "positions", self.update_position(motion, position_m, noise)
        )


def motion_of(over: PreintegratedMotion) -> Motion:
    """The motion as arrays."""
    return Motion(
        dR=np.ascontiguousarray(over.i_T_j.rotation().matrix()),
        dp=np.array(over.i_T_j.translation()),
        C=np.ascontiguousarray(over.covariance),
        D=np.ascontiguousarray(over.D_bias),
        impulse=over.mean_specific_force * over.duration_s,
    )


def backwards(over: PreintegratedMotion) -> Motion:
    """The motion from its end to its start, with covariance and derivative; without the specific force."""
    A = over.i_T_j.AdjointMap()
    back = over.i_T_j.inverse()
    return Motion(
        dR=np.ascontiguousarray(back.rotation().matrix()),
        dp=np.array(back.translation()),
        C=np.ascontiguousarray(A @ over.covariance @ A.T),
        D=np.ascontiguousarray(-A @ over.D_bias),
        impulse=np.full(3, math.nan),
    )


OUTLYING = math.sqrt(-2.0 * math.log(0.001))
"""Mahalanobis distance that one right detection in a thousand exceeds."""
OUTLIERS = 0.1
"""Share of wrong detections that a gate or a kernel is for; three times the largest of our recordings."""


def lockout_messages(log: DetectionLog) -> list[str]:
    """A message where far more detections are outliers than noise and a share `OUTLIERS` of wrong ones explain.

    Of n detections that is more than the mean and four standard deviations of a binomial distribution.
    """
    has_innovation = ~np.isnan(log.innovations[:, 0])
    e = log.innovations[has_innovation]
    S = log.innovation_covs[has_innovation]
    squared = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[:, :, None])[:, :, 0])
    outliers = int(np.count_nonzero(squared > OUTLYING**2))
    share = OUTLIERS + (1.0 - OUTLIERS) * 0.001
    explained = share * len(e) + 4.0 * math.sqrt(share * (1.0 - share) * len(e))
    # four sigmas: one run in 30,000 without a fault
    if outliers <= explained:
        return []
    return [
        f"{outliers} of {len(e)} detections of known landmarks lie outside the 99.9 % ellipse of their innovation, far"
        " more than noise and a tenth of wrong detections explain: the filter is wrong, not they, and its gate or"
        " kernel keeps right detections from correcting it; give gate_probability = 1 and kernel_width = 0, or larger"
        " noise"
    ]


SENSORS = {DEPTH: "depth", HEADING: "heading", FIX: "positions"}
"""Names in `RefusedRow`."""


def _scalars(
    kind: int, place: int, stamps_ns: Ints, values: Floats, variances: Floats
) -> Samples:
    """Samples of one number each."""
    n = len(stamps_ns)
    value = np.zeros((n, 3))
    noise = np.zeros((n, 3, 3))
    value[:, place] = values
    noise[:, place, place] = variances
    return Samples(stamps_ns, np.full(n, kind), value, noise)


def _rows(samples: Samples, rows: Ints | NDArray[np.bool_]) -> Samples:
    return Samples._make(column[rows] for column in samples)
