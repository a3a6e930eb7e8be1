"""Range and azimuth of a landmark of the world, seen by a sonar on a body, and the inverse, with derivatives.

With the landmark p in the world and the sonar at ``world_T_sonar = world_T_body body_T_sonar``::

    q = sonar_R_world (p - world_p_sonar),    range and azimuth of q, D_q: `sonar_graph.slam.models.sonar_model`

    by the body pose    D_q [ [q]x | -I ] Ad(sonar_T_body)      right perturbation [theta, rho], shape (2, 6)
    by the landmark     D_q sonar_R_world                       shape (2, 3)
"""

import math

import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.measurements import Floats
from sonar_graph.numerics import compiled
from sonar_graph.slam.models.sonar_model import sonar_point, sonar_point_jacobian


def poses_of(values: gtsam.Values, keys: NDArray[np.uint64]) -> Floats:
    """Poses of a graph by the keys of keyframes, shape (...): rows of R, and p, shape (..., 12)."""
    known = np.fromiter(values.keys(), np.uint64)
    poses = np.asarray(gtsam.utilities.extractPose3(values))  # by ascending key
    return poses[np.searchsorted(known[known >> np.uint64(56) == ord("x")], keys)]


def pose_row(pose: gtsam.Pose3) -> Floats:
    """Rows of R, and p, shape (12,)."""
    return np.concatenate((pose.rotation().matrix().ravel(), pose.translation()))


@compiled
def project_all(points: Floats, world_T_sonar: Floats) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth of points of the world, shape (m, 3), from a sonar's pose, shape (4, 4).

    Returns
    -------
    (range m, azimuth rad), shape (m, 2); their derivatives by the right perturbation of the sonar's pose,
    ``D_q [[q]x | -I]``, shape (m, 2, 6), and by the point, ``D_q sonar_R_world``, shape (m, 2, 3).
    """
    T, m = world_T_sonar, len(points)
    view, by_sonar, by_point = np.empty((m, 2)), np.empty((m, 2, 6)), np.empty((m, 2, 3))
    for k in range(m):
        dx, dy, dz = points[k, 0] - T[0, 3], points[k, 1] - T[1, 3], points[k, 2] - T[2, 3]
        x = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz
        y = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
        z = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        h2 = x * x + y * y
        r = math.sqrt(h2 + z * z)
        view[k, 0], view[k, 1] = r, math.atan2(y, x)
        by_sonar[k, 0, 0], by_sonar[k, 0, 1], by_sonar[k, 0, 2] = 0.0, 0.0, 0.0  # q^T [q]x
        by_sonar[k, 0, 3], by_sonar[k, 0, 4], by_sonar[k, 0, 5] = -x / r, -y / r, -z / r
        by_sonar[k, 1, 0], by_sonar[k, 1, 1], by_sonar[k, 1, 2] = x * z / h2, y * z / h2, -1.0
        by_sonar[k, 1, 3], by_sonar[k, 1, 4], by_sonar[k, 1, 5] = y / h2, -x / h2, 0.0
        for i in range(2):
            for j in range(3):
                by_point[k, i, j] = -(
                    by_sonar[k, i, 3] * T[j, 0] + by_sonar[k, i, 4] * T[j, 1] + by_sonar[k, i, 5] * T[j, 2]
                )
    return view, by_sonar, by_point


def range_azimuth(world_T_sonar: gtsam.Pose3, p_world: Floats) -> Floats:
    """Range (m) and azimuth (rad) at which a sonar sees a point, shape (2,)."""
    return project_all(p_world[None], world_T_sonar.matrix())[0][0]


def range_azimuth_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, p_world: Floats
) -> tuple[Floats, Floats, Floats]:
    """Range and azimuth with derivatives.

    Returns
    -------
    (range m, azimuth rad), shape (2,); the derivative by the body pose's right perturbation [theta, rho], shape (2, 6);
    the derivative by the landmark, shape (2, 3).
    """
    (z,), (by_sonar,), (by_point,) = project_all(p_world[None], world_T_body.compose(body_T_sonar).matrix())
    return z, by_sonar @ body_T_sonar.inverse().AdjointMap(), by_point


def locate(world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float) -> Floats:
    """The point in the world that a sonar sees there, shape (3,), m."""
    return np.asarray(world_T_sonar.transformFrom(sonar_point(range_m, azimuth_rad, elevation_rad)))


def locate_jacobians(
    world_T_body: gtsam.Pose3, body_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float, elevation_rad: float
) -> tuple[Floats, Floats, Floats]:
    """A located point with derivatives.

    Returns
    -------
    The point, shape (3,), m; its derivative by the body pose's right perturbation [theta, rho], shape (3, 6); its
    derivative by (range, azimuth, elevation), shape (3, 3).
    """
    world_T_sonar = world_T_body.compose(body_T_sonar)
    R_body, R_sonar = world_T_body.rotation().matrix(), world_T_sonar.rotation().matrix()
    point = locate(world_T_sonar, range_m, azimuth_rad, elevation_rad)
    p_body = np.asarray(world_T_body.transformTo(point), dtype=np.float64)
    by_pose = R_body @ np.hstack([-gtsam.SO3.Hat(p_body), np.eye(3)])
    return point, by_pose, R_sonar @ sonar_point_jacobian(range_m, azimuth_rad, elevation_rad)
