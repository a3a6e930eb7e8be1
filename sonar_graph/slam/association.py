"""Which landmark a detection belongs to, whether it may be believed, and the record of what became of it."""

from __future__ import annotations

import math
from array import array
from copy import deepcopy
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
    """Rows about detections, in the order in which an estimator deals with them; 73 bytes each.

    A log of hours has hundreds of thousands: they are kept as columns of numbers, not as objects.
    """

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._ids = array("q")
        self._outcomes = array("b")
        self._innovations = array("d")
        self._innovation_covs = array("d")
        self._forgotten = 0

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
            Measured minus predicted (range m, azimuth rad), shape (2,); None: nothing was predicted.
        innovation_cov
            Shape (2, 2).
        """
        self._stamps_ns.append(stamp_ns)
        self._ids.append(landmark_id)
        self._outcomes.append(_NUMBER[outcome])
        self._innovations.extend(_UNKNOWN[:2] if innovation is None else innovation.tolist())
        self._innovation_covs.extend(_UNKNOWN if innovation_cov is None else innovation_cov.ravel().tolist())
        return self._forgotten + len(self) - 1

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the rows up to the first one that is not older; the others keep their numbers."""
        count = 0
        while count < len(self) and self._stamps_ns[count] < stamp_ns:
            count += 1
        del self._stamps_ns[:count], self._ids[:count], self._outcomes[:count]
        del self._innovations[: 2 * count], self._innovation_covs[: 4 * count]
        self._forgotten += count

    def copy(self) -> DetectionJournal:
        """The same rows, to be amended apart."""
        return deepcopy(self)

    def amend(self, row: int, outcome: Outcome, landmark_id: int | None = None) -> None:
        """What has become of a detection since, and of which landmark it is; None: as it was.

        Its innovation, against the landmark that it was taken for when it came, is dropped.
        """
        row -= self._forgotten
        if row < 0:
            return
        self._outcomes[row] = _NUMBER[outcome]
        self._ids[row] = self._ids[row] if landmark_id is None else landmark_id
        self._innovations[2 * row : 2 * row + 2] = array("d", _UNKNOWN[:2])
        self._innovation_covs[4 * row : 4 * row + 4] = array("d", _UNKNOWN)

    def log(self) -> DetectionLog:
        """All rows that are not forgotten."""
        n = len(self)
        return DetectionLog(
            stamps_ns=np.array(self._stamps_ns, dtype=np.int64),
            landmark_ids=np.array(self._ids, dtype=np.int64),
            innovations=np.array(self._innovations, dtype=np.float64).reshape(n, 2),
            innovation_covs=np.array(self._innovation_covs, dtype=np.float64).reshape(n, 2, 2),
            outcomes=[_OUTCOMES[number] for number in self._outcomes],
        )


_OUTCOMES = list(Outcome)
_NUMBER = {outcome: number for number, outcome in enumerate(_OUTCOMES)}
_UNKNOWN = (math.nan,) * 4
