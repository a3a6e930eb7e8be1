"""Unknown landmarks: detections without identities, paired by geometry (docs/theory/unknown_landmarks.md).

They are paired with the landmarks of the graph, named ones too, by joint compatibility. What is left waits, tied to its
keyframe, and is paired with what waits of earlier frames. Once enough sightings of one candidate place it well enough,
they become factors, each on its own keyframe, and the candidate a landmark.

Two landmarks a, b of the graph are one, and are merged, when

* at least one of them is anonymous, no frame shows both, and no sighting of the one that goes has left the window;
* their difference ``d = p_a - p_b`` with ``S = P_aa + P_bb - P_ab - P_ba + sigma² I`` is compatible with zero:
  ``d' S^-1 d`` is inside the chi-square gate, three degrees of freedom;
* the density of the horizontal difference ``N(d_xy; 0, S_xy)``, 1/m², exceeds that of neighbours which are not in the
  map. Where S is wide it does not.

Sigma is the noise of one sighting: of two landmarks in one place each gets the sightings on its side, so that they stay
apart by about that, and P does not know it.
"""

import math
from collections.abc import Iterator, Set
from itertools import combinations
from typing import Annotated, Literal, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from numpy.typing import NDArray
from pydantic import Field

from sonar_graph.calibration import Section
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import gate_threshold, wrap_angle
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.landmarks.joint_compatibility import UNPAIRED, Innovations, believed, log_density, pair_jointly
from sonar_graph.slam.landmarks.landmark_graph import Assignment, LandmarkGraph
from sonar_graph.slam.landmarks.sighting import SeenFrame, Sighting, place, source
from sonar_graph.slam.prediction import PredictedView
from sonar_graph.slam.smoother import JointCovariance
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome
from sonar_graph.tagged_sections import tagged

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

    Begins landmarks with identities from 3000000000 on; docs/theory/unknown_landmarks.md says on what conditions.

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


UnknownParams = Annotated[IgnoredUnknown | AssociatedUnknown, *tagged("policy", "ignore")]


def unnamed(frame: LandmarkDetections) -> NDArray[np.bool_]:
    """Flags of rows that name no landmark at all, neither one nor several in doubt, shape (n,)."""
    return np.asarray((frame.candidate_ids < 0).all(axis=1))


def nearest_duplicates(
    landmarks: LandmarkGraph, values: gtsam.Values, covariance: JointCovariance, params: AssociatedUnknown
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
    rows = {i: covariance.rows[L(i)] + np.arange(3) for i in points}
    a, b = (np.array([rows[pair[side]] for pair in pairs]) for side in (0, 1))
    P, d = covariance.matrix, np.array([points[i] - points[j] for i, j in pairs])
    signed = ((1, a, a), (1, b, b), (-1, a, b), (-1, b, a))
    S = np.asarray(sum(sign * P[i[:, :, None], j[:, None, :]] for sign, i, j in signed))
    noise = {}
    for i in points:  # of a sighting, across or along its beam, whichever is larger, m²
        sighting = landmarks.any_sighting(i)
        noise[i] = float(max(sighting.noise[0, 0], sighting.line.z[0] ** 2 * sighting.noise[1, 1]))
    S = S + np.array([max(noise[i], noise[j]) for i, j in pairs])[:, None, None] * np.eye(3)
    distance = np.einsum("ki,ki->k", d, np.linalg.solve(S, d[..., None])[..., 0])
    for k in np.argsort(distance).tolist():
        stays, goes = pairs[k]
        is_near = distance[k] <= gate_threshold(params.gate_probability, 3)
        of_both = landmarks.stamps_ns(stays) & landmarks.stamps_ns(goes)
        is_dense = is_near and log_density(d[k][:2], S[k][:2, :2]) > params.log_rival
        if is_dense and not of_both and not landmarks.is_rooted(goes):
            return stays, goes
    return None


Candidate = list[Sighting]
"""Sightings that may be of one landmark, in the order of time."""


class PairedDetection(NamedTuple):
    """Landmark or candidate that a detection was paired with, or neither."""

    landmark_id: int | None
    candidate: Candidate | None
    innovation: Floats | None = None
    """Innovation against the landmark, shape (2,)."""
    S: Floats | None = None
    """Its covariance, shape (2, 2)."""


class NamelessLandmarks:
    """Pairs detections without identities, and begins and merges landmarks."""

    def __init__(self, landmarks: LandmarkGraph, keyframes: Keyframes, params: AssociatedUnknown) -> None:
        self._landmarks, self._keyframes, self._params = landmarks, keyframes, params
        self._smoother, self._factors = landmarks.smoother, landmarks.factors
        self._longest_wait_s = max(min(params.longest_wait_s, self._smoother.params.lag_s - ROUNDING_S), 0.0)
        self._candidates: list[Candidate] = []
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

    def assign(self, frame: SeenFrame, rows: list[int], taken: set[int]) -> Iterator[list[Assignment]]:
        """Merge two landmarks that are one; pair the rows that name none; begin landmarks of what has waited.

        ``taken``: landmarks that are named in this frame.
        """
        yield self.forget()
        if len(self._landmarks.ids) > 1 and self._landmarks.ids[-1] >= FIRST_ANONYMOUS_ID:
            joint = self._smoother.joint_covariance([self._keyframes.newest_key, *self._keys()])
            if found := nearest_duplicates(self._landmarks, self._smoother.values, joint, self._params):
                stays, goes = found
                yield [Assignment(s, Outcome.MOVED, stays) for s in self._landmarks.sightings(goes)]
        if not rows:
            return
        view = frame.predict(self._keys())
        paired = self.pair(view, frame.z[rows], frame.noise[rows], taken)
        assigned, grown = [], []
        for sighting, (i, candidate, e, S) in zip(frame.sightings(view, rows), paired, strict=True):
            if i is not None and S is not None:
                gain = float((np.diag(S) / np.diag(sighting.noise)).max()) - 1.0
                assigned.append(Assignment(sighting, Outcome.USED, i, e, S, gain))
                continue
            if candidate is None:
                candidate = []
                self._candidates.append(candidate)
            candidate.append(sighting)
            grown.append(candidate)
            assigned.append(Assignment(sighting, Outcome.WAITING))
        yield assigned
        for candidate in grown:
            if self.is_placed(candidate):
                self._candidates.remove(candidate)
                begins, self._next_id = self._next_id, self._next_id + 1
                *earlier, newest = candidate
                yield [
                    *(Assignment(sighting, Outcome.PLACED_LATER, begins) for sighting in earlier),
                    Assignment(newest, Outcome.NEW, begins),
                ]

    def is_placed(self, candidate: Candidate) -> bool:
        """True when a candidate has enough sightings, which place it well enough."""
        if len(candidate) < self._params.sightings:
            return False
        _, cov = place(candidate, self._smoother.values, self._factors)
        return bool(np.linalg.eigvalsh(cov)[-1] <= (LARGEST_SIGMA_SHARE * candidate[-1].line.z[0]) ** 2)

    def forget(self, left: Set[int] = frozenset()) -> list[Assignment]:
        """Forget sightings on keyframes that are too old, or leave a bounded window."""
        oldest = self._keyframes.oldest_key(self._longest_wait_s)
        waiting = [sighting for candidate in self._candidates for sighting in candidate]
        gone = {s for s in waiting if s.line.pose_key < oldest or s.line.pose_key in left}
        if gone:
            kept = [[sighting for sighting in candidate if sighting not in gone] for candidate in self._candidates]
            self._candidates = [candidate for candidate in kept if candidate]
        return [Assignment(sighting, Outcome.FORGOTTEN) for sighting in waiting if sighting in gone]

    def _keys(self) -> list[int]:
        """Keys whose joint covariance pairing needs: all landmarks, and keyframes that saw candidates."""
        seen_from = {candidate[-1].line.pose_key for candidate in self._candidates}
        return [*(L(i) for i in self._landmarks.ids), *sorted(seen_from)]

    def pair(self, view: PredictedView, z: Floats, noise: Floats, taken: set[int]) -> list[PairedDetection]:
        """Pair each detection of a frame with a landmark, or else with a candidate.

        Parameters
        ----------
        z, noise
            Range (m) and azimuth (rad), shape (m, 2), and their covariance, shape (m, 2, 2).
        taken
            Landmarks that are named in this frame.
        """
        values = self._smoother.values
        ids = [i for i in self._landmarks.ids if i not in taken]
        keys = [L(i) for i in ids]
        points = np.array([values.atPoint3(key) for key in keys])
        sources = [source(candidate[-1], values, self._factors) for candidate in self._candidates]
        if not keys and not sources:
            return [PairedDetection(None, None)] * len(z)
        expected, cov = view.expect_jointly(keys, points, sources)
        of_landmarks = _choose(z, noise, expected[: len(ids)], cov[: 2 * len(ids), : 2 * len(ids)], self._params)
        left = [i for i, (landmark, *_) in enumerate(of_landmarks) if landmark == UNPAIRED]
        of_candidates = _choose(
            z[left], noise[left], expected[len(ids) :], cov[2 * len(ids) :, 2 * len(ids) :], self._params
        )
        paired = [
            PairedDetection(ids[j], None, e, S) if j != UNPAIRED else PairedDetection(None, None)
            for j, e, S in of_landmarks
        ]
        for i, (j, *_) in zip(left, of_candidates, strict=True):
            paired[i] = PairedDetection(None, self._candidates[j] if j != UNPAIRED else None)
        return paired


def _choose(
    z: Floats, noise: Floats, expected: Floats, cov: Floats, policy: AssociatedUnknown
) -> list[tuple[int, Floats | None, Floats | None]]:
    """For each detection the index of what it is paired with, the innovation and its covariance."""
    if not len(z) or not len(expected):
        return [(UNPAIRED, None, None)] * len(z)
    e = z[:, None] - expected[None]
    for i, j in np.ndindex(e.shape[:2]):
        e[i, j, 1] = wrap_angle(e[i, j, 1])
    innovations = Innovations(e, cov, noise)
    pairing = believed(
        innovations, pair_jointly(innovations, policy.gate_probability), policy.log_rival + np.log(z[:, 0])
    )
    return [
        (j, e[i, j], cov[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] + noise[i]) if j != UNPAIRED else (UNPAIRED, None, None)
        for i, j in enumerate(pairing.landmarks)
    ]
