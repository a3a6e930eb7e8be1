"""Adapters for landmark detections and maps: the messages of this package, and ``vision_msgs/Detection3DArray``.

A position p in the sonar's frame with the covariance C becomes range and azimuth with the covariance ``J C J^T``::

    r = |p|,   a = atan2(p_y, p_x),   J = [p / r; (-p_y, p_x, 0) / (p_x^2 + p_y^2)]

Impossible identities are refused, impossible rows are left out, and unlikely ones are named in `detection_warnings`
(docs/design/0004-logs.md).
"""

from collections.abc import Iterator, Mapping
from typing import Literal, NamedTuple

import numpy as np

from sonar_graph.logs.adapters.adapter import (
    Adapter,
    AngleScale,
    LengthScale,
    turn,
    turn_covariances,
)
from sonar_graph.logs.adapters.message_table import (
    NOT_FINITE,
    Dropped,
    fit_block,
    header_stamps_ns,
    not_finite,
    share,
)
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.mcap import Topic
from sonar_graph.measurements import (
    FIRST_TOO_LARGE_ID,
    FULL_TURN_RAD,
    ID_ADVICE,
    NO_TRACK,
    ROUNDING,
    Floats,
    Ints,
    LandmarkDetections,
    no_posterior,
    possible_ranges,
)
from sonar_graph.states import LandmarkMap

NO_POSTERIOR = "with probabilities that are not between 0 and 1 or more than 1 in sum (97 % is 0.97)"


class _Rows(NamedTuple):
    """Detections, one row each."""

    message: Ints
    """Number of the message in its topic."""
    stamps_ns: Ints
    ids: Ints
    """Shape (n, k)."""
    probabilities: Floats
    """Shape (n, k)."""
    values: tuple[Floats, ...]
    """Columns that do not depend on the candidates."""


def _joined(topic: Topic, parts: list[_Rows]) -> _Rows:
    """Rows of all layouts in the order of messages, padded to the most candidates with -1 and probability 0."""
    most = max(1, *(part.ids.shape[1] for part in parts))
    ids = np.concatenate([_padded(part.ids, most, -1) for part in parts])
    probabilities = np.concatenate(
        [_padded(part.probabilities, most, 0) for part in parts]
    )
    message = np.concatenate([part.message for part in parts])
    stamps_ns = np.concatenate([part.stamps_ns for part in parts])
    values = zip(*(part.values for part in parts), strict=True)
    is_large = (ids >= FIRST_TOO_LARGE_ID).any(axis=1)
    if is_large.any():
        where = f"message {message[int(np.argmax(is_large))]} has an identity of 2^56 or more"
        raise topic.error(
            f"{where}; {ID_ADVICE}, or do not use them: [detections] use = false"
        )
    # rows of one stamp keep the order in which they were sent
    order = np.argsort(message, kind="stable")
    return _Rows(
        message[order],
        stamps_ns[order],
        ids[order],
        probabilities[order],
        tuple(np.concatenate(columns)[order] for columns in values),
    )


def _padded(columns: np.ndarray, count: int, filling: int) -> np.ndarray:
    return np.pad(
        columns, ((0, 0), (0, count - columns.shape[1])), constant_values=filling
    )


class DetectionListsAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkDetections``: range, azimuth, covariance and posterior, in flat lists."""

    reads_table = False
    range_scale: LengthScale = 1.0
    """Turns ranges into metres; 0.001 or "mm" from millimetres, a ratio of sound speeds where that is wrong."""
    azimuth_scale: AngleScale = 1.0
    """Turns azimuths into rad, positive to the left; -1 where they are positive to the right."""

    def read(self, topic: Topic) -> tuple[LandmarkDetections | None, Dropped]:
        """One row a detection; where messages differ in the number of candidates, -1 with probability 0 fills."""
        groups = [group for group in topic.messages() if group["range_m"].shape[1]]
        log_times_ns = topic.log_times_ns  # of sound messages, which are known now
        if not groups:
            return None, {}
        parts = [self._rows(topic, group, log_times_ns) for group in groups]
        rows = _joined(topic, parts)
        ranges, azimuths, covariances, tracks = rows.values
        scales = np.array([self.range_scale, self.azimuth_scale])
        ranges = ranges * self.range_scale
        azimuths = azimuths * self.azimuth_scale
        covariances = covariances * np.outer(scales, scales)
        faults = {
            NOT_FINITE: not_finite(ranges, azimuths, rows.probabilities),
            NO_POSTERIOR: no_posterior(rows.probabilities),
        }
        measured = (ranges, azimuths, covariances)
        named = (rows.ids, rows.probabilities, tracks)
        return fit_block(
            LandmarkDetections, rows.stamps_ns, faults, *measured, *named, unique=False
        )

    def _rows(self, topic: Topic, group: Messages, log_times_ns: Ints) -> _Rows:
        frames, count = group["range_m"].shape
        ids = group["candidate_ids"]
        probabilities = group["id_probability"]
        # not in old logs
        tracks = (
            group["track"] if "track" in group.layout.columns else np.empty((frames, 0))
        )
        where = f"message {group.rows[0]} has {count} ranges"
        azimuths = group["azimuth_rad"].shape[1]
        covariances = group["covariance"].shape[1]
        if (azimuths, covariances, ids.shape[1] % count) != (
            count,
            4 * count,
            0,
        ) or probabilities.shape != ids.shape:
            raise topic.error(
                f"{where}, {azimuths} azimuths, {covariances} covariance elements, {ids.shape[1]} identities, "
                f"{probabilities.shape[1]} probabilities; expected n, n, 4n, kn and kn"
            )
        if tracks.shape[1] not in (0, count):
            raise topic.error(
                f"{where} and {tracks.shape[1]} tracks; expected as many, or none"
            )
        total = frames * count
        candidates = ids.shape[1] // count
        track = np.full(total, NO_TRACK, np.int64)
        if tracks.size:
            track = tracks.astype(np.int64).reshape(total)
        values = (
            group["range_m"].reshape(total),
            group["azimuth_rad"].reshape(total),
            group["covariance"].reshape(total, 2, 2),
            track,
        )
        return _Rows(
            np.repeat(group.rows, count),
            np.repeat(header_stamps_ns(group, log_times_ns), count),
            ids.reshape(total, candidates),
            probabilities.reshape(total, candidates),
            values,
        )


_SCORE = "detections.results.hypothesis.score"
_CLASS = "detections.results.hypothesis.class_id"
_CENTRE = "detections.bbox.center.position"
_RESULT = "detections.results.pose"


class DetectionArrayAdapter(Adapter):
    """``vision_msgs/Detection3DArray``: Cartesian positions with named hypotheses.

    Identities are integers here: a class that is a number stands for itself, others are given in `ids`.
    """

    reads_table = False
    position: Literal["results", "bbox"] = "results"
    """Source of the position: a detection's first result, with its covariance, or the centre of its box, without."""
    ids: Mapping[str, int] = {}
    """Integer identity of each class that is no number: {"buoy" = 1, "ladder" = 2}."""

    def read(self, topic: Topic) -> tuple[LandmarkDetections | None, Dropped]:
        """One row a detection that has a result; the scores are the posterior, in the order of the results."""
        groups = [
            group for group in topic.messages() if group.lengths("detections.results")
        ]
        if not groups:
            return None, {}
        rows = _joined(topic, [self._rows(topic, group) for group in groups])
        scores = rows.probabilities
        # scores that are no probabilities would be taken for certainty
        worst = float(np.nanmax(scores.sum(axis=1), initial=0.0))
        if worst > 1 + ROUNDING or (scores < 0).any():
            raise topic.error(
                f"scores of one detection add up to {worst:g}; the posterior over identities must be between 0 and 1 "
                f"in sum: normalise the scores where the log is made"
            )
        positions, covariances = rows.values
        ranges, azimuths, spread = range_and_azimuth(
            turn(self.rotation, positions), turn_covariances(self.rotation, covariances)
        )
        faults = {
            "without a result": rows.ids[:, 0] < 0,
            NOT_FINITE: not_finite(ranges, azimuths, scores),
            "at the sonar itself": ranges == 0,
        }
        tracks = np.full(len(ranges), NO_TRACK, np.int64)
        measured = (ranges, azimuths, spread)
        named = (rows.ids, scores, tracks)
        return fit_block(
            LandmarkDetections, rows.stamps_ns, faults, *measured, *named, unique=False
        )

    def _rows(self, topic: Topic, group: Messages) -> _Rows:
        """Every detection, with the results of each at its own places; NaN: unknown."""
        counts = np.array(group.lengths("detections.results"), np.int64)
        n = len(group)
        m = len(counts)
        k = max(1, int(counts.max()))
        detection = np.repeat(np.arange(m), counts)
        result = np.concatenate([np.arange(c) for c in counts]).astype(int)
        scores = np.zeros((n, m, k))
        ids = np.full((n, m, k), -1, np.int64)
        scores[:, detection, result] = group[_SCORE]
        names = group.strings(_CLASS)
        ids[:, detection, result] = [
            [self._identity(topic, name) for name in message] for message in names
        ]
        positions = np.full((n, m, 3), np.nan)
        covariances = np.full((n, m, 3, 3), np.nan)
        if self.position == "bbox":
            positions[:] = np.stack(
                [group[f"{_CENTRE}.{axis}"] for axis in "xyz"], axis=-1
            )
        else:
            some = np.flatnonzero(counts)
            first = (np.cumsum(counts) - counts)[some]
            found = np.stack(
                [group[f"{_RESULT}.pose.position.{axis}"] for axis in "xyz"], axis=-1
            )
            positions[:, some] = found[:, first]
            pose = group[f"{_RESULT}.covariance"].reshape(n, -1, 6, 6)[:, first, :3, :3]
            # zeros and a negative variance are unknown
            known = pose.any(axis=(2, 3)) & (pose[..., 0, 0] >= 0)
            covariances[:, some] = np.where(known[..., None, None], pose, np.nan)
        return _Rows(
            np.repeat(group.rows, m),
            np.repeat(header_stamps_ns(group, topic.log_times_ns), m),
            ids.reshape(-1, k),
            scores.reshape(-1, k),
            (positions.reshape(-1, 3), covariances.reshape(-1, 3, 3)),
        )

    def fields(self) -> Iterator[str]:
        """Paths that a message must have."""
        pose = (f"{_RESULT}.pose.position.x", f"{_RESULT}.covariance")
        return iter((f"{_CENTRE}.x", _SCORE, _CLASS, *pose))

    def _identity(self, topic: Topic, name: str) -> int:
        try:
            identity = self.ids[name] if name in self.ids else int(name)
            # beyond int64 is refused as too large as well
            return max(-1, min(identity, FIRST_TOO_LARGE_ID))
        except ValueError:
            raise topic.error(
                f"class {name!r} is no integer identity; say in a log configuration which it is: [detections] ids = "
                f'{{"{name}" = 1}}, or do not use them: use = false'
            ) from None


def range_and_azimuth(
    positions: Floats, covariances: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range, azimuth and their covariance, shapes (n,), (n,) and (n, 2, 2), from positions and theirs."""
    x, y, _ = positions.T
    ranges = np.linalg.norm(positions, axis=1)
    across_squared = x**2 + y**2
    jacobians = np.zeros((len(positions), 2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobians[:, 0] = positions / ranges[:, None]
        jacobians[:, 1, 0] = -y / across_squared
        jacobians[:, 1, 1] = x / across_squared
        spread = jacobians @ covariances @ jacobians.transpose(0, 2, 1)
    return ranges, np.arctan2(y, x), spread


class LandmarkMapAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkMap``: true positions of landmarks."""

    reads_table = False

    def read(self, topic: Topic) -> tuple[LandmarkMap | None, Dropped]:
        """The last sound map of a topic; None where none is."""
        groups = topic.messages()
        if not groups:
            return None, {}
        # a map is latched: the newest counts
        last = max(groups, key=lambda group: int(group.rows[-1]))
        ids, position, covariance = (
            last[name][-1] for name in ("ids", "position", "covariance")
        )
        count = len(ids)
        different = len(np.unique(ids))
        if (different, len(position), len(covariance)) != (count, 3 * count, 9 * count):
            raise topic.error(
                f"{count} ids ({different} different), {len(position)} position and {len(covariance)} covariance "
                f"elements; expected n different, 3n and 9n"
            )
        order = np.argsort(ids)
        positions = position.reshape(-1, 3)[order]
        covariances = covariance.reshape(-1, 3, 3)[order]
        return LandmarkMap(ids[order].astype(np.int64), positions, covariances), {}


def detection_warnings(
    detections: LandmarkDetections, first_ns: int, last_ns: int
) -> Iterator[str]:
    """Rows that estimators do not use: impossible ranges and covariances, repeated tracks, and rows without odometry.

    The odometry lasts from ``first_ns`` to ``last_ns``.
    """
    is_range = possible_ranges(detections.range_m)
    is_azimuth = np.abs(detections.azimuth_rad) <= FULL_TURN_RAD
    faults = {
        "a range that is not above 0 and at most 100 km": ~is_range,
        "a covariance that is not positive definite": is_range
        & is_azimuth
        & ~detections.are_sound(),
        "a stamp before the first odometry": detections.stamps_ns < first_ns,
        "a stamp after the last odometry": detections.stamps_ns > last_ns,
    }
    for fault, has_it in faults.items():
        if has_it.any():
            yield f"{share(has_it)} rows have {fault}: estimators do not use them"
    beyond = np.abs(detections.azimuth_rad) > np.pi
    if beyond.any():
        yield (
            f"{share(beyond)} rows have an azimuth beyond ±3.14 rad (up to "
            f"{np.abs(detections.azimuth_rad).max():.3g}): degrees? Beyond a full turn they are not used"
        )
    tracked = detections.track != NO_TRACK
    # one frame sees an object once
    pairs = np.column_stack((detections.stamps_ns[tracked], detections.track[tracked]))
    different, counts = np.unique(pairs, axis=0, return_counts=True)
    if repeated := int((counts - 1).sum()):
        frames = len(np.unique(different[counts > 1, 0]))
        yield (
            f"{repeated} of {len(detections)} rows have the track number of another row of their frame, in {frames}"
            f" frames: a track is of one object, and one row is used; give rows of no track {NO_TRACK}, not 0 or a "
            f"place in a list"
        )
