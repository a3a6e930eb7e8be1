"""What detections of a log say that cannot be: what is refused, what is left out, and what looks wrong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sonar_graph.detection_rules import ID_ADVICE, possible_ranges, too_large
from sonar_graph.errors import LogError
from sonar_graph.logs.container import Topic
from sonar_graph.measurements import NO_TRACK, Floats, Ints, LandmarkDetections

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
