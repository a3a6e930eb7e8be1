"""One row of a track in a frame: what is watched is one object, and one object is in one place.

Of several the row is kept that says best what its track counts as: the one with the highest posterior of that landmark.
While a track counts as none it is the row with the highest posterior of any; of equals, the first.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.slam.association import DetectionJournal
from sonar_graph.slam.tracks import UNDECIDED
from sonar_graph.states import Outcome


def of_no_landmark(_: int) -> int:
    """What a track counts as, where nobody knows."""
    return UNDECIDED


def best_of_tracks(frame: LandmarkDetections, identity_of: Callable[[int], int]) -> NDArray[np.bool_]:
    """Which rows of a frame are kept, shape (n,): all of no track, and one of each track.

    Parameters
    ----------
    identity_of
        The landmark that a track counts as, by its number; negative: none.
    """
    best: dict[int, tuple[float, float, int]] = {}
    for row, track in enumerate(frame.track.tolist()):
        if track != NO_TRACK:
            is_landmark = frame.candidate_ids[row] >= 0
            ids, posterior = frame.candidate_ids[row, is_landmark], frame.id_probability[row, is_landmark]
            score = float(posterior[ids == identity_of(track)].sum()), float(posterior.max(initial=0.0)), -row
            best[track] = max(best.get(track, score), score)
    is_kept = frame.track == NO_TRACK
    is_kept[[-score[2] for score in best.values()]] = True
    return is_kept


def once_a_track(
    frame: LandmarkDetections, identity_of: Callable[[int], int], journal: DetectionJournal
) -> LandmarkDetections:
    """A frame with one row of each track; the others go to the journal."""
    is_kept = best_of_tracks(frame, identity_of)
    if is_kept.all():
        return frame
    for landmark_id in frame.most_probable()[0][~is_kept].tolist():
        journal.record(int(frame.stamps_ns[0]), landmark_id, Outcome.TRACK_REPEATED)
    return frame.rows(is_kept)
