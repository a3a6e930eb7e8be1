"""Landmarks as ``sensor_msgs/PointCloud2``: positions, identities and covariances that a program can read.

A point has ``x y z`` as float32, because RViz reads nothing else, and as float64 ``id`` (exact up to 2^53) and the
upper triangle of the covariance, ``cov_xx cov_xy cov_xz cov_yy cov_yz cov_zz`` (m²; NaN where unknown).
"""

from __future__ import annotations

import numpy as np

from sonar_graph.logs import encoding
from sonar_graph.logs.recorder import Outgoing
from sonar_graph.logs.tum import LANDMARK_COLUMNS
from sonar_graph.states import LandmarkMap

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
_DATATYPES = {np.dtype(np.float32): 7, np.dtype(np.float64): 8}
"""Those of ``sensor_msgs/PointField``."""
_COVARIANCES = LANDMARK_COLUMNS[4:]
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "id", *_COVARIANCES],
        "formats": ["<f4"] * 3 + ["<f8"] * (1 + len(_COVARIANCES)),
        "offsets": [0, 4, 8, *range(16, 16 + 8 * (1 + len(_COVARIANCES)), 8)],
    }
)
"""One landmark in the cloud's data."""


def landmark_cloud(topic: str, landmarks: LandmarkMap, stamp_ns: int) -> Outgoing:
    """One message with all landmarks."""
    points = np.zeros(len(landmarks), POINT)
    points["id"] = landmarks.ids
    for axis, name in enumerate("xyz"):
        points[name] = landmarks.positions[:, axis]
    for name, row, column in zip(_COVARIANCES, *np.triu_indices(3), strict=True):
        points[name] = landmarks.covariances[:, row, column]
    layout = [POINT.fields[name] for name in POINT.names or ()] if POINT.fields else []
    values = encoding.header(np.array([stamp_ns]), encoding.WORLD_FRAME) | {
        "height": 1,
        "width": len(points),
        "fields.name": list(POINT.names or ()),
        "fields.offset": np.array([[entry[1] for entry in layout]]),
        "fields.datatype": np.array([[_DATATYPES[entry[0]] for entry in layout]]),
        "fields.count": np.ones((1, len(layout))),
        "point_step": POINT.itemsize,
        "row_step": len(points) * POINT.itemsize,
        "data": np.frombuffer(points.tobytes(), np.uint8)[None, :],
        "is_dense": 1,
    }
    stamps_ns = np.array([stamp_ns])
    return encoding.outgoing(topic, POINT_CLOUD, stamps_ns, values, {"fields": len(layout)}, is_latched=True)
