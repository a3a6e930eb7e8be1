"""Victoria Park: a truck among trees in Sydney, as the edge list that GTSAM ships.

Guivant, Nebot, "Optimization of the simultaneous localization and map-building algorithm for real-time
implementation", IEEE T-RA 17(3), 2001. Trees recognised in laser scans, and odometry, are those of the file.

``ODOMETRY i j dx dy dθ  c_xx c_xy c_xθ c_yy c_yθ c_θθ``   pose j in the frame of pose i (x forward, y left)
``LANDMARK i l x y  c_xx c_xy c_yy``                       landmark l in the frame of pose i

Poses and landmarks share one numbering: a number is a pose where an ``ODOMETRY`` line ends and a landmark where a
``LANDMARK`` line does. Landmarks keep their numbers. The file has no times.
"""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert.planar import (
    point_detections,
    step_stamps_ns,
    stepped_calibration,
    stepped_odometry,
    symmetric,
)
from sonar_graph.logs.convert.text_tables import numbers, read_lines
from sonar_graph.sequence import Sequence

STEP_S = 1
ODOMETRY_COLUMNS = ("i", "j", "dx", "dy", "dtheta", "c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt")
LANDMARK_COLUMNS = ("i", "landmark", "x", "y", "c_xx", "c_xy", "c_yy")
STEP_COV_PLACES = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
POINT_COV_PLACES = [[0, 1], [1, 2]]
EXPECTED = "lines 'ODOMETRY i j dx dy dtheta + 6 covariances' and 'LANDMARK i landmark x y + 3 covariances'"


def read_victoria_park(path: Path | None = None) -> Sequence:
    """Sequence of the run, one odometry edge a second.

    Parameters
    ----------
    path
        File in the format above; None: the file in the installed gtsam.

    Returns
    -------
    Sequence
        Without truth. The pose after n edges is at n seconds.

    Raises
    ------
    DatasetError
        When the file is missing or malformed, or its odometry is no single chain.
    """
    path = path or Path(gtsam.findExampleDataFile("victoria_park.txt"))  # type: ignore[no-untyped-call]
    steps: list[list[float]] = []
    landmarks: list[list[float]] = []
    poses: list[int] = []  # number of steps before each landmark
    newest = 0
    for number, (kind, *rest) in read_lines(path, EXPECTED):
        if kind not in ("ODOMETRY", "LANDMARK"):
            raise DatasetError(f"{path}, line {number}: begins with {kind!r}; expected {EXPECTED}")
        values = numbers(path, number, rest, ODOMETRY_COLUMNS if kind == "ODOMETRY" else LANDMARK_COLUMNS)
        if values[0] != newest:
            raise DatasetError(
                f"{path}, line {number}: starts at pose {rest[0]}, but the newest pose is {newest};"
                " expected one chain of poses from 0, with landmarks seen from the newest"
            )
        if kind == "ODOMETRY":
            newest = int(values[1])
            steps.append(values[2:])
        else:
            landmarks.append(values[1:])
            poses.append(len(steps))
    if not steps:
        raise DatasetError(f"{path}: holds no ODOMETRY line; expected {EXPECTED}")
    rows = np.array(steps)
    covs = symmetric(rows[:, 3:], STEP_COV_PLACES)
    imu, dvl = stepped_odometry(rows[:, :3], covs, STEP_S)
    detections = None
    if landmarks:
        seen = np.array(landmarks)
        ids = seen[:, :1].astype(np.int64)
        stamps_ns = step_stamps_ns(len(rows), STEP_S)[poses]
        point_covs = symmetric(seen[:, 3:], POINT_COV_PLACES)
        detections = point_detections(stamps_ns, seen[:, 1:3], point_covs, ids, np.ones(ids.shape))
    return Sequence(
        name="victoria_park",
        calibration=stepped_calibration(dvl, covs, STEP_S),
        imu=imu,
        dvl=dvl,
        detections=detections,
        notes={
            "data set": "Victoria Park; Guivant, Nebot, IEEE T-RA 17(3), 2001; edge list of GTSAM's examples",
            "time": "the file has none: the pose after n edges is at n seconds, so rates and speeds are per step",
            "truth": "none",
            "odometry": "each edge as the constant twist that makes it in one second",
            "noise": "the file's covariances",
        },
    )
