"""What a filter does with rows before its arithmetic: refuse what is wrong, name what was seen, keep books."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filter_detections import GATED, NEW, NO_SLOT, USED, DetectionColumns, DetectionOutcomes
from baselines.filter_events import DepthColumns
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Depth, LandmarkDetections, Measurements
from sonar_graph.slam.association import DetectionJournal, identify
from sonar_graph.states import DetectionLog, Outcome

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
