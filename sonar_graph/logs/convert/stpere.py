"""St. Pere Pescador: an underwater vehicle with a cheap inertial unit in an abandoned marina, satellite positions.

Ribas, Ridao, Tardós, Neira, "Underwater SLAM in man-made structured environments", Journal of Field Robotics 25(11-12),
2008. 3345 s and 645 m; text files with comments after ``%``, each row with its time first:

``MTI.log``   roll, pitch, yaw (degrees, north-east-down), angular rates (rad/s), specific forces (m/s²); 10 Hz
``DVL.log``   date and time (6), velocity through water and status (4), over the bottom in cm/s and status (4), ...
``DGPS.log``  latitude and longitude (ddmm.mmmm), status, height above sea level, ...: a buoy at the surface; 1 Hz

``docs/theory/datasets.md`` has what the files do not state: axes, mountings, biases and noise.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from sonar_graph.calibration import Calibration, Start
from sonar_graph.errors import DatasetError, LogError
from sonar_graph.logs.convert.csv_log import read_csv
from sonar_graph.logs.convert.text_tables import DATA_SETS
from sonar_graph.sequence import Sequence

FILES = ("MTI.log", "DVL.log", "DGPS.log")
GYRO_Z_BIAS_RAD_S = -0.0116
"""About the body's z (up)."""


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
    try:
        tables = [dataset_dir / name for name in FILES]
        run = read_csv(tables, DATA_SETS["stpere_tables"], "stpere")
    except LogError as error:
        raise DatasetError(str(error)) from error
    if run.heading is None or run.truth is None:
        raise DatasetError(
            f"{dataset_dir}: holds no headings or no satellite positions"
        )
    # level on average: a mean horizontal force is a bias
    mean_force = run.imu.specific_force.mean(axis=0) * [1.0, 1.0, 0.0]
    imu = replace(
        run.imu,
        angular_velocity=run.imu.angular_velocity - [0.0, 0.0, GYRO_Z_BIAS_RAD_S],
        specific_force=run.imu.specific_force - mean_force,
    )
    # the run begins where both sensors have rows
    start_ns = int(max(imu.stamps_ns[0], run.dvl.stamps_ns[0]))
    first_ns = max(start_ns, int(run.truth.stamps_ns[0]))
    x, y, _ = run.truth.at(np.array([first_ns])).positions[0].tolist()
    yaws_rad = np.unwrap(run.heading.yaw_rad)
    yaw_rad = np.interp(start_ns, run.heading.stamps_ns, yaws_rad)
    # one row of the compass, with the error that all of its rows share
    known = Calibration.model_validate(DATA_SETS["stpere"])
    compass = known.heading
    yaw_sigma_rad = float(np.hypot(compass.sigma_rad, compass.bias_sigma_rad))
    start = Start(
        position_m=(x, y, 0.0),
        rpy_rad=(0.0, 0.0, float(np.angle(np.exp(1j * yaw_rad)))),
        rpy_sigma_rad=(0.1, 0.1, yaw_sigma_rad),
    )
    calibration = known.model_copy(update={"start": start})
    notes = {
        "data set": "St. Pere Pescador; Ribas, Ridao, Tardós, Neira, Journal of Field Robotics 25(11-12), 2008",
        "licence": "none stated for the data",
        "truth": "satellite positions of a buoy at the surface, without orientation; steps of 0.18 m",
        "imu": "forward-right-down turned to forward-left-up; subtracted: "
        f"{GYRO_Z_BIAS_RAD_S} rad/s about z, and the mean of the horizontal forces, "
        f"{mean_force[0]:.3f} and {mean_force[1]:.3f} m/s2",
        "heading": "yaw of the magnetic attitude reference; the track is consistent with 8° off true north",
        "dvl": f"rows without bottom lock left out ({run.notes.get('csv.left_out', 'none')}); velocities over the bottom",
    }
    return replace(run, calibration=calibration, imu=imu, notes=notes)
