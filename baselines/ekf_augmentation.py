"""A landmark enters EKF-SLAM: augmentation at first sight.

With the point s that a detection shows, in the axes of the state's body, a new landmark is put at ``p = g(x_v, z,
elevation) = X + R s``. With ``G_v | G_m = row(n, s)`` of `baselines.ekf_derivatives` for the world's three axes n::

    P_pv = G_v P_v.,   P_pp = G_v P_vv G_v^T + G_m cov G_m^T + G_z diag(R_z, elevation_sigma^2) G_z^T

On a floor of known height, the height p_z is measured once, then and there: innovation ``floor - p_z``, variance
``P_pp[z, z] + floor_sigma^2``. A point whose range and azimuth show no floor within the aperture has elevation 0, and
an innovation that the gate of the floor refuses unless the floor is near the aperture's edge: it is something in the
water, or a false detection, and must not move the vehicle.
"""

from __future__ import annotations

import numpy as np

from baselines.ekf_derivatives import Moment, Row, add_covariances, motion_covariance, row_along
from baselines.ekf_state import LANDMARK, correct
from baselines.filter_detections import Sighting
from baselines.filter_models import SonarModel
from baselines.sonar_views import elevation_of_new, noise_of_view, point_seen
from sonar_graph.measurements import Floats
from sonar_graph.navigation.kernels import compiled, inlined
from sonar_graph.navigation.triples import (
    Matrix,
    Vector,
    dot,
    matrix,
    place,
    product,
    sandwich,
    symmetric,
    transformed,
    vector,
)
from sonar_graph.slam.models import FLOOR_GATE, sonar_point_jacobian


@inlined
def augment(x: Floats, P: Floats, n: int, moment: Moment, sonar: SonarModel, seen: Sighting) -> None:
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
) -> tuple[Vector, tuple[Row, Row, Row], Matrix]:
    """The point g that a detection shows, ``G_v | G_m`` of its coordinates, G_z by (range, azimuth, elevation)."""
    motion = moment.motion
    s = point_seen(motion, sonar, z, elevation_rad)
    G = (row_along(moment, moment.R[0], s), row_along(moment, moment.R[1], s), row_along(moment, moment.R[2], s))
    world_R_sonar = product(product(moment.R, motion.dR), sonar.body_R_sonar)
    G_z = product(world_R_sonar, matrix(sonar_point_jacobian(z[0], z[1], elevation_rad)))
    return transformed(moment.X, moment.R, s), G, G_z
