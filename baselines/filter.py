"""What is an estimator about a filter, whatever its mathematics: rows, their order, and what was said.

What a filter does with rows before its arithmetic: refuse what is wrong, name what was seen, keep books.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from baselines.filter_events import (
    CLOCK,
    NODE,
    DepthColumns,
    GravityInterval,
    MeasurementWindow,
    PoseArrays,
    open_interval,
)
from baselines.filter_inputs import (
    GATED,
    NEW,
    NO_SLOT,
    USED,
    DetectionColumns,
    DetectionOutcomes,
    FilterParams,
    VehicleModel,
    sonar_model,
    vehicle_model,
)
from sonar_graph.calibration import Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.estimator import CausalEstimates
from sonar_graph.measurements import Depth, Floats, Ints, LandmarkDetections, Measurements
from sonar_graph.navigation import Odometry
from sonar_graph.slam.landmarks import identify
from sonar_graph.states import DetectionJournal, DetectionLog, Estimate, LandmarkMap, Outcome, RefusedRow, Trajectory

OUTCOMES = {USED: Outcome.USED, NEW: Outcome.NEW, GATED: Outcome.GATED}
NO_STAMPS = np.empty(0, np.int64)
NO_OUTCOMES: DetectionOutcomes = (NO_STAMPS, np.empty((0, 2)), np.empty((0, 2, 2)))
_NO_DETECTIONS = (NO_STAMPS, np.empty(0), np.empty(0), np.empty((0, 2, 2)))
_NO_DEPTH = (NO_STAMPS, np.empty(0), np.empty(0))


class Named(NamedTuple):
    """Detections with their most probable identities, and why each is not used, if so."""

    detections: LandmarkDetections | None
    ids: list[int]
    refusals: list[Outcome | None]


class DetectionIntake:
    """Gives landmarks their places in a filter's state, and remembers what became of each detection.

    Parameters
    ----------
    minimum_id_probability
        Posterior below which an identity is not believed.
    """

    def __init__(self, minimum_id_probability: float) -> None:
        self._minimum_id_probability = minimum_id_probability
        self._journal = DetectionJournal()
        self.slots: dict[int, int] = {}
        """Place of each landmark, by identity."""

    def name(self, detections: LandmarkDetections | None, reached_ns: int, done_ns: int) -> Named:
        """The most probable identity of each row; rows before the first node, or before what is done, are refused."""
        if detections is None:
            return Named(None, [], [])
        identities = identify(detections, self._minimum_id_probability)
        refusals = [
            _refusal(stamp_ns, reached_ns, done_ns) or reason
            for stamp_ns, reason in zip(detections.stamps_ns.tolist(), identities.refusals, strict=True)
        ]
        return Named(detections, identities.ids.tolist(), refusals)

    def columns(self, named: Named) -> DetectionColumns:
        """What compiled code needs of the detections; new landmarks get the next places."""
        if named.detections is None:
            return _NO_DETECTIONS
        slots = [
            NO_SLOT if reason else self.slots.setdefault(landmark_id, len(self.slots))
            for landmark_id, reason in zip(named.ids, named.refusals, strict=True)
        ]
        seen = named.detections
        return np.array(slots), seen.range_m, seen.azimuth_rad, seen.range_azimuth_cov

    def record(self, named: Named, outcomes: DetectionOutcomes) -> None:
        """Keep what became of them."""
        if named.detections is None:
            return
        kinds, innovations, covs = outcomes[0].tolist(), outcomes[1], outcomes[2]
        rows = zip(named.detections.stamps_ns.tolist(), named.ids, named.refusals, strict=True)
        for row, (stamp_ns, landmark_id, reason) in enumerate(rows):
            if reason:
                self._journal.record(stamp_ns, landmark_id, reason)
            else:
                self._journal.record(stamp_ns, landmark_id, OUTCOMES[kinds[row]], innovations[row], covs[row])

    def log(self) -> DetectionLog:
        """All so far."""
        return self._journal.log()


def _refusal(stamp_ns: int, reached_ns: int, done_ns: int) -> Outcome | None:
    """Why nothing stamped then can be used."""
    if stamp_ns < reached_ns:
        return Outcome.UNLOCATED
    return Outcome.LATE if stamp_ns < done_ns else None


def check_rows(measurements: Measurements) -> None:
    """Refuse what can only be a mistake of the caller.

    Raises
    ------
    MeasurementError
        When a detection or a depth sample is stamped after ``end_ns``.
    """
    end_ns = measurements.end_ns
    for block in (measurements.detections, measurements.depth):
        if block is not None and block.stamps_ns[-1] > end_ns:
            raise MeasurementError(
                f"Measurements: {type(block).__name__} has a row at {block.stamps_ns[-1]} ns, after end_ns = {end_ns};"
                " hand it in with the call that reaches it"
            )


def depth_since(depth: Depth | None, since_ns: int) -> DepthColumns:
    """Depth samples that are not older than an instant."""
    if depth is None:
        return _NO_DEPTH
    if depth.stamps_ns[0] >= since_ns:
        return depth.stamps_ns, depth.z_m, depth.variance_m2
    first = int(np.searchsorted(depth.stamps_ns, since_ns))
    return depth.stamps_ns[first:], depth.z_m[first:], depth.variance_m2[first:]


SPARE_ROWS = 256
"""IMU rows that may be kept longer than needed."""
_NEVER, _LONG_AGO = int(np.iinfo(np.int64).max), int(np.iinfo(np.int64).min)


class FilterMathematics(Protocol):
    """A filter's state, how a window of measurements changes it, and how landmarks are read from it."""

    def run(self, window: MeasurementWindow) -> tuple[DetectionOutcomes, PoseArrays]:
        """Bring the state to the newest node reached at the window's end.

        Returns
        -------
        What became of the detections, and the pose at the window's end.

        Raises
        ------
        EstimatorError
            When the state has no meaning any more.
        """
        ...

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position in the world (3,) and covariance (3, 3) of the landmark at a place of the state."""
        ...


class FilterShell:
    """The estimator's contract, kept around a filter's mathematics.

    Rows are taken in once and cut into windows; the mathematics sees a window with all its rows in order, and the clock
    that says where the state is. Detections before the first node or before what was done are refused here, those
    outside the gate by the mathematics.

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor.
    params
        Gate, identities, gravity.
    mathematics
        At the start, without landmarks.
    """

    def __init__(self, calibration: Calibration, params: FilterParams, mathematics: FilterMathematics) -> None:
        self._mathematics = mathematics
        self._vehicle_values = (*vehicle_model(calibration, params.gravity_interval_s),)
        self._sonar_values = (*sonar_model(calibration, params.gate_probability),)
        self._odometry = Odometry(calibration)
        self._intake = DetectionIntake(params.minimum_id_probability)
        self._estimates = CausalEstimates()
        self._most_rows = SPARE_ROWS
        self._clock: Ints = np.zeros(CLOCK, np.int64)
        self._interval_values = (*GravityInterval(np.eye(3), np.zeros(3), np.zeros(4)),)
        self._reached_ns, self._done_ns = _NEVER, _LONG_AGO

    @property
    def node_ns(self) -> int:
        """Stamp of the newest node, where the state is."""
        return int(self._clock[NODE])

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in what was measured and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.

        Raises
        ------
        MeasurementError
            When a row is stamped after ``end_ns``.
        EstimatorError
            When the mathematics cannot go on.
        """
        self._odometry.add(measurements.imu, measurements.dvl)
        self._start()
        check_rows(measurements)
        named = self._intake.name(measurements.detections, self._reached_ns, self._done_ns)
        since_ns = max(self._done_ns, self._reached_ns)
        self._done_ns = max(self._done_ns, measurements.end_ns)
        if measurements.end_ns < max(self._reached_ns, self.node_ns):
            self._intake.record(named, NO_OUTCOMES)
            return None
        outcomes, pose = self._mathematics.run(self._window(measurements, named, since_ns))
        self._intake.record(named, outcomes)
        self._forget()
        estimate = Estimate(measurements.end_ns, gtsam.Pose3(gtsam.Rot3(pose[0]), pose[1]), pose[2])
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates: a filter does not look back."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Landmarks in the state, with the covariances of their coordinates."""
        slots = self._intake.slots
        ids = sorted(slots)
        read = [self._mathematics.landmark(slots[i]) for i in ids]
        return LandmarkMap(
            ids=np.array(ids, dtype=np.int64),
            positions=np.array([position for position, _ in read]).reshape(-1, 3),
            covariances=np.array([covariance for _, covariance in read]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """What became of each detection so far."""
        return self._intake.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, and why."""
        return self._odometry.refused

    def _start(self) -> None:
        """Set the clock once the first node is covered by IMU rows from both sides."""
        if self._reached_ns < _NEVER:
            return
        start_ns = self._odometry.start_ns()
        if start_ns is None:
            return
        columns, lever_m = self._odometry.columns(), VehicleModel(*self._vehicle_values).dvl_p_imu
        self._reached_ns = self._odometry.start_reached_ns(start_ns)
        self._clock[NODE] = start_ns
        open_interval(columns, lever_m, GravityInterval(*self._interval_values), self._clock)

    def _window(self, measurements: Measurements, named: Named, since_ns: int) -> MeasurementWindow:
        """From where the filter stands to the end of the measurements."""
        seen = named.detections
        return MeasurementWindow(
            self._odometry.columns(),
            self._vehicle_values,
            self._sonar_values,
            self._clock,
            self._interval_values,
            depth_since(measurements.depth, since_ns),
            NO_STAMPS if seen is None else np.maximum(seen.stamps_ns, since_ns),
            self._intake.columns(named),
            measurements.end_ns,
        )

    def _forget(self) -> None:
        """Drop used rows now and then: that costs as much as keeping a few."""
        self._odometry.settle(self.node_ns)
        if len(self._odometry.columns()[0]) > self._most_rows:
            self._odometry.forget_before(self.node_ns)
            self._most_rows = len(self._odometry.columns()[0]) + SPARE_ROWS
