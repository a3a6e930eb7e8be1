"""Trajectories in the TUM format and landmarks as CSV, written for other tools.

TUM: one line a pose, ``t x y z qx qy qz qw``, seconds and metres
(https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats).
"""

from pathlib import Path

import numpy as np

from sonar_graph.errors import LogError
from sonar_graph.files import replacing
from sonar_graph.measurements import NS_PER_S
from sonar_graph.states import LandmarkMap, Trajectory

LANDMARK_COLUMNS = "id,x_m,y_m,z_m,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
_UPPER = np.triu_indices(3)
_LINE = "%s" + " %.17g" * 7 + "\n"
"""17 digits keep every bit of a double, in less than half the time that the shortest form takes."""


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
        # a float of seconds since 1970 has no nanoseconds
        seconds, nanoseconds = divmod(abs(stamp_ns), NS_PER_S)
        stamp = f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"
        lines.append(_LINE % (stamp, *pose))
    write_text(path, "".join(lines))


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
    lines = [LANDMARK_COLUMNS]
    # symmetric: the upper triangle is all
    triangles = landmarks.covariances[:, _UPPER[0], _UPPER[1]]
    numbers = np.hstack([landmarks.positions, triangles]).tolist()
    lines += [
        f"{i},{','.join(map(repr, row))}"
        for i, row in zip(landmarks.ids.tolist(), numbers, strict=True)
    ]
    write_text(path, "\n".join(lines) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file whole, or not at all; a LogError where it cannot be written."""
    try:
        with replacing(Path(path)) as partial:
            partial.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error
