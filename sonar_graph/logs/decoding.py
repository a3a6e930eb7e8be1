"""Own messages of this package, which are lists of numbers, as detections and maps."""

from __future__ import annotations

import numpy as np

from sonar_graph.detection_rules import no_posterior
from sonar_graph.errors import LogError
from sonar_graph.logs.cdr import Messages
from sonar_graph.logs.container import Topic
from sonar_graph.logs.detection_faults import NO_POSTERIOR, refuse_large_ids
from sonar_graph.logs.table import NOT_FINITE, Dropped, fit_rows, header_stamps_ns, not_finite
from sonar_graph.measurements import NO_TRACK, Ints, LandmarkDetections
from sonar_graph.states import LandmarkMap


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
