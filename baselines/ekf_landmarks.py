"""Landmarks that EKF-SLAM sees again: the paper's observation (6) and innovation (7).

All happens at the instant of a frame, which lies a provisional motion (dR, dp, cov) after the state. For a landmark at
p_n in the axes of the state's body, with n as in `baselines.sonar_views` and row(n, s) of `baselines.ekf_derivatives`::

    z     = h(x_v, p)                                     (6)  range and azimuth, `sonar_graph.slam.models.project`
    e     = z_measured - z, azimuth wrapped               (7)
    H_v | H_m = row(-n, p_n),   H_p = (R n)^T             for n of range and azimuth each
    S     = H P H^T + R_z + H_m cov H_m^T
"""

from __future__ import annotations

import numpy as np

from baselines.ekf_augmentation import augment, location
from baselines.ekf_derivatives import (
    Moment,
    Row,
    add_covariances,
    moment_after,
    motion_covariance,
    row_along,
)
from baselines.ekf_state import LANDMARK, POSE, correct_by, correct_pair
from baselines.far_views import by_range_and_azimuth, is_beyond_linear, view_noise
from baselines.filter_detections import (
    GATED,
    NEW,
    NO_SLOT,
    PASSED_OVER,
    USED,
    Frame,
    Sighting,
    is_inside_gate,
    sighting,
)
from baselines.filter_models import SonarModel
from baselines.sonar_views import predicted_view
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.recursion import Integral
from sonar_graph.navigation.triples import Vector, dot, minus, scaled, vector
from sonar_graph.slam.models import wrap_angle


@compiled
def observe_rows(x: Floats, P: Floats, n: int, motion: Integral, sonar: SonarModel, frame: Frame) -> int:
    """Take in the rows of a frame, a motion after the state, one after the other; returns the state's length."""
    outcomes = frame.told[0]
    for row in range(frame.first, frame.last):
        seen, moment = sighting(frame, row, sonar), moment_after(x, motion)
        at = POSE + LANDMARK * seen.slot
        if seen.slot == NO_SLOT:
            outcomes[row] = PASSED_OVER
        elif at >= n:
            augment(x, P, n, moment, sonar, seen)
            n += LANDMARK
            outcomes[row] = NEW
        elif frame.was_lost:
            outcomes[row] = _observe_far(x, P, n, at, moment, sonar, seen)
        else:
            outcomes[row] = _observe(x, P, n, at, moment, sonar, seen)
    return n


@compiled
def observation(moment: Moment, p: Vector, sonar: SonarModel) -> tuple[Floats, Row, Row]:
    """(6): predicted range and azimuth (2,), and ``H_v | H_m`` of each; ``H_p`` is the opposite of its ``by_X``."""
    z, p_n, by_range, by_azimuth = predicted_view(moment.X, moment.R, moment.motion, sonar, p)
    return z, row_along(moment, scaled(-1.0, by_range), p_n), row_along(moment, scaled(-1.0, by_azimuth), p_n)


@inlined
def _observe(x: Floats, P: Floats, n: int, at: int, moment: Moment, sonar: SonarModel, seen: Sighting) -> int:
    """Correct by a landmark that is in the state, where its innovation is inside the gate."""
    predicted, by_range, by_azimuth = observation(moment, vector(x[at:]), sonar)
    _, z, R_z, innovation, S = seen
    innovation[0], innovation[1] = z[0] - predicted[0], wrap_angle(z[1] - predicted[1])  # (7)
    U = np.zeros((2, n))
    _add_row_covariances(P, n, at, by_range, U[0])
    _add_row_covariances(P, n, at, by_azimuth, U[1])
    motion = moment.motion
    S[0, 0] = _variance_share(U[0], at, by_range) + R_z[0] + motion_covariance(motion, by_range, by_range)
    S[0, 1] = _variance_share(U[0], at, by_azimuth) + R_z[1] + motion_covariance(motion, by_range, by_azimuth)
    S[1, 1] = _variance_share(U[1], at, by_azimuth) + R_z[2] + motion_covariance(motion, by_azimuth, by_azimuth)
    S[1, 0] = S[0, 1]
    if not is_inside_gate(seen, sonar):
        return GATED
    correct_pair(x, P, n, U, S, innovation)
    return USED


@compiled
def _observe_far(x: Floats, P: Floats, n: int, at: int, moment: Moment, sonar: SonarModel, seen: Sighting) -> int:
    """Correct by a landmark that may be far from where it is predicted, inside the gate: `baselines.far_views`."""
    _, z, R_z, innovation, S = seen
    point, G, by_view = location(moment, sonar, z, 0.0)
    G_z = np.array(by_view)
    U, cov, missed = np.empty((LANDMARK, n)), np.empty((LANDMARK, LANDMARK)), np.empty(LANDMARK)
    for r in range(LANDMARK):
        missed[r], U[r] = point[r] - x[at + r], P[at + r, :n]
        add_covariances(P, n, 0, scaled(-1.0, G[r].by_X), U[r])
        add_covariances(P, n, 3, scaled(-1.0, G[r].by_angles), U[r])
    for r in range(LANDMARK):
        for c in range(r + 1):
            share = dot(G[c].by_X, vector(U[r])) + dot(G[c].by_angles, vector(U[r, 3:]))
            cov[r, c] = cov[c, r] = U[r, at + c] - share + motion_covariance(moment.motion, G[r], G[c])
    if not is_beyond_linear(cov, G_z, z[0], R_z):
        return int(_observe(x, P, n, at, moment, sonar, seen))
    cov += G_z @ view_noise(z[0], R_z, sonar.aperture_rad) @ G_z.T
    B = by_range_and_azimuth(G_z, z[0])
    innovation[:], S[:] = B @ missed, B @ cov @ B.T
    if not is_inside_gate(seen, sonar):
        return GATED
    correct_by(x, P, n, U, cov, missed)
    return USED


@inlined
def _add_row_covariances(P: Floats, n: int, at: int, row: Row, out: Floats) -> None:
    """``out += H P`` for a row of H with a landmark, shape (n,): only columns of pose and landmark are not zero."""
    add_covariances(P, n, 0, row.by_X, out)
    add_covariances(P, n, 3, row.by_angles, out)
    add_covariances(P, n, at, scaled(-1.0, row.by_X), out)


@inlined
def _variance_share(U: Floats, at: int, row: Row) -> float:
    """``U H^T`` for a row of H with a landmark."""
    return dot(row.by_X, minus(vector(U), vector(U[at:]))) + dot(row.by_angles, vector(U[3:]))
