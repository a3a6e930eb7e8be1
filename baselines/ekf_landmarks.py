"""Landmarks that EKF-SLAM sees again: the paper's observation (6) and innovation (7).

All happens at the instant of a frame, which lies a provisional motion (dR, dp, cov) after the state. For a landmark at
p_n in the axes of the state's body, with n as in `baselines.sonar_update` and row(n, s) of `baselines.ekf_equations`::

    z     = h(x_v, p)                                     (6)  range and azimuth,
    `sonar_graph.slam.models.sonar_model.project`
    e     = z_measured - z, azimuth wrapped               (7)
    H_v | H_m = row(-n, p_n),   H_p = (R n)^T             for n of range and azimuth each
    S     = H P H^T + R_z + H_m cov H_m^T

A landmark enters EKF-SLAM: augmentation at first sight.

With the point s that a detection shows, in the axes of the state's body, a new landmark is put at ``p = g(x_v, z,
elevation) = X + R s``. With ``G_v | G_m = row(n, s)`` of `baselines.ekf_equations` for the world's three axes n::

    P_pv = G_v P_v.,   P_pp = G_v P_vv G_v^T + G_m cov G_m^T + G_z diag(R_z, elevation_sigma^2) G_z^T

On a floor of known height, the height p_z is measured once, then and there: innovation ``floor - p_z``, variance
``P_pp[z, z] + floor_sigma^2``. A point whose range and azimuth show no floor within the aperture has elevation 0, and
an innovation that the gate of the floor refuses unless the floor is near the aperture's edge: it is something in the
water, or a false detection, and must not move the vehicle.
"""

from __future__ import annotations

import numpy as np

from baselines.ekf_equations import (
    LANDMARK,
    POSE,
    MeasurementRow,
    Moment,
    add_covariances,
    correct,
    correct_by,
    correct_pair,
    moment_after,
    motion_covariance,
    row_along,
)
from baselines.filter_inputs import (
    GATED,
    NEW,
    NO_SLOT,
    PASSED_OVER,
    USED,
    DetectionRow,
    Frame,
    SonarModel,
    is_inside_gate,
    sighting,
)
from baselines.sonar_update import (
    by_range_and_azimuth,
    elevation_of_new,
    is_beyond_linear,
    noise_of_view,
    point_seen,
    predicted_view,
    view_noise,
)
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration import Integral
from sonar_graph.numerics import (
    Matrix,
    Vector,
    compiled,
    dot,
    inlined,
    matrix,
    minus,
    place,
    product,
    sandwich,
    scaled,
    symmetric,
    transformed,
    vector,
)
from sonar_graph.slam.models import FLOOR_GATE, sonar_point_jacobian, wrap_angle


@inlined
def augment(x: Floats, P: Floats, n: int, moment: Moment, sonar: SonarModel, seen: DetectionRow) -> None:
    """Append a landmark where it was seen; its elevation from the floor where there is one, else zero."""
    elevation_rad = elevation_of_new(moment.X, moment.R, moment.motion, sonar, seen.z)
    point, G, G_z = location(moment, sonar, seen.z, elevation_rad)
    noise = noise_of_view(seen.R_z, sonar.aperture_rad)
    own = np.empty((LANDMARK, LANDMARK))
    place(symmetric(sandwich(G_z, noise, G_z)), own, 0, 0)
    for r in range(LANDMARK):
        x[n + r] = point[r]
        P[n + r, :n] = 0.0
        add_covariances(P, n, 0, G[r].by_X, P[n + r])
        add_covariances(P, n, 3, G[r].by_angles, P[n + r])
        for c in range(n):
            P[c, n + r] = P[n + r, c]
    for r in range(LANDMARK):
        for c in range(r + 1):
            own[r, c] += motion_covariance(moment.motion, G[r], G[c])
            own[r, c] += dot(G[c].by_X, vector(P[n + r])) + dot(G[c].by_angles, vector(P[n + r, 3:]))
            P[n + r, n + c] = P[n + c, n + r] = own[r, c]
    if sonar.has_floor:
        _stand_on_floor(x, P, n + LANDMARK, sonar)


@inlined
def _stand_on_floor(x: Floats, P: Floats, n: int, sonar: SonarModel) -> None:
    """Correct the height of the landmark at the end by the floor's, where it can stand there."""
    innovation, S = sonar.floor_z_m - x[n - 1], P[n - 1, n - 1] + sonar.floor_variance_m2
    if innovation * innovation <= FLOOR_GATE * S:
        correct(x, P, n, P[n - 1, :n].copy(), S, innovation)


@compiled
def location(
    moment: Moment, sonar: SonarModel, z: tuple[float, float], elevation_rad: float
) -> tuple[Vector, tuple[MeasurementRow, MeasurementRow, MeasurementRow], Matrix]:
    """The point g that a detection shows, ``G_v | G_m`` of its coordinates, G_z by (range, azimuth, elevation)."""
    motion = moment.motion
    s = point_seen(motion, sonar, z, elevation_rad)
    G = (row_along(moment, moment.R[0], s), row_along(moment, moment.R[1], s), row_along(moment, moment.R[2], s))
    world_R_sonar = product(product(moment.R, motion.dR), sonar.body_R_sonar)
    G_z = product(world_R_sonar, matrix(sonar_point_jacobian(z[0], z[1], elevation_rad)))
    return transformed(moment.X, moment.R, s), G, G_z


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
def observation(moment: Moment, p: Vector, sonar: SonarModel) -> tuple[Floats, MeasurementRow, MeasurementRow]:
    """(6): predicted range and azimuth (2,), and ``H_v | H_m`` of each; ``H_p`` is the opposite of its ``by_X``."""
    z, p_n, by_range, by_azimuth = predicted_view(moment.X, moment.R, moment.motion, sonar, p)
    return z, row_along(moment, scaled(-1.0, by_range), p_n), row_along(moment, scaled(-1.0, by_azimuth), p_n)


@inlined
def _observe(x: Floats, P: Floats, n: int, at: int, moment: Moment, sonar: SonarModel, seen: DetectionRow) -> int:
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
def _observe_far(x: Floats, P: Floats, n: int, at: int, moment: Moment, sonar: SonarModel, seen: DetectionRow) -> int:
    """Correct by a landmark that may be far from where it is predicted, inside the gate: `baselines.sonar_update`."""
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
def _add_row_covariances(P: Floats, n: int, at: int, row: MeasurementRow, out: Floats) -> None:
    """``out += H P`` for a row of H with a landmark, shape (n,): only columns of pose and landmark are not zero."""
    add_covariances(P, n, 0, row.by_X, out)
    add_covariances(P, n, 3, row.by_angles, out)
    add_covariances(P, n, at, scaled(-1.0, row.by_X), out)


@inlined
def _variance_share(U: Floats, at: int, row: MeasurementRow) -> float:
    """``U H^T`` for a row of H with a landmark."""
    return dot(row.by_X, minus(vector(U), vector(U[at:]))) + dot(row.by_angles, vector(U[3:]))
