"""Watches of one object each, what has been seen in them, and which landmark each counts as.

A row of a track is the recogniser's belief after all of the track's evidence so far. It decides (`decide`):

* for a landmark, when that one's posterior reaches the least probability;
* for none of the known ones, when what is missing to 1 does;
* nothing, otherwise: the track goes on counting as what it did.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.slam.sighting import Sighting

UNDECIDED, NO_LANDMARK = -2, -1
"""What a row may decide besides a landmark's identity."""
NS_PER_S = 1_000_000_000


def decide(frame: LandmarkDetections, least_probability: float) -> list[int]:
    """What each row decides: a landmark's identity, `NO_LANDMARK` or `UNDECIDED`."""
    ids, probability = frame.most_probable()
    none = 1.0 - frame.id_probability.sum(axis=1)
    return [
        landmark_id
        if p >= least_probability and landmark_id >= 0
        else (NO_LANDMARK if missing >= least_probability else UNDECIDED)
        for landmark_id, p, missing in zip(ids.tolist(), probability.tolist(), none.tolist(), strict=True)
    ]


@dataclass(eq=False)
class Track:
    """One object, watched."""

    identity: int = UNDECIDED
    """What was decided last: that of a landmark, `NO_LANDMARK`, or nothing yet."""
    newest_ns: int = 0
    """When it was last seen."""
    waiting: list[Sighting] = field(default_factory=list)
    """Those to be used once it is known of which landmark they are."""
    settled: list[Sighting] = field(default_factory=list)
    """Those that are used, or were refused, as sightings of that landmark."""


class Tracks:
    """The tracks that may still change their identity.

    Parameters
    ----------
    longest_wait_s
        A sighting waits at most so long, and a track that was not seen for so long is over.
    """

    def __init__(self, longest_wait_s: float) -> None:
        self._longest_wait_ns = round(longest_wait_s * NS_PER_S)
        self._by_number: dict[int, Track] = {}

    def __len__(self) -> int:
        return len(self._by_number)

    def seen(self, number: int, stamp_ns: int) -> Track:
        """The track of a number, which is seen now."""
        track = self._by_number.setdefault(number, Track())
        track.newest_ns = stamp_ns
        return track

    def identity_of(self, number: int) -> int:
        """What the track of a number counts as, if there is one."""
        track = self._by_number.get(number)
        return UNDECIDED if track is None else track.identity

    def counting_as(self, landmark_id: int) -> list[Track]:
        """Tracks that count as a landmark."""
        return [track for track in self._by_number.values() if track.identity == landmark_id]

    def held_until_s(self) -> dict[int, float]:
        """Keyframes on which sightings wait that may soon be used, by key, and until when (s)."""
        return {
            sighting.line.pose_key: (sighting.stamp_ns + self._longest_wait_ns) / NS_PER_S
            for track in self._by_number.values()
            if track.identity != NO_LANDMARK
            for sighting in track.waiting
        }

    def leave(self, pose_keys: set[int]) -> list[tuple[Sighting, int]]:
        """Let go of what was seen from some poses: the sightings that waited in vain, and what was decided of them."""
        forgotten: list[tuple[Sighting, int]] = []
        for track in self._by_number.values():
            forgotten += [(old, track.identity) for old in track.waiting if old.line.pose_key in pose_keys]
            track.waiting = [sighting for sighting in track.waiting if sighting.line.pose_key not in pose_keys]
            track.settled = [sighting for sighting in track.settled if sighting.line.pose_key not in pose_keys]
        return forgotten

    def forget(self, now_ns: int) -> list[tuple[Sighting, int]]:
        """Let go of what is too old: the sightings that waited in vain, and what their tracks had decided."""
        oldest_ns = now_ns - self._longest_wait_ns
        forgotten: list[tuple[Sighting, int]] = []
        for track in self._by_number.values():
            if track.waiting and track.waiting[0].stamp_ns < oldest_ns:
                forgotten += [(old, track.identity) for old in track.waiting if old.stamp_ns < oldest_ns]
                track.waiting = [sighting for sighting in track.waiting if sighting.stamp_ns >= oldest_ns]
        over = [number for number, track in self._by_number.items() if track.newest_ns < oldest_ns]
        for number in over:
            del self._by_number[number]
        return forgotten
