from functools import partial

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Slerp

from sonar_graph.logs.convert import read_akit

LATITUDE = 0.5733


def written(folder, kind, rows):
    (folder / "Trajectory2").mkdir(exist_ok=True)
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    path = folder / "Trajectory2" / f"{kind}_trajectory2.csv"
    path.write_text("\n".join(["header", *lines]))


@pytest.fixture
def folder(tmp_path):
    """Three seconds north-east of a vehicle that floats level and heads east."""
    write = partial(written, tmp_path)
    write(
        "IMU", [(k * 0.01000025, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03) for k in range(300)]
    )
    write("DVL", [(k * 1.0025, 1.0, 0.5, 0.25) for k in range(3)])
    at = [(0.61 + k * 1e-6, LATITUDE + k * 1e-6, -10 - k) for k in range(3)]
    write("GT", [(k, *at[k], 0, 0, 0, 0, 0, np.pi / 2) for k in range(3)])
    return tmp_path


def test_axes_times_and_start_are_those_of_the_files(folder):
    """The DVL is forward, right, down; the IMU the same but for its y axis, which is to the left already.

    Radii of curvature by hand at that latitude: 6 354 km along the meridian, 5 366 km along the parallel.
    """
    sequence = read_akit(folder, 2)
    assert np.allclose(sequence.dvl.velocity[0], [1.0, -0.5, -0.25])
    assert np.allclose(sequence.imu.angular_velocity[0], [0.01, 0.02, -0.03])
    assert np.allclose(sequence.imu.specific_force[0], [0.1, 0.2, 9.8])
    # rows are timed by their number
    assert np.unique(np.diff(sequence.imu.stamps_ns)).tolist() == [10_000_000]
    assert sequence.dvl.stamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    assert sequence.truth.stamps_ns.tolist() == [0, 10**9, 2 * 10**9]
    assert sequence.start_ns == 10**9
    assert np.allclose(
        np.diff(sequence.truth.positions, axis=0),
        [[5.366, 6.354, -1.0]] * 2,
        rtol=0,
        atol=5e-3,
    )
    assert np.allclose(sequence.truth.positions[0], [0, 0, -10], atol=1e-6)
    # east is along x
    assert np.allclose(sequence.truth.rotations()[0].as_matrix(), np.eye(3), atol=1e-12)
    assert np.allclose(sequence.calibration.start.rpy_rad, 0, atol=1e-9)
    assert np.allclose(
        sequence.calibration.start.position_m, sequence.truth.positions[1]
    )


def test_the_start_is_where_a_reference_that_is_late_turns_as_the_gyros_do(tmp_path):
    """Half a second at up to 11 degrees a second; the IMU's own z is the file's."""
    write = partial(written, tmp_path)

    def heading(seconds):
        return 0.5 * np.sin(0.4 * seconds) + 0.1 * seconds

    def reference(late_s):
        place = 0.61, LATITUDE, *[0] * 6
        write("GT", [(t, *place, heading(t + late_s)) for t in range(60)])
        return read_akit(tmp_path, 2)

    stamps = np.arange(6000) / 100
    rates = 0.2 * np.cos(0.4 * stamps) + 0.1 + 1e-5
    rows = zip(stamps, rates, strict=True)
    write("IMU", [(t, 0, 0, -9.8, 0, 0, rate) for t, rate in rows])
    write("DVL", [(t, 1, 0, 0) for t in range(58)])
    for late_s in (0.5, 0.0, -0.4):
        sequence = reference(late_s)
        yaw_rad = np.pi / 2 - sequence.calibration.start.rpy_rad[2]
        assert yaw_rad == pytest.approx(heading(1.0), abs=0.005), late_s
        first_s = sequence.truth.stamps_ns[0] * 1e-9
        assert first_s >= 0
        assert abs((first_s - late_s + 0.5) % 1.0 - 0.5) < 0.005
    # farther than tried
    assert reference(2.0).truth.stamps_ns[0] == 0


@pytest.fixture(scope="module", params=[1, 3, 7])
def sequence(request, unpacked):
    return read_akit(
        next(unpacked("akit_1-7.tar.xz").rglob("Trajectory1")).parent, request.param
    )


@pytest.mark.recording
class TestRecording:
    """Against the reference, which lags the IMU by a time that differs between trajectories."""

    def test_dvl_measures_the_references_velocity_behind_its_origin(self, sequence):
        lever = np.array(sequence.calibration.dvl.mounting.translation_m)
        right = sideways_error(sequence, lever)
        assert right < 0.06
        assert right < 0.6 * sideways_error(sequence, np.zeros(3))
        assert right < 0.6 * sideways_error(sequence, lever, dvl_delay_s=-1.0)


def sideways_error(sequence, lever, dvl_delay_s=0.0):
    """Standard deviation of the DVL's leftward velocity error."""
    knots = sequence.truth.stamps_ns * 1e-9
    position = CubicSpline(knots, sequence.truth.positions)
    attitude = Slerp(knots, sequence.truth.rotations())
    rows = np.arange(5, 395)
    seconds = sequence.dvl.stamps_ns[rows] * 1e-9 + dvl_delay_s
    centre = np.round(seconds * 100).astype(int)
    rate = np.mean(
        [sequence.imu.angular_velocity[centre + k] for k in range(-10, 11)], axis=0
    )
    body_R_world = attitude(seconds).inv()
    expected = body_R_world.apply(position(seconds, 1)) + np.cross(rate, lever)
    return np.std(sequence.dvl.velocity[rows, 1] - expected[:, 1])
