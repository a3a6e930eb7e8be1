"""Which landmark a detection belongs to, whether it may be believed, and the record of what became of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import chi2

from sonar_graph.measurements import Floats, Ints, LandmarkDetections
from sonar_graph.states import DetectionLog, Outcome


@dataclass(frozen=True, eq=False)
class Identities:
    """The identity of each detection of a block, or the reason why it has none."""

    ids: Ints
    """Most probable identity, shape (n,)."""
    refusals: list[Outcome | None]
    """None where the identity is accepted, length n."""


def identify(detections: LandmarkDetections, minimum_probability: float) -> Identities:
    """Accept the most probable identity of each row where its posterior is high enough.

    A landmark is in one place: of several rows of one frame with one identity the most probable is accepted, the first
    of equals.

    Parameters
    ----------
    minimum_probability
        Rows whose highest posterior is below it, or is not a number, or belongs to no identity (-1), are refused.
    """
    ids, probability = detections.most_probable()
    refusals = [
        None if p >= minimum_probability and landmark_id >= 0 else Outcome.NO_IDENTITY
        for p, landmark_id in zip(probability.tolist(), ids.tolist(), strict=True)
    ]
    return Identities(ids, _once_a_frame(detections.stamps_ns.tolist(), ids.tolist(), probability.tolist(), refusals))


def _once_a_frame(
    stamps_ns: list[int], ids: list[int], probability: list[float], refusals: list[Outcome | None]
) -> list[Outcome | None]:
    best: dict[tuple[int, int], int] = {}
    for row, place in enumerate(zip(stamps_ns, ids, strict=True)):
        if refusals[row] is None and (place not in best or probability[row] > probability[best[place]]):
            best[place] = row
    return [
        refusal if refusal or best[stamp_ns, landmark_id] == row else Outcome.REPEATED
        for row, (stamp_ns, landmark_id, refusal) in enumerate(zip(stamps_ns, ids, refusals, strict=True))
    ]


@cache
def gate_threshold(probability: float, dof: int) -> float:
    """Squared Mahalanobis distance that a true innovation of ``dof`` components stays below with this probability."""
    return float(chi2.ppf(probability, dof))


class DetectionJournal:
    """Rows about detections, in the order in which an estimator deals with them."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._ids: list[int] = []
        self._outcomes: list[Outcome] = []
        self._innovations: list[Floats] = []
        self._innovation_covs: list[Floats] = []

    def __len__(self) -> int:
        return len(self._outcomes)

    def record(
        self,
        stamp_ns: int,
        landmark_id: int,
        outcome: Outcome,
        innovation: Floats | None = None,
        innovation_cov: Floats | None = None,
    ) -> int:
        """Append a row; its number.

        Parameters
        ----------
        innovation
            Measured minus predicted (range m, azimuth rad), shape (2,), kept without a copy; None: nothing was
            predicted.
        innovation_cov
            Shape (2, 2), kept without a copy.
        """
        self._stamps_ns.append(stamp_ns)
        self._ids.append(landmark_id)
        self._outcomes.append(outcome)
        self._innovations.append(_NO_INNOVATION if innovation is None else innovation)
        self._innovation_covs.append(_NO_COV if innovation_cov is None else innovation_cov)
        return len(self) - 1

    def amend(self, row: int, outcome: Outcome, landmark_id: int | None = None) -> None:
        """What has become of a detection since, and of which landmark it is; None: as it was.

        Its innovation, against the landmark that it was taken for when it came, is dropped.
        """
        self._outcomes[row] = outcome
        self._ids[row] = self._ids[row] if landmark_id is None else landmark_id
        self._innovations[row], self._innovation_covs[row] = _NO_INNOVATION, _NO_COV

    def log(self) -> DetectionLog:
        """All rows so far."""
        n = len(self)
        return DetectionLog(
            stamps_ns=np.array(self._stamps_ns, dtype=np.int64),
            landmark_ids=np.array(self._ids, dtype=np.int64),
            innovations=np.array(self._innovations, dtype=np.float64).reshape(n, 2),
            innovation_covs=np.array(self._innovation_covs, dtype=np.float64).reshape(n, 2, 2),
            outcomes=list(self._outcomes),
        )


_NO_INNOVATION = np.full(2, np.nan)
_NO_COV = np.full((2, 2), np.nan)
