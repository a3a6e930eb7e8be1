"""Which landmark a track is: beliefs over identities, carried from frame to frame.

K classes: the known landmarks in the order of their designs, and last "none of them". J features, what one frame can
look like: the same landmarks, and last "none of the above". The confusion matrix ``C[k, j] = p(z = j | x = k)`` has
rows that sum to 1. A frame gives soft scores ``s`` over the features, which sum to 1.

Equation numbers are those of "Experimental Results of Real-time Sonar-based Underwater Localization Using Landmarks",
2014, section II-B::

    (1)   b'[m] = ( sum_j A[m, j] b[j]  +  A[m, new] birth ) T        T = (1 - e) I + e 1 birth^T
    (2)   p[m, k | j] = C[k, j] b'[m, k] / sum_i C[i, j] b'[m, i]
    (3)   b[m, k] = sum_j p[m, k | j] s[m, j]

(2) and (3) together are Jeffrey's rule: `jeffrey`. `virtual_evidence` is ours, Pearl's rule with a temper::

    b[m, k]  ~  b'[m, k] ( sum_j C[k, j] s[m, j] / base[j] )^weight[m]

where ``base`` is the share of each feature in the scorer's own prior and 0 <= weight <= 1 says how much of the frame is
news (`news_of_motion`). Both agree for one-hot scores, and on a first frame from a uniform prior under a uniform base.
How they differ is in docs/theory/recognition.md.

Sources: R. Jeffrey, "The Logic of Decision", 1965; H. Chan and A. Darwiche, "On the revision of probabilistic beliefs
using uncertain evidence", Artificial Intelligence 163, 2005.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sonar_graph.measurements import Floats

Rule = Literal["virtual-evidence", "jeffrey"]
LEAST_PROBABILITY = 1e-12
"""Beliefs never reach 0, from which no evidence leads back."""


def predict(beliefs: Floats, association: Floats, birth: Floats, forgetting: Floats | float = 1e-3) -> Floats:
    """Equation (1): beliefs of the tracks now, before the frame is looked at.

    Parameters
    ----------
    beliefs
        Of the tracks before, shape (M', K), rows sum to 1.
    association
        ``A[m, j]``: probability that track m now is track j before; the last column that it is new. Shape (M, M' + 1),
        rows sum to 1.
    birth
        Belief about a new track, shape (K,).
    forgetting
        ``e``: identities do not change, but a belief must be able to. One number, or one a track, shape (M, 1).

    Returns
    -------
    Floats
        Shape (M, K), rows sum to 1.
    """
    carried = association[:, :-1] @ beliefs + association[:, -1:] * birth
    total = carried.sum(axis=1, keepdims=True)
    return np.asarray((1 - forgetting) * carried + forgetting * total * birth)


def jeffrey(predicted: Floats, scores: Floats, confusion: Floats) -> Floats:
    """Equations (2) and (3), as printed.

    Where a feature is impossible under the prediction, ``sum_k C[k, j] b'[k] = 0``, it says nothing: its part of the
    prediction is kept. A row of scores that are all 0 is a missing measurement: the prediction is kept.

    Parameters
    ----------
    predicted
        Shape (M, K), rows sum to 1.
    scores
        Shape (M, J), rows sum to 1, or to 0 where there is no measurement.
    confusion
        Shape (K, J), rows sum to 1.

    Returns
    -------
    Floats
        Shape (M, K), rows sum to 1.
    """
    evidence = predicted @ confusion
    possible = evidence > 0
    ratio = np.divide(scores, evidence, out=np.zeros_like(scores, dtype=float), where=possible)
    kept = np.where(possible, 0.0, scores).sum(axis=1, keepdims=True)
    posterior = predicted * (ratio @ confusion.T + kept)
    return np.where(scores.any(axis=1, keepdims=True), posterior, predicted)


def virtual_evidence(predicted: Floats, scores: Floats, confusion: Floats, base: Floats, weights: Floats) -> Floats:
    """Tempered virtual evidence: each frame multiplies the odds, by as much as it is news.

    A row of scores that are all 0 is a missing measurement, as is a weight of 0: the prediction is kept.

    Parameters
    ----------
    predicted, scores, confusion
        As in `jeffrey`.
    base
        Share of each feature in the scores' own prior, shape (J,).
    weights
        How much of each frame is news, from 0 to 1, shape (M,).

    Returns
    -------
    Floats
        Shape (M, K), rows sum to 1.
    """
    likelihood = (scores / base) @ confusion.T
    measured = likelihood.max(axis=1, keepdims=True, initial=0.0) > 0
    log_likelihood = np.log(np.maximum(np.where(measured, likelihood, 1.0), LEAST_PROBABILITY))
    log_posterior = np.log(np.maximum(predicted, LEAST_PROBABILITY)) + weights[:, None] * log_likelihood
    odds = np.exp(log_posterior - log_posterior.max(axis=1, keepdims=True))
    return np.where(measured, odds / odds.sum(axis=1, keepdims=True), predicted)


def update(rule: Rule, predicted: Floats, scores: Floats, confusion: Floats, base: Floats, weights: Floats) -> Floats:
    """Beliefs after a frame by the rule of that name; the paper's knows neither base nor weights."""
    if rule == "jeffrey":
        return jeffrey(predicted, scores, confusion)
    return virtual_evidence(predicted, scores, confusion, base, weights)


def news_of_motion(moved_m: Floats, aperture_m: float) -> Floats:
    """Share of a frame that is news after the sonar moved across its line of sight, shape as given.

    It is ``1 - rho^2``, what is left of the intensity of speckle after its correlation with the frame before. A lens of
    aperture D that both sends and receives has the autocorrelation of a triangle::

        rho = 1 - 1.5 u^2 + 0.75 u^3    u <= 1
              0.25 (2 - u)^3            1 < u <= 2          u = 2 moved / D

    which leaves one half at 3.6 cm for the 0.14 m of a DIDSON's high frequency.

    Parameters
    ----------
    moved_m
        Cross-range motion since the frame before, metres.
    aperture_m
        D.
    """
    u = np.minimum(2.0 * np.abs(moved_m) / aperture_m, 2.0)
    rho = np.where(u <= 1, 1 - 1.5 * u**2 + 0.75 * u**3, 0.25 * (2 - u) ** 3)
    return np.asarray(1.0 - rho**2)
