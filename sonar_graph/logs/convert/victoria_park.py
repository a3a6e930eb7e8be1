"""Victoria Park: a truck among trees in Sydney, as the edge list that GTSAM ships.

Guivant, Nebot, "Optimization of the simultaneous localization and map-building algorithm for real-time
implementation", IEEE T-RA 17(3), 2001. The recognition of trees in laser scans and the odometry are those of the file.

``ODOMETRY i j dx dy dθ  c_xx c_xy c_xθ c_yy c_yθ c_θθ``   pose j in the frame of pose i (x forward, y left)
``LANDMARK i l x y  c_xx c_xy c_yy``                       landmark l in the frame of pose i

Poses and landmarks share one numbering: a number is a pose where an ``ODOMETRY`` line ends and a landmark where a
``LANDMARK`` line does, never both. Landmarks keep their numbers. The file has no times.
"""

from __future__ import annotations

from dataclasses import dataclass, field
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
    """The run, one odometry edge a second.

    Parameters
    ----------
    path
        File in the format above; None: the one in the installed gtsam.

    Returns
    -------
    Sequence
        Without truth. The pose after n edges is at n seconds.

    Raises
    ------
    DatasetError
        When the file is missing or malformed, or its odometry is no single chain.
    """
    edges = _read(path or Path(gtsam.findExampleDataFile("victoria_park.txt")))  # type: ignore[no-untyped-call]
    steps, covs = np.array(edges.steps), symmetric(np.array(edges.step_covs), STEP_COV_PLACES)
    imu, dvl = stepped_odometry(steps, covs, STEP_S)
    stamps_ns = step_stamps_ns(len(steps), STEP_S)
    detections = None
    if edges.points:
        ids = np.array(edges.landmarks, dtype=np.int64)[:, None]
        detections = point_detections(
            stamps_ns[edges.poses],
            np.array(edges.points),
            symmetric(np.array(edges.point_covs), POINT_COV_PLACES),
            ids,
            np.ones(ids.shape),
        )
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


@dataclass
class _Edges:
    """What the file's lines say, in their order."""

    last_vertex: int = 0
    steps: list[list[float]] = field(default_factory=list)
    step_covs: list[list[float]] = field(default_factory=list)
    poses: list[int] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    points: list[list[float]] = field(default_factory=list)
    point_covs: list[list[float]] = field(default_factory=list)

    def add_step(self, values: list[float]) -> None:
        self.last_vertex = int(values[1])
        self.steps.append(values[2:5])
        self.step_covs.append(values[5:])

    def add_point(self, values: list[float]) -> None:
        self.poses.append(len(self.steps))
        self.landmarks.append(int(values[1]))
        self.points.append(values[2:4])
        self.point_covs.append(values[4:])


def _read(path: Path) -> _Edges:
    edges = _Edges()
    for number, (kind, *rest) in read_lines(path, EXPECTED):
        if kind not in ("ODOMETRY", "LANDMARK"):
            raise DatasetError(f"{path}, line {number}: begins with {kind!r}; expected {EXPECTED}")
        odometry = kind == "ODOMETRY"
        values = numbers(path, number, rest, ODOMETRY_COLUMNS if odometry else LANDMARK_COLUMNS)
        if values[0] != edges.last_vertex:
            raise DatasetError(
                f"{path}, line {number}: starts at pose {rest[0]}, but the newest pose is {edges.last_vertex};"
                " expected one chain of poses from 0, with landmarks seen from the newest"
            )
        (edges.add_step if odometry else edges.add_point)(values)
    if not edges.steps:
        raise DatasetError(f"{path}: holds no ODOMETRY line; expected {EXPECTED}")
    return edges
