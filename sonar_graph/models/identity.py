"""Identities as a recogniser states them, accepted where their posterior is high enough."""

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats, Ints, LandmarkDetections
from sonar_graph.numerics import compiled
from sonar_graph.states import OUTCOME_NUMBERS, Outcome

ACCEPTED = -1
"""In place of an outcome."""
MINIMUM_PROBABILITY = 0.7
"""Default of every estimator: a wrong identity, which may spoil a landmark for good, weighs more than a lost one."""
NO_IDENTITY, REPEATED = OUTCOME_NUMBERS[Outcome.NO_IDENTITY], OUTCOME_NUMBERS[Outcome.REPEATED]
UNSOUND = OUTCOME_NUMBERS[Outcome.UNSOUND]


def identify(detections: LandmarkDetections, minimum_probability: float) -> tuple[Ints, NDArray[np.int8]]:
    """Most probable identity of each row, shape (n,), and `ACCEPTED` or the `OUTCOME_NUMBERS` of its refusal, (n,).

    Refused is an unsound row, and a posterior that is too low or NaN, or of no identity (-1). A landmark is in one
    place: of several rows of one frame with one identity the most probable is accepted, the first of equals.
    """
    ids, outcomes = np.empty(len(detections), np.int64), np.full(len(detections), ACCEPTED, np.int8)
    outcomes[~detections.are_sound()] = UNSOUND
    rows = detections.stamps_ns, detections.candidate_ids, detections.id_probability
    _write_identities(*rows, minimum_probability, ids, outcomes)
    return ids, outcomes


@compiled
def _write_identities(
    stamps_ns: Ints, candidates: Ints, posterior: Floats, minimum: float, ids: Ints, outcomes: NDArray[np.int8]
) -> None:
    """Fill what `identify` returns; outcomes other than `ACCEPTED` stay."""
    p = np.empty(len(ids))
    for row in range(len(ids)):
        best = 0
        for k in range(1, candidates.shape[1]):
            if posterior[row, k] > posterior[row, best]:
                best = k
        ids[row], p[row] = candidates[row, best], posterior[row, best]
        if outcomes[row] == ACCEPTED and not (p[row] >= minimum and ids[row] >= 0):
            outcomes[row] = NO_IDENTITY
        other = row - 1
        while other >= 0 and stamps_ns[other] == stamps_ns[row]:
            if ids[other] == ids[row] and outcomes[other] == ACCEPTED and outcomes[row] == ACCEPTED:
                outcomes[row if p[row] <= p[other] else other] = REPEATED
            other -= 1
