"""Zeros of a Doppler log: left out where the accelerometers feel no stop, used where the vehicle rests.

The vehicle drives level circles: with speed s and yaw rate r the rate is (0, 0, r) and the force (s', s r, g).
"""

import numpy as np
import pytest

from sonar_graph import Calibration, Dvl, Imu, Sequence
from sonar_graph.logs import read_log, row_notes, write_log
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.checks import unfelt_zeros
from sonar_graph.measurements import Floats

from .converters.copies import bare

RATE_RAD_S = 0.1


def drive(rate_hz: float, begin_s: float, end_s: float) -> Sequence:
    """A minute at half a metre a second, more or less, with velocities of zero from one time to another."""
    rng = np.random.default_rng(7)

    def noisy(columns: Floats, sigma: float) -> Floats:
        return columns + sigma * rng.standard_normal(columns.shape)

    t = np.arange(0.0, 60.0, 0.01)
    speed = 0.5 + 0.2 * np.sin(0.4 * t)
    rate = np.tile([0.0, 0.0, RATE_RAD_S], (len(t), 1))
    ahead = np.gradient(speed, t)
    force = np.column_stack([ahead, speed * RATE_RAD_S, 0 * t + 9.80665])
    imu = Imu((t * 1e9).round().astype(int), noisy(rate, 1e-3), noisy(force, 1e-2))
    at = np.arange(0.0, 60.0, 1 / rate_hz)
    velocity = noisy(np.interp(at, t, speed)[:, None] * [1.0, 0, 0], 0.01)
    velocity[(at >= begin_s) & (at < end_s)] = 0.0
    unknown = np.full((len(at), 3, 3), np.nan)
    dvl = Dvl((at * 1e9).round().astype(int), velocity, unknown)
    return Sequence("by hand", Calibration(), imu, dvl)


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 5.0])
@pytest.mark.parametrize(
    ("begin_s", "end_s"), [(20.0, 22.0), (20.0, 35.0), (0.0, 9.0), (50.0, 60.0)]
)
def test_zeros_without_lock_are_found_at_every_rate_and_place(rate_hz, begin_s, end_s):
    run = drive(rate_hz, begin_s, end_s)
    is_zero = ~run.dvl.velocity.any(axis=1)
    found = unfelt_zeros(run.imu, run.dvl, run.calibration)
    np.testing.assert_array_equal(found, is_zero)
    assert is_zero.sum() == (end_s - begin_s) * rate_hz


def test_a_log_with_zeros_is_read_without_them_unless_they_are_measured(tmp_path):
    path = tmp_path / "dive.mcap"
    run = drive(1.0, 20.0, 35.0)
    write_log(tmp_path / "own.mcap", run)
    # as a vehicle records them: rows of a log with a calibration were chosen before
    bare(tmp_path / "own.mcap", path)
    read = read_log(path)
    assert len(read.dvl) == 45
    assert "15 with a velocity of 0" in read.notes["log.dropped"]
    used = LogConfig.parse({"dvl": {"are_zeros_measured": True}}, "x")
    assert len(read_log(path, config=used).dvl) == 60
    assert "dvl: 15 of 60 rows with a velocity of 0" in row_notes(run)["log.doubtful"]
