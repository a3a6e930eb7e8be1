"""DLR Spatial Cognition: a wheeled robot in an office building, white discs on the floor as landmarks.

Kurlbaum, Frese, "A benchmark data set for data association", Universität Bremen, SFB/TR 8 report, 2009. Its file
``map.circles`` holds

``STEP image dx dy dφ  c_xx c_xy c_yy c_xφ c_yφ c_φφ``        the pose after the step in the frame before it
``LANDMARK_C px py quality  c_xx c_xy c_yy  id [id ...]``     a disc in the frame of the newest pose

with −y forward and x to the right. Body axes (x forward, y left) are therefore ``(x, y)_body = (−y, −x)_file``, a
reflection, so that angles change their sign: ``θ = −φ``.
"""

from __future__ import annotations

from pathlib import Path

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

FILE_NAME = "map.circles"
STEP_S = 1
STEP_COLUMNS = ("dX", "dY", "dPhi", "cXX", "cXY", "cYY", "cXPhi", "cYPhi", "cPhiPhi")
POINT_COLUMNS = ("pX", "pY", "quality", "cXX", "cXY", "cYY")
EXPECTED = "lines 'STEP image dX dY dPhi + 6 covariances' and 'LANDMARK_C pX pY quality + 3 covariances + IDs'"
STEP_COV_PLACES = [[0, 1, 3], [1, 2, 4], [3, 4, 5]]
POINT_COV_PLACES = [[0, 1], [1, 2]]
BODY_OF_FILE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""(x, y, θ) in body axes from (x, y, φ) in the file's."""


def read_dlr(path: Path) -> Sequence:
    """Sequence of the run, one odometry step a second.

    Parameters
    ----------
    path
        ``map.circles``, or the folder that holds it.

    Returns
    -------
    Sequence
        Without truth; the pose after n steps is at n seconds. A detection with several IDs has them as equally
        probable candidates; one with ID −1 (no known disc) has none.

    Raises
    ------
    DatasetError
        When the file is missing or malformed, or a landmark comes before the first step.
    """
    if path.is_dir() and not (path / FILE_NAME).exists():
        raise DatasetError(f"{path}: holds no {FILE_NAME} ({EXPECTED}); give the folder that does, or the file itself")
    path = path / FILE_NAME if path.is_dir() else path
    steps: list[list[float]] = []
    points: list[list[float]] = []
    ids: list[list[int]] = []
    poses: list[int] = []  # number of steps before each landmark
    for number, (kind, *rest) in read_lines(path, EXPECTED):
        if kind == "STEP":
            steps.append(numbers(path, number, rest[1:], STEP_COLUMNS))
            continue
        if kind not in ("LANDMARK", "LANDMARK_C"):
            raise DatasetError(f"{path}, line {number}: begins with {kind!r}; expected {EXPECTED}")
        if not steps:
            raise DatasetError(f"{path}, line {number}: a landmark before the first STEP; expected {EXPECTED}")
        points.append(numbers(path, number, rest[: len(POINT_COLUMNS)], POINT_COLUMNS))
        try:
            ids.append([int(text) for text in rest[len(POINT_COLUMNS) :]])
        except ValueError as error:
            raise DatasetError(f"{path}, line {number}: {error}; expected whole numbers as landmark IDs") from error
        if not ids[-1]:
            raise DatasetError(f"{path}, line {number}: no landmark ID after the covariances; expected {EXPECTED}")
        poses.append(len(steps))
    if not steps:
        raise DatasetError(f"{path}: holds no STEP line; expected {EXPECTED}")
    rows = np.array(steps)
    covs = symmetric(rows[:, 3:], STEP_COV_PLACES)
    imu, dvl = stepped_odometry(rows[:, :3] @ BODY_OF_FILE.T, BODY_OF_FILE @ covs @ BODY_OF_FILE.T, STEP_S)
    detections = None
    if points:
        candidate_ids = np.full((len(ids), max(map(len, ids))), -1, dtype=np.int64)
        for row, found in enumerate(ids):
            known = [identity for identity in found if identity >= 0]
            candidate_ids[row, : len(known)] = known
        is_known = candidate_ids >= 0
        seen, plane = np.array(points), BODY_OF_FILE[:2, :2]
        detections = point_detections(
            step_stamps_ns(len(rows), STEP_S)[poses],
            seen[:, :2] @ plane.T,
            plane @ symmetric(seen[:, 3:], POINT_COV_PLACES) @ plane.T,
            candidate_ids,
            is_known / np.maximum(is_known.sum(axis=1, keepdims=True), 1),
        )
    return Sequence(
        name="dlr_spatial_cognition",
        calibration=stepped_calibration(dvl, covs, STEP_S),
        imu=imu,
        dvl=dvl,
        detections=detections,
        notes={
            "data set": "DLR Spatial Cognition; Kurlbaum, Frese, SFB/TR 8 report, 2009",
            "licence": "none stated",
            "time": "the file has none: the pose after n steps is at n seconds, so rates and speeds are per step",
            "truth": "none",
            "odometry": "each step as the constant twist that makes it in one second",
            "noise": "the file's covariances; of the turn their mean, and not their correlation with the displacement",
            "detections": f"{sum(found == [-1] for found in ids)} of {len(ids)} have no identity (-1)",
        },
    )
