"""St. Pere Pescador: an underwater vehicle with a cheap inertial unit in an abandoned marina, satellite positions.

Ribas, Ridao, Tardós, Neira, "Underwater SLAM in man-made structured environments", Journal of Field Robotics 25(11-12),
2008. 3345 s and 645 m; text files with comments after ``%``, each row with its time first:

``MTI.log``   roll, pitch, yaw (degrees, north-east-down), angular rates (rad/s), specific forces (m/s²); 10 Hz
``DVL.log``   date and time (6), velocity through water and status (4), over the bottom in cm/s and status (4), ...
``DGPS.log``  latitude and longitude (ddmm.mmmm), status, height above sea level, ...: a buoy at the surface; 1 Hz

``docs/theory/datasets.md`` has what the files do not say: axes, mountings, biases and noise.
"""

from pathlib import Path

import numpy as np

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    HeadingCalibration,
    ImuCalibration,
    Mounting,
    Start,
)
from sonar_graph.errors import DatasetError
from sonar_graph.logs.adapters import east_north_up
from sonar_graph.logs.convert.akit import FLU_OF_FRD, enu_R_flu
from sonar_graph.logs.convert.text_tables import NumberTable, read_table
from sonar_graph.measurements import Dvl, Floats, Heading, Imu
from sonar_graph.sequence import Sequence
from sonar_graph.states import Trajectory

MTI_COLUMNS = (
    "time",
    *("roll", "pitch", "yaw"),
    *("rate x", "rate y", "rate z"),
    *("force x", "force y", "force z"),
)
CLOCK = ("year", "month", "day", "hour", "minute", "second")
DVL_COLUMNS = (
    *("time", *CLOCK, "water x", "water y", "water z", "water status"),
    *("bottom x", "bottom y", "bottom z", "bottom status"),
    *(
        "range 1",
        "range 2",
        "range 3",
        "amplitude 1",
        "amplitude 2",
        "amplitude 3",
        "good pings",
        "heading",
        "pitch",
    ),
    *(
        "roll",
        "temperature",
        "pressure",
        "power",
        "sound speed 1",
        "sound speed 2",
        "distance x",
        "distance y",
    ),
)
FIX_COLUMNS = (
    *("time", "latitude", "longitude", "status", "height", "geoid height"),
    *("true course", "magnetic course", "knots", "km/h"),
)
FILES = {"MTI.log": MTI_COLUMNS, "DVL.log": DVL_COLUMNS, "DGPS.log": FIX_COLUMNS}
BODY_YAW_IMU_RAD = -np.pi / 2
BODY_YAW_DVL_RAD = -np.pi / 3
GYRO_Z_BIAS_RAD_S = -0.0116
"""About the body's z (up)."""
COMPASS = HeadingCalibration(sigma_rad=0.1, bias_sigma_rad=0.1)


def read_stpere(dataset_dir: Path) -> Sequence:
    """Sequence of the run.

    Parameters
    ----------
    dataset_dir
        Folder that holds ``MTI.log``, ``DVL.log`` and ``DGPS.log``.

    Returns
    -------
    Sequence
        Body axes of the vehicle; world x east, y north by the compass, with the origin at the first satellite position.
        Yaw of the attitude reference as heading; the truth has positions only. Rows of the Doppler log without
        bottom lock are left out, its spikes are not. No detections.

    Raises
    ------
    DatasetError
        When the folder does not exist, or a file is missing or malformed.
    """
    advice = f"give the folder that holds {', '.join(FILES)}"
    if not dataset_dir.is_dir():
        raise DatasetError(f"{dataset_dir}: is not a folder; {advice}")
    if missing := [name for name in FILES if not (dataset_dir / name).exists()]:
        raise DatasetError(f"{dataset_dir}: holds no {', '.join(missing)}; {advice}")
    inertial, doppler, fixes = (
        read_table(dataset_dir / name, columns, comment="%", encoding="latin-1")
        for name, columns in FILES.items()
    )
    imu, bias = _inertial_rows(inertial)
    has_lock = doppler.values[:, DVL_COLUMNS.index("bottom status")] == 1
    velocity = (
        0.01
        * doppler.values[
            has_lock, DVL_COLUMNS.index("bottom x") : DVL_COLUMNS.index("bottom status")
        ]
    )
    dvl = Dvl(
        doppler.stamps_ns()[has_lock], velocity, np.full((len(velocity), 3, 3), np.nan)
    )
    angles = np.radians(inertial.values[:, 1:4])
    yaw_rad = enu_R_flu(*angles.T).as_euler("ZYX")[:, 0] - BODY_YAW_IMU_RAD
    heading = Heading(imu.stamps_ns, yaw_rad, np.full(len(imu), np.nan))
    latitude, longitude = (
        np.radians(_degrees(fixes.values[:, column])) for column in (1, 2)
    )
    height = fixes.values[:, FIX_COLUMNS.index("height")]
    origin = float(latitude[0]), float(longitude[0]), float(height[0])
    truth = Trajectory.of_positions(
        fixes.stamps_ns(), east_north_up(latitude, longitude, height, origin)
    )
    start_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    x, y, _ = (
        truth.at(np.array([max(start_ns, int(truth.stamps_ns[0]))]))
        .positions[0]
        .tolist()
    )
    start_yaw = float(
        np.interp(start_ns, heading.stamps_ns, np.unwrap(heading.yaw_rad))
    )
    return Sequence(
        name="stpere",
        calibration=Calibration(
            imu=ImuCalibration(
                gyro_noise_density=2e-3,
                gyro_bias_sigma=1e-3,
                accel_noise_density=1e-2,
                accel_bias_sigma=0.1,
                mounting=Mounting(rpy_rad=(0.0, 0.0, BODY_YAW_IMU_RAD)),
            ),
            dvl=DvlCalibration(
                velocity_sigma_m_s=(0.08, 0.08, 0.08),
                mounting=Mounting(rpy_rad=(0.0, 0.0, BODY_YAW_DVL_RAD)),
            ),
            heading=COMPASS,
            start=Start(
                position_m=(x, y, 0.0),
                rpy_rad=(0.0, 0.0, float(np.angle(np.exp(1j * start_yaw)))),
                # one row of the compass, with the error that all of its rows share
                rpy_sigma_rad=(
                    0.1,
                    0.1,
                    float(np.hypot(COMPASS.sigma_rad, COMPASS.bias_sigma_rad)),
                ),
            ),
        ),
        imu=imu,
        dvl=dvl,
        heading=heading,
        truth=truth,
        notes={
            "data set": "St. Pere Pescador; Ribas, Ridao, Tardós, Neira, Journal of Field Robotics 25(11-12), 2008",
            "licence": "none stated for the data",
            "truth": "satellite positions of a buoy at the surface, without orientation; steps of 0.18 m",
            "imu": f"forward-right-down turned to forward-left-up; subtracted: {bias}",
            "heading": "yaw of the magnetic attitude reference; the track says that it is 8° off true north",
            "dvl": f"{np.count_nonzero(~has_lock)} rows without bottom lock left out; velocities over the bottom",
        },
    )


def _inertial_rows(table: NumberTable) -> tuple[Imu, str]:
    """IMU in axes forward, left, up of its own, less the bias of its vertical gyro and the mean horizontal force."""
    rate, force = table.values[:, 4:7] * FLU_OF_FRD, table.values[:, 7:10] * FLU_OF_FRD
    mean_force = force.mean(axis=0) * [1.0, 1.0, 0.0]
    bias = (
        f"{GYRO_Z_BIAS_RAD_S} rad/s about z, and the mean of the horizontal forces, {mean_force[0]:.3f} and "
        f"{mean_force[1]:.3f} m/s2"
    )
    return Imu(
        table.stamps_ns(), rate - [0.0, 0.0, GYRO_Z_BIAS_RAD_S], force - mean_force
    ), bias


def _degrees(ddmm: Floats) -> Floats:
    """Degrees from degrees and minutes written as one number, ddmm.mmmm."""
    return np.asarray(np.floor(ddmm / 100) + ddmm % 100 / 60)
