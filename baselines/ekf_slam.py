"""EKF-SLAM as published, in its textbook form: the baseline that a smoother has to beat.

EKF-SLAM over a window of measurements, in one compiled call: what each event of `baselines.filter_events` does.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from baselines.ekf_equations import LANDMARK, POSE, advance_to_node, correct_depth, pose_after
from baselines.ekf_landmarks import observe_rows
from baselines.filter import FilterShell
from baselines.filter_events import (
    BEFORE_ALL,
    DEPTH,
    FRAME,
    NODE,
    NODE_REACHED,
    GravityInterval,
    MeasurementWindow,
    PoseArrays,
    WindowValues,
    depth_sample,
    frame_at,
    next_event,
    stamps_of,
)
from baselines.filter_inputs import DetectionOutcomes, FilterParams, SonarModel, VehicleModel, nothing_told
from baselines.filter_motion import inflate_shared_motion, motion_since_node, motion_to_node, nothing_running
from sonar_graph.calibration import Calibration, Section, Start
from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.numerics import compiled, euler_from_rates, euler_from_rotation, matrix, vector


@compiled
def process_window(x: Floats, P: Floats, n: int, values: WindowValues) -> tuple[int, DetectionOutcomes, PoseArrays]:
    """Bring the state to the newest node reached at the window's end, with all that was measured on the way.

    Parameters
    ----------
    x, P, n
        Filter state; changed. With room for all landmarks of the window.
    values
        Fields of a `MeasurementWindow`.

    Returns
    -------
    Length of the state, what became of the detections, and the pose at the window's end.
    """
    window = MeasurementWindow(*values)
    columns, clock, interval = window.columns, window.clock, GravityInterval(*window.interval)
    vehicle, sonar = VehicleModel(*window.vehicle), SonarModel(*window.sonar)
    stamps, told, event, running = stamps_of(window), nothing_told(len(window.frame_ns)), BEFORE_ALL, nothing_running()
    while True:
        event = next_event(stamps, clock, vehicle.gap[0], event)
        if event.kind == NODE_REACHED:
            motion = motion_to_node(columns, vehicle, x, clock[NODE], event.stamp_ns)
            advance_to_node(columns, vehicle, x, P, n, clock, interval, event.stamp_ns, motion)
            continue
        running, motion = motion_since_node(columns, vehicle, x, running, clock[NODE], event.stamp_ns)
        if event.times_told > 0:
            motion = inflate_shared_motion(motion, event.times_told)
        if event.kind == DEPTH:
            z_m, variance_m2 = depth_sample(window.depth, event, vehicle)
            correct_depth(x, P, n, motion, vehicle.body_p_port, z_m, variance_m2)
        elif event.kind == FRAME:
            n = observe_rows(x, P, n, motion, sonar, frame_at(window.detections, event, told, clock))
        else:
            return n, told, pose_after(x, P, motion)


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
    Underwater Localization Using Landmarks". Equations: `baselines.ekf_equations`, `baselines.ekf_landmarks`,
    `baselines.ekf_landmarks`, `baselines.ekf_equations`. Derivation: docs/theory/ekf_slam.md.

    What the paper leaves open, and how it is settled here:

    - Prediction runs from one DVL stamp to the next, over the same steps as every other estimator's
      (`sonar_graph.navigation.odometry`); attitude is integrated exactly for a constant rate, Q is the covariance of
      the integrated gyro and Doppler noise, lever arms included.
    - There is no gyro bias in the state (4). Its drift is not in the covariance either: with a biased gyro this filter
      trusts its heading too much, and gates true detections sooner or later.
    - While the Doppler log has no bottom lock the prediction is that of
    `sonar_graph.navigation.preintegration.dvl_gaps`, common to
      all estimators; only there Q holds the gyro bias, which tilts gravity. The state does not grow: what is measured
      in a gap is related to the state before it, ever more weakly (`baselines.filter_motion.inflate_shared_motion`).
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

    def run(self, window: MeasurementWindow) -> tuple[DetectionOutcomes, PoseArrays]:
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
