"""Trajectories in the TUM format and landmarks as CSV: text files that other tools read.

TUM: one line a pose, ``t x y z qx qy qz qw``, seconds and metres
(https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats).
"""

import csv
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.files import regular, replacing, text_of
from sonar_graph.measurements import NS_PER_S
from sonar_graph.states import LandmarkMap, Trajectory

LANDMARK_COLUMNS = (
    "id",
    "x_m",
    "y_m",
    "z_m",
    "cov_xx",
    "cov_xy",
    "cov_xz",
    "cov_yy",
    "cov_yz",
    "cov_zz",
)
_UPPER = np.triu_indices(3)
_VALUES = 8
_LINE = "%s" + " %.17g" * (_VALUES - 1) + "\n"
"""17 digits keep every bit of a double, in less than half the time that the shortest form takes."""


def decimal_ns(seconds: str) -> int:
    """Nanoseconds of a decimal number of seconds, rounded once.

    A double cannot tell apart neighbouring nanoseconds of times counted from 1970; the text can.

    Raises `ValueError` when the text is no finite number.
    """
    try:
        return int((Decimal(seconds) * NS_PER_S).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise ValueError(f"{seconds!r} is no finite decimal number") from error


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write poses, with stamps of nine decimals made from integers, so that no nanosecond is lost.

    Raises
    ------
    LogError
        When the file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sonar_graph.logs import write_tum
    >>> from sonar_graph.testing import small_world
    >>> write_tum(Path("truth.tum"), small_world().true_poses)
    >>> len(Path("truth.tum").read_text().splitlines()[-1].split())
    8
    """
    poses = np.hstack([trajectory.positions, trajectory.quaternions_xyzw]).tolist()
    lines = []
    for stamp_ns, pose in zip(trajectory.stamps_ns.tolist(), poses, strict=True):
        seconds, nanoseconds = divmod(abs(stamp_ns), NS_PER_S)
        stamp = f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"
        lines.append(_LINE % (stamp, *pose))
    _write(path, "".join(lines))


def read_tum(path: Path) -> Trajectory:
    """Read poses without covariances; blank lines and lines that begin with ``#`` are skipped.

    Raises `LogError` naming the line that is not a pose; or when the file cannot be read or its stamps do not increase.
    """
    try:
        lines = text_of(Path(path)).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{path} cannot be read as a text file: {error}") from error
    stamps, poses = [], []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        stamp, *pose = line.split()
        if len(pose) != _VALUES - 1:
            raise LogError(
                f"{path}, line {number}: {len(pose) + 1} values; a pose has {_VALUES}: t x y z qx qy qz qw"
            )
        try:
            stamps.append(decimal_ns(stamp))
            poses.append([float(value) for value in pose])
        except ValueError as error:
            raise LogError(
                f"{path}, line {number}: {line!r} has something that is no number"
            ) from error
    stamps_ns = np.array(stamps, np.int64)
    values = np.array(poses).reshape(-1, _VALUES - 1)
    backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if backwards.size:
        raise LogError(
            f"{path}: pose {backwards[0] + 2} is not later than the one before; sort the lines by time"
        )
    return Trajectory.without_covariances(stamps_ns, values[:, :3], values[:, 3:])


def write_landmarks_csv(path: Path, landmarks: LandmarkMap) -> None:
    """Write positions and the upper triangles of their covariances (m, m²), one line a landmark.

    Raises
    ------
    LogError
        When the file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sonar_graph.logs import write_landmarks_csv
    >>> from sonar_graph.testing import small_world
    >>> write_landmarks_csv(Path("map.csv"), small_world().true_landmarks)
    >>> print(Path("map.csv").read_text().splitlines()[0])
    id,x_m,y_m,z_m,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz
    """
    lines = [",".join(LANDMARK_COLUMNS)]
    triangles = landmarks.covariances[:, _UPPER[0], _UPPER[1]]
    numbers = np.hstack([landmarks.positions, triangles]).tolist()
    lines += [
        f"{i},{','.join(map(repr, row))}"
        for i, row in zip(landmarks.ids.tolist(), numbers, strict=True)
    ]
    _write(path, "\n".join(lines) + "\n")


def read_landmarks_csv(path: Path) -> LandmarkMap:
    """Read what `write_landmarks_csv` wrote.

    Raises `LogError` when the file cannot be read, or a column is missing or not a number.
    """
    try:
        with regular(Path(path)).open(encoding="utf-8", newline="") as stream:
            rows = [
                [float(row[name]) for name in LANDMARK_COLUMNS]
                for row in csv.DictReader(stream)
            ]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise LogError(
            f"{path} is not a landmark table with columns {','.join(LANDMARK_COLUMNS)}: {error}"
        ) from error
    table = np.array(rows).reshape(-1, len(LANDMARK_COLUMNS))
    covariances = np.empty((len(table), 3, 3))
    covariances[:, _UPPER[0], _UPPER[1]] = covariances[:, _UPPER[1], _UPPER[0]] = table[
        :, 4:
    ]
    order = np.argsort(table[:, 0])
    return LandmarkMap(
        table[order, 0].astype(np.int64), table[order, 1:4], covariances[order]
    )


def _write(path: Path, text: str) -> None:
    try:
        with replacing(Path(path)) as partial:
            partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error
