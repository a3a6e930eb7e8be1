"""Joint compatibility of a frame's detections with landmarks, by geometry alone.

Branch and bound (Neira and Tardós, IEEE T-RA 17(6), 2001). A pairing of k detections with k landmarks has the
innovation e of 2 k numbers and its covariance C, with P the joint covariance of the expectations and R the noise::

    D² = e' C^-1 e,     C = P of the paired landmarks + blockdiag(R),     D² <= chi2(2 k)

P contains the error of the vehicle, which shifts all innovations of a frame together. A test of each detection alone
ignores that. The largest jointly compatible pairing is taken, of equally large ones that with the smallest D²
(docs/theory/unknown_landmarks.md).
"""

import math
from dataclasses import dataclass

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import gate_threshold

UNPAIRED = -1


@dataclass(frozen=True)
class Pairing:
    """Hypothesis: index of the landmark of each detection, or `UNPAIRED`."""

    landmarks: tuple[int, ...]
    distance: float
    """D², the squared Mahalanobis distance of all innovations together."""

    @property
    def size(self) -> int:
        """Number of pairs."""
        return sum(landmark != UNPAIRED for landmark in self.landmarks)


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of m detections against n landmarks."""

    innovation: Floats
    """Measured minus expected range (m) and azimuth (rad, wrapped), shape (m, n, 2)."""
    expected_cov: Floats
    """Joint covariance of the expectations, shape (2 n, 2 n)."""
    noise: Floats
    """Noise of each detection, shape (m, 2, 2)."""

    def of(self, landmarks: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Innovation of the pairs of a hypothesis and its covariance, shapes (2 k,) and (2 k, 2 k)."""
        i = np.flatnonzero(np.array(landmarks) != UNPAIRED)  # detections, (k,)
        j = np.array(landmarks)[i]  # their landmarks
        rows = (2 * j[:, None] + [0, 1]).ravel()
        C = self.expected_cov[np.ix_(rows, rows)]
        # noise of different detections is independent: blocks on the diagonal
        for k, detection in enumerate(i.tolist()):
            C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += self.noise[detection]
        return self.innovation[i, j].ravel(), C

    def pairing(self, landmarks: tuple[int, ...]) -> Pairing:
        """Pairing of these landmarks with its D²."""
        e, C = self.of(landmarks)
        return Pairing(landmarks, float(e @ np.linalg.solve(C, e)))

    def distances(self) -> Floats:
        """D² of each detection with each landmark alone, shape (m, n)."""
        n = self.innovation.shape[1]
        own = self.expected_cov.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n), :]
        S = own[None] + self.noise[:, None]  # (m, n, 2, 2)
        weighed = np.linalg.solve(S, self.innovation[..., None])[..., 0]
        return np.asarray(np.einsum("mni,mni->mn", self.innovation, weighed))


def pair_jointly(innovations: Innovations, probability: float) -> Pairing:
    """Largest jointly compatible pairing, the nearest of equally large ones.

    Its pairs are also compatible each by itself, and each landmark is paired once at most. Part of a pairing may be
    beyond the gate of its size, where more pairs make up for it. The cost grows exponentially with the number of
    detections that are compatible with several landmarks.

    ``probability``: chance that a true pairing of k pairs passes the gate, the chi-square quantile with 2 k degrees of
    freedom.
    """
    search = _Search(innovations, probability)
    search.branch(0, search.best)
    return search.best


class _Search:
    """Depth first, detections with the fewest possible landmarks first, landmarks from near to far."""

    def __init__(self, innovations: Innovations, probability: float) -> None:
        count = len(innovations.innovation)
        self._innovations = innovations
        self._gates = [0.0] + [gate_threshold(probability, 2 * (k + 1)) for k in range(count)]
        # a pair that is incompatible alone stays so in every pairing
        self._possible = [
            [j for j in np.argsort(row).tolist() if row[j] <= self._gates[1]] for row in innovations.distances()
        ]
        self._order = sorted(range(count), key=lambda i: (len(self._possible[i]) == 0, len(self._possible[i])))
        self._left = [sum(bool(self._possible[i]) for i in self._order[depth:]) for depth in range(count + 1)]
        """Number of detections at each depth and below that are compatible with a landmark."""
        self.best = Pairing((UNPAIRED,) * count, 0.0)

    def branch(self, depth: int, part: Pairing) -> None:
        """Try all pairings that extend a part of one."""
        best = self.best
        if (part.size, -part.distance) > (best.size, -best.distance) and part.distance <= self._gates[part.size]:
            self.best = part
        if self._left[depth] == 0:
            return
        # bound: D² only grows with pairs, so that a pairing of equal size cannot come below it any more
        reach = part.size + self._left[depth]
        if (reach, -part.distance) <= (self.best.size, -self.best.distance):
            return
        i = self._order[depth]
        for j in self._possible[i]:
            if j not in part.landmarks:
                more = self._innovations.pairing((*part.landmarks[:i], j, *part.landmarks[i + 1 :]))
                if more.distance <= self._gates[reach]:
                    self.branch(depth + 1, more)
        self.branch(depth + 1, part)


def drop_unlikely(innovations: Innovations, pairing: Pairing, log_rivals: Floats) -> Pairing:
    """Drop the pairs that are less likely than a landmark which is not in the map.

    Where the expectation is wide, a detection inside the gate may as well be of such a rival. Pairs are kept where the
    measurement is denser than under the rival::

        ln N(e; 0, C)  >  sum of ln_rivals          all pairs together
        ln N(e_i; given the others)  >  ln_rival_i  each pair, given the other pairs

    The pair that fails worst is dropped until each one passes, and then all unless they pass together.

    ``log_rivals``: logarithm of the density of range and azimuth, 1 / (m rad), that the rival has at each detection,
    shape (m,).
    """
    landmarks = pairing.landmarks
    nothing = Pairing((UNPAIRED,) * len(landmarks), 0.0)
    while landmarks != nothing.landmarks:
        paired = [i for i, landmark in enumerate(landmarks) if landmark != UNPAIRED]
        e, C = innovations.of(landmarks)
        A = np.linalg.inv(C)
        weighed = A @ e
        given_others = []
        for k in range(0, len(e), 2):
            # given the others, e_i is normal about 0 with covariance S = A_ii^-1 and innovation S (A e)_i
            S = np.linalg.inv(A[k : k + 2, k : k + 2])
            given_others.append(log_density(S @ weighed[k : k + 2], S))
        excess = np.array(given_others) - log_rivals[paired]
        worst = int(np.argmin(excess))
        if excess[worst] > 0:
            is_likely = log_density(e, C) > float(log_rivals[paired].sum())
            return innovations.pairing(landmarks) if is_likely else nothing
        landmarks = tuple(UNPAIRED if i == paired[worst] else j for i, j in enumerate(landmarks))
    return nothing


def log_density(e: Floats, C: Floats) -> float:
    """Logarithm of ``N(e; 0, C)``."""
    log_det = float(np.linalg.slogdet(C)[1])
    return -0.5 * (float(e @ np.linalg.solve(C, e)) + log_det + len(e) * math.log(2 * math.pi))
