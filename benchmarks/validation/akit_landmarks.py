"""Landmarks simulated along A-KIT's reference: what they can correct, and how sure the estimators are of it.

Part of `akit`. Three things decide what is seen, and each is made visible:

* The start heading is drawn as wrong as its sigma says (0.03 rad). No landmark whose place is not known beforehand can
  tell it: it turns track and map together, and at 200 m from the start that is 6 m. The raw error is that of the
  heading, for every estimator; what landmarks do is in the error after SE(2) alignment and over 10 s. The NEES of the
  raw error still judges the whole covariance.
* The reference's positions are not the sum of its own velocities (`reference_wander`): they wander by centimetres a
  second, decimetres in turns, which no noise of the sensors covers. Landmarks are seen from the reference, so with the
  sensors' noise (0.01 m/s) an estimator believes its odometry more than the landmarks. With 0.05 m/s, what odometry
  errs by against the reference in 10 s, it does not.
* The tracks hardly ever return. Landmarks seen up to 40 m away are seen once, for 20 s: they correct the motion
  while they are in sight and leave the drift between. Seen up to 150 m away they are seen again and again.
"""

import math
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
from common import note
from scipy.interpolate import CubicSpline

from sonar_graph.evaluation import judge, run_estimator
from sonar_graph.logs.convert.akit import REFERENCE_COLUMNS
from sonar_graph.logs.convert.text_tables import read_table
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import LandmarkOptions, add_landmarks

ESTIMATORS: dict[str, tuple[str, dict[str, Any]]] = {
    "isam2": ("isam2", {}),
    "ekf-slam": ("ekf-slam", {}),
    "ekf-slam, gate": ("ekf-slam", {"gate_probability": 0.999}),
    "dead-reckoning": ("dead-reckoning", {}),
}
"""Estimator and settings by the name in the table. One identity in a hundred is wrong, which EKF-SLAM as published
takes for right."""
KINDS = ("causal", "smoothed")
MEASURES = ("ate_raw_m", "ate_se2_m", "rpe_10s_m", "nees_position", "nees_yaw")
SIGMA_AGAINST_REFERENCE_M_S = (0.05, 0.05, 0.025)
"""Noise of one Doppler sample a second that explains what dead reckoning errs by against the reference in 10 s."""
FAR = LandmarkOptions(
    spacing_m=100.0,
    side_min_m=15.0,
    side_max_m=60.0,
    range_max_m=150.0,
    azimuth_aperture_rad=radians(170),
    elevation_aperture_rad=radians(6),
)
UNSURE_START = (6,)
"""Runs that begin in a quick turn: the attitude interpolated there is off by more than its sigma."""
Scores = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Placing:
    """Placing and visibility of landmarks, and noise of the Doppler log (None: the sensor's)."""

    options: LandmarkOptions
    sigma_m_s: tuple[float, float, float] | None


PLACINGS = {
    "near, sensor's noise": Placing(LandmarkOptions(), None),
    "near": Placing(LandmarkOptions(), SIGMA_AGAINST_REFERENCE_M_S),
    "far": Placing(FAR, SIGMA_AGAINST_REFERENCE_M_S),
}


def slam(aligned: Sequence, seed: int) -> dict[str, Scores]:
    """Scores of all estimators in each placing, the start attitude drawn as wrong as its sigmas say."""
    start = aligned.calibration.start
    drawn = np.array(start.rpy_rad) + np.array(
        start.rpy_sigma_rad
    ) * np.random.default_rng(seed).standard_normal(3)
    wrong = start.model_copy(update={"rpy_rad": tuple(drawn.tolist())})
    return {
        name: _scores(aligned, placing, wrong) for name, placing in PLACINGS.items()
    }


def _scores(aligned: Sequence, placing: Placing, start: Any) -> Scores:
    """Each estimator's, asked at the reference's own instants: nothing is interpolated. NaN of one that failed."""
    placed = add_landmarks(aligned, placing.options)
    changes: dict[str, Any] = {"start": start}
    if placing.sigma_m_s is not None:
        changes["dvl"] = placed.calibration.dvl.model_copy(
            update={"velocity_sigma_m_s": placing.sigma_m_s}
        )
    sequence = replace(
        placed, calibration=placed.calibration.model_copy(update=changes)
    )
    assert sequence.truth is not None
    stamps_ns = sequence.truth.stamps_ns
    stamps_ns = stamps_ns[
        (stamps_ns > sequence.start_ns) & (stamps_ns <= sequence.end_ns)
    ]
    runs = [
        replace(
            run_estimator(sequence, name, settings, instants_ns=stamps_ns),
            estimator=shown,
        )
        for shown, (name, settings) in ESTIMATORS.items()
    ]
    for result in runs:
        if result.status == "failed":
            note(f"{aligned.name}: {result.estimator}: {result.reason}")
    scores = judge(sequence, stamps_ns, runs).scores
    return {
        result.estimator: {
            name: math.nan
            if result.status == "failed"
            else scores[result.estimator][name].value
            for name in (f"{kind}.{measure}" for kind in KINDS for measure in MEASURES)
        }
        for result in runs
    }


def sightings(aligned: Sequence) -> dict[str, tuple[float, float]]:
    """Median number of detections of a landmark, and seconds from first to last, for each placing."""
    return {
        name: _sightings(add_landmarks(aligned, placing.options))
        for name, placing in PLACINGS.items()
    }


def _sightings(placed: Sequence) -> tuple[float, float]:
    assert placed.detections is not None
    ids, probability = placed.detections.most_probable()
    sure = probability > 0.5
    ids, seconds = ids[sure], placed.detections.stamps_ns[sure] * 1e-9
    seen = [seconds[ids == identity] for identity in np.unique(ids)]
    return float(np.median([len(times) for times in seen])), float(
        np.median([np.ptp(times) for times in seen])
    )


def reference_wander(
    folder: Path, number: int, positions: Floats
) -> tuple[float, float]:
    """Difference of the reference's positions from the sum of its velocities: rms over one second, and maximum.

    Horizontal, metres. Velocities are integrated along cubic splines, row by row. The sequence may lack the first
    rows of the file, those before its IMU began.
    """
    path = folder / f"Trajectory{number}" / f"GT_trajectory{number}.csv"
    north, east = (
        read_table(path, REFERENCE_COLUMNS, delimiter=",")
        .values[-len(positions) :, 4:6]
        .T
    )
    seconds = np.arange(len(positions), dtype=float)
    summed = CubicSpline(seconds, np.column_stack([east, north])).antiderivative()(
        seconds
    )
    wander = positions[:, :2] - summed
    wander -= wander[0]
    return float(np.sqrt(np.mean(np.sum(np.diff(wander, axis=0) ** 2, axis=1)))), float(
        np.linalg.norm(wander, axis=1).max()
    )
