import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Slerp

from sonar_graph.logs.convert import read_akit

LATITUDE = 0.5733


def written(folder, kind, rows):
    (folder / "Trajectory2").mkdir(exist_ok=True)
    path = folder / "Trajectory2" / f"{kind}_trajectory2.csv"
    np.savetxt(path, list(rows), "%.17g", ",", header="header", comments="")


@pytest.fixture
def folder(tmp_path):
    """Three seconds north-east of a vehicle that floats level and heads east."""
    force_and_rate = 0.1, 0.2, -9.8, 0.01, 0.02, 0.03
    rows = np.arange(300)
    written(tmp_path, "IMU", [(k * 0.01000025, *force_and_rate) for k in rows])
    written(tmp_path, "DVL", [(k * 1.0025, 1.0, 0.5, 0.25) for k in range(3)])
    at = [(0.61 + k * 1e-6, LATITUDE + k * 1e-6, -10 - k) for k in range(3)]
    rest = [0] * 5
    written(tmp_path, "GT", [(k, *at[k], *rest, np.pi / 2) for k in range(3)])
    return tmp_path


def test_axes_times_and_start_are_those_of_the_files(folder):
    """The DVL is forward, right, down; the IMU the same but for its y axis, which is to the left already.

    Radii of curvature by hand at that latitude: 6 354 km along the meridian, 5 366 km along the parallel.
    """
    sequence = read_akit(folder, 2)
    truth = sequence.truth
    start = sequence.calibration.start
    assert np.allclose(sequence.dvl.velocity[0], [1.0, -0.5, -0.25])
    assert np.allclose(sequence.imu.angular_velocity[0], [0.01, 0.02, -0.03])
    assert np.allclose(sequence.imu.specific_force[0], [0.1, 0.2, 9.8])
    # rows are timed by their number
    assert np.unique(np.diff(sequence.imu.stamps_ns)).tolist() == [10_000_000]
    assert sequence.dvl.stamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    assert truth.stamps_ns.tolist() == [0, 10**9, 2 * 10**9]
    assert sequence.start_ns == 10**9
    steps_m = np.diff(truth.positions, axis=0)
    assert np.allclose(steps_m, [5.366, 6.354, -1.0], rtol=0, atol=5e-3)
    assert np.allclose(truth.positions[0], [0, 0, -10], atol=1e-6)
    # east is along x
    assert np.allclose(truth.matrices[0], np.eye(3), atol=1e-12)
    assert np.allclose(start.rpy_rad, 0, atol=1e-9)
    assert np.allclose(start.position_m, truth.positions[1])


def test_the_start_is_where_a_reference_that_is_late_turns_as_the_gyros_do(tmp_path):
    """Half a second at up to 11 degrees a second; the IMU's own z is the file's."""

    def heading(seconds):
        return 0.5 * np.sin(0.4 * seconds) + 0.1 * seconds

    def reference(late_s):
        place = 0.61, LATITUDE, *[0] * 6
        rows = [(t, *place, heading(t + late_s)) for t in range(60)]
        written(tmp_path, "GT", rows)
        return read_akit(tmp_path, 2)

    stamps = np.arange(6000) / 100
    rates = 0.2 * np.cos(0.4 * stamps) + 0.1 + 1e-5
    rows = zip(stamps, rates, strict=True)
    written(tmp_path, "IMU", [(t, 0, 0, -9.8, 0, 0, rate) for t, rate in rows])
    written(tmp_path, "DVL", [(t, 1, 0, 0) for t in range(58)])
    for late_s in (0.5, 0.0, -0.4):
        sequence = reference(late_s)
        yaw_rad = np.pi / 2 - sequence.calibration.start.rpy_rad[2]
        assert yaw_rad == pytest.approx(heading(1.0), abs=0.005), late_s
        first_s = sequence.truth.stamps_ns[0] * 1e-9
        assert first_s >= 0
        assert abs((first_s - late_s + 0.5) % 1.0 - 0.5) < 0.005
    # farther than tried
    assert reference(2.0).truth.stamps_ns[0] == 0


@pytest.mark.recording
@pytest.mark.parametrize("number", [1, 3, 7])
def test_dvl_measures_the_references_velocity_behind_its_origin(unpacked, number):
    """By its leftward part; the reference lags the IMU by a time that differs between trajectories."""
    folder = next(unpacked("akit_1-7.tar.xz").rglob("Trajectory1")).parent
    sequence = read_akit(folder, number)
    knots = sequence.truth.stamps_ns * 1e-9
    position = CubicSpline(knots, sequence.truth.positions)
    attitude = Slerp(knots, sequence.truth.rotations())
    dvl = sequence.dvl.rows(np.arange(5, 395))

    def sideways_error(lever, delay_s=0.0):
        seconds = dvl.stamps_ns * 1e-9 + delay_s
        rows = np.round(seconds * 100).astype(int) + np.arange(-10, 11)[:, None]
        rate = sequence.imu.angular_velocity[rows].mean(axis=0)
        expected = attitude(seconds).inv().apply(position(seconds, 1))
        expected += np.cross(rate, lever)
        return np.std(dvl.velocity[:, 1] - expected[:, 1])

    lever = sequence.calibration.dvl.mounting.translation_m
    right = sideways_error(lever)
    assert right < 0.06
    assert right < 0.6 * sideways_error(np.zeros(3))
    assert right < 0.6 * sideways_error(lever, -1.0)
