"""Unknown landmarks: detections without identities, paired by geometry (docs/theory/unknown_landmarks.md).

They are paired with the landmarks of the graph, named ones too, by joint compatibility. An unpaired sighting waits,
tied to its keyframe, and is paired with sightings of later frames: together they are a candidate. Once the sightings of
a candidate place it well enough, they become factors, each on its own keyframe, and the candidate a landmark.

Two landmarks a, b of the graph are one, and are merged, when

* at least one of them is anonymous, no frame shows both, and no sighting of the one that goes has left the window;
* their difference ``d = p_a - p_b`` with ``S = P_aa + P_bb - P_ab - P_ba + sigma² I`` is compatible with zero:
  ``d' S^-1 d`` is inside the chi-square gate, three degrees of freedom;
* the density of the horizontal difference ``N(d_xy; 0, S_xy)``, 1/m², exceeds that of neighbours which are not in the
  map. Where S is wide it does not.

Sigma is the noise of one sighting. Of two landmarks in one place each gets the sightings on its side, so that they stay
apart by about sigma, which P does not contain.
"""

import math
from collections.abc import Set
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Literal, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Section, tagged
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import (
    locate_jacobians,
    polar_difference,
    range_azimuth_jacobians,
)
from sonar_graph.numerics import chi_square_quantile, diagonal_blocks
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.landmarks.landmark_graph import (
    UNCHANGED,
    Assignment,
    Decision,
    IdentityPolicy,
    LandmarkGraph,
)
from sonar_graph.slam.landmarks.sighting import (
    Frame,
    SeenFrame,
    Sighting,
    SightingFactors,
)
from sonar_graph.slam.prediction import PredictedView, Source
from sonar_graph.slam.smoother import JointCovariance, Known
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome

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
        own = diagonal_blocks(self.expected_cov, 2)
        S = own[None] + self.noise[:, None]  # (m, n, 2, 2)
        weighed = np.linalg.solve(S, self.innovation[..., None])[..., 0]
        return np.einsum("mni,mni->mn", self.innovation, weighed)


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
        self._gates = [0.0] + [
            chi_square_quantile(probability, 2 * (k + 1)) for k in range(count)
        ]
        # a pair that is incompatible alone stays so in every pairing
        self._possible = [
            [j for j in np.argsort(row).tolist() if row[j] <= self._gates[1]]
            for row in innovations.distances()
        ]
        self._order = sorted(
            range(count),
            key=lambda i: (len(self._possible[i]) == 0, len(self._possible[i])),
        )
        self._left = [
            sum(bool(self._possible[i]) for i in self._order[depth:])
            for depth in range(count + 1)
        ]
        """Number of detections at each depth and below that are compatible with a landmark."""
        self.best = Pairing((UNPAIRED,) * count, 0.0)

    def branch(self, depth: int, part: Pairing) -> None:
        """Try all pairings that extend a part of one."""
        best = self.best
        if (part.size, -part.distance) > (
            best.size,
            -best.distance,
        ) and part.distance <= self._gates[part.size]:
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
                more = self._innovations.pairing(
                    (*part.landmarks[:i], j, *part.landmarks[i + 1 :])
                )
                if more.distance <= self._gates[reach]:
                    self.branch(depth + 1, more)
        self.branch(depth + 1, part)


def drop_unlikely(
    innovations: Innovations, pairing: Pairing, log_rivals: Floats
) -> Pairing:
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
            is_likely = log_density(e, C) > log_rivals[paired].sum()
            return innovations.pairing(landmarks) if is_likely else nothing
        landmarks = tuple(
            UNPAIRED if i == paired[worst] else j for i, j in enumerate(landmarks)
        )
    return nothing


def log_density(e: Floats, C: Floats) -> float:
    """Logarithm of ``N(e; 0, C)``."""
    log_det = np.linalg.slogdet(C)[1]
    return -0.5 * (e @ np.linalg.solve(C, e) + log_det + len(e) * math.log(2 * math.pi))


ROUNDING_S = 1e-3
"""A keyframe as old as the lag may have left the window."""
ODDS = 10.0
"""How much more likely a pairing must be than that the detection is of a landmark which is not in the map."""
LARGEST_SIGMA_SHARE = 0.1
"""A candidate is placed well enough when its largest standard deviation, seen from the poses, is this share of its
range: a point that far off still looks linear."""


class IgnoredUnknown(Section):
    """Refuse detections that name no landmark."""

    policy: Literal["ignore"] = "ignore"


class AssociatedUnknown(Section):
    """Pair detections that name no landmark with landmarks by geometry.

    Begins landmarks with identities from 3000000000 on, under the conditions of docs/theory/unknown_landmarks.md.

    Examples
    --------
    >>> from sonar_graph.slam import AssociatedUnknown, Isam2Params, RobustIdentity
    >>> params = Isam2Params(identity=RobustIdentity(unknown=AssociatedUnknown(density_m2=0.01)))
    >>> params.identity.unknown.policy, params.identity.unknown.sightings
    ('associate', 5)
    """

    policy: Literal["associate"] = "associate"
    gate_probability: float = Field(0.9999, gt=0, lt=1)
    """Probability with which a frame's right pairing of detections with landmarks passes the joint chi-square gate."""
    density_m2: float = Field(0.05, gt=0)
    """Density of landmarks that are not in the map, 1/m². A pairing has to be more probable than one of these."""
    sightings: int = Field(5, ge=1)
    """Number of sightings of one unpaired object from which a new landmark begins."""
    longest_wait_s: float = Field(10.0, gt=0)
    """Longest time for which an unpaired sighting waits for the others, at most ``smoother.lag_s``."""

    @property
    def log_rival(self) -> float:
        """Logarithm of the density, 1/m², that a pairing has to exceed."""
        return math.log(ODDS * self.density_m2)


UnknownParams = Annotated[
    IgnoredUnknown | AssociatedUnknown, *tagged("policy", "ignore")
]


def unnamed(frame: LandmarkDetections) -> NDArray[np.bool_]:
    """Flags of rows that name no landmark at all, neither one nor several in doubt, shape (n,)."""
    return np.asarray((frame.candidate_ids < 0).all(axis=1))


Candidate = list[Sighting]
"""Sightings that may be of one landmark, in the order of time."""


class PairedDetection(NamedTuple):
    """Landmark or candidate that a detection was paired with, or neither."""

    landmark_id: int | None = None
    candidate: Candidate | None = None
    innovation: Floats | None = None
    """Innovation against the landmark, shape (2,)."""
    S: Floats | None = None
    """Its covariance, shape (2, 2)."""


class NamelessLandmarks(IdentityPolicy):
    """Pairs detections without identities, and begins and merges landmarks."""

    def __init__(
        self, landmarks: LandmarkGraph, keyframes: Keyframes, params: AssociatedUnknown
    ) -> None:
        super().__init__(landmarks)
        self._keyframes = keyframes
        self._params = params
        self._longest_wait_s = max(
            min(params.longest_wait_s, self.smoother.params.lag_s - ROUNDING_S), 0.0
        )
        self._candidates: list[Candidate] = []
        self._grown: list[Candidate] = []
        """Candidates that the last frame shows."""
        self._next_id = FIRST_ANONYMOUS_ID

    def refuse_taken_ids(self, frame: LandmarkDetections) -> None:
        """Refuse identities that are reserved for landmarks without names, with an `EstimatorError`."""
        largest = int(frame.candidate_ids.max())
        if largest >= FIRST_ANONYMOUS_ID:
            raise EstimatorError(
                f"isam2: a detection at {frame.stamps_ns[0]} ns has identity {largest}; with identity.unknown.policy ="
                f' "associate" those from {FIRST_ANONYMOUS_ID} on are of landmarks without names: number the landmarks'
                ' below that, or give it identity.unknown.policy = "ignore"'
            )

    def retract(self, frame: Frame | None) -> Decision:  # noqa: ARG002
        """Give up sightings that have waited too long."""
        return Decision.of(self.forget())

    def associate(self, frame: Frame | None) -> Decision:  # noqa: ARG002
        """Merge the nearest two landmarks that are one."""
        ids = self.landmarks.ids
        if len(ids) < 2 or ids[-1] < FIRST_ANONYMOUS_ID:
            return UNCHANGED
        joint = self.smoother.joint_covariance(
            [self._keyframes.newest_key, *self._keys()]
        )
        duplicates = nearest_duplicates(
            self.landmarks, self.smoother.estimates, joint, self._params
        )
        if duplicates is None:
            return UNCHANGED
        stays, goes = duplicates
        return Decision.of(
            Assignment(s, Outcome.MOVED, stays) for s in self.landmarks.sightings(goes)
        )

    def rivals(self, frame: Frame, world_T_sonar: gtsam.Pose3) -> list[int]:  # noqa: ARG002
        """All landmarks, and the keyframes of all candidates."""
        return self._keys()

    def judge(self, seen: SeenFrame) -> Decision:
        """Use paired detections; let the others wait, each with its candidate."""
        self._grown = []
        rows = list(range(len(seen.frame)))
        paired = self.pair(seen.view, seen.frame.z, seen.frame.noise, seen.taken)
        judged = []
        for sighting, pair in zip(
            seen.sightings(rows, seen.beam_points(rows)), paired, strict=True
        ):
            if pair.landmark_id is not None and pair.S is not None:
                # S = S_0 + R
                gain = (np.diag(pair.S) / np.diag(sighting.noise)).max() - 1.0
                judged.append(
                    Assignment(
                        sighting,
                        Outcome.USED,
                        pair.landmark_id,
                        pair.innovation,
                        pair.S,
                        gain,
                    )
                )
                continue
            candidate = pair.candidate
            if candidate is None:  # neither near a landmark nor near what waits
                candidate = []
                self._candidates.append(candidate)
            candidate.append(sighting)
            self._grown.append(candidate)
            judged.append(Assignment(sighting, Outcome.WAITING))
        return Decision.of(judged)

    def reconsider(self) -> Decision:
        """Begin a landmark of the next candidate that is placed well enough."""
        while self._grown:
            candidate = self._grown.pop(0)
            if self.is_placed(candidate):
                self._candidates.remove(candidate)
                landmark_id = self._next_id
                self._next_id += 1
                *earlier, newest = candidate
                later = [
                    Assignment(sighting, Outcome.PLACED_LATER, landmark_id)
                    for sighting in earlier
                ]
                return Decision.of(
                    [*later, Assignment(newest, Outcome.NEW, landmark_id)]
                )
        return UNCHANGED

    def is_placed(self, candidate: Candidate) -> bool:
        """True when a candidate has enough sightings, which place it well enough."""
        if len(candidate) < self._params.sightings:
            return False
        _, P = place(candidate, self.smoother.estimates, self.landmarks.factors)
        return bool(
            np.linalg.eigvalsh(P)[-1]
            <= (LARGEST_SIGMA_SHARE * candidate[-1].line.z[0]) ** 2
        )

    def forget(self, now_ns: int = 0, left: Set[int] = frozenset()) -> list[Assignment]:  # noqa: ARG002
        """Give up sightings on keyframes that are too old, or leave a bounded window."""
        oldest = self._keyframes.oldest_key(self._longest_wait_s)
        given_up = []
        for candidate in self._candidates:
            old = [
                s
                for s in candidate
                if s.line.pose_key < oldest or s.line.pose_key in left
            ]
            given_up += [Assignment(sighting, Outcome.FORGOTTEN) for sighting in old]
            for sighting in old:
                candidate.remove(sighting)
        self._candidates = [candidate for candidate in self._candidates if candidate]
        return given_up

    def _keys(self) -> list[int]:
        """Keys whose joint covariance pairing needs: all landmarks, and keyframes of candidates."""
        seen_from = {candidate[-1].line.pose_key for candidate in self._candidates}
        return [*map(L, self.landmarks.ids), *sorted(seen_from)]

    def pair(
        self, view: PredictedView, z: Floats, noise: Floats, taken: Set[int]
    ) -> list[PairedDetection]:
        """Pair each detection of a frame with a landmark, or else with a candidate.

        Parameters
        ----------
        z, noise
            Range (m) and azimuth (rad), shape (m, 2), and their covariance, shape (m, 2, 2).
        taken
            Landmarks that are named in this frame.
        """
        values = self.smoother.estimates
        ids = [i for i in self.landmarks.ids if i not in taken]
        keys = [L(i) for i in ids]
        points = np.array([values.atPoint3(key) for key in keys])
        sources = [
            source(candidate[-1], values, self.landmarks.factors)
            for candidate in self._candidates
        ]
        paired = [PairedDetection()] * len(z)
        if not keys and not sources:
            return paired
        expected, P = view.expect_jointly(keys, points, sources)
        n = len(ids)
        # landmarks first; a candidate takes only what no landmark explains
        e = polar_difference(z[:, None], expected[None])  # (m, n + s, 2)
        innovations = Innovations(e[:, :n], P[: 2 * n, : 2 * n], noise)
        of_landmarks = self._choose(innovations, z)
        for i, j in of_landmarks.items():
            S = (
                innovations.expected_cov[2 * j : 2 * j + 2, 2 * j : 2 * j + 2]
                + noise[i]
            )
            paired[i] = PairedDetection(ids[j], None, innovations.innovation[i, j], S)
        left = [i for i in range(len(z)) if i not in of_landmarks]
        innovations = Innovations(e[left, n:], P[2 * n :, 2 * n :], noise[left])
        for i, j in self._choose(innovations, z[left]).items():
            paired[left[i]] = PairedDetection(None, self._candidates[j])
        return paired

    def _choose(self, innovations: Innovations, z: Floats) -> dict[int, int]:
        """Index of what each detection is paired with, for those that are paired."""
        if innovations.innovation.size == 0:
            return {}
        compatible = pair_jointly(innovations, self._params.gate_probability)
        # a density per area is r times that per range and azimuth
        likely = drop_unlikely(
            innovations, compatible, self._params.log_rival + np.log(z[:, 0])
        )
        return {i: j for i, j in enumerate(likely.landmarks) if j != UNPAIRED}


def nearest_duplicates(
    landmarks: LandmarkGraph,
    values: Known,
    covariance: JointCovariance,
    params: AssociatedUnknown,
) -> tuple[int, int] | None:
    """Nearest two landmarks that are one, or None: that which stays and that which becomes part of it.

    A named landmark stays, of two anonymous ones the one with the lower identity. The covariance is of all of them.
    """
    named = [i for i in landmarks.ids if i < FIRST_ANONYMOUS_ID]
    nameless = landmarks.ids[len(named) :]
    pairs = [(a, b) for b in nameless for a in named] + list(combinations(nameless, 2))
    if not pairs:
        return None
    points = {i: values.atPoint3(L(i)) for i in landmarks.ids}
    noise = {i: _noise_m2(landmarks.any_sighting(i)) for i in landmarks.ids}
    d = np.array([points[a] - points[b] for a, b in pairs])  # (k, 3)
    sigma2 = np.array([max(noise[a], noise[b]) for a, b in pairs])
    # (k, 3)
    of_a = np.array([covariance.rows[L(a)] for a, _ in pairs])[:, None] + np.arange(3)
    of_b = np.array([covariance.rows[L(b)] for _, b in pairs])[:, None] + np.arange(3)

    def P(i: NDArray[np.int64], j: NDArray[np.int64]) -> Floats:
        return covariance.matrix[i[:, :, None], j[:, None, :]]  # (k, 3, 3)

    S = (
        P(of_a, of_a)
        + P(of_b, of_b)
        - P(of_a, of_b)
        - P(of_b, of_a)
        + sigma2[:, None, None] * np.eye(3)
    )
    # d' S^-1 d
    distance = np.einsum("ki,ki->k", d, np.linalg.solve(S, d[..., None])[..., 0])
    for k in np.argsort(distance).tolist():
        stays, goes = pairs[k]
        if distance[k] > chi_square_quantile(params.gate_probability, 3):
            return None  # nor is any later pair compatible
        is_dense = log_density(d[k, :2], S[k, :2, :2]) > params.log_rival
        in_one_frame = landmarks.stamps_ns(stays) & landmarks.stamps_ns(goes)
        if is_dense and not in_one_frame and not landmarks.is_rooted(goes):
            return stays, goes
    return None


def _noise_m2(sighting: Sighting) -> float:
    """Variance of a sighting across or along its beam, whichever is larger, m²."""
    return max(sighting.noise[0, 0], sighting.line.z[0] ** 2 * sighting.noise[1, 1])


def source(sighting: Sighting, values: Known, factors: SightingFactors) -> Source:
    """The point as located by one sighting.

    With ``p = g(X, range, azimuth, elevation)``: ``cov = g_z diag(R, sigma_e²) g_z'``, sigma_e that of an elevation
    anywhere in the aperture. On a floor, ``p_z ~ N(floor z, sigma²)`` narrows it.
    """
    line = sighting.line
    X = values.atPose3(line.pose_key)
    elevation = factors.elevation_on(
        sighting.floor, X.compose(line.body_T_sonar), line.z
    )
    point, by_pose, by_polar = locate_jacobians(
        X, line.body_T_sonar, line.z[0], line.z[1], elevation
    )
    polar_cov = np.zeros((3, 3))
    polar_cov[:2, :2] = sighting.noise
    polar_cov[2, 2] = factors.elevation_sigma_rad**2
    cov = by_polar @ polar_cov @ by_polar.T
    if sighting.floor is not None:
        # condition on p_z, a measurement of the third component
        cov = cov - np.outer(cov[:, 2], cov[2]) / (
            cov[2, 2] + sighting.floor.sigma_m**2
        )
    return Source(line.pose_key, point, by_pose, cov)


def place(
    sightings: list[Sighting], values: Known, factors: SightingFactors
) -> tuple[Floats, Floats]:
    """Point of several sightings, shape (3,), m, and its covariance, shape (3, 3), m².

    The first sighting, corrected by the others one after the other::

        K = P H' (H P H' + R)^-1,    p <- p + K (z - h(p)),    P <- (I - K H) P
    """
    first = source(sightings[0], values, factors)
    point = first.point
    P = first.cov
    for sighting in sightings[1:]:
        line = sighting.line
        predicted, _, H = range_azimuth_jacobians(
            values.atPose3(line.pose_key), line.body_T_sonar, point
        )
        K = np.linalg.solve(H @ P @ H.T + sighting.noise, H @ P).T  # (3, 2)
        point = point + K @ polar_difference(line.z, predicted)
        P = P - K @ H @ P
    return point, P
