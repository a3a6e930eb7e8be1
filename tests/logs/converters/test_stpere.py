import numpy as np
import pytest

from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert import read_stpere

T0 = 1_000
MINUTE_M = 1852.0
"""A minute of latitude is a nautical mile, to half a per cent."""


@pytest.fixture
def folder(tmp_path):
    """Three seconds north of a level vehicle that heads north: its IMU's x axis points to the right, east."""
    readings = f"0 0 90 0 0 {0.0116 - 0.02} 0.3 -0.2 -9.8"
    inertial = [f"{T0 + k / 10:.1f} {readings}" for k in range(31)]
    kinds = "position", "velocity", "acceleration"
    names = ", ".join(f"{kind}{axis}" for kind in kinds for axis in "XYZ")
    header = f"% time, [idSensor], {names}, \n"
    (tmp_path / "MTI.log").write_text(header + "\n".join(inertial))
    ahead = f"{50 * np.cos(np.pi / 3)} {50 * np.sin(np.pi / 3)}"
    doppler = [
        f"{T0 + k} 2007 3 16 13 0 {k} 9 9 9 1 {ahead} 2 {int(k != 1)} {'0 ' * 17}"
        for k in range(4)
    ]
    (tmp_path / "DVL.log").write_text("% time, ...\n" + "\n".join(doppler))
    fixes = [
        f"{T0 + k} {4212.0 + 0.5 * k / MINUTE_M:.8f} 306.0 1 {-2 - k} 51.8 0 0 0 0"
        for k in range(4)
    ]
    header = b"% time, [idSensor], latitude, longitude, status, altitude(m), geoide, course(\xba), magnetic, kts, km/h\n"
    (tmp_path / "DGPS.log").write_bytes(header + "\n".join(fixes).encode())
    return tmp_path


def test_axes_units_and_biases_are_those_found_in_the_data(folder):
    sequence = read_stpere(folder)
    calibration = sequence.calibration
    body_R_imu, body_R_dvl = (
        section.mounting.rotation_matrix()
        for section in (calibration.imu, calibration.dvl)
    )
    for found, expected, atol in (
        (body_R_dvl @ sequence.dvl.velocity[0], [0.5, 0, 0.02], 1e-12),  # forward
        (body_R_imu @ sequence.imu.angular_velocity[0], [0, 0, 0.02], 1e-12),
        # the mean is taken off
        (sequence.imu.specific_force[0], [0, 0, 9.8], 1e-12),
        (sequence.heading.yaw_rad, np.pi / 2, 1e-12),  # north
        (body_R_imu[:, 0], [0, -1, 0], 1e-12),
        (sequence.truth.positions[:, :2], [[0, 0.5 * k] for k in range(4)], 0.01),
        (sequence.truth.positions[:, 2], [0, -1, -2, -3], 1e-6),
        (calibration.start.rpy_rad, [0, 0, np.pi / 2], 1e-12),
    ):
        np.testing.assert_allclose(found, expected, atol=atol)
    # one without lock
    assert (sequence.dvl.stamps_ns // 10**9 - T0).tolist() == [0, 2, 3]
    assert not sequence.truth.has_orientation
    compass = calibration.heading
    shared_and_own = np.hypot(compass.bias_sigma_rad, compass.sigma_rad)
    sigma_rad = calibration.start.rpy_sigma_rad[2]
    assert sigma_rad == pytest.approx(shared_and_own), "the start is a compass' row"


def test_a_missing_file_or_folder_is_named(folder):
    doppler = folder / "DVL.log"

    def refused(place, told):
        with pytest.raises(DatasetError, match=told):
            read_stpere(place)

    refused(folder / "absent", r"is not a folder; .* MTI\.log, DVL\.log, DGPS\.log$")
    doppler.unlink()
    refused(
        folder, rf"{folder.name}: holds no DVL\.log; give the folder that holds MTI"
    )
    doppler.mkdir()
    refused(folder, r"DVL\.log: holds no files")
