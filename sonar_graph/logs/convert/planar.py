"""Planar robots as vehicles whose Doppler log measures (v_x, v_y, 0) and whose gyro measures (0, 0, ω).

A file of steps has no times: each step ``(dx, dy, dθ)`` takes T = 1 s here, and becomes the constant twist that makes
it, the logarithm of SE(2). With ``p = V(dθ) v T`` and ``V`` the left Jacobian of SO(2)::

    ω = dθ / T
    v = V(dθ)^-1 (dx, dy) / T,    V(θ)^-1 = [[h, θ/2], [-θ/2, h]],    h = (θ/2) / tan(θ/2)

Held over the step, it composes to the step exactly. See ``docs/theory/datasets.md``.

Files of odometry steps and landmarks seen between them: DLR Spatial Cognition and Victoria Park; neither has times.

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

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    PlanarMotion,
    SonarCalibration,
    Start,
)
from sonar_graph.errors import DatasetError
from sonar_graph.files import text_of
from sonar_graph.logs.adapters import range_and_azimuth
from sonar_graph.measurements import (
    NS_PER_S,
    Dvl,
    Floats,
    Imu,
    Ints,
    LandmarkDetections,
)
from sonar_graph.sequence import Sequence

FLOOR_SIGMA_M = 1e-3
"""Sigma of a landmark's height over the plane in which it was measured."""
SMALL_ANGLE_RAD = 1e-4
"""Angle below which the series for h is exact to 1e-18."""
VERTICAL_VELOCITY_SIGMA_M_S = 1e-3
"""Sigma of the vertical velocity, which is zero by construction; the planar prior does the rest."""
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


def twists_of_steps(steps: Floats, covs: Floats) -> tuple[Floats, Floats, Floats]:
    """Velocity, its covariance, and rate that make the steps in a second.

    The covariance is that of the velocity given the turn, ``V^-1 S V^-T / T²`` with S the covariance of (dx, dy). The
    correlation with the turn is left out, since the two sensors are independent.

    ``steps``: (dx, dy, dθ) in the frame before the step (x forward, y left), shape (n, 3), metres and radians; turns
    within (-2π, 2π); ``covs``: covariances of the steps, shape (n, 3, 3).

    Returns (v_x, v_y), shape (n, 2), m/s; its covariance, shape (n, 2, 2), m²/s²; ω, shape (n,), rad/s.
    """
    angle_rad = steps[:, 2]
    half = 0.5 * angle_rad
    # at zero the tangent's quotient is 0 / 0
    small = np.abs(angle_rad) < SMALL_ANGLE_RAD
    h = np.where(
        small, 1.0 - angle_rad**2 / 12.0, half / np.tan(np.where(small, 1.0, half))
    )
    V_inverse = np.stack([np.stack([h, half], -1), np.stack([-half, h], -1)], -2)
    velocity = np.einsum("nij,nj->ni", V_inverse, steps[:, :2])
    return (
        velocity,
        V_inverse @ covs[:, :2, :2] @ np.swapaxes(V_inverse, -1, -2),
        angle_rad,
    )


def planar_imu(stamps_ns: Ints, rate_rad_s: Floats) -> Imu:
    """Rows (0, 0, ω) without specific force."""
    angular_velocity = np.zeros((len(stamps_ns), 3))
    angular_velocity[:, 2] = rate_rad_s
    return Imu(stamps_ns, angular_velocity, np.full((len(stamps_ns), 3), np.nan))


def planar_dvl(stamps_ns: Ints, velocity: Floats, velocity_cov: Floats) -> Dvl:
    """Rows (v_x, v_y, 0) from velocities (n, 2) and their covariances (n, 2, 2)."""
    n = len(stamps_ns)
    cov = np.zeros((n, 3, 3))
    cov[:, :2, :2] = velocity_cov
    # the robot does not leave its plane; zero would make the covariance singular
    cov[:, 2, 2] = VERTICAL_VELOCITY_SIGMA_M_S**2
    return Dvl(stamps_ns, np.column_stack([velocity, np.zeros(n)]), cov)


def planar_calibration(
    gyro: tuple[float, float, float],
    velocity_sigma_m_s: tuple[float, float, float],
    sonar: SonarCalibration | None = None,
    start: Start | None = None,
) -> Calibration:
    """Calibration of a planar robot from its gyro's noise density, bias sigma and bias walk density, and its DVL's."""
    density, bias_sigma, walk_density = gyro
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=density,
            gyro_bias_sigma=bias_sigma,
            gyro_bias_walk_density=walk_density,
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=velocity_sigma_m_s),
        sonar=sonar or SonarCalibration(),
        start=start or Start(),
        floor=FloorPrior(z_m=0.0, sigma_m=FLOOR_SIGMA_M),
        planar=PlanarMotion(),
        # there are no forces, and each row holds over the step before it
        use_gravity=False,
        odometry_interpolation="hold-past",
    )


class StepSighting(NamedTuple):
    """A landmark in the frame of a pose, and its equally probable identities; negative ones are left out."""

    pose: int
    """Number of steps before it."""
    row: list[float]
    """(x, y), and three elements of their covariance."""
    ids: list[int]


def sequence_of_steps(
    name: str,
    steps: list[list[float]],
    seen: list[StepSighting],
    step_cov_places: list[list[int]],
    body_R_file: Floats,
    notes: Mapping[str, str],
) -> Sequence:
    """Sequence of a run; rows at the end of each step, and at rest at 0.

    The turn's noise is one density whose integral over a step has the mean variance of dθ,
    ``sqrt(mean(c_θθ) / T)``; that of the velocity is in the rows, and in the calibration their root mean square.
    The gyro has no bias.

    ``steps``: (dx, dy, dθ) in the frame before the step, and six elements of its covariance, whose columns are
    ``step_cov_places``; ``body_R_file``: body axes (x forward, y left) from those of the file.
    """
    rows = np.array(steps)  # (n, 9)
    covs = body_R_file @ rows[:, 3:][:, step_cov_places] @ body_R_file.T
    velocity, velocity_cov, rate_rad_s = twists_of_steps(
        rows[:, :3] @ body_R_file.T, covs
    )
    stamps_ns = np.arange(len(rows) + 1, dtype=np.int64) * NS_PER_S
    # before the first step the robot rests, as uncertain as in that step
    velocities = np.vstack([np.zeros(2), velocity])
    velocity_covs = np.concatenate([velocity_cov[:1], velocity_cov])
    dvl = planar_dvl(stamps_ns, velocities, velocity_covs)
    variances = np.mean(np.diagonal(dvl.velocity_cov, axis1=1, axis2=2), axis=0)
    x, y, z = np.sqrt(variances).tolist()
    gyro_noise_density = float(np.sqrt(np.mean(covs[:, 2, 2])))
    return Sequence(
        name=name,
        calibration=planar_calibration((gyro_noise_density, 0.0, 0.0), (x, y, z)),
        imu=planar_imu(stamps_ns, np.concatenate([[0.0], rate_rad_s])),
        dvl=dvl,
        detections=_detections(seen, stamps_ns, body_R_file[:2, :2]) if seen else None,
        notes={
            "time": "the file has none: the pose after n steps is at n seconds, so rates and speeds are per step",
            "truth": "none",
            "odometry": "each step as the constant twist that makes it in one second",
        }
        | dict(notes),
    )


def _detections(
    seen: list[StepSighting], stamps_ns: Ints, plane: Floats
) -> LandmarkDetections:
    """Landmarks as ranges and azimuths, at the end of the step before; ``plane`` turns the file's axes to the body's."""
    most = max(len(one.ids) for one in seen)
    candidate_ids = np.array([one.ids + [-1] * (most - len(one.ids)) for one in seen])
    # no identity is more probable than another
    is_known = candidate_ids >= 0
    id_probability = is_known / np.maximum(is_known.sum(axis=1, keepdims=True), 1)
    rows = np.array([one.row for one in seen])  # (m, 5)
    # a reflection in the plane turns the sense of angles
    point_covs = plane @ rows[:, 2:][:, POINT_COV_PLACES] @ plane.T
    # the sonar is in the plane of the landmarks
    points = np.pad(rows[:, :2] @ plane.T, ((0, 0), (0, 1)))
    polar = range_and_azimuth(points, np.pad(point_covs, ((0, 0), (0, 1), (0, 1))))
    poses = [one.pose for one in seen]
    return LandmarkDetections(stamps_ns[poses], *polar, candidate_ids, id_probability)


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
    seen: list[StepSighting] = []
    for place, kind, rest in _lines(path, DLR_LINES, "STEP", "LANDMARK", "LANDMARK_C"):
        if kind == "STEP":
            # the first number is that of an image
            steps.append(_numbers(place, rest[1:], DLR_STEP))
            continue
        if not steps:
            raise DatasetError(
                f"{place}: a landmark before the first STEP; expected {DLR_LINES}"
            )
        x, y, _, *cov = _numbers(place, rest[: len(DLR_POINT)], DLR_POINT)
        ids = rest[len(DLR_POINT) :]
        if not ids or not all(text.lstrip("-").isdecimal() for text in ids):
            raise DatasetError(
                f"{place}: {ids} are no landmark IDs; expected whole numbers after the covariances"
            )
        seen.append(StepSighting(len(steps), [x, y, *cov], list(map(int, ids))))
    if not steps:
        raise DatasetError(f"{path}: holds no STEP line; expected {DLR_LINES}")
    without = sum(one.ids == [-1] for one in seen)
    return sequence_of_steps(
        "dlr_spatial_cognition",
        steps,
        seen,
        DLR_STEP_COV_PLACES,
        BODY_OF_FILE,
        {
            "data set": "DLR Spatial Cognition; Kurlbaum, Frese, SFB/TR 8 report, 2009",
            "licence": "none stated",
            "noise": "the file's covariances; of the turn their mean, and not their correlation with the displacement",
            "detections": f"{without} of {len(seen)} have no identity (-1)",
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
    seen: list[StepSighting] = []
    newest = 0
    for place, kind, rest in _lines(path, PARK_LINES, *PARK_COLUMNS):
        start, end, *values = _numbers(place, rest, PARK_COLUMNS[kind])
        # a loop closure between poses would be an odometry edge too: the format has none
        if start != newest:
            raise DatasetError(
                f"{place}: starts at pose {rest[0]}, but the newest pose is {newest};"
                " expected one chain of poses from 0, with landmarks seen from the newest"
            )
        if kind == "ODOMETRY":
            newest = int(end)
            steps.append(values)
        else:
            seen.append(StepSighting(len(steps), values, [int(end)]))
    if not steps:
        raise DatasetError(f"{path}: holds no ODOMETRY line; expected {PARK_LINES}")
    return sequence_of_steps(
        "victoria_park",
        steps,
        seen,
        PARK_STEP_COV_PLACES,
        np.eye(3),
        {
            "data set": "Victoria Park; Guivant, Nebot, IEEE T-RA 17(3), 2001; edge list of GTSAM's examples",
            "noise": "the file's covariances",
        },
    )


def _lines(
    path: Path, expected: str, *kinds: str
) -> Iterator[tuple[str, str, list[str]]]:
    """Place, kind and other fields of each line with content; a `DatasetError` for other kinds."""
    try:
        lines = text_of(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(
            f"{path}: cannot be read as text ({getattr(error, 'strerror', None) or error}); expected {expected}"
        ) from error
    for number, line in enumerate(lines, 1):
        kind, *rest = line.split() or [""]
        if kind in kinds:
            yield f"{path}, line {number}", kind, rest
        elif kind and not kind.startswith("#"):
            raise DatasetError(
                f"{path}, line {number}: begins with {kind!r}; expected {expected}"
            )


def _numbers(place: str, texts: list[str], columns: tuple[str, ...]) -> list[float]:
    """Fields of one line as finite numbers, as many as there are columns."""
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = []
    # "nan" is a number to Python, and no measurement in these data sets
    if len(values) != len(columns) or not np.isfinite(values).all():
        raise DatasetError(
            f"{place}: {len(texts)} fields, {' '.join(texts)!r}; "
            f"expected {len(columns)} finite numbers: {', '.join(columns)}"
        )
    return values
