"""What the operator intends: straight drives, turns on the spot and hovers, each from rest to rest.

Speed rises over ``ramp_s`` by a cubic smoothstep, stays, and falls again, so that position is twice continuously
differentiable. With ``A(t)`` the distance covered since a start at unit final speed, progress along a piece of
duration T is ``(A(t) - A(t - (T - ramp))) / (T - ramp)``; the greatest acceleration is 1.5 times speed / ramp.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sonar_graph.measurements import Floats

PlanarPose = tuple[float, float, float]


@dataclass(frozen=True)
class Piece:
    """One rest-to-rest motion to a goal."""

    duration_s: float
    ramp_s: float
    """Time to gain full speed, and to lose it; at most half the duration."""
    goal: PlanarPose
    """x, y (m) and unwrapped yaw (rad) at its end."""


def follow(start: PlanarPose, pieces: list[Piece], seconds: Floats) -> Floats:
    """The intended pose at some instants.

    Parameters
    ----------
    start
        Where the first piece begins.
    pieces
        Motions one after the other.
    seconds
        Instants since the start, shape (n,); after the last piece its goal holds.

    Returns
    -------
    Floats
        x, y (m) and unwrapped yaw (rad), shape (n, 3).
    """
    pose = np.tile(np.array(start), (len(seconds), 1))
    begin_s = 0.0
    for (from_, to), piece in zip(pairwise([start, *(p.goal for p in pieces)]), pieces, strict=True):
        first = np.searchsorted(seconds, begin_s)
        progress = _progress(seconds[first:] - begin_s, piece)
        pose[first:] += progress[:, None] * np.subtract(to, from_)
        begin_s += piece.duration_s
    return pose


def drive(start: PlanarPose, length_m: float, speed_m_s: float, ramp_s: float) -> Piece:
    """Straight ahead over a length."""
    x, y, yaw = start
    goal = (x + length_m * float(np.cos(yaw)), y + length_m * float(np.sin(yaw)), yaw)
    return Piece(length_m / speed_m_s + ramp_s, ramp_s, goal)


def turn(start: PlanarPose, angle_rad: float, duration_s: float) -> Piece:
    """On the spot, positive to the left."""
    x, y, yaw = start
    return Piece(duration_s, duration_s / 2, (x, y, yaw + angle_rad))


def hover(start: PlanarPose, duration_s: float) -> Piece:
    """Stay where it is."""
    return Piece(duration_s, duration_s / 2, start)


def _progress(seconds: Floats, piece: Piece) -> Floats:
    """Share of a piece that is done after some seconds of it, from 0 to 1."""
    full_speed_s = piece.duration_s - piece.ramp_s
    if full_speed_s <= 0:
        return np.ones_like(seconds)
    covered = _distance(seconds, piece.ramp_s) - _distance(seconds - full_speed_s, piece.ramp_s)
    return covered / full_speed_s


def _distance(seconds: Floats, ramp_s: float) -> Floats:
    """Distance at unit final speed: the integral of the smoothstep 3u² - 2u³, then of 1."""
    u = np.clip(seconds / ramp_s, 0, 1)
    distance: Floats = ramp_s * (u**3 - u**4 / 2) + np.maximum(seconds - ramp_s, 0)
    return distance
