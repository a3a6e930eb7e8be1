"""Identities as a recogniser states them, accepted where their posterior is high enough, and the gate's threshold."""

from functools import cache

from scipy.stats import chi2

from sonar_graph.measurements import Ints, LandmarkDetections
from sonar_graph.states import Outcome


def identify(detections: LandmarkDetections, minimum_probability: float) -> tuple[Ints, list[Outcome | None]]:
    """Most probable identity of each row, shape (n,), and the reason why it is refused; None where it is accepted.

    Refused is a posterior that is too low or NaN, or of no identity (-1). A landmark is in one place: of several rows
    of one frame with one identity the most probable is accepted, the first of equals.
    """
    ids, probability = detections.most_probable()
    rows = zip(detections.stamps_ns.tolist(), ids.tolist(), probability.tolist(), strict=True)
    refusals: list[Outcome | None] = []
    best: dict[tuple[int, int], tuple[int, float]] = {}
    for row, (stamp_ns, landmark_id, p) in enumerate(rows):
        is_likely = p >= minimum_probability and landmark_id >= 0
        refusals.append(None if is_likely else Outcome.NO_IDENTITY)
        if is_likely:
            other, other_p = best.get((stamp_ns, landmark_id), (row, -1.0))
            if p > other_p:
                best[stamp_ns, landmark_id] = row, p
            if other != row:
                refusals[other if p > other_p else row] = Outcome.REPEATED
    return ids, refusals


@cache
def gate_threshold(probability: float, dof: int) -> float:
    """Squared Mahalanobis distance that a true innovation of ``dof`` components stays below with this probability."""
    return float(chi2.ppf(probability, dof))
