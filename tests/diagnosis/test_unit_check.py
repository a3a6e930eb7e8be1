"""Readings of a steady vehicle in other units, by hand."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from sonar_graph.calibration import Calibration
from sonar_graph.diagnosis.sensor_check import WrongUnit, wrong_units
from sonar_graph.logs.adapters.log_config import LogConfig
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.sequence import Sequence

N = 100
ALONG = np.array([2.0, -1.0, 2.0]) / 3.0


def vectors(length: float | Floats) -> Floats:
    """All in one direction, along none of the axes."""
    return np.broadcast_to(length, N)[:, None] * ALONG


def found(
    speed: float | Floats = 1.0,
    turn: float | Floats = 0.1,
    force: float | Floats = 9.8,
    gravity: float = 9.80665,
    **scales: dict[str, float],
) -> list[WrongUnit]:
    stamps_ns = np.arange(N) * 10_000_000
    sequence = Sequence(
        "hand",
        Calibration(gravity_m_s2=gravity),
        Imu(stamps_ns, vectors(turn), vectors(force)),
        Dvl(stamps_ns, vectors(speed), np.full((N, 3, 3), np.nan)),
    )
    return wrong_units(sequence, LogConfig.parse(scales, "x"))


def line_of(fault: WrongUnit) -> dict[str, float]:
    return tomllib.loads(fault.advice.split("`")[1])


def test_a_lively_vehicle_is_not_doubted():
    assert not found(speed=19.9, turn=1.99, force=9.0)


@pytest.mark.parametrize(
    ("speed", "unit", "times", "scale"),
    [
        (20.1, "cm/s", 100, 0.01),
        (299.0, "cm/s", 100, 0.01),
        (301.0, "mm/s", 1000, 0.001),
        (2900.0, "mm/s", 1000, 0.001),
        (9e5, "mm/s", 1000, 0.001),  # no unit makes it slow: the smallest
    ],
)
def test_a_speed_over_twenty_is_in_the_largest_unit_in_which_it_is_no_more_than_three(speed, unit, times, scale):
    (fault,) = found(speed=speed)
    assert fault.quantity == "DVL: unit"
    assert fault.advice.startswith(f"velocities look {times} times too large (up to {speed:.3g} m/s): {unit}? ")
    assert line_of(fault) == pytest.approx({"scale": scale})


def test_a_rate_over_two_is_in_degrees():
    (fault,) = found(turn=2.1)
    assert fault.quantity == "gyro: unit"
    assert "rates look 57 times too large (up to 2.1 rad/s)" in fault.advice
    assert line_of(fault) == pytest.approx({"angular_velocity_scale": np.pi / 180}, rel=1e-4)


@pytest.mark.parametrize(
    ("unit", "factor", "shares"),
    [
        ("g", 9.80665, (0.81, 1.0, 1.19)),
        ("mg", 9.80665e-3, (0.992, 1.0, 1.19)),
        ("cm/s²", 0.01, (0.81, 1.0, 1.008)),
        ("mm/s²", 0.001, (0.81, 1.0, 1.19)),
    ],
)
def test_a_force_is_in_the_unit_that_brings_it_nearest_to_gravity(unit, factor, shares):
    """Between mg and cm/s², which differ by a fiftieth, an accelerometer within a hundredth decides."""
    for share in shares:
        (fault,) = found(force=share * 9.80665 / factor)
        assert fault.quantity == "accelerometer: unit"
        assert f"instead of 9.807 m/s²: {unit}?" in fault.advice
        assert line_of(fault) == pytest.approx({"linear_acceleration_scale": factor}, rel=1e-5)


@pytest.mark.parametrize("force", [0.78, 1.22, 0.0, 1.5, 3.7, 300.0, 1e6])
def test_a_force_that_is_gravity_in_no_unit_has_no_wrong_one(force):
    assert not found(force=force)


def test_gravity_is_that_of_the_calibration():
    """0.78 g are within a fifth of 9.1 m/s²."""
    assert not found(force=0.78)
    (fault,) = found(force=0.78, gravity=9.1)
    assert "instead of 9.1 m/s²: g?" in fault.advice


def test_what_the_configuration_scales_is_taken_over():
    faults = found(
        speed=200.0,
        turn=20.0,
        force=1.0,
        dvl={"scale": 3.0},
        imu={"angular_velocity_scale": -1.0, "linear_acceleration_scale": 2.0},
    )
    assert [fault.quantity for fault in faults] == ["DVL: unit", "gyro: unit", "accelerometer: unit"]
    speed, turn, force = map(line_of, faults)
    assert speed == pytest.approx({"scale": 0.03})
    assert turn == pytest.approx({"angular_velocity_scale": -np.pi / 180}, rel=1e-4)
    assert force == pytest.approx({"linear_acceleration_scale": 19.6133})


def test_a_twentieth_of_spikes_counts_for_nothing_and_more_does():
    few, many = (np.where(np.arange(N) < k, 1e4, 0.1) for k in (4, 7))
    assert not found(speed=few, turn=few)
    assert [fault.quantity for fault in found(speed=many, turn=many)] == ["DVL: unit", "gyro: unit"]


def test_the_typical_force_is_that_of_half_the_rows():
    """Shocks move a mean, not a median."""
    shocked = np.where(np.arange(N) < 40, 20.0, 1.0)
    (fault,) = found(force=shocked)
    assert "typically 1 instead" in fault.advice


def test_rows_that_were_not_measured_in_full_do_not_count():
    """A vector without one component looks shorter than it is; without any row there is nothing to say."""
    force = vectors(9.8).copy()
    force[: N - 10] = [np.nan, 0.0, 1.0]
    stamps_ns = np.arange(N) * 10_000_000
    imu, dvl = Imu(stamps_ns, vectors(0.1), force), Dvl(stamps_ns, vectors(1.0), np.full((N, 3, 3), np.nan))
    assert not wrong_units(Sequence("hand", Calibration(), imu, dvl), LogConfig())
    assert not found(force=np.nan)
