"""Landmarks from ``vision_msgs/Detection3DArray``: Cartesian positions with a covariance and named hypotheses.

Range and azimuth of a position p in the sonar's frame are

    r = |p|,   a = atan2(p_y, p_x)

and their covariance is J C J^T with J = [p / r; (-p_y, p_x, 0) / (p_x^2 + p_y^2)].
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np

from sonar_graph.detection_rules import FIRST_TOO_LARGE_ID, ROUNDING
from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.adapters.axes import turn, turn_covariances
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.container import Topic
from sonar_graph.logs.detection_faults import refuse_large_ids
from sonar_graph.logs.table import NOT_FINITE, Dropped, fit_rows, header_stamps_ns, not_finite
from sonar_graph.measurements import Floats, Ints, LandmarkDetections

_DETECTION = "detections.bbox.center.position.x"
_SCORE = "detections.results.hypothesis.score"
_CLASS = "detections.results.hypothesis.class_id"
_RESULT_POSE = "detections.results.pose"


class DetectionArrayAdapter(Adapter):
    """Identities are integers here: a class that is a number stands for itself, others are given in `ids`."""

    position: Literal["results", "bbox"] = "results"
    """Where the position is: of a detection's first result, with its covariance, or the centre of its box, without."""
    ids: Mapping[str, int] = {}
    """Integer identity of each class that is no number: {"buoy" = 1, "ladder" = 2}."""

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        yield from (_DETECTION, _SCORE, _CLASS, f"{_RESULT_POSE}.pose.position.x", f"{_RESULT_POSE}.covariance")

    def read(self, topic: Topic) -> tuple[LandmarkDetections | None, Dropped]:
        """One row a detection that has a result; the scores are the posterior, in the order of the results.

        Raises
        ------
        LogError
            For a class that stands for no integer, and scores that are no posterior.
        """
        parts = [part for group in topic.messages() if (part := self._rows(topic, group)) is not None]
        if not parts:
            return None, {}
        candidates = max(part.ids.shape[1] for part in parts)
        parts = [part.widened(candidates) for part in parts]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        message, stamps_ns, positions, covariances, ids, scores = columns
        _check_posterior(topic, scores)
        refuse_large_ids(topic, message, ids)
        ranges, azimuths, spread = range_and_azimuth(
            turn(self.rotation, positions), turn_covariances(self.rotation, covariances)
        )
        faults = {
            "without a result": ids[:, 0] < 0,
            NOT_FINITE: not_finite(ranges, azimuths, scores),
            "at the sonar itself": ranges == 0,
        }
        order = np.argsort(message, kind="stable")
        fit, dropped = fit_rows(
            stamps_ns[order], {name: has_it[order] for name, has_it in faults.items()}, unique=False
        )
        rows = order[fit]
        found = (stamps_ns[rows], ranges[rows], azimuths[rows], spread[rows], ids[rows], scores[rows])
        return (LandmarkDetections(*found) if rows.size else None), dropped

    def _rows(self, topic: Topic, group: Messages) -> _Rows | None:
        """The detections of messages that share a layout, message by message."""
        counts = np.array(group.lengths("detections.results"), np.int64)
        if not len(counts):
            return None
        n, k = len(group), max(1, int(counts.max(initial=0)))
        shape = (n, len(counts))
        place = np.repeat(np.arange(len(counts)), counts), np.concatenate([np.arange(c) for c in counts])
        scores, ids = np.zeros((*shape, k)), np.full((*shape, k), -1, np.int64)
        place = place[0], place[1].astype(int)
        scores[:, *place] = group[_SCORE]
        ids[:, *place] = [[self._identity(topic, name) for name in names] for names in group.strings(_CLASS)]
        positions, covariances = self._positions(group, counts)
        stamps_ns = header_stamps_ns(group, topic.log_times_ns)
        return _Rows(
            np.repeat(group.rows, len(counts)),
            np.repeat(stamps_ns, len(counts)),
            positions.reshape(-1, 3),
            covariances.reshape(-1, 3, 3),
            ids.reshape(-1, k),
            scores.reshape(-1, k),
        )

    def _positions(self, group: Messages, counts: Ints) -> tuple[Floats, Floats]:
        """Shapes (messages, detections, 3) and (messages, detections, 3, 3); NaN: unknown."""
        positions = np.full((len(group), len(counts), 3), np.nan)
        covariances = np.full((len(group), len(counts), 3, 3), np.nan)
        if self.position == "bbox":
            positions[:] = np.stack([group[f"detections.bbox.center.position.{axis}"] for axis in "xyz"], axis=-1)
            return positions, covariances
        some = np.flatnonzero(counts)
        first = (np.cumsum(counts) - counts)[some]
        found = np.stack([group[f"{_RESULT_POSE}.pose.position.{axis}"] for axis in "xyz"], axis=-1)
        positions[:, some] = found[:, first]
        pose = group[f"{_RESULT_POSE}.covariance"].reshape(len(group), -1, 6, 6)[:, first, :3, :3]
        known = pose.any(axis=(2, 3)) & (pose[..., 0, 0] >= 0)
        covariances[:, some] = np.where(known[..., None, None], pose, np.nan)
        return positions, covariances

    def _identity(self, topic: Topic, name: str) -> int:
        try:
            identity = self.ids[name] if name in self.ids else int(name)
            return max(-1, min(identity, FIRST_TOO_LARGE_ID))  # what no array of integers holds is refused as well
        except ValueError:
            raise LogError(
                f"{topic.file}: topic {topic.name}: class {name!r} is no integer identity; say in a log "
                f'configuration which it is: [detections] ids = {{"{name}" = 1}}, or do not use them: use = false'
            ) from None


class _Rows(NamedTuple):
    """One row a detection."""

    message: Ints
    stamps_ns: Ints
    positions: Floats
    covariances: Floats
    ids: Ints
    scores: Floats

    def widened(self, candidates: int) -> _Rows:
        more = ((0, 0), (0, candidates - self.ids.shape[1]))
        return self._replace(ids=np.pad(self.ids, more, constant_values=-1), scores=np.pad(self.scores, more))


def range_and_azimuth(positions: Floats, covariances: Floats) -> tuple[Floats, Floats, Floats]:
    """Range, azimuth and their covariance, shapes (n,), (n,) and (n, 2, 2), from positions and theirs."""
    x, y, _ = positions.T
    ranges, across_squared = np.linalg.norm(positions, axis=1), x**2 + y**2
    jacobians = np.zeros((len(positions), 2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobians[:, 0] = positions / ranges[:, None]
        jacobians[:, 1, 0] = -y / across_squared
        jacobians[:, 1, 1] = x / across_squared
        spread = jacobians @ covariances @ jacobians.transpose(0, 2, 1)
    return ranges, np.arctan2(y, x), spread


def _check_posterior(topic: Topic, scores: Floats) -> None:
    """A posterior over identities adds up to 1 at most; detectors' scores need not."""
    worst = float(np.nanmax(scores.sum(axis=1), initial=0.0))
    if worst > 1 + ROUNDING or (scores < 0).any():
        raise LogError(
            f"{topic.file}: topic {topic.name}: scores of one detection add up to {worst:g}; the posterior over "
            f"identities must be between 0 and 1 in sum: normalise the scores where the log is made"
        )
