"""Corrections of the invariant filter, and augmentation by a new landmark.

With H and H_m of `baselines.invariant_models`, C the covariance of the motion since the state, R_z the sensor's::

    S = H P H^T + H_m C H_m^T + R_z                                                                           (8)

Gates, the elevation of a new landmark and when it stands on the floor are as in `baselines.ekf_landmarks`.
"""

from __future__ import annotations

import numpy as np

from baselines.ekf_landmarks import (
    GATED,
    NEW,
    NO_SLOT,
    PASSED_OVER,
    USED,
    DetectionColumns,
    Noise,
    SonarModel,
    logged_noise,
    squared_distance,
)
from baselines.far_views import by_range_and_azimuth, is_beyond_linear, view_noise
from baselines.invariant_models import (
    height_of_body_point,
    height_of_point,
    location,
    missed_up,
    observation,
)
from baselines.invariant_state import BODY, POINT, InvariantState, correct, motion_matrix, put
from sonar_graph.measurements import Floats, Ints
from sonar_graph.navigation.gap_motion import GapMotion
from sonar_graph.navigation.kernels import compiled
from sonar_graph.navigation.triples import Vector, matrix, product, transformed, vector
from sonar_graph.slam.models import FLOOR_GATE, floor_elevation, wrap_angle


@compiled
def observe_rows(
    state: InvariantState,
    motion: GapMotion,
    sonar: SonarModel,
    detections: DetectionColumns,
    first: int,
    last: int,
    outcomes: Ints,
    innovations: Floats,
    covs: Floats,
    was_lost: bool = False,
) -> InvariantState:
    """Take in some rows, all of one instant, one after the other.

    Parameters
    ----------
    motion
        From the state to that instant.
    first, last
        Rows from the first up to, without, the last.
    outcomes, innovations, covs
        Written: USED, NEW, GATED or PASSED_OVER, shape (m,); innovations (m, 2) and their covariances (m, 2, 2), which
        stay as they are where nothing is predicted.
    was_lost
        Whether the Doppler log has lost the bottom: from then on views are linearised as in `baselines.far_views`,
        where it takes that.

    Returns
    -------
    The state, larger by what was new.
    """
    slots, range_m, azimuth_rad, noise = detections
    for row in range(first, last):
        z, R_z = (range_m[row], azimuth_rad[row]), logged_noise(noise[row], sonar)
        k = 1 + slots[row]
        if slots[row] == NO_SLOT:
            outcomes[row] = PASSED_OVER
        elif k == len(state.points):
            state = _augmented(state, motion, sonar, z, R_z)
            outcomes[row] = NEW
        elif was_lost:
            outcomes[row] = _observe_far(state, k, motion, sonar, z, R_z, innovations[row], covs[row])
        else:
            outcomes[row] = _observe(state, k, motion, sonar, z, R_z, innovations[row], covs[row])
    return state


@compiled
def _observe(
    state: InvariantState,
    k: int,
    motion: GapMotion,
    sonar: SonarModel,
    z: tuple[float, float],
    R_z: Noise,
    innovation: Floats,
    S: Floats,
) -> int:
    """Correct by a landmark that is in the state, where its innovation is inside the gate."""
    predicted, H, H_m = observation(state, k, motion, sonar)
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])
    cross_cov = H @ state.P
    S[:] = _symmetric(cross_cov @ H.T + _blur(H_m, motion) + _noise_matrix(R_z))
    if not squared_distance(innovation, S) <= sonar.gate:
        return GATED
    correct(state, cross_cov, S, innovation)
    return USED


@compiled
def _observe_far(
    state: InvariantState,
    k: int,
    motion: GapMotion,
    sonar: SonarModel,
    z: tuple[float, float],
    R_z: Noise,
    innovation: Floats,
    S: Floats,
) -> int:
    """Correct by a landmark that may be far from where it is predicted, inside the gate: `baselines.far_views`.

    ``Exp(theta)`` turns both points, so that the place where the landmark was seen less the one where it was predicted
    is ``J_r(theta) (xi_k - xi_new)``: no H of theta, however far they are apart.
    """
    point, G, G_m, G_z = location(state, motion, sonar, z, 0.0)
    missed, H, at = np.array(point) - state.points[k], -G, BODY + POINT * k
    for r in range(POINT):
        H[r, at + r] += 1.0
    cross_cov = H @ state.P
    cov = _symmetric(cross_cov @ H.T + _blur(G_m, motion))
    if not is_beyond_linear(cov, G_z, z[0], R_z):
        return int(_observe(state, k, motion, sonar, z, R_z, innovation, S))
    cov += _symmetric(G_z @ view_noise(z[0], R_z, sonar.aperture_rad) @ G_z.T)
    B = by_range_and_azimuth(G_z, z[0])
    innovation[:], S[:] = B @ missed, _symmetric(B @ cov @ B.T)
    if not squared_distance(innovation, S) <= sonar.gate:
        return GATED
    correct(state, cross_cov, cov, missed)
    return USED


@compiled
def _augmented(
    state: InvariantState, motion: GapMotion, sonar: SonarModel, z: tuple[float, float], R_z: Noise
) -> InvariantState:
    """The state with a landmark where it was seen; its elevation from the floor where there is one, else zero."""
    point, G, G_m, G_z = location(state, motion, sonar, z, _elevation(state, motion, sonar, z))
    view = np.zeros((3, 3))
    view[:2, :2] = _noise_matrix(R_z)
    view[2, 2] = sonar.aperture_rad**2 / 12.0
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
def _elevation(state: InvariantState, motion: GapMotion, sonar: SonarModel, z: tuple[float, float]) -> float:
    """Elevation on the floor; 0 without one, or where it is outside the aperture."""
    if not sonar.has_floor:
        return 0.0
    dR, dp = motion.integral.dR, motion.integral.dp
    node_p_sonar, R = transformed(dp, dR, sonar.body_p_sonar), matrix(state.R)
    world_R_sonar = product(product(R, dR), sonar.body_R_sonar)
    height_m = sonar.floor_z_m - transformed(vector(state.points[0]), R, node_p_sonar)[2]
    elevation = floor_elevation(np.array(world_R_sonar[2]), height_m, z[0], z[1], sonar.aperture_rad)
    return 0.0 if np.isnan(elevation) else elevation


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
    correct_up(state, (0.0, 0.0, 1.0), tilt_variance)


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
