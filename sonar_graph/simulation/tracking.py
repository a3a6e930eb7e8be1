"""A recogniser that watches each landmark over frames, and believes one thing of it at a time.

A track is an uninterrupted watch of one landmark: it ends when the landmark was not detected for `LONGEST_GAP_S`.
Until it is ``id_delay_s`` old nothing is believed of it. Of some tracks another landmark is believed then, for a share
of what is left of the track, and the right one after that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints

LONGEST_GAP_S = 1.0
"""Longer without a detection ends a track."""


@dataclass(frozen=True)
class Tracking:
    """How long a recogniser needs for an identity, and for correcting a wrong one."""

    id_delay_s: float = 0.0
    """Age of a track from which on it has an identity."""
    wrong_id_share: float = 0.5
    """Share of a track, after that, in which an identity that is wrong is believed; 1: to its end."""


@dataclass(frozen=True, eq=False)
class Watched:
    """Detections, each of a landmark, as parts of tracks."""

    landmark: Ints
    """Index of the true landmark of each track, shape (t,)."""
    track: Ints
    """Of each detection, shape (n,), from 0 in the order in which tracks begin."""
    age_s: Floats
    """Of its track at each detection, shape (n,)."""
    lifetime_s: Floats
    """Of each track, shape (t,)."""
    tracking: Tracking

    @classmethod
    def of(cls, landmark: Ints, stamps_ns: Ints, tracking: Tracking) -> Watched:
        """Detections in time order, shapes (n,) and (n,)."""
        track = np.empty(len(landmark), dtype=np.int64)
        newest: dict[int, tuple[int, int]] = {}
        landmarks: list[int] = []
        first_ns: list[int] = []
        for row, (index, stamp_ns) in enumerate(zip(landmark.tolist(), stamps_ns.tolist(), strict=True)):
            number, last_ns = newest.get(index, (-1, 0))
            if number < 0 or stamp_ns - last_ns > LONGEST_GAP_S * 1e9:
                number = len(landmarks)
                landmarks.append(index)
                first_ns.append(stamp_ns)
            newest[index] = number, stamp_ns
            track[row] = number
        age_s = np.asarray((stamps_ns - np.array(first_ns, dtype=np.int64)[track]) * 1e-9, dtype=np.float64)
        lifetime_s = np.zeros(len(landmarks))
        np.maximum.at(lifetime_s, track, age_s)
        return cls(np.array(landmarks, dtype=np.int64), track, age_s, lifetime_s, tracking)

    def is_undecided(self) -> NDArray[np.bool_]:
        """Detections of tracks too young for an identity, shape (n,)."""
        return np.asarray(self.age_s < self.tracking.id_delay_s)

    def believed(self, first_taken_for: Ints) -> Ints:
        """Index of the landmark believed at each detection, shape (n,).

        Parameters
        ----------
        first_taken_for
            Index of the landmark for which each track is taken at first, shape (t,).
        """
        delay_s, share = self.tracking.id_delay_s, self.tracking.wrong_id_share
        corrected_s = delay_s + share * np.maximum(self.lifetime_s - delay_s, 0.0)
        is_corrected = (self.age_s >= corrected_s[self.track]) & (share < 1)
        return np.where(is_corrected, self.landmark[self.track], first_taken_for[self.track])
