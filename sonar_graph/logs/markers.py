"""Landmarks and positions as ``visualization_msgs/MarkerArray``: 95 % ellipsoids, and landmarks' identities.

Viewers differ in how large they draw the covariance of a pose (RViz: one sigma; Lichtblick: half a sigma, without
correlations); an ellipsoid marker looks the same in all of them.

A marker's namespace says what it is: ``ellipsoid_95_percent``, ``covariance_unknown`` (a sphere whose size means
nothing), ``identity``. A viewer switches each on and off.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_graph.logs import encoding
from sonar_graph.logs.cdr import Value
from sonar_graph.logs.pose_covariance import body_to_ros
from sonar_graph.logs.recorder import Outgoing
from sonar_graph.measurements import Floats
from sonar_graph.states import LandmarkMap, Trajectory

MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
SPHERE, TEXT_VIEW_FACING = 2, 9
UNKNOWN_DIAMETER_M = 0.2
"""Drawn where a covariance is unknown."""
_SMALLEST_DIAMETER_M = 1e-3
ELLIPSOID, UNKNOWN, IDENTITY = "ellipsoid_95_percent", "covariance_unknown", "identity"
_FAINT = 0.35
_SIGMAS = float(np.sqrt(chi2.ppf(0.95, df=3)))

Colour = tuple[float, float, float, float]
BLUE: Colour = (0.12, 0.47, 0.71, 0.8)
ORANGE: Colour = (1.0, 0.5, 0.05, 0.8)
PURPLE: Colour = (0.58, 0.4, 0.74, 0.8)
GREEN: Colour = (0.17, 0.63, 0.17, 0.8)
GREY: Colour = (0.5, 0.5, 0.5, 0.9)


def ellipsoids(covariances: Floats) -> tuple[Floats, Floats]:
    """The 95 % ellipsoids of Gaussian points in space, ``x' C^-1 x = chi2_3(0.95)``.

    Parameters
    ----------
    covariances
        Shape (m, 3, 3), m²; NaN where unknown: a small sphere then.

    Returns
    -------
    diameters
        Along the principal axes, shape (m, 3), metres.
    quaternions_xyzw
        From the principal axes to the world, shape (m, 4).
    """
    covariances = covariances.copy()
    covariances[_unknown(covariances)] = np.eye(3) * (UNKNOWN_DIAMETER_M / (2 * _SIGMAS)) ** 2
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # right-handed
    diameters = 2 * _SIGMAS * np.sqrt(np.maximum(variances, 0))
    return np.maximum(diameters, _SMALLEST_DIAMETER_M), Rotation.from_matrix(axes).as_quat()


def _unknown(covariances: Floats) -> NDArray[np.bool_]:
    return np.asarray(~np.isfinite(covariances.reshape(-1, 9)).all(axis=1))


def landmark_markers(
    topic: str, landmarks: LandmarkMap, stamp_ns: int, colour: Colour, text_height_m: float
) -> Outgoing:
    """One message: for each landmark an ellipsoid, and its identity as text above it."""
    count = len(landmarks)
    diameters, quaternions = ellipsoids(landmarks.covariances)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    above = landmarks.positions + np.array([0, 0, text_height_m])
    stamps_ns = np.full(2 * count, stamp_ns)
    values = encoding.header(stamps_ns, encoding.WORLD_FRAME, "markers.header")
    values |= encoding.fields("markers.pose.position", "xyz", np.vstack([landmarks.positions, above]))
    values |= encoding.fields("markers.pose.orientation", "xyzw", np.vstack([quaternions, upright]))
    values |= encoding.fields("markers.scale", "xyz", np.vstack([diameters, np.full((count, 3), text_height_m)]))
    values |= encoding.fields("markers.color", "rgba", np.tile(colour, (2 * count, 1)))
    values |= {
        "markers.ns": [UNKNOWN if unknown else ELLIPSOID for unknown in _unknown(landmarks.covariances)]
        + [IDENTITY] * count,
        "markers.id": np.tile(np.arange(count), 2),
        "markers.type": np.repeat([SPHERE, TEXT_VIEW_FACING], count),
        "markers.text": [""] * count + [str(identity) for identity in landmarks.ids.tolist()],
    }
    return encoding.outgoing(topic, MARKER_ARRAY, np.array([stamp_ns]), values, {"markers": 2 * count}, is_latched=True)


def position_ellipsoids(topic: str, trajectory: Trajectory, colour: Colour) -> Outgoing:
    """For each pose whose covariance is known one message: where the position is, as an ellipsoid."""
    known = trajectory.rows(np.flatnonzero(~_unknown(trajectory.covariances[:, 3:, 3:])))
    world_axes = body_to_ros(known.covariances, known.matrices) if len(known) else known.covariances
    diameters, quaternions = ellipsoids(world_axes[:, :3, :3])
    columns = encoding.header(known.stamps_ns, encoding.WORLD_FRAME, "markers.header")
    columns |= encoding.fields("markers.pose.position", "xyz", known.positions)
    columns |= encoding.fields("markers.pose.orientation", "xyzw", quaternions)
    columns |= encoding.fields("markers.scale", "xyz", diameters)
    columns |= encoding.fields("markers.color", "rgba", np.tile((*colour[:3], _FAINT), (len(known), 1)))
    values: dict[str, Value] = {
        path: value[:, None] if isinstance(value, np.ndarray) else value for path, value in columns.items()
    }
    values |= {"markers.ns": ELLIPSOID, "markers.type": SPHERE}
    return encoding.outgoing(topic, MARKER_ARRAY, known.stamps_ns, values, {"markers": 1})
