"""Zeros of a Doppler log: left out where the accelerometers feel no stop, used where the vehicle rests.

The vehicle drives level circles: with speed s and yaw rate r the rate is (0, 0, r) and the force (s', s r, g).
"""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph import Calibration, Dvl, Imu, Sequence
from sonar_graph.logs import read_log, row_notes, write_log
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.logs.checks import unfelt_zeros
from sonar_graph.measurements import Floats

from .conftest import copy, recorded, writing

SECOND = 1_000_000_000
RATE_RAD_S = 0.1


def drive(rate_hz: float, speed_of, noise_m_s: float = 0.01) -> Sequence:
    """A minute with a speed by time."""
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 60.0, 0.01)
    speed = speed_of(t)
    rate = np.tile([0.0, 0.0, RATE_RAD_S], (len(t), 1))
    sideways = speed * RATE_RAD_S
    force = np.column_stack([np.gradient(speed, t), sideways, np.full(len(t), 9.80665)])
    imu = Imu(
        np.round(t * SECOND).astype(np.int64),
        rate + 1e-3 * rng.standard_normal(rate.shape),
        force + 1e-2 * rng.standard_normal(force.shape),
    )
    at = np.arange(0.0, 60.0, 1 / rate_hz)
    velocity = np.column_stack([np.interp(at, t, speed), 0 * at, 0 * at])
    velocity += noise_m_s * rng.standard_normal(velocity.shape)
    unknown = np.full((len(at), 3, 3), np.nan)
    dvl = Dvl(np.round(at * SECOND).astype(np.int64), velocity, unknown)
    return Sequence("by hand", Calibration(), imu, dvl)


def cruise(t: Floats) -> Floats:
    """Half a metre a second, more or less."""
    return 0.5 + 0.2 * np.sin(0.4 * t)


def without_lock(run: Sequence, begin_s: float, end_s: float) -> Sequence:
    t = run.dvl.stamps_ns / SECOND
    velocity = run.dvl.velocity.copy()
    velocity[(t >= begin_s) & (t < end_s)] = 0.0
    return replace(run, dvl=replace(run.dvl, velocity=velocity))


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 5.0])
@pytest.mark.parametrize(
    ("begin_s", "end_s"), [(20.0, 22.0), (20.0, 35.0), (0.0, 9.0), (50.0, 60.0)]
)
def test_zeros_without_lock_are_found_at_every_rate_and_place(rate_hz, begin_s, end_s):
    run = without_lock(drive(rate_hz, cruise), begin_s, end_s)
    t = run.dvl.stamps_ns / SECOND
    found = unfelt_zeros(run.imu, run.dvl, run.calibration)
    assert (found == ((t >= begin_s) & (t < end_s))).all()


def test_a_log_with_zeros_is_read_without_them_unless_they_are_measured(
    tmp_path,
):
    path = tmp_path / "dive.mcap"
    run = without_lock(drive(1.0, cruise), 20.0, 35.0)
    write_log(tmp_path / "own.mcap", run)
    # as a vehicle records them: rows of a log with a calibration were chosen before
    with writing(path) as writer:
        copy(recorded(tmp_path / "own.mcap"), writer)
    read = read_log(path)
    assert len(read.dvl) == 45
    assert "15 with a velocity of 0" in read.notes["log.dropped"]
    used = LogConfig.parse({"dvl": {"are_zeros_measured": True}}, "x")
    assert len(read_log(path, config=used).dvl) == 60
    assert "dvl: 15 of 60 rows with a velocity of 0" in row_notes(run)["log.doubtful"]
