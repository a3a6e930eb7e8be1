"""Are identity posteriors as sure as they are right? Judged against the true landmarks.

A detection is of the true landmark that lies nearest to it, if that is within 15 cm, and of none if all are farther
than 40 cm; those in between are left out. Its confidence is the posterior of its most probable class, "none of them"
included. With n_b of n detections in bin b of confidence,

    ECE = sum_b n_b / n | mean confidence of b - share of right ones in b |

(Naeini et al., AAAI 2015). Detections of one pass depend on each other: the number tells little about few passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_graph.measurements import Floats, Ints, LandmarkDetections
from sonar_graph.sequence import Sequence

BINS = 10
SAME_M, APART_M = 0.15, 0.40
NONE, UNJUDGED = -1, -2


@dataclass(frozen=True, eq=False)
class Reliability:
    """Confidence and truth by bins of equal width from 0 to 1."""

    count: Ints
    """Detections in each bin, shape (10,)."""
    confidence: Floats
    """Their mean confidence; NaN in an empty bin."""
    right: Floats
    """Share of them whose class is right; NaN in an empty bin."""

    @property
    def expected_error(self) -> float:
        """The expected calibration error."""
        return float(np.nansum(self.count * np.abs(self.confidence - self.right)) / max(self.count.sum(), 1))


def reliability(confidence: Floats, right: Floats) -> Reliability:
    """Bins of detections, shape (n,) each."""
    row = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(row, minlength=BINS)
    some = np.maximum(count, 1)
    means = [np.where(count > 0, np.bincount(row, v, BINS) / some, np.nan) for v in (confidence, right)]
    return Reliability(count, *means)


def reliability_of(sequence: Sequence) -> Reliability | None:
    """Of a sequence's detections; None without them, truth, or any that can be judged."""
    if sequence.detections is None or sequence.truth is None or sequence.true_landmarks is None:
        return None
    labels = true_identities(sequence, sequence.detections)
    judged = labels != UNJUDGED
    if not judged.any():
        return None
    confidence, named = confidences(sequence.detections)
    return reliability(confidence[judged], (named == labels)[judged].astype(float))


def confidences(detections: LandmarkDetections) -> tuple[Floats, Ints]:
    """Posterior of the most probable class and that class, -1 for none of them, shapes (n,)."""
    ids, probability = detections.most_probable()
    none = 1.0 - detections.id_probability.sum(axis=1)
    return np.maximum(probability, none), np.where(none > probability, NONE, ids)


def true_identities(sequence: Sequence, detections: LandmarkDetections) -> Ints:
    """The true class of each detection; -1: none, -2: cannot be told. Shape (n,)."""
    assert sequence.truth is not None
    assert sequence.true_landmarks is not None
    truth, landmarks = sequence.truth, sequence.true_landmarks
    labels = np.full(len(detections), UNJUDGED)
    within = (detections.stamps_ns >= truth.stamps_ns[0]) & (detections.stamps_ns <= truth.stamps_ns[-1])
    stamps_ns, frame = np.unique(detections.stamps_ns[within], return_inverse=True)
    if not len(stamps_ns):
        return labels
    poses = truth.at(stamps_ns)
    world_R_body, mounting = poses.matrices, sequence.calibration.sonar.mounting.pose()
    origin = poses.positions + world_R_body @ mounting.translation()
    from_sonar = landmarks.positions[None] - origin[:, None]
    q = np.einsum("nji,nmj->nmi", world_R_body @ mounting.rotation().matrix(), from_sonar)[frame]
    off_azimuth = np.arctan2(q[..., 1], q[..., 0]) - detections.azimuth_rad[within, None]
    off_range = np.linalg.norm(q, axis=2) - detections.range_m[within, None]
    off = np.hypot(off_range, detections.range_m[within, None] * 2 * np.sin(off_azimuth / 2))
    nearest = off.min(axis=1)
    found = np.where(nearest <= SAME_M, landmarks.ids[off.argmin(axis=1)], UNJUDGED)
    labels[within] = np.where(nearest > APART_M, NONE, found)
    return labels
