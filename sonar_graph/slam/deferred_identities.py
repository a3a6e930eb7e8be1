"""Identities that become known late, or turn out to be others than was believed.

A track's sightings wait, each on the keyframe at which it was made, until the track is known to be of a landmark; then
all become factors there. When a track turns out to be of another landmark, or of none, its factors are taken out of the
graph. Those of the other landmark are put in once the estimate no longer rests on the wrong ones: a new landmark then
begins in the right place. What counts as known is in `sonar_graph.slam.tracks`; which factors result, in
`sonar_graph.slam.landmark_sightings`.
"""

from __future__ import annotations

from collections import defaultdict

from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.slam.association import DetectionJournal
from sonar_graph.slam.landmark_sightings import LandmarkSightings
from sonar_graph.slam.late_gate import LateGate
from sonar_graph.slam.sighting import Sighting
from sonar_graph.slam.tracks import NO_LANDMARK, UNDECIDED, Track, Tracks
from sonar_graph.states import Outcome


class DeferredIdentities:
    """Keeps the graph in line with what tracks are known to show.

    Parameters
    ----------
    landmarks
        Of the graph.
    journal
        Its rows are amended when sightings are used, moved, taken back or forgotten.
    gate
        For sightings that come late to a landmark of the graph.
    longest_wait_s
        A sighting waits at most so long. A track that was not seen for so long is over: what it counts as stays.
    """

    def __init__(
        self, landmarks: LandmarkSightings, journal: DetectionJournal, gate: LateGate, longest_wait_s: float
    ) -> None:
        self._landmarks = landmarks
        self._smoother = landmarks.smoother
        self._journal = journal
        self._gate = gate
        self._tracks = Tracks(longest_wait_s)

    def hear(self, frame: LandmarkDetections, decisions: list[int], time_s: float) -> None:
        """Bring earlier sightings in line with what a frame's rows decide, before its own are made.

        Where tracks come to claim one landmark in one earlier frame, that of the more probable row gets it, but what
        is used already stays.

        Parameters
        ----------
        frame
            No track has two rows in it (`sonar_graph.slam.repeated_tracks`).
        decisions
            Of each row: an identity, `NO_LANDMARK` or `UNDECIDED`.
        time_s
            Of the newest keyframe.
        """
        stamp_ns = int(frame.stamps_ns[0])
        self.forget(stamp_ns)
        rows = zip(frame.track.tolist(), decisions, frame.most_probable()[1].tolist(), strict=True)
        seen = [
            (self._tracks.seen(number, stamp_ns), decision)
            for number, decision, _ in sorted(rows, key=lambda row: -row[2])
            if number != NO_TRACK
        ]
        decided = [(track, decision) for track, decision in seen if decision != UNDECIDED]
        displaced = self._change([(track, new) for track, new in decided if new != track.identity], time_s)
        self._use_late([track for track, _ in decided] + displaced, time_s)

    def identity_of(self, number: int) -> int:
        """What a track counts as: an identity, `NO_LANDMARK` or `UNDECIDED`."""
        return self._tracks.identity_of(number)

    def remember(self, number: int, sighting: Sighting) -> None:
        """A sighting of a track's newest frame."""
        track = self._tracks.seen(number, sighting.stamp_ns)
        (track.waiting if sighting.outcome is Outcome.WAITING else track.settled).append(sighting)
        self._smoother.hold(self._tracks.held_until_s())

    def forget(self, now_ns: int) -> None:
        """Let go of sightings that have waited too long."""
        self._give_up(self._tracks.forget(now_ns))

    def leave(self, pose_keys: set[int]) -> None:
        """Poses leave a bounded window: nothing that was seen from them can be used or taken back any more."""
        self._give_up(self._tracks.leave(pose_keys))

    def _give_up(self, forgotten: list[tuple[Sighting, int]]) -> None:
        for sighting, decision in forgotten:
            if sighting.outcome is Outcome.WAITING:
                outcome = Outcome.NO_IDENTITY if decision == NO_LANDMARK else Outcome.FORGOTTEN
                self._journal.amend(sighting.row, outcome)

    def _change(self, changed: list[tuple[Track, int]], time_s: float) -> list[Track]:
        """Take back what tracks no longer count as; other tracks that now get what these had displaced."""
        leaving = [s for track, _ in changed for s in track.settled if s.landmark_id is not None]
        freed: dict[int, set[int]] = defaultdict(set)
        for sighting in leaving:
            if sighting.landmark_id is not None:
                freed[sighting.landmark_id].add(sighting.stamp_ns)
                sighting.outcome = Outcome.TAKEN_BACK
        if leaving:
            self._landmarks.exchange(leaving, [], time_s)
        for track, identity in changed:
            self._reopen(track, track.settled)
            track.identity = identity
        return self._displaced(freed)

    def _displaced(self, freed: dict[int, set[int]]) -> list[Track]:
        found = []
        for landmark_id, stamps_ns in freed.items():
            for track in self._tracks.counting_as(landmark_id):
                displaced = [s for s in track.settled if s.outcome is Outcome.REPEATED and s.stamp_ns in stamps_ns]
                if displaced:
                    self._reopen(track, displaced)
                    found.append(track)
        return found

    def _reopen(self, track: Track, sightings: list[Sighting]) -> None:
        """Sightings wait again."""
        for sighting in sightings:
            if sighting.outcome is not Outcome.TAKEN_BACK:
                sighting.outcome = Outcome.WAITING
            self._journal.amend(sighting.row, sighting.outcome)
        reopened = set(sightings)
        track.settled = [sighting for sighting in track.settled if sighting not in reopened]
        track.waiting = sorted(track.waiting + sightings, key=lambda sighting: sighting.stamp_ns)

    def _use_late(self, tracks: list[Track], time_s: float) -> None:
        """Put waiting sightings of tracks that count as a landmark into the graph."""
        coming: list[tuple[Sighting, int]] = []
        taken: dict[int, set[int]] = {}
        for track in tracks:
            if track.waiting and track.identity >= 0:
                stamps_ns = taken.setdefault(track.identity, self._landmarks.stamps_ns(track.identity))
                coming += [(sighting, track.identity) for sighting in self._settle(track, stamps_ns)]
        if coming:
            self._landmarks.exchange([], coming, time_s)

    def _settle(self, track: Track, taken_ns: set[int]) -> list[Sighting]:
        """Judge a track's waiting sightings; those to be used. Frames in which the landmark is seen count as taken."""
        free = []
        for sighting in track.waiting:
            if sighting.stamp_ns in taken_ns:
                sighting.outcome = Outcome.REPEATED
            else:
                taken_ns.add(sighting.stamp_ns)
                free.append(sighting)
        for sighting, is_inside in zip(free, self._gate.inside(free, track.identity), strict=True):
            used = Outcome.MOVED if sighting.outcome is Outcome.TAKEN_BACK else Outcome.USED_LATER
            sighting.outcome = used if is_inside else Outcome.GATED
        for sighting in track.waiting:
            self._journal.amend(sighting.row, sighting.outcome, track.identity)
        track.settled, track.waiting = track.settled + track.waiting, []
        return [sighting for sighting in free if sighting.outcome is not Outcome.GATED]
