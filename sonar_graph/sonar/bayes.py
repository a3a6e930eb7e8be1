"""Recursive Bayesian estimate of landmark identities, one belief per track.

K classes: the known landmarks in the order of their designs, last "none of them". J features that one frame can show:
the same landmarks, last "none of the above". Beliefs b of M tracks, shape (M, K); soft scores s of the features, shape
(M, J), a row of 0 where nothing was measured; confusion matrix ``C[k, j] = p(z = j | x = k)``; association A of the
tracks now with those before, shape (M, M' + 1), the last column for new ones. Rows sum to 1. With the equation numbers
of the 2014 paper, section II-B::

    (1)   b'[m] = ( sum_j A[m, j] b[j]  +  A[m, new] birth ) T        T = (1 - e) I + e 1 birth^T
    (2)   p[m, k | j] = C[k, j] b'[m, k] / sum_i C[i, j] b'[m, i]
    (3)   b[m, k] = sum_j p[m, k | j] s[m, j]

(2) and (3) are Jeffrey's rule: `jeffrey`. Ours is bounded evidence: `bounded_evidence`. With the log odds l of a
frame, its independent share 0 <= w <= 1 (`independent_share`), and the sums over the frames of a track, carried by A,

    L[m] = sum_j A[m, j] L[j] + w[m] l[m],    W[m] = sum_j A[m, j] W[j] + w[m]
    b[m]  =  (1 - doubt) p[m] + doubt birth,    p[m, k]  ~  birth[k] exp( L[m, k] / (W[m] + looks) )

Comparison of both rules, and sources: docs/theory/recognition.md.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sonar.confusion import Confusion, soft_scores
from sonar_graph.sonar.tracker import Association

Bools = NDArray[np.bool_]
Rule = Literal["virtual-evidence", "jeffrey"]


def predict(
    beliefs: Floats,
    association: Floats,
    birth: Floats,
    forgetting: Floats | float = 1e-3,
) -> Floats:
    """Predict beliefs by equation (1), with the belief about a new track, shape (K,), and e for all or each track."""
    carried = association[:, :-1] @ beliefs + association[:, -1:] * birth
    total = carried.sum(axis=1, keepdims=True)
    return (1 - forgetting) * carried + forgetting * total * birth


def jeffrey(predicted: Floats, scores: Floats, confusion: Floats) -> Floats:
    """Update beliefs by equations (2) and (3), as printed.

    A feature that is impossible under the prediction, ``sum_k C[k, j] b'[k] = 0``, keeps its part of the prediction.
    A row of zero scores keeps the prediction.
    """
    evidence = predicted @ confusion
    possible = evidence > 0
    # (2) and (3) together: sum_j C[k, j] s[j] / evidence[j], times the prediction
    ratio = np.divide(
        scores, evidence, out=np.zeros_like(scores, dtype=float), where=possible
    )
    # features that are impossible under the prediction change nothing
    kept = np.where(possible, 0.0, scores).sum(axis=1, keepdims=True)
    posterior = predicted * (ratio @ confusion.T + kept)
    return np.where(scores.any(axis=1, keepdims=True), posterior, predicted)


def bounded_evidence(
    birth: Floats, log_odds: Floats, counted: Floats, looks: float, doubt: float
) -> Floats:
    """Beliefs from weighted sums of log odds, shape (M, K), and of the weights, shape (M,).

    The mean of the log odds counts, times a share that comes near to 1 with the number of looks: the mismatch between
    a landmark and its design is the same in every frame, so that no number of them makes certain. A share of doubt is
    left for tracks whose frames hold no evidence.
    """
    log_belief = np.log(birth) + log_odds / (counted + looks)[:, None]
    # the largest exponent is 0: no overflow
    odds = np.exp(log_belief - log_belief.max(axis=1, keepdims=True))
    return (1 - doubt) * odds / odds.sum(axis=1, keepdims=True) + doubt * birth


def independent_share(moved_m: Floats, aperture_m: float) -> Floats:
    """Independent share of a frame after motion across the line of sight, shape as given.

    ``1 - rho^2`` with rho the correlation of speckle with the frame before. A lens of aperture D that both sends and
    receives has the autocorrelation of a triangle::

        rho = 1 - 1.5 u^2 + 0.75 u^3    u <= 1
              0.25 (2 - u)^3            1 < u <= 2          u = 2 moved / D

    which leaves one half at 3.6 cm for the 0.14 m of a DIDSON's high frequency.
    """
    # beyond the aperture speckle is independent
    u = np.minimum(2.0 * np.abs(moved_m) / aperture_m, 2.0)
    rho = np.where(u <= 1, 1 - 1.5 * u**2 + 0.75 * u**3, 0.25 * (2 - u) ** 3)
    return 1.0 - rho**2


class IdentityParams(Section):
    """Settings of the identity estimate."""

    rule: Rule = "virtual-evidence"
    """virtual-evidence: ours, bounded; jeffrey: the 2014 paper's equations as printed, every frame counting in full."""
    unknown_prior: float = Field(12 / 13, gt=0, lt=1)
    """Belief in "none of them" about a new track: twelve unknown objects for each landmark. The least whole number with
    which strangers of the calibration basins are rarely accepted (docs/theory/recognition.md)."""
    forgetting: float = Field(1e-4, ge=0, lt=1)
    """Share of a belief that returns to that of a new track, per frame; of the rule jeffrey only."""
    least_independent_share: float = Field(0.1, ge=0, lt=1)
    """Frames with a smaller independent share are left out; motion adds up until the next one counts."""
    aperture_m: float = Field(0.14, gt=0)
    """Aperture of the sonar's lens; it sets how soon speckle changes."""
    ahead_ratio: float = Field(2.0, ge=1)
    """Motion ahead or up that changes speckle as much as a unit of motion to the side. Chosen on simulated basins of
    seeds 1001 to 1003, not derived."""
    most_looks: int = Field(64, ge=1)
    """Sonar positions remembered for each track."""

    def birth(self, landmarks: int) -> Floats:
        """Belief about a new track, shape (landmarks + 1,)."""
        return np.append(
            np.full(landmarks, (1 - self.unknown_prior) / landmarks), self.unknown_prior
        )


class Beliefs:
    """Beliefs over the landmarks and "none of them", by track.

    A frame counts only as far as the sonar moved since it last looked at the track from there: speckle belongs to the
    floor and comes back when the sonar comes back.
    """

    def __init__(
        self, confusion: Confusion, params: IdentityParams | None = None
    ) -> None:
        self.params = params or IdentityParams()
        self._model = confusion
        known = len(confusion.ids)
        self._birth = self.params.birth(known)
        self._order: list[int] = []
        self._beliefs, self._log_odds = np.empty((2, 0, known + 1))
        self._counted = np.empty(0)
        self._seen_tracks: Ints = np.empty(0, dtype=np.int64)
        self._seen_from = np.empty((0, 3))
        """Tracks, and the places of the sonar from which they were seen."""

    def step(
        self,
        association: Association,
        log_odds: Floats,
        is_fitted: Bools,
        place: Floats,
        sideways: Floats,
    ) -> tuple[Floats, Floats]:
        """Predict and update for one frame; the beliefs after it, shape (M, K), and its independent shares, shape (M,).

        Log odds of the classes, shape (M, K), the last one's 0, of the tracks that designs were fitted to, shape (M,).
        ``place`` is the position of the sonar in a fixed frame, shape (3,), and ``sideways`` the horizontal unit vector
        across each line of sight in the same frame, shape (M, 3).
        """
        rows = [self._order.index(track) for track in association.previous_ids.tolist()]
        self._order = association.ids.tolist()
        if self.params.rule == "jeffrey":
            # the paper's rule counts every frame in full
            shares = np.where(is_fitted, 1.0, 0.0)
            predicted = predict(
                self._beliefs[rows],
                association.matrix,
                self._birth,
                self.params.forgetting,
            )
            known = np.where(is_fitted[:, None], log_odds, 0.0)
            scores = np.where(
                is_fitted[:, None], soft_scores(known, self._model.looks), 0.0
            )
            self._beliefs = jeffrey(predicted, scores, self._model.array())
            return self._beliefs, shares
        shares = self._independent_shares(association.ids, place, sideways)
        is_counted = is_fitted & (shares >= self.params.least_independent_share)
        shares = np.where(is_counted, shares, 0.0)
        known = np.where(shares[:, None] > 0, log_odds, 0.0)
        self._remember(association.ids[shares > 0], place)
        # sums of evidence go with the tracks, as beliefs do in equation (1)
        carried = association.matrix[:, :-1]
        self._log_odds = carried @ self._log_odds[rows] + shares[:, None] * known
        self._counted = carried @ self._counted[rows] + shares
        beliefs = bounded_evidence(
            self._birth,
            self._log_odds,
            self._counted,
            self._model.looks,
            self._model.doubt,
        )
        return beliefs, shares

    def _independent_shares(self, ids: Ints, place: Floats, sideways: Floats) -> Floats:
        """Independent share of a frame from here for each track, shape (M,); places of other tracks are forgotten."""
        seen, row = np.nonzero(self._seen_tracks[:, None] == ids)
        self._seen_tracks = self._seen_tracks[seen]
        self._seen_from = self._seen_from[seen]
        moved = place - self._seen_from
        aside = np.vecdot(moved, sideways[row])
        ahead = np.sqrt(np.maximum(np.vecdot(moved, moved) - aside**2, 0.0))
        # speckle is a function of the place: the nearest earlier place decides, however long ago
        nearest = np.full(len(ids), np.inf)
        np.minimum.at(nearest, row, np.hypot(aside, ahead / self.params.ahead_ratio))
        return independent_share(nearest, self.params.aperture_m)

    def _remember(self, ids: Ints, place: Floats) -> None:
        """Remember the place from which tracks were seen; of too many places of a track the first is forgotten."""
        self._seen_tracks = np.append(self._seen_tracks, ids)
        self._seen_from = np.vstack([self._seen_from, np.tile(place, (len(ids), 1))])
        if len(self._seen_tracks) <= self.params.most_looks:
            return
        _, first, count = np.unique(
            self._seen_tracks, return_index=True, return_counts=True
        )
        too_many = first[count > self.params.most_looks]
        self._seen_tracks = np.delete(self._seen_tracks, too_many)
        self._seen_from = np.delete(self._seen_from, too_many, axis=0)
