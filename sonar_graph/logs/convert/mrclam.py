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
so the row at each stamp carries the command of the stamp before. ``docs/theory/datasets.md`` has the evidence for that
and the origin of the noise parameters.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import SonarCalibration, Start
from sonar_graph.logs.convert.planar import (
    VERTICAL_VELOCITY_SIGMA_M_S,
    planar_calibration,
    planar_dvl,
    planar_imu,
)
from sonar_graph.logs.convert.text_tables import NumberTable, numbered_run, read_table
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

ROBOT_SUBJECTS = frozenset(range(1, 6))
# The same for every robot; estimated from robots 1 to 5 of set 6 against motion capture (docs/theory/datasets.md).
FORWARD_NOISE_M_SQRT_S = 0.02
"""Wheel slip along the heading: the sigma of the distance over T is this times sqrt(T)."""
SIDEWAYS_NOISE_M_SQRT_S = 0.005
"""Wheel slip across the heading."""
GYRO = (0.04, 0.003, 1e-5)
"""Noise density, bias sigma in rad/s, bias walk density."""
RANGE_SIGMA_M = 0.18
AZIMUTH_SIGMA_RAD = 0.0125
TYPICAL_INTERVAL_S = 0.0145
"""Mean time between commands, used for the first row, which has no interval, and for the calibration."""
FILES = "Barcodes.dat, Landmark_Groundtruth.dat, RobotN_Odometry.dat and RobotN_Measurement.dat"


def read_mrclam(dataset_dir: Path, robot: int) -> Sequence:
    """Sequence of one robot's run.

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
    odometry = numbered_run(dataset_dir, "RobotN_Odometry.dat", robot, FILES)
    imu, dvl = _odometry(
        read_table(odometry, ("time", "forward velocity", "angular velocity"))
    )
    detections, left_out = _detections(
        read_table(
            dataset_dir / f"Robot{robot}_Measurement.dat",
            ("time", "bar code", "range", "bearing"),
        ),
        read_table(dataset_dir / "Barcodes.dat", ("subject", "bar code")),
    )
    truth = None
    start = None
    true_poses = dataset_dir / f"Robot{robot}_Groundtruth.dat"
    if true_poses.exists():
        table = read_table(true_poses, ("time", "x", "y", "orientation"))
        # motion capture repeats some stamps; the first row of each counts
        stamps_ns, rows = np.unique(table.stamps_ns, return_index=True)
        x_m, y_m, heading_rad = table.values[rows, 1:].T
        quaternions = Rotation.from_euler("z", heading_rad[:, None]).as_quat()
        truth = Trajectory.without_covariances(
            stamps_ns, np.column_stack([x_m, y_m, np.zeros(len(rows))]), quaternions
        )
        start_ns = int(imu.stamps_ns[0])
        if truth.stamps_ns[0] <= start_ns <= truth.stamps_ns[-1]:
            pose = truth.at(np.array([start_ns]))
            x, y, z = pose.positions[0].tolist()
            yaw = float(pose.rotations().as_euler("ZYX")[0, 0])
            start = Start(position_m=(x, y, z), rpy_rad=(0.0, 0.0, yaw))
    columns = ("subject", "x", "y", "sigma of x", "sigma of y")
    values = read_table(dataset_dir / "Landmark_Groundtruth.dat", columns).values
    values = values[np.argsort(values[:, 0])]
    covariances = np.zeros((len(values), 3, 3))
    covariances[:, 0, 0] = values[:, 3] ** 2
    covariances[:, 1, 1] = values[:, 4] ** 2
    positions = np.column_stack([values[:, 1:3], np.zeros(len(values))])
    # the rows have their own noise; that of the calibration is for a typical interval
    interval_sqrt = float(np.sqrt(TYPICAL_INTERVAL_S))
    velocity_sigma_m_s = (
        FORWARD_NOISE_M_SQRT_S / interval_sqrt,
        SIDEWAYS_NOISE_M_SQRT_S / interval_sqrt,
        VERTICAL_VELOCITY_SIGMA_M_S,
    )
    return Sequence(
        name=f"{dataset_dir.resolve().name}_robot{robot}",
        calibration=planar_calibration(
            GYRO,
            velocity_sigma_m_s,
            SonarCalibration(
                range_sigma_m=RANGE_SIGMA_M, azimuth_sigma_rad=AZIMUTH_SIGMA_RAD
            ),
            start,
        ),
        imu=imu,
        dvl=dvl,
        detections=detections,
        truth=truth,
        true_landmarks=LandmarkMap(
            values[:, 0].astype(np.int64), positions, covariances
        ),
        notes={
            "data set": "UTIAS MRCLAM; Leung, Halpern, Barfoot, Liu, IJRR 30(8), 2011",
            "licence": "none stated; the authors ask to be cited",
            "truth": "motion capture"
            if truth is not None
            else "of the landmarks only; this set has no robot truth",
            "start": "true pose at the first odometry stamp"
            if start
            else "origin: no truth at the first stamp",
            "odometry": "commanded velocities, each held until the next; "
            "the row at a stamp holds the command before it",
            "detections": left_out,
            "noise": "estimated from robots 1-5 of set 6 against motion capture; the same for every robot",
        },
    )


def _odometry(table: NumberTable) -> tuple[Imu, Dvl]:
    """Sensor rows of the commanded velocities; of several commands at one stamp the last counts."""
    stamps_ns, first_from_end = np.unique(table.stamps_ns[::-1], return_index=True)
    commands = table.values[len(table.values) - 1 - first_from_end, 1:]
    # a command holds until the next, a row of a sequence over the interval before it
    in_force = np.concatenate([commands[:1], commands[:-1]])
    interval_s = np.concatenate([[TYPICAL_INTERVAL_S], np.diff(stamps_ns) * 1e-9])
    # slip is a random walk: its variance as a velocity falls with the interval
    noise = np.diag(np.square([FORWARD_NOISE_M_SQRT_S, SIDEWAYS_NOISE_M_SQRT_S]))
    velocity = np.column_stack([in_force[:, 0], np.zeros(len(stamps_ns))])
    dvl = planar_dvl(stamps_ns, velocity, noise / interval_s[:, None, None])
    return planar_imu(stamps_ns, in_force[:, 1]), dvl


def _detections(
    table: NumberTable, barcodes: NumberTable
) -> tuple[LandmarkDetections | None, str]:
    """Detections of landmarks in the order of time, and a note about those left out."""
    subjects = {int(barcode): int(subject) for subject, barcode in barcodes.values}
    stamps_ns = table.stamps_ns
    # stable: detections of one image keep their order
    order = np.argsort(stamps_ns, kind="stable")
    seen = np.array(
        [subjects.get(int(barcode), -1) for barcode in table.values[:, 1]],
        dtype=np.int64,
    )
    of_robot = np.isin(seen, list(ROBOT_SUBJECTS))
    note = f"left out: {of_robot.sum()} of other robots, {(seen < 0).sum()} with unknown bar codes"
    rows = order[(~of_robot & (seen >= 0))[order]]
    if not len(rows):
        return None, note
    detections = LandmarkDetections(
        stamps_ns=stamps_ns[rows],
        range_m=table.values[rows, 2],
        azimuth_rad=table.values[rows, 3],
        range_azimuth_cov=np.full((len(rows), 2, 2), np.nan),
        candidate_ids=seen[rows, None],
        id_probability=np.ones((len(rows), 1)),
    )
    return detections, note
