"""A-KIT "Snapir": an autonomous underwater vehicle at sea, fibre-optic IMU, Doppler log, navigation-system reference.

Cohen, Klein, "Adaptive Kalman-informed transformer", Engineering Applications of AI 146, 2025. A trajectory is a folder
``TrajectoryN`` of ``IMU_``, ``DVL_`` and ``GT_trajectoryN.csv``: 400 s at 100, 1 and 1 Hz, body axes forward, right,
down and a world of north, east, down. ``docs/theory/datasets.md`` derives from the data what the files do not state:
the sign of the IMU's y axis, the times of the rows, the lever arms, and that the gyros measure the Earth's rotation.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.errors import DatasetError
from sonar_graph.logs.adapters import ENU_R_NED, east_north_up
from sonar_graph.logs.convert.text_tables import DATA_SETS, numbered_run, read_table
from sonar_graph.measurements import NS_PER_S, Dvl, Floats, Imu
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

IMU_PERIOD_NS = NS_PER_S // 100
DVL_PERIOD_NS = NS_PER_S
DVL_DELAY_NS = NS_PER_S
"""Time of the DVL's first row on the IMU's clock."""
FLU_OF_FRD = np.array([1.0, -1.0, -1.0])
IMU_FRD_SIGNS = np.array([1.0, -1.0, 1.0])
"""Signs that turn the IMU's own axes into forward, right, down."""
LEAST_POSES = 30
OFFSETS_S = np.arange(-1.0, 1.005, 0.01)
"""Offsets of the reference's stamps that are tried."""
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


def reference_offset_s(imu: Imu, reference: Trajectory) -> float:
    """Seconds to add to the reference's stamps so that it turns when the gyros do; 0 where the best is the last tried.

    The offset τ, about one of `OFFSETS_S`, whose sum of ``|Log(R_k^T R_k+1) - ∫ ω dt - mean|²`` is least. The integral
    is from ``t_k + τ`` to ``t_k+1 + τ``, and the mean is what gyro bias and the Earth add.
    """
    if len(reference) < LEAST_POSES:
        return 0.0
    first_ns = imu.stamps_ns[0]
    seconds = (imu.stamps_ns - first_ns) * 1e-9
    knots = (reference.stamps_ns - first_ns) * 1e-9
    rates = imu.angular_velocity
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(seconds)[:, None]
    # integral of ω; over a second the turns are small enough to add as vectors
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    # the same knots for each offset, so that the misfits are of as many terms
    is_inside = knots + OFFSETS_S[0] >= seconds[0]
    is_inside &= knots + OFFSETS_S[-1] <= seconds[-1]
    knots = knots[is_inside]
    knots_ns = first_ns + np.rint(knots * NS_PER_S).astype(np.int64)
    rotations = reference.at(knots_ns).rotations()
    of_reference = (rotations[:-1].inv() * rotations[1:]).as_rotvec()

    def misfit(offset_s: float) -> float:
        by_gyros = [
            np.diff(np.interp(knots + offset_s, seconds, turned[:, axis]))
            for axis in range(3)
        ]
        return float(np.var(np.column_stack(by_gyros) - of_reference, axis=0).sum())

    misfits = np.array([misfit(offset_s) for offset_s in OFFSETS_S])
    best = int(np.argmin(misfits))
    if not 0 < best < len(OFFSETS_S) - 1:
        return 0.0
    # the vertex of the parabola through the least misfit and those beside it
    before, least, after = misfits[best - 1 : best + 2].tolist()
    vertex = 0.5 * (before - after) / (before - 2 * least + after)
    return float(OFFSETS_S[best] + vertex * (OFFSETS_S[1] - OFFSETS_S[0]))


def read_akit(dataset_dir: Path, trajectory: int) -> Sequence:
    """Sequence of one trajectory.

    Parameters
    ----------
    dataset_dir
        Folder that holds ``Trajectory1``, ``Trajectory2``, ...
    trajectory
        Number of the trajectory.

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
    folder = numbered_run(dataset_dir, "TrajectoryN", trajectory, FILES)

    # the times in the files are rounded: rows count by their number
    def rows_of(kind: str, columns: tuple[str, ...]) -> Floats:
        path = folder / f"{kind}_trajectory{trajectory}.csv"
        return read_table(path, columns, delimiter=",").values

    imu_rows = rows_of("IMU", IMU_COLUMNS)
    dvl_rows = rows_of("DVL", DVL_COLUMNS)
    reference_rows = rows_of("GT", REFERENCE_COLUMNS)
    imu_ns = np.arange(len(imu_rows), dtype=np.int64) * IMU_PERIOD_NS
    dvl_ns = np.arange(len(dvl_rows), dtype=np.int64) * DVL_PERIOD_NS
    reference_ns = np.arange(len(reference_rows), dtype=np.int64) * DVL_PERIOD_NS
    to_flu = FLU_OF_FRD * IMU_FRD_SIGNS
    imu = Imu(imu_ns, imu_rows[:, 4:7] * to_flu, imu_rows[:, 1:4] * to_flu)
    velocity = dvl_rows[:, 1:] * FLU_OF_FRD
    unknown = np.full((len(dvl_ns), 3, 3), np.nan)
    dvl = Dvl(DVL_DELAY_NS + dvl_ns, velocity, unknown)
    longitude, latitude, altitude = reference_rows[:, 1:4].T
    # roll, pitch and yaw of north-east-down: enu_R_ned Rz(yaw) Ry(pitch) Rx(roll) frd_R_flu
    ned_R_frd = Rotation.from_euler("ZYX", reference_rows[:, 9:6:-1]).as_matrix()
    enu_R_flu = ENU_R_NED @ ned_R_frd @ np.diag(FLU_OF_FRD)
    quaternions = Rotation.from_matrix(enu_R_flu).as_quat()
    origin = (float(latitude[0]), float(longitude[0]), 0.0)
    positions = east_north_up(latitude, longitude, altitude, origin)
    truth = Trajectory.without_covariances(reference_ns, positions, quaternions)
    offset_s = reference_offset_s(imu, truth)
    truth = replace(truth, stamps_ns=reference_ns + round(offset_s * NS_PER_S))
    # before the IMU's first row there is nothing to compare
    truth = truth.rows(np.flatnonzero(truth.stamps_ns >= 0))
    start_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    if truth.stamps_ns[-1] < start_ns:
        raise DatasetError(
            f"{folder}: the reference has fewer than two rows; expected one a second"
        )
    start = truth.at(np.array([start_ns]))
    x, y, z = start.positions[0].tolist()
    yaw, pitch, roll = start.rotations().as_euler("ZYX")[0].tolist()
    known = DATA_SETS["akit"]
    pose = {"position_m": (x, y, z), "rpy_rad": (roll, pitch, yaw)}
    of_run = {
        "start": known["start"] | pose,
        "earth_rate_latitude_rad": float(latitude[0]),
    }
    calibration = Calibration.model_validate(known | of_run)
    return Sequence(
        name=f"akit_trajectory{trajectory}",
        calibration=calibration,
        imu=imu,
        dvl=dvl,
        truth=truth,
        notes={
            "data set": "A-KIT Snapir; Cohen, Klein, Engineering Applications of AI 146, 2025",
            "licence": "none stated; the authors ask to be cited",
            "truth": "navigation system computed from the same IMU and DVL: a reference, no independent truth",
            "time": "rows timed by their number (IMU 100 Hz, DVL and reference 1 Hz), DVL one second later; "
            f"the reference moved by {offset_s:+.3f} s, so that it turns when the gyros do",
            "imu": "y axes negated; forward-right-down turned to forward-left-up",
        },
    )
