"""Two landmarks of the graph that are one.

A landmark that was seen again after much drift may be taken for a new one. When other evidence has since corrected
the poses, its duplicate comes to lie where it lies. Two landmarks a, b are one when all of this holds:

* at least one of them is anonymous;
* no frame shows both, and with a bounded history none of the one that goes has left the window;
* their difference ``d = p_a - p_b``, with ``S = P_aa + P_bb - P_ab - P_ba + sigma² I``, is compatible with zero:
  ``d' S^-1 d`` is within the chi-square gate, three degrees of freedom;
* that says something: the density of the horizontal difference ``N(d_xy; 0, S_xy)``, 1/m², exceeds the density that
  neighbours which are not in the map are expected to have. Where S is wide it does not.

Sigma is the noise of one sighting. Of two landmarks in one place each gets the sightings on its side, so that they stay
apart by about that, and P does not know it. Two that really lie so near each other are told apart by frames with both.
"""

from __future__ import annotations

import math
from itertools import combinations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.slam.association import gate_threshold
from sonar_graph.slam.joint_covariance import JointCovariance
from sonar_graph.slam.landmark_sightings import LandmarkSightings


class LandmarkMerging:
    """Finds landmarks that are one.

    Parameters
    ----------
    landmarks
        Those of the graph, with their frames.
    gate_probability
        Two that are one pass the gate with this probability.
    log_rival
        Logarithm of the density, 1/m², which the horizontal difference has to exceed.
    """

    def __init__(self, landmarks: LandmarkSightings, gate_probability: float, log_rival: float) -> None:
        self._landmarks = landmarks
        self._gate = gate_threshold(gate_probability, 3)
        self._log_rival = log_rival

    def nearest(
        self, values: gtsam.Values, covariance: JointCovariance, named: list[int], anonymous: list[int]
    ) -> tuple[int, int] | None:
        """The pair of landmarks that are most likely one: which stays, and which becomes part of it; None: no pair.

        A named landmark stays, of two anonymous ones that of the lower identity.

        Parameters
        ----------
        covariance
            Joint, of all these landmarks.
        """
        pairs = [(a, b) for b in anonymous for a in named] + list(combinations(sorted(anonymous), 2))
        if not pairs:
            return None
        d, S = _differences(values, covariance, pairs)
        S = S + np.array([max(map(self._variance, pair)) for pair in pairs])[:, None, None] * np.eye(3)
        distance = np.einsum("ki,ki->k", d, np.linalg.solve(S, d[..., None])[..., 0])
        near = [k for k in np.argsort(distance).tolist() if distance[k] <= self._gate]
        return next((pairs[k] for k in near if self._is_telling(d[k], S[k]) and self._may_be_one(*pairs[k])), None)

    def _variance(self, landmark_id: int) -> float:
        """Noise of a sighting, across or along its beam, whichever is larger, m²."""
        sighting = self._landmarks.any_sighting(landmark_id)
        return float(max(sighting.noise[0, 0], sighting.line.z[0] ** 2 * sighting.noise[1, 1]))

    def _is_telling(self, d: Floats, S: Floats) -> bool:
        level = S[:2, :2]
        log_det = float(np.linalg.slogdet(level)[1])
        return -0.5 * (float(d[:2] @ np.linalg.solve(level, d[:2])) + log_det) - math.log(2 * math.pi) > self._log_rival

    def _may_be_one(self, stays: int, goes: int) -> bool:
        """Whether no frame shows both, and all sightings of the one that goes can still be moved."""
        of_both = self._landmarks.stamps_ns(stays) & self._landmarks.stamps_ns(goes)
        return not of_both and not self._landmarks.is_rooted(goes)


def _differences(
    values: gtsam.Values, covariance: JointCovariance, pairs: list[tuple[int, int]]
) -> tuple[Floats, Floats]:
    """Difference of each pair and its covariance, shapes (k, 3) and (k, 3, 3)."""
    points = {i: values.atPoint3(L(i)) for i in {i for pair in pairs for i in pair}}
    rows = {i: covariance.rows[L(i)] + np.arange(3) for i in points}
    a, b = (np.array([rows[pair[side]] for pair in pairs]) for side in (0, 1))
    P = covariance.matrix
    S = sum(sign * P[i[:, :, None], j[:, None, :]] for sign, i, j in ((1, a, a), (1, b, b), (-1, a, b), (-1, b, a)))
    return np.array([points[i] - points[j] for i, j in pairs]), np.asarray(S)
