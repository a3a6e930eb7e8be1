import numpy as np
import pytest

from sonar_graph.errors import DatasetError
from sonar_graph.evaluation.metrics import aligned_errors_m, rmse
from sonar_graph.logs.convert import read_stpere

T0 = 1_000
MINUTE_M = 1852.0
"""A minute of latitude is a nautical mile, to half a per cent."""


@pytest.fixture
def folder(tmp_path):
    """Three seconds north of a level vehicle that heads north: its IMU's x axis points to the right, east."""
    inertial = [
        f"{T0 + k / 10:.1f} 0 0 90 0 0 {0.0116 - 0.02} 0.3 -0.2 -9.8" for k in range(31)
    ]
    of_three = [
        f"{kind}{axis}"
        for kind in ("position", "velocity", "acceleration")
        for axis in "XYZ"
    ]
    header = f"% time, [idSensor], {', '.join(of_three)}, \n"
    (tmp_path / "MTI.log").write_text(header + "\n".join(inertial))
    ahead = 50 * np.array([np.cos(np.pi / 3), np.sin(np.pi / 3)])
    rest = "0 " * 17
    doppler = [
        f"{T0 + k} 2007 3 16 13 0 {k} 9 9 9 1 {ahead[0]} {ahead[1]} 2 {int(k != 1)} {rest}"
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
    body_R_imu, body_R_dvl = (
        section.mounting.pose().rotation().matrix()
        for section in (sequence.calibration.imu, sequence.calibration.dvl)
    )
    # forward
    np.testing.assert_allclose(
        body_R_dvl @ sequence.dvl.velocity[0], [0.5, 0, 0.02], atol=1e-12
    )
    np.testing.assert_allclose(
        body_R_imu @ sequence.imu.angular_velocity[0], [0, 0, 0.02], atol=1e-12
    )
    # the mean is taken off
    np.testing.assert_allclose(sequence.imu.specific_force[0], [0, 0, 9.8], atol=1e-12)
    np.testing.assert_allclose(sequence.heading.yaw_rad, np.pi / 2, atol=1e-12)  # north
    np.testing.assert_allclose(body_R_imu @ [1.0, 0, 0], [0, -1, 0], atol=1e-12)
    # one without lock
    assert sequence.dvl.stamps_ns.tolist() == [
        T0 * 10**9,
        (T0 + 2) * 10**9,
        (T0 + 3) * 10**9,
    ]
    assert not sequence.truth.has_orientation
    np.testing.assert_allclose(
        sequence.truth.positions[:, :2], [[0, 0.5 * k] for k in range(4)], atol=0.01
    )
    np.testing.assert_allclose(
        sequence.truth.positions[:, 2], [0, -1, -2, -3], atol=1e-6
    )
    np.testing.assert_allclose(
        sequence.calibration.start.rpy_rad, [0, 0, np.pi / 2], atol=1e-12
    )
    compass = sequence.calibration.heading
    shared_and_own = np.hypot(compass.bias_sigma_rad, compass.sigma_rad)
    assert sequence.calibration.start.rpy_sigma_rad[2] == pytest.approx(
        shared_and_own
    ), "the start is a compass' row"


def test_a_missing_file_or_folder_is_named(folder):
    told = r"absent: is not a folder; .* MTI\.log, DVL\.log, DGPS\.log$"
    with pytest.raises(DatasetError, match=told):
        read_stpere(folder / "absent")
    (folder / "DVL.log").unlink()
    told = rf"{folder.name}: holds no DVL\.log; give the folder that holds MTI"
    with pytest.raises(DatasetError, match=told):
        read_stpere(folder)
    (folder / "DVL.log").mkdir()
    with pytest.raises(DatasetError, match=r"DVL\.log: holds no files"):
        read_stpere(folder)


@pytest.fixture(scope="module")
def run(unpacked):
    return read_stpere(next(unpacked("stpere.tar.xz").rglob("MTI.log")).parent)


def reckoned_error(run, yaw_rad, mirror=False):
    """Horizontal error against the satellites, aligned, of velocities without spikes turned by headings, m."""
    is_sound = np.linalg.norm(run.dvl.velocity, axis=1) < 1
    mounting = run.calibration.dvl.mounting.pose().rotation().matrix()
    velocity = run.dvl.velocity[is_sound] @ mounting.T * [1, -1 if mirror else 1, 1]
    stamps_ns = run.dvl.stamps_ns[is_sound]
    turned = np.interp(stamps_ns, run.heading.stamps_ns, yaw_rad)
    steps = (
        (velocity[:, 0] + 1j * velocity[:, 1])[:-1]
        * np.exp(1j * turned[:-1])
        * np.diff(stamps_ns)
        * 1e-9
    )
    path = np.concatenate([[0], np.cumsum(steps)])
    at = [
        np.interp(run.truth.stamps_ns, stamps_ns, part)
        for part in (path.real, path.imag, 0 * path.real)
    ]
    return rmse(aligned_errors_m(np.column_stack(at), run.truth.positions)[:, :2])


@pytest.mark.recording
class TestRecording:
    """Against satellite positions of a buoy that the vehicle tows."""

    def test_compass_and_doppler_log_reckon_the_satellites_path(self, run):
        """4.1 m; a mirrored Doppler log, or headings of the other sense, do not."""
        yaw_rad = np.unwrap(run.heading.yaw_rad)
        assert reckoned_error(run, yaw_rad) < 4.5
        assert reckoned_error(run, yaw_rad, mirror=True) > 7
        assert reckoned_error(run, -yaw_rad) > 40

    def test_gyro_less_its_bias_reckons_it_too(self, run):
        seconds = (run.imu.stamps_ns - run.imu.stamps_ns[0]) * 1e-9
        rate = run.imu.angular_velocity[:, 2]

        def integrated(rate):
            return np.concatenate(
                [[0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(seconds))]
            )

        assert reckoned_error(run, integrated(rate)) < 8
        assert reckoned_error(run, integrated(rate - 0.0116)) > 40  # as logged
        off = np.unwrap(run.heading.yaw_rad) - integrated(rate)
        assert np.ptp(off) < 1.0  # rad, in 56 minutes
