"""Landmark messages of this package itself: nothing in them is open, but for the topic.

What detections of a log say that cannot be: what is refused, what is left out, and what looks wrong.

Landmarks from ``vision_msgs/Detection3DArray``: Cartesian positions with a covariance and named hypotheses.

Range and azimuth of a position p in the sonar's frame are

    r = |p|,   a = atan2(p_y, p_x)

and their covariance is J C J^T with J = [p / r; (-p_y, p_x, 0) / (p_x^2 + p_y^2)].

Own messages of this package, which are lists of numbers, as detections and maps.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.adapter import Adapter, turn, turn_covariances
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.logs.message_table import NOT_FINITE, Dropped, fit_rows, header_stamps_ns, not_finite
from sonar_graph.measurements import (
    FIRST_TOO_LARGE_ID,
    ID_ADVICE,
    NO_TRACK,
    ROUNDING,
    Floats,
    Ints,
    LandmarkDetections,
    no_posterior,
    possible_ranges,
    too_large,
)
from sonar_graph.states import LandmarkMap


class LandmarkMapAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkMap``: true positions of landmarks."""


class DetectionListsAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkDetections``: range, azimuth, covariance and posterior, in flat lists."""


NO_POSTERIOR = "with probabilities that are not between 0 and 1 or more than 1 in sum (97 % is 0.97)"


def refuse_large_ids(topic: Topic, messages: Ints, ids: Ints) -> None:
    """Refuse identities for which an estimator has no room.

    Parameters
    ----------
    messages
        Number of the message of each row, shape (n,).
    ids
        Shape (n, k).

    Raises
    ------
    LogError
        Naming the first message.
    """
    has_it = too_large(ids)
    if has_it.any():
        row = int(np.argmax(has_it))
        raise LogError(
            f"{topic.file}: topic {topic.name}: message {messages[row]} has an identity of 2^56 or more; {ID_ADVICE},"
            " or do not use them: [detections] use = false"
        )


def detection_warnings(detections: LandmarkDetections, first_ns: int, last_ns: int) -> Iterator[str]:
    """What can be read but is not used, or looks wrong.

    Parameters
    ----------
    first_ns, last_ns
        Between which there is odometry.
    """
    faults = {
        "a range that is not above 0 and at most 100 km": ~possible_ranges(detections.range_m),
        "a covariance that is not positive definite": _no_covariance(detections.range_azimuth_cov),
        "a stamp before the first odometry": detections.stamps_ns < first_ns,
        "a stamp after the last odometry": detections.stamps_ns > last_ns,
    }
    for fault, has_it in faults.items():
        if has_it.any():
            yield f"{np.count_nonzero(has_it)} of {len(detections)} rows have {fault}: estimators do not use them"
    text = _repeated_tracks(detections)
    yield from [text] if text else []


def _no_covariance(covs: Floats) -> NDArray[np.bool_]:
    """Of range and azimuth, shape (n, 2, 2); unknown ones (NaN) are none too few."""
    a, b, c = covs[:, 0, 0], covs[:, 1, 0], covs[:, 1, 1]
    is_unknown, is_finite = np.isnan(covs).any(axis=(1, 2)), np.isfinite(covs).all(axis=(1, 2))
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(~is_unknown & ~(is_finite & (a > 0) & (c > 0) & (a * c > b * b)))


def _repeated_tracks(detections: LandmarkDetections) -> str | None:
    """That tracks have several rows in a frame, of which estimators use one; None: they have not."""
    rows = np.flatnonzero(detections.track != NO_TRACK)
    pairs = np.column_stack((detections.stamps_ns[rows], detections.track[rows]))
    different, counts = np.unique(pairs, axis=0, return_counts=True)
    more = int((counts - 1).sum())
    if not more:
        return None
    frames = len(np.unique(different[counts > 1, 0]))
    return (
        f"{more} of {len(detections)} rows have the track number of another row of their frame, in {frames} frames: a"
        f" track is of one object, and one row is used; give rows of no track {NO_TRACK}, not 0 or a place in a list"
    )


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

    def _rows(self, topic: Topic, group: Messages) -> _PoseRows | None:
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
        return _PoseRows(
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


class _PoseRows(NamedTuple):
    """One row a detection."""

    message: Ints
    stamps_ns: Ints
    positions: Floats
    covariances: Floats
    ids: Ints
    scores: Floats

    def widened(self, candidates: int) -> _PoseRows:
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


def read_detections(topic: Topic) -> tuple[LandmarkDetections | None, Dropped]:
    """``sonar_graph_msgs/LandmarkDetections``; where messages differ in candidates, -1 with probability 0 fills.

    Raises
    ------
    LogError
        When the lists of a message do not belong together.
    """
    groups = [group for group in topic.messages() if group["range_m"].shape[1]]
    log_times_ns = topic.log_times_ns  # of sound messages, now that they are known
    if not groups:
        return None, {}
    parts = [_detection_columns(topic, group, log_times_ns) for group in groups]
    places = max(1, *(ids.shape[1] for *_, ids, _, _ in parts))
    order, stamps, ranges, azimuths, covariances = (np.concatenate([p[i] for p in parts]) for i in range(5))
    ids = np.concatenate([_widen(p[5], places, -1) for p in parts])
    probabilities = np.concatenate([_widen(p[6], places, 0) for p in parts])
    tracks = np.concatenate([p[7] for p in parts])
    refuse_large_ids(topic, order, ids)
    faults = {NOT_FINITE: not_finite(ranges, azimuths, probabilities), NO_POSTERIOR: no_posterior(probabilities)}
    first = np.argsort(order, kind="stable")
    rows, dropped = fit_rows(stamps[first], {k: v[first] for k, v in faults.items()}, unique=False)
    columns = (stamps, ranges, azimuths, covariances, ids, probabilities, tracks)
    return (LandmarkDetections(*(c[first[rows]] for c in columns)) if rows.size else None), dropped


def _detection_columns(topic: Topic, group: Messages, log_times_ns: Ints) -> tuple[np.ndarray, ...]:
    """Message number, stamp, range, azimuth, covariance, identities, probabilities and track, one row a detection."""
    frames, count = group["range_m"].shape
    ids, probabilities = group["candidate_ids"], group["id_probability"]
    sizes = (group["azimuth_rad"].shape[1], group["covariance"].shape[1], ids.shape[1] % count, probabilities.shape[1])
    if sizes != (count, 4 * count, 0, ids.shape[1]):
        raise LogError(
            f"{topic.file}: topic {topic.name}: message {group.rows[0]} has {count} ranges, {sizes[0]} azimuths, "
            f"{sizes[1]} covariance elements, {ids.shape[1]} identities, {sizes[3]} probabilities; "
            f"expected n, n, 4n, kn and kn"
        )
    total, places = frames * count, ids.shape[1] // count
    return (
        np.repeat(group.rows, count),
        np.repeat(header_stamps_ns(group, log_times_ns), count),
        group["range_m"].reshape(total),
        group["azimuth_rad"].reshape(total),
        group["covariance"].reshape(total, 2, 2),
        ids.reshape(total, places),
        probabilities.reshape(total, places),
        _tracks(topic, group),
    )


def _tracks(topic: Topic, group: Messages) -> Ints:
    """Track of each detection, shape (n,); logs of earlier versions have none."""
    frames, count = group["range_m"].shape
    tracks = group["track"] if "track" in group.layout.columns else np.empty((frames, 0), np.int64)
    if tracks.shape[1] == 0:
        return np.full(frames * count, NO_TRACK, dtype=np.int64)
    if tracks.shape[1] != count:
        raise LogError(
            f"{topic.file}: topic {topic.name}: message {group.rows[0]} has {count} ranges and {tracks.shape[1]} "
            "tracks; expected as many, or none"
        )
    return np.asarray(tracks, dtype=np.int64).reshape(frames * count)


def _widen(columns: np.ndarray, places: int, filling: int) -> np.ndarray:
    return np.pad(columns, ((0, 0), (0, places - columns.shape[1])), constant_values=filling)


def read_landmark_map(topic: Topic) -> LandmarkMap | None:
    """The last sound ``sonar_graph_msgs/LandmarkMap`` of a topic; None where none is.

    Raises
    ------
    LogError
        When its lists do not belong together or an identity comes twice.
    """
    groups = topic.messages()
    if not groups:
        return None
    last = max(groups, key=lambda group: int(group.rows[-1]))
    ids, position, covariance = (last[name][-1] for name in ("ids", "position", "covariance"))
    count = len(ids)
    sizes = (len(np.unique(ids)), len(position), len(covariance))
    if sizes != (count, 3 * count, 9 * count):
        raise LogError(
            f"{topic.file}: topic {topic.name}: {count} ids ({sizes[0]} different), {sizes[1]} position and "
            f"{sizes[2]} covariance elements; expected n different, 3n and 9n"
        )
    order = np.argsort(ids)
    return LandmarkMap(ids[order].astype(np.int64), position.reshape(-1, 3)[order], covariance.reshape(-1, 3, 3)[order])
