from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest


def test_units_are_scaled_and_axes_turned(foreign: Any, read: Any) -> None:
    toml = '[imu]\nrotation = "frd"\nangular_velocity_scale = 0.017453292519943295\nlinear_acceleration_scale = 9.80665'
    sequence = read(foreign.imu(force=(0, 0, -1), rate=(0, 0, 90)), foreign.dvl(), toml=toml)
    np.testing.assert_allclose(sequence.imu.specific_force, [[0, 0, 9.80665]] * 5)
    np.testing.assert_allclose(sequence.imu.angular_velocity, [[0, 0, -np.pi / 2]] * 5, atol=1e-15)


@pytest.mark.parametrize(
    ("force", "warned"),
    [
        ((0, 0, 9.8), None),
        ((5, 0, 8.4), None),
        ((0, 9.8, 0), r"+y (9.80 m/s2) instead of the body's +z: give rotation = [90, 0, 0]"),
        ((0, 0, -9.8), 'give rotation = "frd"'),
        ((0, 0, 1), "the typical specific force is 1 m/s2 instead of 9.81"),
        ((float("nan"),) * 3, None),
    ],
)
def test_gravity_that_is_not_felt_upwards_is_mentioned(
    foreign: Any, read: Any, force: tuple[float, ...], warned: str | None
) -> None:
    dvl = '[dvl]\nrotation = "frd"\nsound_speed = false'
    notes = read(foreign.imu(force=force), foreign.dvl(), toml=dvl).notes
    assert (warned is None) == ("log.warnings" not in notes)
    assert warned is None or warned in notes["log.warnings"]


def test_a_force_that_is_zero_throughout_was_not_measured(foreign: Any, read: Any) -> None:
    dvl = '[dvl]\nrotation = "frd"\nsound_speed = false'
    sequence = read(foreign.imu(force=(0, 0, 0)), foreign.dvl(), toml=dvl)
    assert np.isnan(sequence.imu.specific_force).all()
    assert sequence.notes["log.warnings"] == (
        "imu: linear_acceleration.x, linear_acceleration.y, linear_acceleration.z are 0 in every message, which no "
        "accelerometer measures: taken as not measured"
    )


def test_a_force_that_is_zero_once_was_measured(foreign: Any, read: Any) -> None:
    topic, kind, messages = foreign.imu()
    messages[2]["linear_acceleration"] = foreign.vector(0, 0, 0)
    np.testing.assert_array_equal(read((topic, kind, messages), foreign.dvl()).imu.specific_force[2], [0, 0, 0])


def test_a_wild_angular_rate_is_mentioned(foreign: Any, read: Any) -> None:
    topic, kind, messages = foreign.imu(rows=300)
    messages[150]["angular_velocity"] = foreign.vector(0, 0, 30)
    notes = read((topic, kind, messages), foreign.dvl(rows=300)).notes
    assert "imu: 1 angular rate stands out from both neighbours, by 30 rad/s" in notes["log.warnings"]


@pytest.mark.parametrize("force", [(9.8, 0, 0), (-9.8, 0, 0), (0, 9.8, 0), (0, -9.8, 0), (0, 0, -9.8)])
def test_the_rotation_that_a_warning_proposes_puts_gravity_right(
    foreign: Any, read: Any, force: tuple[float, ...]
) -> None:
    dvl = '[dvl]\nrotation = "frd"\nsound_speed = false\n'
    warning = read(foreign.imu(force=force), foreign.dvl(), toml=dvl).notes["log.warnings"]
    proposed = re.search(r'give (rotation = ("\w+"|\[.*?\]))', warning)
    assert proposed
    sequence = read(foreign.imu(force=force), foreign.dvl(), toml=f"{dvl}[imu]\n{proposed[1]}")
    np.testing.assert_allclose(sequence.imu.specific_force, [[0, 0, 9.8]] * 5, atol=1e-12)


def test_a_mounting_that_puts_gravity_right_is_enough(foreign: Any, read: Any) -> None:
    half = float(np.sqrt(0.5))
    link = {"header": foreign.header(0, "base_link"), "child_frame_id": "imu_link"}
    link["transform"] = {"translation": foreign.vector(0, 0, 0), "rotation": {"x": half, "y": 0, "z": 0, "w": half}}
    tree = ("/tf_static", "tf2_msgs/msg/TFMessage", [{"transforms": [link]}])
    toml = '[dvl]\nrotation = "frd"\nsound_speed = false\n'
    assert "log.warnings" not in read(foreign.imu(force=(0, 9.8, 0)), foreign.dvl(), tree, toml=toml).notes


def test_the_frame_of_a_sensor_can_be_named(foreign: Any, read: Any) -> None:
    link = {"header": foreign.header(0, "base_link"), "child_frame_id": "real_link"}
    link["transform"] = {"translation": foreign.vector(1, 2, 3), "rotation": {"x": 0.0, "y": 0, "z": 0, "w": 1}}
    tree = ("/tf_static", "tf2_msgs/msg/TFMessage", [{"transforms": [link]}])
    sequence = read(foreign.imu(), foreign.dvl(), tree, toml='[imu]\nframe_id = "real_link"')
    assert sequence.calibration.imu.mounting.translation_m == (1, 2, 3)
