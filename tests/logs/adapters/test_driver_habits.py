"""Messages as drivers really fill them, rebuilt field by field: bottom lock, held velocities, covariances of -1."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sonar_graph.logs import read_log, write_log
from sonar_graph.logs.adapters.dvl_messages import repeats
from sonar_graph.testing import small_world
from tests.logs.adapters.conftest import imu, rows_of
from tests.logs.conftest import Entry, tree, vector

ROWS = 60
LOST = np.arange(20, 40)
"""Rows that were sent without bottom lock."""
MARINE = "marine_acoustic_msgs/msg/Dvl"
NO_LOCK = vector(0, 0, 0)


def velocity(row: int) -> dict[str, float]:
    """Slow change, with the noise of a sensor."""
    noise = np.random.default_rng(row).normal(0, 0.005, 3)
    return vector(*(np.array([0.6 + 0.1 * np.sin(row / 9), 0.1, 0.02]) + noise))


def report(
    *, lost: dict[str, Any], sent: dict[str, Any] | None = None, kind: str = MARINE
) -> Entry:
    """Messages of a Doppler log; `LOST` have other fields."""
    common = (
        {
            "velocity_mode": 1,
            "num_good_beams": 4,
            "altitude": 3.0,
            "sound_speed": 1480.0,
        }
        if kind == MARINE
        else {}
    )
    rows = [
        common
        | (sent or {})
        | {"velocity": velocity(row)}
        | (lost if row in LOST else {})
        for row in range(ROWS)
    ]
    return rows_of("/dvl", kind, rows, "dvl_link")


def twists() -> Entry:
    """Velocities as twists; where nothing was measured the covariance is -1, as ROS has it."""
    rows = [
        {
            "twist": {
                "twist": {"linear": NO_LOCK if row in LOST else velocity(row)},
                "covariance": [-1.0 if row in LOST else 1e-4] + [0.0] * 35,
            }
        }
        for row in range(ROWS)
    ]
    return rows_of(
        "/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped", rows, "dvl_link"
    )


# Each driver has its own mark of a missing bottom lock.
WITHOUT_LOCK: dict[str, tuple[Entry, str]] = {
    "Water Linked, velocity report: zeros, one beam": (
        report(
            sent={"beam_velocities_valid": True, "beam_ranges_valid": True, "velocity_covar": [-1.0] * 9},
            lost={"beam_velocities_valid": False, "velocity": NO_LOCK, "num_good_beams": 1},
        ),
        "20 with beam_velocities_valid not true",
    ),
    "Water Linked, velocity report: four good beams and a velocity": (
        report(sent={"beam_velocities_valid": True}, lost={"beam_velocities_valid": False}),
        "20 with beam_velocities_valid not true",
    ),
    "Nortek Nucleus, lock by its flag, never an altitude": (
        report(
            sent={"beam_velocities_valid": True, "num_good_beams": 3, "altitude": 0.0},
            lost={"beam_velocities_valid": False, "num_good_beams": 0},
        ),
        "20 with beam_velocities_valid not true",
    ),
    "no flag, altitude -1": (report(lost={"altitude": -1.0}), "20 with altitude below 0"),
    "a flag that is always true, altitude -1": (
        report(sent={"beam_velocities_valid": True}, lost={"altitude": -1.0}),
        "20 with altitude below 0",
    ),
    "no flag, two beams": (report(lost={"num_good_beams": 2}), "20 with fewer than 3 good beams"),
    "no flag, zeros": (report(lost={"velocity": NO_LOCK}), "20 with a velocity of 0 in one step"),
    "PD0, its value for not measured": (
        report(lost={"velocity": vector(-32.768, -32.768, -32.768)}),
        "20 with one value beyond 30 m/s in all components",
    ),
    "dvl_msgs, velocity_valid": (
        report(kind="dvl_msgs/msg/DVL", sent={"velocity_valid": True, "altitude": 3.0, "fom": 0.01},
               lost={"velocity_valid": False, "altitude": -1.0, "velocity": NO_LOCK}),
        "20 with velocity_valid not true",
    ),
    "twists, a covariance of -1 where nothing was measured": (
        twists(), "20 with a covariance that says invalid",
    ),
    "Stonefish, covariance of -1": (
        report(kind="stonefish_ros2/msg/DVL", sent={"altitude": 3.0, "velocity_covariance": [1e-4] + [0.0] * 8},
               lost={"velocity_covariance": [-1.0] + [0.0] * 8}),
        "20 with a covariance that says invalid",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("entry", "reason"), WITHOUT_LOCK.values(), ids=WITHOUT_LOCK)
def test_velocities_without_bottom_lock_are_left_out(foreign, entry, reason):
    sequence = foreign.read(imu(ROWS), entry, tree("dvl_link", w=1.0))
    assert sequence.notes["log.dropped"] == f"dvl: {reason}"
    np.testing.assert_array_equal(
        np.flatnonzero(~np.isin(foreign.stamps(ROWS), sequence.dvl.stamps_ns)), LOST
    )


def test_a_velocity_mode_that_is_never_filled_does_not_count(foreign):
    entry = report(sent={"velocity_mode": 0}, lost={})
    sequence = foreign.read(imu(ROWS), entry, tree("dvl_link", w=1.0))
    assert len(sequence.dvl.stamps_ns) == ROWS
    assert (
        "velocity_mode and beam_velocities_valid are 0 in every message"
        in sequence.notes["log.warnings"]
    )


def turning(row: int, **status: Any) -> dict[str, Any]:
    return {"angular_velocity": vector(0.01 * np.sin(row), 0, 0.1), **status}


DENIED = {
    f"{name}_covariance": [-1.0] + [0.0] * 8
    for name in ("orientation", "angular_velocity", "linear_acceleration")
}


def test_an_imu_that_denies_all_that_it_measures_is_used_with_a_warning(
    foreign,
):
    """A driver that has no covariances writes -1 into each, which by the definition means: not measured."""
    rows = [
        turning(row, linear_acceleration=vector(0.1 * np.cos(row), 0, 9.8), **DENIED)
        for row in range(ROWS)
    ]
    entry = rows_of("/imu", "sensor_msgs/msg/Imu", rows, "imu_link")
    sequence = foreign.read(entry, report(lost={}))
    assert len(sequence.imu.stamps_ns) == ROWS
    assert np.isfinite(sequence.imu.specific_force).all()
    assert (
        "`angular_velocity_status = false` and `linear_acceleration_status = false`"
        in sequence.notes["log.warnings"]
    )


def test_a_log_that_this_package_wrote_keeps_every_velocity(tmp_path):
    """Rows were chosen before it was written; wheels stop from one row to the next, and turn evenly."""
    world = small_world()
    velocity = world.dvl.velocity.copy()
    velocity[40:60] = 0.0
    velocity[60:90] = np.repeat(velocity[61:91:2], 2, axis=0)
    written = replace(world, dvl=replace(world.dvl, velocity=velocity))
    write_log(tmp_path / "own.mcap", written)
    np.testing.assert_array_equal(
        read_log(tmp_path / "own.mcap").dvl.velocity, velocity
    )
    with_whole = read_log(tmp_path / "own.mcap", calibration=world.calibration)
    np.testing.assert_array_equal(with_whole.dvl.velocity, velocity)


def test_a_held_velocity_is_a_drivers_habit_and_a_coarse_one_is_none():
    fine = np.random.default_rng(0).standard_normal((60, 3))
    held = np.repeat(fine, 2, axis=0)
    assert repeats(held).sum() == 60
    t = np.arange(120) * 0.1
    coarse = np.round(np.column_stack([np.sin(t), np.cos(0.7 * t), 0 * t]), 1)
    assert (np.diff(coarse, axis=0) == 0).all(axis=1).sum() > 20
    assert not repeats(coarse).any()


@pytest.mark.parametrize("times", [2, 5])
def test_held_velocities_are_used_once(foreign, times):
    """Water Linked's driver publishes ``~/odom`` once for each of two reports."""
    rows = [
        {
            "twist": {"twist": {"linear": velocity(row // times)}},
            "child_frame_id": "dvl_link",
        }
        for row in range(ROWS)
    ]
    odometry = rows_of("/dvl/odom", "nav_msgs/msg/Odometry", rows, "odom")
    sequence = foreign.read(imu(ROWS), odometry, tree("dvl_link", w=1.0))
    np.testing.assert_array_equal(sequence.dvl.stamps_ns, foreign.stamps(ROWS)[::times])
    assert "that repeat the velocity before" in sequence.notes["log.dropped"]


def test_a_sensor_that_got_stuck_once_does_not_hold_velocities(
    foreign,
):
    stuck = report(lost={"velocity": velocity(20)})
    assert (
        len(foreign.read(imu(ROWS), stuck, tree("dvl_link", w=1.0)).dvl.stamps_ns)
        == ROWS
    )
