"""Files of odometry steps and landmarks seen between them: DLR Spatial Cognition and Victoria Park; neither has times.

DLR: a wheeled robot in an office building, white discs on the floor as landmarks (Kurlbaum, Frese, "A benchmark data
set for data association", Universität Bremen, SFB/TR 8 report, 2009). Its file ``map.circles`` holds

``STEP image dx dy dφ  c_xx c_xy c_yy c_xφ c_yφ c_φφ``        the pose after the step in the frame before it
``LANDMARK_C px py quality  c_xx c_xy c_yy  id [id ...]``     a disc in the frame of the newest pose

with −y forward and x to the right. Body axes (x forward, y left) are therefore ``(x, y)_body = (−y, −x)_file``, a
reflection, so that angles change their sign: ``θ = −φ``.

Victoria Park: a truck among trees in Sydney, recognised in laser scans, as the edge list that GTSAM ships (Guivant,
Nebot, "Optimization of the simultaneous localization and map-building algorithm for real-time implementation", IEEE
T-RA 17(3), 2001).

``ODOMETRY i j dx dy dθ  c_xx c_xy c_xθ c_yy c_yθ c_θθ``   pose j in the frame of pose i (x forward, y left)
``LANDMARK i l x y  c_xx c_xy c_yy``                       landmark l in the frame of pose i

Poses and landmarks share one numbering: a number is a pose where an ``ODOMETRY`` line ends and a landmark where a
``LANDMARK`` line does. Landmarks keep their numbers.
"""

from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert.planar import StepRun, stepped_sequence
from sonar_graph.logs.convert.text_tables import numbers, read_lines
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence

POINT_COV_PLACES = [[0, 1], [1, 2]]
"""Columns of the elements of a landmark's covariance, in both files."""
DLR_FILE = "map.circles"
DLR_STEP = ("dX", "dY", "dPhi", "cXX", "cXY", "cYY", "cXPhi", "cYPhi", "cPhiPhi")
DLR_STEP_COV_PLACES = [[0, 1, 3], [1, 2, 4], [3, 4, 5]]
DLR_POINT = ("pX", "pY", "quality", "cXX", "cXY", "cYY")
DLR_LINES = "lines 'STEP image dX dY dPhi + 6 covariances' and 'LANDMARK_C pX pY quality + 3 covariances + IDs'"
BODY_OF_FILE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""(x, y, θ) in body axes from (x, y, φ) in DLR's file."""
PARK_COV = ("c_xx", "c_xy", "c_xt", "c_yy", "c_yt", "c_tt")
PARK_COLUMNS = {
    "ODOMETRY": ("i", "j", "dx", "dy", "dtheta", *PARK_COV),
    "LANDMARK": ("i", "landmark", "x", "y", "c_xx", "c_xy", "c_yy"),
}
PARK_STEP_COV_PLACES = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
PARK_LINES = "lines 'ODOMETRY i j dx dy dtheta + 6 covariances' and 'LANDMARK i landmark x y + 3 covariances'"


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
    if path.is_dir():
        if not (path / DLR_FILE).exists():
            raise DatasetError(
                f"{path}: holds no {DLR_FILE} ({DLR_LINES}); give the folder that does, or the file itself"
            )
        path = path / DLR_FILE
    steps: list[list[float]] = []
    points: list[list[float]] = []
    ids: list[list[int]] = []
    poses: list[int] = []
    for number, kind, rest in _lines(path, DLR_LINES, "STEP", "LANDMARK", "LANDMARK_C"):
        if kind == "STEP":
            # the first number is that of an image
            steps.append(numbers(path, number, rest[1:], DLR_STEP))
            continue
        place = f"{path}, line {number}:"
        if not steps:
            raise DatasetError(
                f"{place} a landmark before the first STEP; expected {DLR_LINES}"
            )
        x, y, _, *cov = numbers(path, number, rest[: len(DLR_POINT)], DLR_POINT)
        try:
            found = [int(text) for text in rest[len(DLR_POINT) :]]
        except ValueError as error:
            raise DatasetError(
                f"{place} {error}; expected whole numbers as landmark IDs"
            ) from error
        if not found:
            raise DatasetError(
                f"{place} no landmark ID after the covariances; expected {DLR_LINES}"
            )
        points.append([x, y, *cov])
        ids.append(found)
        poses.append(len(steps))
    if not steps:
        raise DatasetError(f"{path}: holds no STEP line; expected {DLR_LINES}")
    return stepped_sequence(
        "dlr_spatial_cognition",
        _run(steps, DLR_STEP_COV_PLACES, poses, points, ids, BODY_OF_FILE),
        {
            "data set": "DLR Spatial Cognition; Kurlbaum, Frese, SFB/TR 8 report, 2009",
            "licence": "none stated",
            "noise": "the file's covariances; of the turn their mean, and not their correlation with the displacement",
            "detections": f"{sum(found == [-1] for found in ids)} of {len(ids)} have no identity (-1)",
        },
    )


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

    Examples
    --------
    The file comes with gtsam:

    >>> from sonar_graph.logs.convert import read_victoria_park
    >>> sequence = read_victoria_park()
    >>> round(sequence.duration_s), len(sequence.detections)
    (6968, 3640)
    """
    path = path or Path(gtsam.findExampleDataFile("victoria_park.txt"))  # type: ignore[no-untyped-call]
    steps: list[list[float]] = []
    points: list[list[float]] = []
    ids: list[list[int]] = []
    poses: list[int] = []
    newest = 0
    for number, kind, rest in _lines(path, PARK_LINES, *PARK_COLUMNS):
        start, end, *values = numbers(path, number, rest, PARK_COLUMNS[kind])
        # a loop closure between poses would be an odometry edge too: the format has none
        if start != newest:
            raise DatasetError(
                f"{path}, line {number}: starts at pose {rest[0]}, but the newest pose is {newest};"
                " expected one chain of poses from 0, with landmarks seen from the newest"
            )
        if kind == "ODOMETRY":
            newest = int(end)
            steps.append(values)
        else:
            points.append(values)
            ids.append([int(end)])
            poses.append(len(steps))
    if not steps:
        raise DatasetError(f"{path}: holds no ODOMETRY line; expected {PARK_LINES}")
    return stepped_sequence(
        "victoria_park",
        _run(steps, PARK_STEP_COV_PLACES, poses, points, ids, np.eye(3)),
        {
            "data set": "Victoria Park; Guivant, Nebot, IEEE T-RA 17(3), 2001; edge list of GTSAM's examples",
            "noise": "the file's covariances",
        },
    )


def _lines(
    path: Path, expected: str, *kinds: str
) -> Iterator[tuple[int, str, list[str]]]:
    """Number, kind and other fields of each line; a `DatasetError` for other kinds."""
    for number, (kind, *rest) in read_lines(path, expected):
        if kind not in kinds:
            raise DatasetError(
                f"{path}, line {number}: begins with {kind!r}; expected {expected}"
            )
        yield number, kind, rest


def _run(
    steps: list[list[float]],
    step_cov_places: list[list[int]],
    poses: list[int],
    points: list[list[float]],
    ids: list[list[int]],
    body_R_file: Floats,
) -> StepRun:
    """Steps and landmarks in body axes; the rows of the file hold a displacement, then elements of its covariance."""
    rows = np.array(steps)  # (n, 9)
    seen = np.array(points).reshape(-1, 5)  # (m, 5)
    step_covs = rows[:, 3:][:, step_cov_places]
    point_covs = seen[:, 2:][:, POINT_COV_PLACES]
    # a reflection in the plane, which turns the sense of angles
    plane = body_R_file[:2, :2]
    return StepRun(
        steps=rows[:, :3] @ body_R_file.T,
        step_covs=body_R_file @ step_covs @ body_R_file.T,
        poses=poses,
        points=seen[:, :2] @ plane.T,
        point_covs=plane @ point_covs @ plane.T,
        ids=ids,
    )
