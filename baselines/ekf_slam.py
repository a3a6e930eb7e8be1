"""EKF-SLAM as published, in its textbook form: the baseline that a smoother has to beat."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from baselines.ekf_state import LANDMARK, POSE
from baselines.ekf_window import process_window
from baselines.euler import euler_from_rates, euler_from_rotation
from baselines.filter_clock import NODE
from baselines.filter_detections import DetectionOutcomes
from baselines.filter_events import PoseArrays, Window
from baselines.filter_models import FilterParams
from baselines.filter_shell import FilterShell
from sonar_graph.calibration import Calibration, Section, Start
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.navigation.triples import matrix, vector

ROOM = 8
"""Landmarks that the first arrays have room for; doubled when needed."""
SINGULAR_COSINE = 1e-3
"""Below this cosine of the pitch the Euler angles are useless."""


class EkfSlamParams(FilterParams):
    """Settings of EKF-SLAM; the paper gives none of them."""


class EkfSlam(FilterShell):
    """Extended Kalman filter over pose and landmarks.

    State (4) and covariance (5), prediction by gyros and Doppler log, observation (6) and innovation (7) of range and
    azimuth, augmentation at first sight; the numbers are those of "Experimental Results of Real-time Sonar-based
    Underwater Localization Using Landmarks". Equations: `baselines.ekf_state`, `baselines.ekf_landmarks`,
    `baselines.ekf_augmentation`, `baselines.ekf_prediction`. Derivation: docs/theory/ekf_slam.md.

    What the paper leaves open, and how it is settled here:

    - Prediction runs from one DVL stamp to the next, over the same steps as every other estimator's
      (`sonar_graph.navigation.odometry`); attitude is integrated exactly for a constant rate, Q is the covariance of
      the integrated gyro and Doppler noise, lever arms included.
    - There is no gyro bias in the state (4). Its drift is not in the covariance either: with a biased gyro this filter
      trusts its heading too much, and gates true detections sooner or later.
    - While the Doppler log has no bottom lock the prediction is that of `sonar_graph.navigation.gap_motion`, common to
      all estimators; only there Q holds the gyro bias, which tilts gravity. The state does not grow: what is measured
      in a gap is related to the state before it, ever more weakly (`baselines.ekf_motion.told_again`).
    - A new landmark's elevation comes from the floor where its height is known, else it is 0; its sigma is the
      aperture over sqrt(12). A known floor enters once for each landmark, as a measurement of its height.
    - Identities need a posterior, innovations a gate (`EkfSlamParams`). A refused detection changes nothing.
    - Depth, the direction of gravity and planar motion, where the calibration has them, are further corrections;
      none is gated. Gravity's sigma is widened for the bias that successive directions share.
    - Several detections of one frame are taken one after the other, in the order of their rows.
    - Corrections are ``P - K S K^T`` in a form that stays symmetric, the Jacobians are taken once (no iteration).

    Parameters
    ----------
    calibration
        Noise, mountings, start, floor.
    params
        None: the defaults.
    """

    Params: ClassVar[type[Section]] = EkfSlamParams

    def __init__(self, calibration: Calibration, params: EkfSlamParams | None = None) -> None:
        self._filter = EkfFilter(calibration.start)
        super().__init__(calibration, params or EkfSlamParams(), self._filter)

    def state(self) -> tuple[int, Floats, Floats]:
        """Stamp (ns), x of equation (4) and P of (5) at the newest node; copies."""
        return self.node_ns, *self._filter.state()


class EkfFilter:
    """State and covariance of EKF-SLAM from one window to the next, in arrays with room for more landmarks.

    Parameters
    ----------
    start
        Mean and covariance at the first node.
    """

    def __init__(self, start: Start) -> None:
        self._x, self._P = start_state(start)
        self._n = POSE

    def run(self, window: Window) -> tuple[DetectionOutcomes, PoseArrays]:
        """Bring the state to the newest node reached at the window's end.

        Raises
        ------
        EstimatorError
            When the pitch comes so near 90 degrees that the Euler angles are singular.
        """
        self._make_room(window.detections[0].tolist())
        self._n, outcomes, pose = process_window(self._x, self._P, self._n, (*window,))
        if math.cos(self._x[4]) < SINGULAR_COSINE:
            raise EstimatorError(
                f"ekf-slam: pitch is {math.degrees(self._x[4]):.2f} deg at {window.clock[NODE]} ns, where the Euler"
                " angles of its state are singular; use isam2 for this log"
            )
        return outcomes, pose

    def landmark(self, slot: int) -> tuple[Floats, Floats]:
        """Position, and block of (5)."""
        block = slice(POSE + LANDMARK * slot, POSE + LANDMARK * (slot + 1))
        return self._x[block], self._P[block, block]

    def state(self) -> tuple[Floats, Floats]:
        """Copies of x and P, without the spare room."""
        n = self._n
        return self._x[:n].copy(), self._P[:n, :n].copy()

    def _make_room(self, slots: list[int]) -> None:
        """For all landmarks that are seen."""
        needed, room = POSE + LANDMARK * (1 + max(slots, default=-1)), len(self._x)
        if needed <= room:
            return
        grown = max(2 * room, needed)
        x, P = np.zeros(grown), np.zeros((grown, grown))
        x[:room], P[:room, :room] = self._x, self._P
        self._x, self._P = x, P


def start_state(start: Start) -> tuple[Floats, Floats]:
    """State and covariance of the start pose: world axes for position, small body rotations for attitude."""
    room = POSE + LANDMARK * ROOM
    x, P = np.zeros(room), np.zeros((room, room))
    x[:3] = start.position_m
    x[3:POSE] = euler_from_rotation(matrix(start.pose().rotation().matrix()))
    E = np.array(euler_from_rates(vector(x[3:])))
    P[:3, :3] = np.diag(np.square(start.position_sigma_m))
    P[3:POSE, 3:POSE] = E @ np.diag(np.square(start.rpy_sigma_rad)) @ E.T
    return x, P
