"""Rows that can be measurements at all: variances above zero, covariances positive definite, ranges above zero.

A block of measurements checks shapes, order and that numbers are finite (`sonar_graph.measurements`). What is checked
here depends on what a number means. NaN is sound: it says that the log does not know, and the calibration does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Depth, Dvl, Floats, LandmarkDetections
from sonar_graph.navigation.velocity_covariances import in_numbers
from sonar_graph.slam.association import DetectionJournal
from sonar_graph.states import Outcome

ROUNDING = 1e-15
"""Share of the largest eigenvalue below which the smallest is taken for zero."""

Flags = NDArray[np.bool_]


def sound_detections(frame: LandmarkDetections) -> Flags:
    """Shape (n,)."""
    said = np.asarray(~np.isnan(frame.range_azimuth_cov).any(axis=(1, 2)))
    covs = np.where(said[:, None, None], frame.range_azimuth_cov, np.eye(2))
    return (frame.range_m > 0) & positive_definite(covs)


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


def positive_definite(covs: Floats) -> Flags:
    """Which of some symmetric matrices, shape (n, k, k), are finite and positive definite."""
    finite = np.asarray(np.isfinite(covs).all(axis=(1, 2)))
    eigenvalues = np.linalg.eigvalsh(np.where(finite[:, None, None], covs, 0.0))
    return np.asarray(finite & (eigenvalues[:, 0] > ROUNDING * eigenvalues[:, -1]))
