"""Against scipy's rotations and derivatives by differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, ImuCalibration, Mounting
from sonar_graph.errors import AlignmentError
from sonar_graph.measurements import Imu
from sonar_graph.navigation.alignment.gravity import angles_by_up, earth_up_and_level, in_body_axes, roll_and_pitch

from .rows import derivative

ATTITUDES = [(0.3, -0.4), (-2.8, 1.2), (0.0, 0.0), (1.5, -1.5)]


def up_of(roll: float, pitch: float, yaw: float = 0.7) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).inv().apply([0, 0, 1.0])


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
@pytest.mark.parametrize("length", [1.0, 9.8])
def test_up_in_the_body_has_the_roll_and_pitch_of_the_attitude(roll, pitch, length):
    assert roll_and_pitch(length * up_of(roll, pitch)) == pytest.approx((roll, pitch))


@pytest.mark.parametrize(("roll", "pitch"), ATTITUDES)
def test_the_derivative_is_that_of_turning_up_a_little(roll, pitch):
    """Along the sphere; a change of length is none of either angle."""
    up = up_of(roll, pitch)

    def angles(phi: np.ndarray) -> tuple[float, float]:
        return roll_and_pitch(Rotation.from_rotvec(phi).apply(up))

    by_turn = derivative(lambda phi: Rotation.from_rotvec(phi).apply(up), 3)
    assert angles_by_up(up) @ by_turn == pytest.approx(derivative(angles, 3), abs=1e-6)
    assert angles_by_up(up) @ up == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("pitch", [np.pi / 2 - 0.9e-3, -np.pi / 2 + 0.9e-3])
def test_a_nose_within_a_milliradian_of_the_vertical_has_no_roll(pitch):
    with pytest.raises(AlignmentError, match="nose points straight"):
        angles_by_up(up_of(0.3, pitch))
    angles_by_up(up_of(0.3, pitch - np.copysign(0.2e-3, pitch)))


def test_the_earth_turns_up_and_north_at_its_latitude():
    """15.041 degrees an hour, by hand; not where it is not asked for."""
    rate, latitude = np.radians(15.041067) / 3600, 0.6
    assert earth_up_and_level(Calibration(earth_rate_latitude_rad=latitude)) == pytest.approx(
        (rate * np.sin(latitude), rate * np.cos(latitude)), rel=1e-6
    )
    assert earth_up_and_level(Calibration()) == (0.0, 0.0)


def test_readings_are_turned_by_the_mounting():
    rpy, rng = (0.3, -0.5, 1.1), np.random.default_rng(0)
    rate, force = rng.standard_normal((2, 5, 3))
    known = Calibration(imu=ImuCalibration(mounting=Mounting(rpy_rad=rpy)))
    imu, turn = Imu(np.arange(5), rate, force), Rotation.from_euler("xyz", rpy)
    found = in_body_axes(imu, known)
    assert found.angular_velocity == pytest.approx(turn.apply(rate))
    assert found.specific_force == pytest.approx(turn.apply(force))


def test_a_single_force_that_was_not_measured_is_refused():
    force = np.ones((5, 3))
    force[3, 1] = np.nan
    with pytest.raises(AlignmentError, match="not finite in every row"):
        in_body_axes(Imu(np.arange(5), np.zeros((5, 3)), force), Calibration())
