"""Landmarks that began with sightings of something else, and where those that name them agree that they are.

Choosing components is a descent: each watch goes where it fits best now. A landmark that began in a wrong place fits
none of its own sightings, and nothing moves it. So the sightings that name it vote on its place. With the component l_i
of the mixture for the landmark at a point p, and that of no landmark::

    vote(p) = sum over watches that name i of max(l_i(p), l_none)

at the point where it is, and where each sighting that does not fit has it. The best wins.
"""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.slam.mixture import Choices, Errors, Mixture, Watch

MOST_PROPOSALS = 20
"""Newest sightings whose places are put to the vote."""
MOST_VOTERS = 400
LEAST_MARGIN = 3.0
"""A new place has to be e to this power times as probable."""


def supporters_elsewhere(
    landmark_id: int, watches: list[Watch], choices: Choices, values: gtsam.Values, mixture: Mixture
) -> list[Watch] | None:
    """Watches that put a landmark in a better place than where it is; None where there is no better one.

    Parameters
    ----------
    watches
        Those that name the landmark.
    choices
        What each counts as now.
    """
    voters = watches[-MOST_VOTERS:]
    proposals = [w for w, choice in zip(watches, choices, strict=True) if choice != landmark_id][-MOST_PROPOSALS:]
    if len(proposals) < 2:
        return None
    places = Errors([watch.sightings[0] for watch in proposals], values).located()
    points = np.vstack([values.atPoint3(L(landmark_id)), places])
    gains = mixture.gains(landmark_id, voters, points, values)
    votes = np.maximum(gains, 0.0).sum(axis=0)
    winner = int(np.argmax(votes))
    if votes[winner] < votes[0] + LEAST_MARGIN:
        return None
    return [watch for watch, gain in zip(voters, gains[:, winner].tolist(), strict=True) if gain > 0.0]
