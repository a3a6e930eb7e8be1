"""The beliefs of all tracks, and from where each was looked at.

A frame is news only as far as the sonar moved since it looked at the same object before, from whatever place: speckle
belongs to the floor and comes back when the sonar comes back. Motion ahead and up counts less than motion to the side:
half as much, which was chosen on simulated basins of the seeds 1001 to 1003 and not derived. The turning of phases with
the grazing angle alone would make it an eighth, with which landmarks that are driven at are recognised too late.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import Floats
from sonar_graph.sonar.bayes import Rule, news_of_motion, predict, update
from sonar_graph.sonar.confusion import Confusion
from sonar_graph.sonar.track_filter import Association


class IdentityParams(Section):
    """How identities are estimated over a series of frames."""

    rule: Rule = "virtual-evidence"
    """virtual-evidence: ours; jeffrey: the 2014 paper's equations as printed, every frame counting in full."""
    unknown_prior: float = Field(0.5, gt=0, lt=1)
    """Belief in "none of them" about a new track."""
    forgetting: float = Field(1e-4, ge=0, lt=1)
    """Share of a belief that returns to that of a new track, a frame that is all news."""
    temper: float = Field(1.0, gt=0, le=1)
    """Weight of a frame that is all news; below 1 where a landmark's looks are less certain than was measured."""
    least_news: float = Field(0.1, ge=0, lt=1)
    """Frames that are less of a news are left out; what they have adds up until the next counts."""
    aperture_m: float = Field(0.14, gt=0)
    """Of the sonar's lens, which says how soon speckle changes."""
    ahead_ratio: float = Field(2.0, ge=1)
    """How many times farther the sonar moves ahead than to the side for the same change of speckle."""
    most_looks: int = Field(64, ge=1)
    """Places remembered for each track."""


class Beliefs:
    """Beliefs over the landmarks and "none of them", by track.

    Parameters
    ----------
    confusion
        The measured model.
    params
        None: the defaults.
    """

    def __init__(self, confusion: Confusion, params: IdentityParams | None = None) -> None:
        self.params = params or IdentityParams()
        self._matrix, self._base = confusion.array(), confusion.base()
        known = len(confusion.ids)
        self._birth = np.append(np.full(known, (1 - self.params.unknown_prior) / known), self.params.unknown_prior)
        self._order: list[int] = []
        self._beliefs: Floats = np.empty((0, known + 1))
        self._looks: dict[int, list[Floats]] = {}

    def step(
        self, association: Association, scores: Floats, places: Sequence[Floats | None], sideways: Floats
    ) -> Floats:
        """Equations (1) to (3) for one frame.

        Parameters
        ----------
        association
            Of the tracks before and after it.
        scores
            Of each track after it, shape (M, features); rows of 0 where there is no measurement.
        places
            The sonar's position in a fixed frame for each track that was looked at, shape (3,); None: not looked at.
        sideways
            Horizontal unit vector across each track's line of sight in the same frame, shape (M, 3).

        Returns
        -------
        Floats
            Beliefs after the frame, shape (M, classes).
        """
        rows = [self._order.index(track) for track in association.previous_ids.tolist()]
        weights = np.array(
            [
                self._weight(track, place, direction)
                for track, place, direction in zip(association.track_ids.tolist(), places, sideways, strict=True)
            ]
        )
        forgetting = self.params.forgetting * weights[:, None]
        predicted = predict(self._beliefs[rows], association.matrix, self._birth, forgetting)
        scores = np.where(weights[:, None] > 0, scores, 0.0)
        self._beliefs = update(self.params.rule, predicted, scores, self._matrix, self._base, weights)
        self._order = association.track_ids.tolist()
        self._looks = {track: looks for track, looks in self._looks.items() if track in self._order}
        return self._beliefs

    def _weight(self, track: int, place: Floats | None, sideways: Floats) -> float:
        """How much of what is seen from a place counts; remembers the place if anything does."""
        if place is None:
            return 0.0
        if self.params.rule == "jeffrey":
            return 1.0
        looks = self._looks.setdefault(track, [])
        news = self._news(np.array(looks), place, sideways) if looks else 1.0
        if news < self.params.least_news:
            return 0.0
        looks.append(place)
        del looks[: -self.params.most_looks]
        return self.params.temper * news

    def _news(self, looks: Floats, place: Floats, sideways: Floats) -> float:
        moved = place - looks
        aside = moved @ sideways
        ahead = np.sqrt(np.maximum(np.sum(moved**2, axis=1) - aside**2, 0.0))
        nearest = np.hypot(aside, ahead / self.params.ahead_ratio).min()
        return float(news_of_motion(nearest, self.params.aperture_m))
