"""A-KIT "Snapir": an autonomous underwater vehicle at sea, fibre-optic IMU, Doppler log, navigation-system reference.

Cohen, Klein, "Adaptive Kalman-informed transformer", Engineering Applications of AI 146, 2025. A trajectory is a folder
``TrajectoryN`` of ``IMU_``, ``DVL_`` and ``GT_trajectoryN.csv``: 400 s at 100, 1 and 1 Hz, body axes forward, right,
down and a world of north, east, down. What the files do not say was told from the data of all seven trajectories
(``docs/theory/datasets.md`` has the figures):

- The IMU's y axis points the other way than that of the DVL and the reference, for rates and specific forces.
- The time columns spread the rows evenly from 0 to 400 s *inclusive*, which makes the second of the 1 Hz files 0.25 %
  longer than that of the IMU's. Against row number the clocks agree, so rows are timed by their number.
- Row k of the DVL measures at k + 1 s on the IMU's clock.
- The DVL sits 1.84 m behind the point whose velocity the reference gives, and the IMU 1.76 m behind
  that point.
- The gyros feel the Earth's rotation.

Latitude and longitude as metres east, north and up of a point.

WGS-84 ellipsoid, through Earth-centred coordinates, hence without the flat-Earth approximation::

    N = a / sqrt(1 - e² sin²φ)
    X = (N + h) cos φ cos λ,   Y = (N + h) cos φ sin λ,   Z = (N (1 - e²) + h) sin φ
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting, Start
from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert.text_tables import NumberTable, read_table, require_folder
from sonar_graph.measurements import Dvl, Floats, Imu, Ints
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.states import Trajectory

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


def earth_centred(latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats) -> Floats:
    """Earth-centred, Earth-fixed coordinates, shape (n, 3), metres."""
    sin, cos = np.sin(latitude_rad), np.cos(latitude_rad)
    N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin**2)
    across = (N + altitude_m) * cos
    return np.column_stack(
        [
            across * np.cos(longitude_rad),
            across * np.sin(longitude_rad),
            (N * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * sin,
        ]
    )


def enu_R_earth(latitude_rad: float, longitude_rad: float) -> Floats:
    """Rotation from Earth-centred axes to east, north, up at a point, shape (3, 3)."""
    sin_lat, cos_lat = np.sin(latitude_rad), np.cos(latitude_rad)
    sin_lon, cos_lon = np.sin(longitude_rad), np.cos(longitude_rad)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def east_north_up(latitude_rad: Floats, longitude_rad: Floats, altitude_m: Floats) -> Floats:
    """Positions relative to the first row horizontally and to altitude 0 vertically, shape (n, 3), metres."""
    origin = earth_centred(latitude_rad[:1], longitude_rad[:1], np.zeros(1))
    offsets = earth_centred(latitude_rad, longitude_rad, altitude_m) - origin
    return offsets @ enu_R_earth(float(latitude_rad[0]), float(longitude_rad[0])).T


IMU_PERIOD_NS = NS_PER_S // 100
DVL_PERIOD_NS = NS_PER_S
DVL_DELAY_NS = NS_PER_S
"""Instant of the DVL's first row on the IMU's clock."""
FLU_OF_FRD = np.array([1.0, -1.0, -1.0])
IMU_FRD_SIGNS = np.array([1.0, -1.0, 1.0])
"""Turns the IMU's own axes into forward, right, down."""
ENU_R_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Estimated from trajectories 1 to 7 against the reference (docs/theory/datasets.md).
GYRO_NOISE_DENSITY = 2e-5
GYRO_BIAS_SIGMA_RAD_S = 3e-6
GYRO_BIAS_WALK_DENSITY = 1e-8
VELOCITY_SIGMA_M_S = (0.01, 0.01, 0.005)
BODY_P_DVL_M = (-1.84, 0.03, -0.1)
BODY_P_IMU_M = (-1.76, 0.01, 0.1)
START_RPY_SIGMA_RAD = (0.01, 0.01, 0.03)
FILES = "TrajectoryN/{IMU,DVL,GT}_trajectoryN.csv"
IMU_COLUMNS = ("Time", "ACC X", "ACC Y", "ACC Z", "GYRO X", "GYRO Y", "GYRO Z")
DVL_COLUMNS = ("Time", "DVL X", "DVL Y", "DVL Z")
REFERENCE_COLUMNS = (
    "Time",
    "Longitude",
    "Latitude",
    "Altitude",
    "V North",
    "V East",
    "V Down",
    "Roll",
    "Pitch",
    "Yaw",
)


def read_akit(dataset_dir: Path, trajectory: int) -> Sequence:
    """One trajectory.

    Parameters
    ----------
    dataset_dir
        Folder that holds ``Trajectory1``, ``Trajectory2``, ...
    trajectory
        Which of them.

    Returns
    -------
    Sequence
        Time 0 is the IMU's first row; world x east, y north, z up, with the origin at the reference's first position
        at altitude 0. Without detections and depth, which the data set does not have.

    Raises
    ------
    DatasetError
        When the folder or the trajectory does not exist, or a file is missing or malformed.
    """
    folder = _trajectory_folder(dataset_dir, trajectory)
    imu_table, dvl_table, reference_table = (
        read_table(folder / f"{kind}_trajectory{trajectory}.csv", columns, delimiter=",", header_lines=1)
        for kind, columns in (("IMU", IMU_COLUMNS), ("DVL", DVL_COLUMNS), ("GT", REFERENCE_COLUMNS))
    )
    imu, dvl, truth = _imu(imu_table), _dvl(dvl_table), _reference(reference_table)
    start_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    latitude_rad = float(reference_table.values[0, 2])
    return Sequence(
        name=f"akit_trajectory{trajectory}",
        calibration=_calibration(_start(truth, start_ns, folder), latitude_rad),
        imu=imu,
        dvl=dvl,
        truth=truth,
        notes={
            "data set": "A-KIT Snapir; Cohen, Klein, Engineering Applications of AI 146, 2025",
            "licence": "none stated; the authors ask to be cited",
            "truth": "navigation system computed from the same IMU and DVL: a reference, no independent truth",
            "time": "rows timed by their number (IMU 100 Hz, DVL and reference 1 Hz), DVL one second later; "
            "poses of the reference are 0.4 to 0.5 s older (trajectories 1-4, 7) or newer (5, 6) than their time says",
            "imu": "y axes negated; forward-right-down turned to forward-left-up",
        },
    )


def _trajectory_folder(dataset_dir: Path, trajectory: int) -> Path:
    require_folder(dataset_dir, FILES)
    found = (re.fullmatch(r"Trajectory(\d+)", path.name) for path in dataset_dir.iterdir() if path.is_dir())
    numbers = sorted(int(match[1]) for match in found if match)
    if not numbers:
        raise DatasetError(f"{dataset_dir}: holds no folder TrajectoryN; give the folder that holds {FILES}")
    if trajectory not in numbers:
        raise DatasetError(f"{dataset_dir}: has no trajectory {trajectory}; it has {', '.join(map(str, numbers))}")
    return dataset_dir / f"Trajectory{trajectory}"


def _row_stamps(table: NumberTable, period_ns: int, first_ns: int = 0) -> Ints:
    return first_ns + np.arange(len(table.values), dtype=np.int64) * period_ns


def _imu(table: NumberTable) -> Imu:
    to_flu = FLU_OF_FRD * IMU_FRD_SIGNS
    return Imu(_row_stamps(table, IMU_PERIOD_NS), table.values[:, 4:7] * to_flu, table.values[:, 1:4] * to_flu)


def _dvl(table: NumberTable) -> Dvl:
    stamps_ns = _row_stamps(table, DVL_PERIOD_NS, DVL_DELAY_NS)
    return Dvl(stamps_ns, table.values[:, 1:] * FLU_OF_FRD, np.full((len(stamps_ns), 3, 3), np.nan))


def _reference(table: NumberTable) -> Trajectory:
    longitude, latitude, altitude = table.values[:, 1:4].T
    roll, pitch, yaw = table.values[:, 7:10].T
    return Trajectory.without_covariances(
        _row_stamps(table, DVL_PERIOD_NS),
        east_north_up(latitude, longitude, altitude),
        enu_R_flu(roll, pitch, yaw).as_quat(),
    )


def enu_R_flu(roll_rad: Floats, pitch_rad: Floats, yaw_rad: Floats) -> Rotation:
    """World (east, north, up) from body (forward, left, up), from the angles of north-east-down convention.

    ``enu_R_ned Rz(yaw) Ry(pitch) Rx(roll) frd_R_flu``.
    """
    ned_R_frd = Rotation.from_euler("ZYX", np.column_stack([yaw_rad, pitch_rad, roll_rad])).as_matrix()
    return Rotation.from_matrix(ENU_R_NED @ ned_R_frd @ np.diag(FLU_OF_FRD))


def _start(reference: Trajectory, start_ns: int, folder: Path) -> Start:
    if reference.stamps_ns[-1] < start_ns:
        raise DatasetError(f"{folder}: the reference has fewer than two rows; expected one a second")
    pose = reference.at(np.array([start_ns]))
    x, y, z = pose.positions[0].tolist()
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    return Start(
        position_m=(x, y, z),
        rpy_rad=(roll, pitch, yaw),
        rpy_sigma_rad=START_RPY_SIGMA_RAD,
    )


def _calibration(start: Start, latitude_rad: float) -> Calibration:
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=GYRO_NOISE_DENSITY,
            gyro_bias_sigma=GYRO_BIAS_SIGMA_RAD_S,
            gyro_bias_walk_density=GYRO_BIAS_WALK_DENSITY,
            mounting=Mounting(translation_m=BODY_P_IMU_M),
        ),
        dvl=DvlCalibration(velocity_sigma_m_s=VELOCITY_SIGMA_M_S, mounting=Mounting(translation_m=BODY_P_DVL_M)),
        start=start,
        use_gravity=False,  # at 2 m/s a turn feels like a tilt of degrees, while the gyros drift by hundredths
        odometry_interpolation="linear",
        earth_rate_latitude_rad=latitude_rad,
    )
