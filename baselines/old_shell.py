"""Shell of a filter, whatever its mathematics: the estimator's contract, windows of rows, and detections' outcomes."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import gtsam
import numpy as np

from baselines.filter_motion import open_interval
from baselines.filter_window import (
    CLOCK,
    NODE,
    DepthColumns,
    FilterParams,
    GravityInterval,
    MeasurementWindow,
    PoseArrays,
    VehicleModel,
    vehicle_model,
)
from baselines.sonar_update import GATED, NEW, NO_SLOT, USED, DetectionColumns, DetectionOutcomes, sonar_model
from sonar_graph.calibration import Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Depth, Floats, Ints, LandmarkDetections, Measurements
from sonar_graph.motion import MotionSource
from sonar_graph.navigation import Odometry
from sonar_graph.slam.landmarks import identify
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

OUTCOMES = {USED: Outcome.USED, NEW: Outcome.NEW, GATED: Outcome.GATED}
NO_STAMPS = np.empty(0, np.int64)
NO_OUTCOMES: DetectionOutcomes = (NO_STAMPS, np.empty((0, 2)), np.empty((0, 2, 2)))
NO_DETECTIONS = (NO_STAMPS, np.empty(0), np.empty(0), np.empty((0, 2, 2)))
NO_DEPTH = (NO_STAMPS, np.empty(0), np.empty(0))


class IdentifiedDetections(NamedTuple):
    """Detections with their most probable identities, and the reason where one is not used."""

    detections: LandmarkDetections | None
    ids: list[int]
    refusals: list[Outcome | None]


class DetectionIntake:
    """Assigns landmarks their slots in a filter's state, and keeps the outcome of each detection.

    ``minimum_id_probability``: posterior below which an identity is not believed.
    """

    def __init__(self, minimum_id_probability: float) -> None:
        self._minimum_id_probability = minimum_id_probability
        self._journal = DetectionJournal()
        self.slots: dict[int, int] = {}
        """Slot of each landmark, by identity."""

    def identify(self, detections: LandmarkDetections | None, reached_ns: int, done_ns: int) -> IdentifiedDetections:
        """Most probable identity of each row; rows before the first epoch, or older than those done, are refused."""
        if detections is None:
            return IdentifiedDetections(None, [], [])
        identities = identify(detections, self._minimum_id_probability)
        refusals = [
            Outcome.UNLOCATED if stamp_ns < reached_ns else Outcome.LATE if stamp_ns < done_ns else reason
            for stamp_ns, reason in zip(detections.stamps_ns.tolist(), identities.refusals, strict=True)
        ]
        return IdentifiedDetections(detections, identities.ids.tolist(), refusals)

    def columns(self, identified: IdentifiedDetections) -> DetectionColumns:
        """The detections as compiled code takes them; new landmarks get the next slots."""
        if identified.detections is None:
            return NO_DETECTIONS
        slots = [
            NO_SLOT if reason else self.slots.setdefault(landmark_id, len(self.slots))
            for landmark_id, reason in zip(identified.ids, identified.refusals, strict=True)
        ]
        seen = identified.detections
        return np.array(slots), seen.range_m, seen.azimuth_rad, seen.range_azimuth_cov

    def record(self, identified: IdentifiedDetections, outcomes: DetectionOutcomes) -> None:
        """Keep the outcomes."""
        if identified.detections is None:
            return
        kinds, innovations, covs = outcomes[0].tolist(), outcomes[1], outcomes[2]
        rows = zip(identified.detections.stamps_ns.tolist(), identified.ids, identified.refusals, strict=True)
        for row, (stamp_ns, landmark_id, reason) in enumerate(rows):
            if reason:
                self._journal.record(stamp_ns, landmark_id, reason)
            else:
                self._journal.record(stamp_ns, landmark_id, OUTCOMES[kinds[row]], innovations[row], covs[row])

    def log(self) -> DetectionLog:
        """All outcomes so far."""
        return self._journal.log()


def check_rows(measurements: Measurements) -> None:
    """Refuse rows that only a mistake of the caller can explain.

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
        return NO_DEPTH
    if depth.stamps_ns[0] >= since_ns:
        return depth.stamps_ns, depth.z_m, depth.variance_m2
    first = int(np.searchsorted(depth.stamps_ns, since_ns))
    return depth.stamps_ns[first:], depth.z_m[first:], depth.variance_m2[first:]


SPARE_ROWS = 256
"""IMU rows that may be kept longer than needed."""
NEVER, LONG_AGO = int(np.iinfo(np.int64).max), int(np.iinfo(np.int64).min)


class FilterShell(ABC):
    """Estimator around the mathematics of a filter, which a subclass adds.

    It cuts the rows into windows; `update` gets each window with its rows in order and the clock. Detections before the
    first epoch or older than those done are refused here, those outside the gate by `update`.
    """

    @abstractmethod
    def update(self, window: MeasurementWindow) -> tuple[DetectionOutcomes, PoseArrays]:
        """Carry the state to the newest epoch reached at the window's end.

        Returns
        -------
        Outcomes of the detections, and the pose at the window's end.

        Raises
        ------
        EstimatorError
            When the state has no meaning any more.
        """

    @abstractmethod
    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position in the world (3,) and covariance (3, 3) of the landmark in a slot of the state."""

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: FilterParams) -> None:
        self._vehicle_values = (*vehicle_model(calibration, params.gravity_interval_s),)
        self._sonar_values = (*sonar_model(calibration, params.gate_probability),)
        assert isinstance(odometry, Odometry)
        self._odometry = odometry
        self._intake = DetectionIntake(params.minimum_id_probability)
        self._estimates = CausalEstimates()
        self._most_rows = SPARE_ROWS
        self._clock: Ints = np.zeros(CLOCK, np.int64)
        self._interval_values = (*GravityInterval(np.eye(3), np.zeros(3), np.zeros(4)),)
        self._reached_ns, self._done_ns = NEVER, LONG_AGO

    @property
    def node_ns(self) -> int:
        """Stamp of the newest epoch, that of the state."""
        return int(self._clock[NODE])

    def process(self, measurements: Measurements) -> Estimate | None:
        """Process measurements and return the causal estimate at ``measurements.end_ns``.

        None before the first DVL stamp that IMU rows cover from both sides.

        Raises
        ------
        MeasurementError
            When a row is stamped after ``end_ns``.
        EstimatorError
            When the state has no meaning any more.
        """
        self._odometry.add(measurements.imu, measurements.dvl)
        if self._reached_ns == NEVER and (start_ns := self._odometry.start_ns()) is not None:
            self._start(start_ns)
        check_rows(measurements)
        identified = self._intake.identify(measurements.detections, self._reached_ns, self._done_ns)
        since_ns = max(self._done_ns, self._reached_ns)
        self._done_ns = max(self._done_ns, measurements.end_ns)
        if measurements.end_ns < max(self._reached_ns, self.node_ns):
            self._intake.record(identified, NO_OUTCOMES)
            return None
        seen = identified.detections
        window = MeasurementWindow(
            self._odometry.columns(),
            self._vehicle_values,
            self._sonar_values,
            self._clock,
            self._interval_values,
            depth_since(measurements.depth, since_ns),
            NO_STAMPS if seen is None else np.maximum(seen.stamps_ns, since_ns),
            self._intake.columns(identified),
            measurements.end_ns,
        )
        outcomes, pose = self.update(window)
        self._intake.record(identified, outcomes)
        self._odometry.settle(self.node_ns)
        if len(self._odometry.columns()[0]) > self._most_rows:  # dropping rows costs as much as keeping a few
            self._odometry.forget_before(self.node_ns)
            self._most_rows = len(self._odometry.columns()[0]) + SPARE_ROWS
        estimate = Estimate(measurements.end_ns, gtsam.Pose3(gtsam.Rot3(pose[0]), pose[1]), pose[2])
        self._estimates.keep(estimate)
        return estimate

    def trajectory(self) -> Trajectory:
        """The causal estimates; a filter does not revise them."""
        return self._estimates.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Landmarks in the state, with the covariances of their coordinates."""
        slots = self._intake.slots
        ids = sorted(slots)
        read = [self.landmark(slots[i]) for i in ids]
        return LandmarkMap(
            ids=np.array(ids, dtype=np.int64),
            positions=np.array([position for position, _ in read]).reshape(-1, 3),
            covariances=np.array([covariance for _, covariance in read]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """Outcome of each detection so far."""
        return self._intake.log()

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU and Doppler log that are not used, with the reason."""
        return self._odometry.refused

    def _start(self, start_ns: int) -> None:
        """Set the clock to the first epoch, which IMU rows cover from both sides."""
        lever_m = VehicleModel(*self._vehicle_values).dvl_p_imu
        self._reached_ns = self._odometry.start_reached_ns(start_ns)
        self._clock[NODE] = start_ns
        open_interval(self._odometry.columns(), lever_m, GravityInterval(*self._interval_values), self._clock)
