"""How the tracks of two frames belong together: the process model p(m, j) of equation (1) of the 2014 paper."""

from __future__ import annotations

from dataclasses import dataclass

from sonar_graph.measurements import Floats, Ints


@dataclass(frozen=True, eq=False)
class Association:
    """The tracks after a frame, M of them, and where each came from among the M' tracks before it."""

    stamp_ns: int
    """Of the frame."""
    previous_ids: Ints
    """Track numbers before the frame, shape (M',)."""
    track_ids: Ints
    """Track numbers after the frame, shape (M,). Numbers are never used twice."""
    matrix: Floats
    """Probability that track m now was track j before, shape (M, M' + 1); the last column is "new track". Rows sum
    to 1. A track without a candidate in this frame is itself, with certainty; only a track that starts can be new."""
    candidate: Ints
    """Row in `Candidates` that each track took, shape (M,); -1: it was not seen in this frame."""
    existence: Floats
    """Probability that something persistent is behind the track, shape (M,)."""
    position_m: Floats
    """In the sonar frame at ``stamp_ns``, shape (M, 3)."""
    position_cov: Floats
    """Shape (M, 3, 3), m²."""
    frames_seen: Ints
    """Frames in which the track had a candidate, shape (M,)."""
    ended_ids: Ints
    """Tracks that were given up in this frame, shape (k,)."""
    ended_reasons: tuple[str, ...]
    """Why, one for each of ``ended_ids``."""
