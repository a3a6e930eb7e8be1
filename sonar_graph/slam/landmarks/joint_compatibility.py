"""Joint compatibility of a frame's detections with landmarks, by geometry alone.

Branch and bound (Neira and Tardós, IEEE T-RA 17(6), 2001). A pairing of k detections with k landmarks has the
innovation e of 2 k numbers and its covariance C, with P the joint covariance of the expectations and R the noise::

    D² = e' C^-1 e,     C = P of the paired landmarks + blockdiag(R),     D² <= chi2(2 k)

P contains the error of the vehicle, which shifts all innovations of a frame together; a test of each detection alone
does not see that. The largest jointly compatible pairing is taken, of equally large ones that with the smallest D²
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
        paired = [(i, j) for i, j in enumerate(landmarks) if j != UNPAIRED]
        rows = np.array([2 * j + axis for _, j in paired for axis in (0, 1)], dtype=np.int64)
        C = self.expected_cov[np.ix_(rows, rows)].copy()
        for k, (i, _) in enumerate(paired):
            C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += self.noise[i]
        return np.array([self.innovation[i, j] for i, j in paired]).reshape(-1), C

    def distances(self) -> Floats:
        """D² of each detection with each landmark alone, shape (m, n)."""
        n = self.innovation.shape[1]
        own = self.expected_cov.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n), :]
        S = own[None] + self.noise[:, None]
        return np.asarray(
            np.einsum("mni,mni->mn", self.innovation, np.linalg.solve(S, self.innovation[..., None])[..., 0])
        )


def pair_jointly(innovations: Innovations, probability: float) -> Pairing:
    """The largest jointly compatible pairing, the nearest of equally large ones.

    Its pairs are also compatible each by itself. A landmark is in one place: each is paired once at most. Part of a
    pairing may be beyond the gate of its size, where more pairs make up for it. The cost is small where few pairs are
    compatible by themselves, and grows exponentially with the number of detections where many are.

    ``probability``: chance that a true pairing of k pairs passes the gate, the chi-square quantile with 2 k degrees of
    freedom.
    """
    search = _Search(innovations, probability)
    search.branch(0, _Whitened((UNPAIRED,) * len(innovations.innovation), [], np.zeros((0, 0)), np.zeros(0), 0.0))
    return search.best


@dataclass(frozen=True, eq=False)
class _Whitened:
    """A partial hypothesis: ``L L' = C`` and ``w = L^-1 e``, so that ``D² = w' w``."""

    landmarks: tuple[int, ...]
    rows: list[int]
    L: Floats
    w: Floats
    distance: float

    @property
    def size(self) -> int:
        return len(self.rows) // 2


class _Search:
    """Depth first, detections with the fewest possible landmarks first, landmarks from near to far."""

    def __init__(self, innovations: Innovations, probability: float) -> None:
        self._of = innovations
        count = len(innovations.innovation)
        self._gates = [0.0] + [gate_threshold(probability, 2 * (k + 1)) for k in range(count)]
        distances = innovations.distances()
        self._possible = [[j for j in np.argsort(row).tolist() if row[j] <= self._gates[1]] for row in distances]
        self._order = sorted(range(count), key=lambda i: (len(self._possible[i]) == 0, len(self._possible[i])))
        self._left = [sum(bool(self._possible[i]) for i in self._order[depth:]) for depth in range(count + 1)]
        self.best = Pairing((UNPAIRED,) * count, 0.0)
        self._best_size = 0

    def branch(self, depth: int, found: _Whitened) -> None:
        is_better = (found.size, -found.distance) > (self._best_size, -self.best.distance)
        if is_better and found.distance <= self._gates[found.size]:
            self.best, self._best_size = Pairing(found.landmarks, found.distance), found.size
        reach = found.size + self._left[depth]
        # D² only grows with pairs: with so many in the end nothing can be better than the best so far.
        is_hopeless = reach < self._best_size or (reach == self._best_size and found.distance >= self.best.distance)
        if self._left[depth] == 0 or is_hopeless:
            return
        i = self._order[depth]
        for j in self._possible[i]:
            if j not in found.landmarks:
                more = self._with_pair(found, i, j)
                if more.distance <= self._gates[reach]:
                    self.branch(depth + 1, more)
        self.branch(depth + 1, found)

    def _with_pair(self, found: _Whitened, i: int, j: int) -> _Whitened:
        """One more pair, by a block of the Cholesky factor."""
        k, rows = len(found.rows), [2 * j, 2 * j + 1]
        E = self._of.expected_cov
        across = np.linalg.solve(found.L, E[np.ix_(found.rows, rows)]) if k else np.zeros((0, 2))
        corner = np.linalg.cholesky(E[np.ix_(rows, rows)] + self._of.noise[i] - across.T @ across)
        w = np.linalg.solve(corner, self._of.innovation[i, j] - across.T @ found.w)
        L = np.zeros((k + 2, k + 2))
        L[:k, :k], L[k:, :k], L[k:, k:] = found.L, across.T, corner
        landmarks = tuple(j if place == i else at for place, at in enumerate(found.landmarks))
        distance = found.distance + float(w @ w)
        return _Whitened(landmarks, found.rows + rows, L, np.concatenate([found.w, w]), distance)


def believed(innovations: Innovations, pairing: Pairing, log_rivals: Floats) -> Pairing:
    """The pairing without what geometry says too little about.

    Where the expectation is wide a detection inside the gate may as well be of a landmark that is not in the map. A
    pairing is believed where the measurement is denser than under that rival::

        ln N(e; 0, C)  >  sum of ln_rivals          all pairs together
        ln N(e_i; given the others)  >  ln_rival_i  each pair, given the other pairs

    ``log_rivals``: logarithm of the density of range and azimuth, 1 / (m rad), that the rival has at each detection,
    shape (m,).

    Returns the pairing without the pairs that fail worst, until each one passes; without any if together they do not.
    """
    landmarks, nothing = pairing.landmarks, Pairing((UNPAIRED,) * len(pairing.landmarks), 0.0)
    while any(landmark != UNPAIRED for landmark in landmarks):
        paired = [i for i, landmark in enumerate(landmarks) if landmark != UNPAIRED]
        e, C = innovations.of(landmarks)
        A = np.linalg.inv(C)  # given the others, e_i is normal about 0 with innovation A_ii^-1 (A e)_i
        weighed, given = A @ e, []
        for first in range(0, len(e), 2):
            at = slice(first, first + 2)
            S = np.linalg.inv(A[at, at])
            given.append(log_density(S @ weighed[at], S))
        excess = np.array(given) - log_rivals[paired]
        worst = int(np.argmin(excess))
        if excess[worst] > 0:
            is_likely = log_density(e, C) > float(log_rivals[paired].sum())
            return Pairing(landmarks, float(e @ np.linalg.solve(C, e))) if is_likely else nothing
        landmarks = tuple(UNPAIRED if i == paired[worst] else at for i, at in enumerate(landmarks))
    return nothing


def log_density(e: Floats, C: Floats) -> float:
    """Logarithm of ``N(e; 0, C)``."""
    log_det = float(np.linalg.slogdet(C)[1])
    return -0.5 * (float(e @ np.linalg.solve(C, e)) + log_det + len(e) * math.log(2 * math.pi))
