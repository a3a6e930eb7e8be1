"""Corrections of the invariant filter, and augmentation by a new landmark.

With H and H_m of `baselines.invariant_equations`, C the covariance of the motion since the state, R_z the sensor's::

    S = H P H^T + H_m C H_m^T + R_z                                                                           (8)

The gate and the elevation of a new landmark are those of `baselines.filter_inputs` and `baselines.sonar_update`; it
stands on the floor as in `baselines.ekf_landmarks`.
"""

from __future__ import annotations

import numpy as np

from baselines.filter_events import UP
from baselines.filter_inputs import (
    GATED,
    NEW,
    NO_SLOT,
    PASSED_OVER,
    USED,
    DetectionRow,
    Frame,
    Noise,
    SonarModel,
    is_inside_gate,
    sighting,
)
from baselines.invariant_equations import (
    BODY,
    POINT,
    InvariantState,
    correct,
    height_of_body_point,
    height_of_point,
    location,
    missed_up,
    motion_matrix,
    observation,
    put,
)
from baselines.sonar_update import by_range_and_azimuth, elevation_of_new, is_beyond_linear, noise_of_view, view_noise
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration import GapMotion
from sonar_graph.numerics import Vector, compiled, matrix, vector
from sonar_graph.slam.models import FLOOR_GATE, wrap_angle


@compiled
def observe_rows(state: InvariantState, motion: GapMotion, sonar: SonarModel, frame: Frame) -> InvariantState:
    """Take in the rows of a frame, a motion after the state, one after the other; what is new makes it larger."""
    outcomes = frame.told[0]
    for row in range(frame.first, frame.last):
        seen = sighting(frame, row, sonar)
        k = 1 + seen.slot
        if seen.slot == NO_SLOT:
            outcomes[row] = PASSED_OVER
        elif k == len(state.points):
            state = _augmented(state, motion, sonar, seen)
            outcomes[row] = NEW
        elif frame.was_lost:
            outcomes[row] = _observe_far(state, k, motion, sonar, seen)
        else:
            outcomes[row] = _observe(state, k, motion, sonar, seen)
    return state


@compiled
def _observe(state: InvariantState, k: int, motion: GapMotion, sonar: SonarModel, seen: DetectionRow) -> int:
    """Correct by a landmark that is in the state, where its innovation is inside the gate."""
    _, z, R_z, innovation, S = seen
    predicted, H, H_m = observation(state, k, motion, sonar)
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])
    cross_cov = H @ state.P
    S[:] = _symmetric(cross_cov @ H.T + _blur(H_m, motion) + _noise_matrix(R_z))
    if not is_inside_gate(seen, sonar):
        return GATED
    correct(state, cross_cov, S, innovation)
    return USED


@compiled
def _observe_far(state: InvariantState, k: int, motion: GapMotion, sonar: SonarModel, seen: DetectionRow) -> int:
    """Correct by a landmark that may be far from where it is predicted, inside the gate: `baselines.sonar_update`.

    ``Exp(theta)`` turns both points, so that the place where the landmark was seen less the one where it was predicted
    is ``J_r(theta) (xi_k - xi_new)``: no H of theta, however far they are apart.
    """
    _, z, R_z, innovation, S = seen
    point, G, G_m, G_z = location(state, motion, sonar, z, 0.0)
    missed, H, at = np.array(point) - state.points[k], -G, BODY + POINT * k
    for r in range(POINT):
        H[r, at + r] += 1.0
    cross_cov = H @ state.P
    cov = _symmetric(cross_cov @ H.T + _blur(G_m, motion))
    if not is_beyond_linear(cov, G_z, z[0], R_z):
        return int(_observe(state, k, motion, sonar, seen))
    cov += _symmetric(G_z @ view_noise(z[0], R_z, sonar.aperture_rad) @ G_z.T)
    B = by_range_and_azimuth(G_z, z[0])
    innovation[:], S[:] = B @ missed, _symmetric(B @ cov @ B.T)
    if not is_inside_gate(seen, sonar):
        return GATED
    correct(state, cross_cov, cov, missed)
    return USED


@compiled
def _augmented(state: InvariantState, motion: GapMotion, sonar: SonarModel, seen: DetectionRow) -> InvariantState:
    """The state with a landmark where it was seen."""
    elevation_rad = elevation_of_new(vector(state.points[0]), matrix(state.R), motion.integral, sonar, seen.z)
    point, G, G_m, G_z = location(state, motion, sonar, seen.z, elevation_rad)
    view = np.array(noise_of_view(seen.R_z, sonar.aperture_rad))
    n, cross_cov = len(state.P), G @ state.P
    points, P = np.empty((len(state.points) + 1, 3)), np.empty((n + POINT, n + POINT))
    points[:-1], P[:n, :n] = state.points, state.P
    put(points[-1], point)
    P[n:, :n], P[:n, n:] = cross_cov, cross_cov.T
    P[n:, n:] = _symmetric(cross_cov @ G.T + _blur(G_m, motion) + G_z @ view @ G_z.T)
    larger = InvariantState(state.R, points, state.bias, P)
    if sonar.has_floor:
        _stand_on_floor(larger, sonar)
    return larger


@compiled
def _stand_on_floor(state: InvariantState, sonar: SonarModel) -> None:
    """Correct the height of the newest landmark by the floor's, where it can stand there."""
    height_m, H = height_of_point(state, len(state.points) - 1)
    innovation, cross_cov = np.array([sonar.floor_z_m - height_m]), H @ state.P
    S = cross_cov @ H.T + sonar.floor_variance_m2
    if innovation[0] ** 2 <= FLOOR_GATE * S[0, 0]:
        correct(state, cross_cov, S, innovation)


@compiled
def correct_depth(
    state: InvariantState, motion: GapMotion, body_p_port: Vector, z_m: float, variance_m2: float
) -> None:
    """Correct by the height of the pressure port."""
    predicted, H, H_m = height_of_body_point(state, motion, body_p_port)
    cross_cov = H @ state.P
    correct(state, cross_cov, cross_cov @ H.T + _blur(H_m, motion) + variance_m2, np.array([z_m - predicted]))


@compiled
def correct_up(state: InvariantState, up: Vector, variance: float) -> None:
    """Correct by the direction of the world's up, measured in the body, with the variance of its tilt (rad²)."""
    missed, H = missed_up(state, up)
    cross_cov = H @ state.P
    correct(state, cross_cov, _symmetric(cross_cov @ H.T + variance * np.eye(2)), missed)


@compiled
def correct_plane(state: InvariantState, z_m: float, z_variance: float, tilt_variance: float) -> None:
    """Correct by a plane on which the vehicle stays: height and tilt."""
    height_m, H = height_of_point(state, 0)
    cross_cov = H @ state.P
    correct(state, cross_cov, cross_cov @ H.T + z_variance, np.array([z_m - height_m]))
    correct_up(state, UP, tilt_variance)


@compiled
def _blur(H_m: Floats, motion: GapMotion) -> Floats:
    """``H_m C H_m^T``."""
    return H_m @ motion_matrix(motion.integral) @ H_m.T


@compiled
def _noise_matrix(R_z: Noise) -> Floats:
    """Of range and azimuth, shape (2, 2)."""
    return np.array([[R_z[0], R_z[1]], [R_z[1], R_z[2]]])


@compiled
def _symmetric(A: Floats) -> Floats:
    """``(A + A^T) / 2``."""
    return 0.5 * (A + A.T)
