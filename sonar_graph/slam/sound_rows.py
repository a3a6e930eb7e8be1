"""Rows that can be measurements at all: variances above zero, covariances positive definite, ranges that can be.

A block of measurements checks shapes, order and that numbers are finite (`sonar_graph.measurements`). What is checked
here depends on what a number means. NaN is sound: it says that the log does not know, and the calibration does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonar_graph.detection_rules import possible_ranges
from sonar_graph.measurements import Depth, Dvl, Floats, LandmarkDetections
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.velocity_covariances import in_numbers
from sonar_graph.slam.association import DetectionJournal
from sonar_graph.states import Outcome

ROUNDING = 1e-13
"""Share of the largest variance below which what is left of another is taken for zero."""

Flags = NDArray[np.bool_]


def sound_detections(frame: LandmarkDetections) -> Flags:
    """Shape (n,)."""
    unsaid = np.asarray(np.isnan(frame.range_azimuth_cov).any(axis=(1, 2)))
    return possible_ranges(frame.range_m) & (unsaid | positive_definite(frame.range_azimuth_cov))


def without_unsound(frame: LandmarkDetections, journal: DetectionJournal) -> LandmarkDetections | None:
    """A frame without what no sonar can have measured, which goes to the journal; None: nothing is left."""
    is_sound = sound_detections(frame)
    if is_sound.all():
        return frame
    for landmark_id in frame.most_probable()[0][~is_sound].tolist():
        journal.record(int(frame.stamps_ns[0]), landmark_id, Outcome.UNSOUND)
    return frame.rows(is_sound) if is_sound.any() else None


def sound_velocities(dvl: Dvl) -> Flags:
    """Shape (n,). An infinite variance is sound: of an axis that was not measured."""
    return positive_definite(in_numbers(dvl.velocity_cov, np.eye(3)))


def sound_depths(depth: Depth) -> Flags:
    """Shape (n,)."""
    variance = np.where(np.isnan(depth.variance_m2), 1.0, depth.variance_m2)
    return (variance > 0) & np.isfinite(variance)


@compiled
def positive_definite(covs: Floats) -> Flags:
    """Which of some symmetric matrices, shape (n, k, k), are finite and positive definite: Cholesky takes them."""
    n, k = covs.shape[:2]
    found = np.ones(n, np.bool_)
    for row in range(n):
        L, largest = np.zeros((k, k)), 0.0
        for i in range(k):
            largest = max(largest, covs[row, i, i])
        for i in range(k):
            for j in range(i + 1):
                rest = covs[row, i, j]
                for m in range(j):
                    rest -= L[i, m] * L[j, m]
                if i > j:
                    L[i, j] = rest / L[j, j]
                elif rest > ROUNDING * largest and rest < np.inf:
                    L[i, i] = np.sqrt(rest)
                else:  # NaN ends here too
                    found[row] = False
                    L[i, i] = 1.0
    return found
