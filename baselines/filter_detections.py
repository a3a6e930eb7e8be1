"""Detections of landmarks in the compiled code of both filters: what comes in, what is said of each, and the gate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from baselines.filter_models import SonarModel
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.kernels import compiled, inlined

USED, NEW, GATED, PASSED_OVER = 0, 1, 2, 3
"""What became of a detection, in compiled code."""
NO_SLOT = -1
"""The place of a detection that is not to be used."""

DetectionColumns = tuple[Ints, Floats, Floats, Floats]
"""Place of each row's landmark in the state, the first unused one for a new landmark, or NO_SLOT (m,); range in m and
azimuth in rad (m,); their covariance (m, 2, 2), NaN where the log does not say."""
DetectionOutcomes = tuple[Ints, Floats, Floats]
"""USED, NEW, GATED or PASSED_OVER (m,); innovations (m, 2), their covariances (m, 2, 2): NaN without prediction."""
Noise = tuple[float, float, float]
"""Variance of the range, covariance, variance of the azimuth."""


class Frame(NamedTuple):
    """The detections of one instant, among those of a window."""

    detections: DetectionColumns
    first: int
    last: int
    """Rows from the first up to, without, the last."""
    told: DetectionOutcomes
    """Written at these rows."""
    was_lost: bool
    """Whether the Doppler log has lost the bottom: from then on views are linearised as in `baselines.far_views`, where
    it takes that."""


class Sighting(NamedTuple):
    """One detection, and where to write what was expected of it."""

    slot: int
    z: tuple[float, float]
    """Range in m and azimuth in rad."""
    R_z: Noise
    innovation: Floats
    """Shape (2,)."""
    S: Floats
    """Covariance of the innovation, shape (2, 2)."""


@compiled
def nothing_told(rows: int) -> DetectionOutcomes:
    """Room for what becomes of some detections."""
    return np.empty(rows, np.int64), np.full((rows, 2), np.nan), np.full((rows, 2, 2), np.nan)


@inlined
def sighting(frame: Frame, row: int, sonar: SonarModel) -> Sighting:
    """A row of a frame; its noise as logged, or the calibration's."""
    slots, range_m, azimuth_rad, noise = frame.detections
    z, R_z = (range_m[row], azimuth_rad[row]), _logged_noise(noise[row], sonar)
    return Sighting(slots[row], z, R_z, frame.told[1][row], frame.told[2][row])


@inlined
def _logged_noise(logged: Floats, sonar: SonarModel) -> Noise:
    if math.isnan(logged[0, 0] + logged[0, 1] + logged[1, 0] + logged[1, 1]):
        return sonar.range_variance_m2, 0.0, sonar.azimuth_variance
    return logged[0, 0], 0.5 * (logged[0, 1] + logged[1, 0]), logged[1, 1]


@inlined
def is_inside_gate(seen: Sighting, sonar: SonarModel) -> bool:
    """Whether ``e^T S^-1 e`` of the innovation written is no more than the gate."""
    e, S = seen.innovation, seen.S
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    squared = (S[1, 1] * e[0] * e[0] - (S[0, 1] + S[1, 0]) * e[0] * e[1] + S[0, 0] * e[1] * e[1]) / determinant
    return bool(squared <= sonar.gate)
