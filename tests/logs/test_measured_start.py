"""A start that is not stated is measured: height by depth, level by gravity, yaw and place where sensors know them."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Start
from sonar_graph.logs import PartialCalibration, read_log, write_log
from sonar_graph.logs.measured_start import with_measured_start
from sonar_graph.measurements import (
    Depth,
    Dvl,
    Floats,
    Imu,
    PositionFixes,
)
from sonar_graph.sequence import Sequence

RPY = (0.1, -0.05, 0.7)


def moving(rpy: tuple[float, float, float] = RPY) -> dict[str, Any]:
    """A vehicle of fixed roll and pitch that turns, 60 s: IMU 50 Hz, Doppler log and depth 5 Hz, fixes 1 Hz."""
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 50
    stamps_ns = (t * 1e9).astype(np.int64)
    roll, pitch, yaw = np.add(rpy, [[0, 0, 0.1 * s] for s in t]).T
    body_R_world = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).inv()
    v = np.column_stack([0.8 * np.cos(yaw), 0.8 * np.sin(yaw), 0 * t - 0.05])
    force = np.add(np.gradient(v, t, axis=0), [0.0, 0.0, 9.80665])
    rate = np.tile([0.0, 0.0, 0.1], (3000, 1))
    imu = Imu(stamps_ns, body_R_world.apply(rate), body_R_world.apply(force))

    def seen(values: Floats, step: int, sigma: float) -> tuple[Any, ...]:
        """Some rows with noise and unknown covariances."""
        some = values[::step]
        covariances = np.full((len(some), 3, 3), np.nan)
        return stamps_ns[::step], some + rng.normal(0, sigma, some.shape), covariances

    place = np.cumsum(v, axis=0) / 50 + [100.0, 50.0, -14.0]
    velocity = seen(body_R_world.apply(v), 10, 0.01)
    at_ns, depth_m, _ = seen(place[:, 2], 10, 0.01)
    return {
        "imu": imu,
        "dvl": Dvl(*velocity),
        "depth": Depth(at_ns, depth_m, np.full(300, np.nan)),
        "positions": PositionFixes(*seen(place, 50, 0.3)),
    }


@pytest.mark.parametrize("rpy", [RPY, (0.0, 0.0, -2.0), (-0.2, 0.2, 3.0)])
def test_each_part_of_the_start_is_within_its_sigma_of_the_truth(rpy):
    calibration, note = with_measured_start(Calibration(), moving(rpy))
    start = calibration.start
    assert (np.abs(np.subtract(start.rpy_rad, rpy)) < start.rpy_sigma_rad).all()
    assert abs(start.position_m[2] + 14.0) < start.position_sigma_m[2] < 0.2
    assert start.source == "fixes"
    said = "start pose not stated: height by the first depths; level by gravity"
    assert note.startswith(said)


def test_what_is_stated_stays_and_the_rest_is_measured():
    blocks = moving()
    place = Calibration(start=Start(position_m=(1.0, 2.0, 3.0)))
    start = with_measured_start(place, blocks)[0].start
    assert start.position_m == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(start.rpy_rad[:2], RPY[:2], atol=0.01)
    heading = Calibration(start=Start(rpy_rad=(0.0, 0.0, 1.0)))
    calibration, note = with_measured_start(heading, blocks)
    assert calibration.start.rpy_rad == (0.0, 0.0, 1.0)
    assert note.startswith("of the start only rpy_rad stated")


def test_a_stated_start_replaces_the_measured_one_of_a_converted_log(tmp_path):
    """Scores count from a stated start: only where none is stated is the truth moved to the estimates."""
    blocks = moving()
    calibration, note = with_measured_start(Calibration(), blocks)
    path = tmp_path / "converted.mcap"
    notes = {"log.start": note}
    write_log(path, Sequence("tables", calibration, notes=notes, **blocks))
    assert read_log(path).calibration.start.source == "fixes"
    place = {"position_m": (1.0, 2.0, -3.0)}
    measured = calibration.start.rpy_rad
    for stated, expected in ((place, measured), (place | {"rpy_rad": RPY}, RPY)):
        given = PartialCalibration.parse({"start": stated}, "vehicle.toml")
        read = read_log(path, calibration=given)
        start = read.calibration.start
        assert (start.source, start.position_m) == ("stated", place["position_m"])
        assert start.rpy_rad == pytest.approx(expected, abs=1e-3)
        assert ("log.start" in read.notes) == ("rpy_rad" not in stated)
