"""UTIAS Multi-Robot Cooperative Localization and Mapping: planar robots among bar-coded tubes.

Leung, Halpern, Barfoot, Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR 30(8), 2011.

========================  =================================================================================
``RobotN_Odometry.dat``   time [s], forward velocity [m/s], angular velocity [rad/s]: what was *commanded*
``RobotN_Measurement``    time [s], bar code, range [m], bearing [rad], positive to the left
``RobotN_Groundtruth``    time [s], x [m], y [m], heading [rad] from motion capture; not in every set
``Landmark_Groundtruth``  subject, x [m], y [m], sigma of x, sigma of y
``Barcodes.dat``          subject, bar code; subjects 1 to 5 are robots, 6 to 20 landmarks
========================  =================================================================================

A command holds from its stamp to the next. Samples of a `Sequence` hold over the interval that *ends* at their stamp,
so the row at each stamp carries the command of the stamp before; stamps and values stay the data set's own. How that
was told from the other readings, and where the noise parameters come from: ``docs/theory/datasets.md``.
"""

from __future__ import annotations

import re
from pathlib import Path

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
from sonar_graph.logs.convert.planar import (
    FLOOR_SIGMA_M,
    VERTICAL_VELOCITY_SIGMA_M_S,
    planar_dvl,
    planar_imu,
    planar_trajectory,
)
from sonar_graph.logs.convert.text_tables import NumberTable, read_table, require_folder
from sonar_graph.measurements import Dvl, Imu, Ints, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

ROBOT_SUBJECTS = frozenset(range(1, 6))
# The same for every robot; estimated from robots 1 to 5 of set 6 against motion capture (docs/theory/datasets.md).
FORWARD_NOISE_M_SQRT_S = 0.02
"""Wheel slip along the heading: sigma of the distance over T is this times sqrt(T)."""
SIDEWAYS_NOISE_M_SQRT_S = 0.005
"""The same across the heading."""
GYRO_NOISE_DENSITY = 0.04
GYRO_BIAS_SIGMA_RAD_S = 0.003
GYRO_BIAS_WALK_DENSITY = 1e-5
RANGE_SIGMA_M = 0.18
AZIMUTH_SIGMA_RAD = 0.0125
TYPICAL_INTERVAL_S = 0.0145
"""Mean time between commands: the interval given to the first row, which has none, and to the calibration."""
FILES = "Barcodes.dat, Landmark_Groundtruth.dat, RobotN_Odometry.dat and RobotN_Measurement.dat"


def read_mrclam(dataset_dir: Path, robot: int) -> Sequence:
    """One robot's run.

    Parameters
    ----------
    dataset_dir
        Folder with the data set's files as distributed.
    robot
        Number of the robot in the file names.

    Returns
    -------
    Sequence
        Times, subjects and coordinates are the data set's own. Landmarks lie on the plane of the robot (z = 0).
        The start pose is the true one where there is truth at the first odometry stamp, else the origin.

    Raises
    ------
    DatasetError
        When the folder or the robot does not exist, or a file is missing or malformed.
    """
    require_folder(dataset_dir, FILES)
    prefix = _robot_prefix(dataset_dir, robot)
    imu, dvl = _odometry(read_table(Path(f"{prefix}_Odometry.dat"), ("time", "forward velocity", "angular velocity")))
    detections, dropped = _detections(
        read_table(Path(f"{prefix}_Measurement.dat"), ("time", "bar code", "range", "bearing")),
        _subjects_by_barcode(dataset_dir),
    )
    truth = _truth(Path(f"{prefix}_Groundtruth.dat"))
    start = _start(truth, int(imu.stamps_ns[0]))
    return Sequence(
        name=f"{dataset_dir.resolve().name}_robot{robot}",
        calibration=_calibration(start or Start()),
        imu=imu,
        dvl=dvl,
        detections=detections,
        truth=truth,
        true_landmarks=_true_landmarks(dataset_dir),
        notes=_notes(dropped, has_truth=truth is not None, true_start=start is not None),
    )


def _robot_prefix(dataset_dir: Path, robot: int) -> str:
    found = (re.fullmatch(r"Robot(\d+)_Odometry\.dat", path.name) for path in dataset_dir.iterdir())
    robots = sorted(int(match[1]) for match in found if match)
    if not robots:
        raise DatasetError(f"{dataset_dir}: holds no RobotN_Odometry.dat; give the folder that holds {FILES}")
    if robot not in robots:
        raise DatasetError(f"{dataset_dir}: has no robot {robot}; it has {', '.join(map(str, robots))}")
    return str(dataset_dir / f"Robot{robot}")


def _odometry(table: NumberTable) -> tuple[Imu, Dvl]:
    stamps_ns, rows = _last_of_each_stamp(table.stamps_ns())
    commands = table.values[rows, 1:]
    in_force = np.concatenate([commands[:1], commands[:-1]])
    interval_s = np.concatenate([[TYPICAL_INTERVAL_S], np.diff(stamps_ns) * 1e-9])
    noise = np.diag(np.square([FORWARD_NOISE_M_SQRT_S, SIDEWAYS_NOISE_M_SQRT_S]))
    velocity = np.column_stack([in_force[:, 0], np.zeros(len(stamps_ns))])
    return (
        planar_imu(stamps_ns, in_force[:, 1]),
        planar_dvl(stamps_ns, velocity, noise / interval_s[:, None, None]),
    )


def _last_of_each_stamp(stamps_ns: Ints) -> tuple[Ints, Ints]:
    """Stamps in order, each once, and the row that was written last for each: the command that then held."""
    stamps, first_from_end = np.unique(stamps_ns[::-1], return_index=True)
    return stamps, len(stamps_ns) - 1 - first_from_end


def _subjects_by_barcode(dataset_dir: Path) -> dict[int, int]:
    table = read_table(dataset_dir / "Barcodes.dat", ("subject", "bar code"))
    return {int(barcode): int(subject) for subject, barcode in table.values}


def _detections(table: NumberTable, subjects: dict[int, int]) -> tuple[LandmarkDetections | None, dict[str, int]]:
    stamps_ns = table.stamps_ns()
    order = np.argsort(stamps_ns, kind="stable")
    seen = np.array([subjects.get(int(barcode), -1) for barcode in table.values[:, 1]], dtype=np.int64)
    of_robot = np.isin(seen, list(ROBOT_SUBJECTS))
    dropped = {"robots": int(of_robot.sum()), "unknown": int((seen < 0).sum())}
    rows = order[(~of_robot & (seen >= 0))[order]]
    if not len(rows):
        return None, dropped
    detections = LandmarkDetections(
        stamps_ns=stamps_ns[rows],
        range_m=table.values[rows, 2],
        azimuth_rad=table.values[rows, 3],
        range_azimuth_cov=np.full((len(rows), 2, 2), np.nan),
        candidate_ids=seen[rows, None],
        id_probability=np.ones((len(rows), 1)),
    )
    return detections, dropped


def _truth(path: Path) -> Trajectory | None:
    if not path.exists():
        return None
    table = read_table(path, ("time", "x", "y", "orientation"))
    stamps_ns, rows = np.unique(table.stamps_ns(), return_index=True)
    return planar_trajectory(stamps_ns, table.values[rows, 1:])


def _true_landmarks(dataset_dir: Path) -> LandmarkMap:
    columns = ("subject", "x", "y", "sigma of x", "sigma of y")
    values = read_table(dataset_dir / "Landmark_Groundtruth.dat", columns).values
    values = values[np.argsort(values[:, 0])]
    covariances = np.zeros((len(values), 3, 3))
    covariances[:, 0, 0], covariances[:, 1, 1] = values[:, 3] ** 2, values[:, 4] ** 2
    positions = np.column_stack([values[:, 1:3], np.zeros(len(values))])
    return LandmarkMap(values[:, 0].astype(np.int64), positions, covariances)


def _start(truth: Trajectory | None, start_ns: int) -> Start | None:
    if truth is None or not truth.stamps_ns[0] <= start_ns <= truth.stamps_ns[-1]:
        return None
    pose = truth.at(np.array([start_ns]))
    x, y, z = pose.positions[0].tolist()
    yaw = float(pose.rotations().as_euler("ZYX")[0, 0])
    return Start(position_m=(x, y, z), rpy_rad=(0.0, 0.0, yaw))


def _calibration(start: Start) -> Calibration:
    per_sample = np.sqrt(TYPICAL_INTERVAL_S)
    return Calibration(
        imu=ImuCalibration(
            gyro_noise_density=GYRO_NOISE_DENSITY,
            gyro_bias_sigma=GYRO_BIAS_SIGMA_RAD_S,
            gyro_bias_walk_density=GYRO_BIAS_WALK_DENSITY,
        ),
        dvl=DvlCalibration(
            velocity_sigma_m_s=(
                float(FORWARD_NOISE_M_SQRT_S / per_sample),
                float(SIDEWAYS_NOISE_M_SQRT_S / per_sample),
                VERTICAL_VELOCITY_SIGMA_M_S,
            )
        ),
        sonar=SonarCalibration(range_sigma_m=RANGE_SIGMA_M, azimuth_sigma_rad=AZIMUTH_SIGMA_RAD),
        start=start,
        floor=FloorPrior(z_m=0.0, sigma_m=FLOOR_SIGMA_M),
        planar=PlanarMotion(),
        use_gravity=False,
        odometry_interpolation="hold-past",
    )


def _notes(dropped: dict[str, int], *, has_truth: bool, true_start: bool) -> dict[str, str]:
    return {
        "data set": "UTIAS MRCLAM; Leung, Halpern, Barfoot, Liu, IJRR 30(8), 2011",
        "licence": "none stated; the authors ask to be cited",
        "truth": "motion capture" if has_truth else "of the landmarks only; this set has no robot truth",
        "start": "true pose at the first odometry stamp" if true_start else "origin: no truth at the first stamp",
        "odometry": "commanded velocities, each held until the next; the row at a stamp holds the command before it",
        "detections": f"left out: {dropped['robots']} of other robots, {dropped['unknown']} with unknown bar codes",
        "noise": "estimated from robots 1-5 of set 6 against motion capture; the same for every robot",
    }
