"""Shell of both landmark filters: the contract, the order of events, and the outcomes of detections.

A filter's state sits at an epoch, a stamp of the Doppler log. Events happen in the order of their stamps, whatever the
calls in which measurements arrive: an epoch when it is reached, a depth sample, a heading, a position fix, then the
detections of a frame. What is measured at an instant is related to the newest epoch reached by then, through a motion
from rows stamped no later::

    epoch i --- epoch j          predict; then the plane, and gravity where an interval of it ends here
          i -------- t           depth, heading, position fix, frame, or estimate at the end of the call
    t' ------ i                  position fix that comes late, by the motion backwards (`FilterShell._use_late`)

Measurements that are related to one epoch over the same gap of the Doppler log share its error. The k-th gets k (k + 1)
times the motion's covariance: together those of one kind, such as depths or detections, tell no more than one exact
measurement, ``sum 1 / (k (k + 1)) = 1``.

Far landmarks (`far_view`) and the choices that the paper leaves open: docs/theory/ekf_slam.md, docs/theory/gaps.md.
"""

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Calibration, PlanarMotion, Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Depth, Floats, Heading, Ints, LandmarkDetections, Measurements, PositionFixes
from sonar_graph.motion import Motions, MotionSource, require_source
from sonar_graph.navigation.alignment import earth_rate_in_world, tilt_sigma, up_direction
from sonar_graph.numerics import I3, LOWER_LEFT, ZERO, compiled, cross, exp_and_mean, mat, store, vec
from sonar_graph.slam.landmarks import ACCEPTED, MINIMUM_PROBABILITY, gate_threshold, identify
from sonar_graph.slam.models import elevation_on_floor
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


# ------------------------------------------------------------------------------------------------- motions and events


class Motion(Motions):
    """One row of `Motions`: i_T_j with covariance C, derivative D by the gyro bias, and impulse."""


@compiled
def remove_rate(dR: Floats, dp: Floats, D: Floats, impulse: Floats, bias: Floats, earth: Floats) -> None:
    """Remove a gyro bias and the Earth's rate (frame i, rad/s) from dR, dp and impulse, to first order.

    To gyros the Earth's rate is a bias, the mean of that in both frames, i and j; the specific force is turned by half
    of what the body is.
    """
    R, p, f, rate_i = mat(dR), vec(dp), vec(impulse), vec(earth)
    rate = vec(bias) + 0.5 * (rate_i + R.T @ rate_i)
    theta, rho = mat(D) @ rate, mat(D, LOWER_LEFT) @ rate
    store(R @ exp_and_mean(theta)[0], dR)
    dp[0], dp[1], dp[2] = p + R @ rho
    impulse[0], impulse[1], impulse[2] = f + 0.5 * cross(R @ theta, f)


@compiled
def add_force(i_R_j: Floats, impulse: Floats, dR: Floats, more: Floats) -> None:
    """Continue an interval of gravity by a motion: rotation, and specific force summed up in the frame of its start."""
    R = mat(i_R_j)
    impulse[0], impulse[1], impulse[2] = vec(impulse) + R @ vec(more)
    store(R @ mat(dR), i_R_j)


@compiled
def up_at_end(i_R_j: Floats, impulse: Floats, interval: Floats) -> Floats:
    """World's up in the body where an interval of `Events.gravity` ends; NaN if not measured. The next one begins."""
    duration_s = interval[6]
    for i in range(3):
        impulse[i] /= duration_s
    up = up_direction(impulse, i_R_j, interval[:3], interval[3:6], duration_s)
    store(I3, i_R_j)
    impulse[0], impulse[1], impulse[2] = ZERO
    return up


EPOCH, PLANE, GRAVITY, DEPTH, HEADING, FIX, FRAME, END = range(8)
"""Kinds of events; at equal stamps the lower comes first, but plane and gravity right after their epoch."""
USED, GATED, NEW, LET_IN = (OUTCOME_NUMBERS[o] for o in (Outcome.USED, Outcome.GATED, Outcome.NEW, Outcome.LET_IN))
OUTLYING, JUDGED_TOGETHER = -2.0 * math.log(0.001), 10
"""Squared Mahalanobis distance that one right detection in a thousand exceeds, and number of detections of which most
tell: with a tenth of outliers six of ten are so once in 7,000 times, ``P(Bin(10, 0.1) > 5) = 1.5e-4``."""
NOT_STARTED, LONG_AGO = int(np.iinfo(np.int64).max), int(np.iinfo(np.int64).min)


class Views(NamedTuple):
    """Detections of a call: range and azimuth z (m, 2) with covariance R_z, innovation e with S (NaN without one)."""

    stamp_ns: Ints
    landmark: Ints
    """Number of the landmark in the state; -1 for one that may be new, or far from where it is predicted."""
    z: Floats
    R_z: Floats
    outcome: NDArray[np.int8]
    """`OUTCOME_NUMBERS`, or ACCEPTED: to be used."""
    e: Floats
    S: Floats


def accepted_rows(seen_ns: Ints, outcome: NDArray[np.int8], first: int) -> list[int]:
    """Detections of a frame that are to be used, of which one is given."""
    return np.flatnonzero((seen_ns == seen_ns[first]) & (outcome == ACCEPTED)).tolist()


class Events(NamedTuple):
    """Events of a call in their order, as columns."""

    stamp_ns: Ints
    """When they happen; no row stamped later is used."""
    start_ns: Ints
    """Newest epoch, at which the motion to an event begins, and the instant at which it ends."""
    end_ns: Ints
    kind: Ints
    row: Ints
    """Number of the sample in its block, of the interval of gravity, or of the first detection of the frame."""
    dR: Floats
    """Columns of `Motions`; NaN over a gap, until that is bridged."""
    dp: Floats
    C: Floats
    D: Floats
    impulse: Floats
    has_rate: NDArray[np.bool_]
    """True where a gyro bias and the Earth's rate are still in a motion."""
    z_m: Floats
    """Depths, with their variances; NaN: that of the calibration."""
    variance_m2: Floats
    gravity: Floats
    """Intervals of gravity: velocity of the IMU's point at both ends, duration, and sigma of the tilt, shape (g, 8)."""
    seen_ns: Ints
    """Columns of `Views`."""
    landmark: Ints
    z: Floats
    R_z: Floats
    outcome: NDArray[np.int8]
    e: Floats
    S: Floats


@compiled
def in_order(
    epochs_ns: Ints, reached_ns: Ints, samples: Ints, seen_ns: Ints, outcome: NDArray[np.int8], since_ns: int,
    end_ns: int, node_ns: int, opened_ns: int, interval_ns: int, is_planar: bool, out: Ints,
) -> int:  # fmt: skip
    """Write the first five columns of `Events` into the rows of ``out``, up to the end of a call; their number.

    Parameters
    ----------
    samples
        Stamps, kinds and rows of depths, headings and fixes, in order, shape (3, s).
    since_ns
        Samples stamped earlier are passed over, and detections that are not accepted.
    node_ns, opened_ns, interval_ns
        Epochs of the state and at which the interval of gravity began, and its least length; 0: no gravity.
    """
    n, e, s, r, g, kind, stamp_ns, frame_ns = 0, 0, 0, 0, 0, END, LONG_AGO, LONG_AGO
    sample_ns = samples[0]
    while n == 0 or kind != END:
        if kind == EPOCH and is_planar:
            kind, until_ns = PLANE, node_ns
        elif kind <= PLANE and 0 < interval_ns <= node_ns - opened_ns:
            kind, until_ns, opened_ns, row, g = GRAVITY, node_ns, node_ns, g, g + 1
        else:
            while s < len(sample_ns) and sample_ns[s] < since_ns:
                s += 1
            while r < len(seen_ns) and (seen_ns[r] == frame_ns or outcome[r] != ACCEPTED):
                r += 1
            stamp_ns, until_ns, kind, row = end_ns, end_ns, END, 0
            if r < len(seen_ns):
                stamp_ns, until_ns, kind, row = seen_ns[r], seen_ns[r], FRAME, r
            if s < len(sample_ns) and sample_ns[s] <= stamp_ns:
                stamp_ns, until_ns, kind, row = sample_ns[s], sample_ns[s], samples[1, s], samples[2, s]
            if e < len(epochs_ns) and reached_ns[e] <= stamp_ns:
                stamp_ns, until_ns, kind, row = reached_ns[e], epochs_ns[e], EPOCH, e
            e, s = e + int(kind == EPOCH), s + int(DEPTH <= kind <= FIX)
            frame_ns = stamp_ns if kind == FRAME else frame_ns
        out[0, n], out[1, n], out[2, n], out[3, n], out[4, n] = stamp_ns, node_ns, until_ns, kind, row
        node_ns, n = until_ns if kind == EPOCH else node_ns, n + 1
    return n


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


class Gate(NamedTuple):
    """Doubt about detections: a gate that refuses, and a kernel that widens the noise of outliers."""

    threshold: float
    """Squared Mahalanobis distance beyond which an innovation is refused."""
    width: float
    """Of the kernel, in standard deviations; infinite: none."""
    outlying: NDArray[np.bool_]
    """Which of the last detections were outliers, as a ring."""
    judged: Ints
    """Number of detections so far, shape (1,)."""

    @classmethod
    def of(cls, params: FilterParams) -> "Gate":
        """The gate and kernel of a filter's settings, with nothing judged yet."""
        threshold, width = gate_threshold(params.gate_probability, 2), params.kernel_width or math.inf
        return cls(threshold, width, np.zeros(JUDGED_TOGETHER, np.bool_), np.zeros(1, np.int64))


@compiled
def admit(e: Floats, S: Floats, R_z: Floats, gate: Gate) -> tuple[int, Floats]:
    """Judge an innovation of range and azimuth: `USED`, `GATED` or `LET_IN`, and what the kernel adds to R_z (2, 2).

    The kernel's weights w_i at ``e_i / sqrt(S_ii)`` make ``R_ij / sqrt(w_i w_j)`` of the noise. While most of the last
    detections are outliers, the filter is wrong, not they: no gate, no kernel. docs/theory/fair_comparison.md.
    """
    squared = S[1, 1] * e[0] ** 2 - 2.0 * S[0, 1] * e[0] * e[1] + S[0, 0] * e[1] ** 2
    squared /= S[0, 0] * S[1, 1] - S[0, 1] ** 2
    widened, is_inside = np.zeros((2, 2)), squared <= gate.threshold
    gate.outlying[gate.judged[0] % len(gate.outlying)] = not squared <= OUTLYING
    gate.judged[0] += 1
    if 2 * gate.outlying.sum() > len(gate.outlying):
        return USED if is_inside else LET_IN, widened
    if not is_inside:
        return GATED, widened
    spread = np.empty(2)
    for i in range(2):
        spread[i] = math.sqrt(1.0 + e[i] ** 2 / (S[i, i] * gate.width**2))
    for i in range(2):
        for j in range(2):
            widened[i, j] = (spread[i] * spread[j] - 1.0) * R_z[i, j]
    return USED, widened


class SonarModel(NamedTuple):
    """Sonar mounting and noise, gate, and floor."""

    body_R_sonar: Floats
    body_p_sonar: Floats
    gate: Gate
    aperture_rad: float
    R_z: Floats
    """Covariance of range and azimuth where the log has none, shape (2, 2)."""
    floor_z_m: float
    """NaN where it is not known."""
    floor_variance_m2: float
    body_T_sonar: gtsam.Pose3

    @classmethod
    def of(cls, calibration: Calibration, params: FilterParams) -> "SonarModel":
        """The model of a calibration and a filter's settings."""
        sonar, floor = calibration.sonar, calibration.floor
        return cls(
            body_R_sonar=np.ascontiguousarray(sonar.mounting.pose().rotation().matrix()),
            body_p_sonar=np.array(sonar.mounting.translation_m),
            gate=Gate.of(params),
            aperture_rad=sonar.elevation_aperture_rad,
            R_z=np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2]),
            floor_z_m=floor.z_m if floor else math.nan,
            floor_variance_m2=floor.sigma_m**2 if floor else math.nan,
            body_T_sonar=sonar.mounting.pose(),
        )

    def elevation_of_new(self, R: Floats, X: Floats, z: Floats) -> float:
        """Elevation of a new landmark seen from a body: on the floor, or 0 without a floor within the aperture."""
        world_T_sonar = gtsam.Pose3(gtsam.Rot3(R), X).compose(self.body_T_sonar)
        return elevation_on_floor(world_T_sonar, z[0], z[1], self.floor_z_m, self.aperture_rad) or 0.0


@compiled
def read(range_m: Floats, azimuth_rad: Floats, logged: Floats, R_z: Floats) -> tuple[Floats, Floats]:
    """Detections z (m, 2) and their covariances (m, 2, 2): symmetric, and R_z where the log has none."""
    z, noise = np.empty((len(range_m), 2)), np.empty(logged.shape)
    for k in range(len(z)):
        z[k, 0], z[k, 1] = range_m[k], azimuth_rad[k]
        cross = 0.5 * (logged[k, 0, 1] + logged[k, 1, 0])
        is_known = not math.isnan(logged[k, 0, 0] + cross + logged[k, 1, 1])
        noise[k, 0, 0], noise[k, 1, 1] = (logged[k, 0, 0], logged[k, 1, 1]) if is_known else (R_z[0, 0], R_z[1, 1])
        noise[k, 0, 1] = noise[k, 1, 0] = cross if is_known else R_z[0, 1]
    return z, noise


def polar_covariance(R_z: Floats, aperture_rad: float) -> Floats:
    """Covariance of range, azimuth and elevation (3, 3); the latter is uniform in the aperture: ``aperture^2 / 12``."""
    V = np.diag([0.0, 0.0, aperture_rad**2 / 12.0])
    V[:2, :2] = R_z
    return V


def far_view(
    missed: Floats, cov: Floats, G_z: Floats, sonar: SonarModel, z: Floats, R_z: Floats
) -> tuple[int, Floats, Floats, Floats] | None:
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
    Outcome by `admit`; the covariance with the noise of the detection (3, 3); the innovation of range and azimuth (2,)
    and its covariance.
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
    e, S = B @ missed, B @ cov @ B.T
    outcome, widened = admit(e, S, R_z, sonar.gate)
    return outcome, cov + G_z[:, :2] @ widened @ G_z[:, :2].T, e, S


# ------------------------------------------------------------------------------------------------- the shell

NO_BIAS, NO_STAMPS, NO_DEPTH, NO_GRAVITY = np.zeros(3), np.empty(0, np.int64), np.empty(0), np.empty((0, 8))
NO_SAMPLES = np.empty((3, 0), np.int64)
NO_PAIRS, NO_COV = np.empty((0, 2)), np.empty((0, 2, 2))
NO_VIEWS = Views(NO_STAMPS, NO_STAMPS, NO_PAIRS, NO_COV, np.empty(0, np.int8), NO_PAIRS, NO_COV)
KEPT_NS = 20_000_000_000
"""Age of a position fix up to which rows for it are kept: the smoother's window by default. Up to twice as many are
kept, since dropping them costs as much as keeping a few."""


class FilterShell(ABC):
    """Estimator around the mathematics of a filter, which a subclass adds; `name` stands in messages."""

    name: str

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: FilterParams) -> None:
        require_source(odometry, calibration, f"{type(self).__name__}(calibration, odometry, params)")
        self.calibration, self.odometry = calibration, odometry
        self.sonar = SonarModel.of(calibration, params)
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
        """Message about detections that a gate would have kept out, of most that it saw (`admit`)."""
        log = self.detections()
        let_in = [
            stamp for stamp, why in zip(log.stamps_ns.tolist(), log.outcomes, strict=True) if why is Outcome.LET_IN
        ]
        if not let_in:
            return []
        return [
            f"most of {JUDGED_TOGETHER} detections in a row were outliers, first at {let_in[0]} ns, so {len(let_in)}"
            " were used outside the gate: the filter was wrong, not they, and the gate may be the cause; give"
            " gate_probability = 1, or larger noise"
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
        between = self.odometry.motion(first_ns, last_ns, self.gyro_bias(), self.attitude(), since_ns)
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
        self.correct_position(motion, np.array(known.antenna_m), fixes.position_m[row], cov_m2)

    def _turn(self, motion: Motion, heading: Heading, row: int) -> None:
        """Update by a heading, with the calibration's noise where it has none."""
        sigma_rad = float(heading.sigma_rad[row])
        sigma_rad = self.calibration.heading.sigma_rad if math.isnan(sigma_rad) else sigma_rad
        self.correct_heading(motion, float(heading.yaw_rad[row]), sigma_rad**2)

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
