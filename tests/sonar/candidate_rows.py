"""Candidates and frames made by hand."""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.sonar.regions import Candidates, CandidateVerdict

RANGES_M = 1.26 + (np.arange(512) + 0.5) * 1.25 / 512
AZIMUTHS_RAD = np.radians(np.linspace(14.25, -14.25, 96))
WINDOW = np.array([[1.26, 2.51], [-0.25, 0.25]])


def candidates_at(range_m: list[float], azimuth_rad: list[float], rejected: tuple[int, ...] = ()) -> Candidates:
    """Candidates with these positions and an elevation known to 0.07 rad."""
    n = len(range_m)
    verdicts = np.zeros(n, dtype=np.int64)
    verdicts[list(rejected)] = CandidateVerdict.TOO_SMALL
    zero = np.zeros(n)
    return Candidates(
        points_m=np.zeros((n, 3)),
        verdicts=verdicts,
        range_m=np.array(range_m, dtype=float),
        azimuth_rad=np.array(azimuth_rad, dtype=float),
        elevation_rad=zero,
        elevation_sigma_rad=zero + 0.07,
        area_m2=zero,
        extent_m=zero,
        level_db=zero,
        boxes=np.zeros((n, 4), dtype=np.int64),
        window=WINDOW,
        labels=np.zeros((2, 2), dtype=np.int32),
    )


def speckle_db(seed: int, level_db: float | Floats = 30.0, shape: tuple[int, int] = (96, 512)) -> Floats:
    """One-look speckle: 10 log10 of an exponential variable."""
    return level_db + 10 * np.log10(np.random.default_rng(seed).exponential(size=shape))
