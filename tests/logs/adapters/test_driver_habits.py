"""Messages as drivers really fill them, rebuilt field by field: bottom lock, held velocities, covariances of -1."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sonar_graph.logs import read_log, write_log
from sonar_graph.logs.adapters.dvl_messages import repeats
from sonar_graph.sequence import Sequence
from sonar_graph.testing import small_world
from tests.logs.adapters.conftest import Foreign, imu, rows_of
from tests.logs.conftest import Entry, tree, vector

ROWS = 60
LOST = np.arange(20, 40)
"""Rows that were sent without bottom lock."""
NO_LOCK = vector(0, 0, 0)


def velocity(row: int) -> dict[str, float]:
    """Slow change, with the noise of a sensor."""
    noise = np.random.default_rng(row).normal(0, 0.005, 3)
    return vector(*(np.array([0.6 + 0.1 * np.sin(row / 9), 0.1, 0.02]) + noise))


def report(*, lost: dict[str, Any], **sent: Any) -> Entry:
    """Messages of a Doppler log; `LOST` have other fields."""
    common = {"velocity_mode": 1, "num_good_beams": 4, "altitude": 3.0} | sent
    rows = [
        common | {"velocity": velocity(row)} | (lost if row in LOST else {})
        for row in range(ROWS)
    ]
    return rows_of("/dvl", "marine_acoustic_msgs/msg/Dvl", rows, "dvl_link")


def twists() -> Entry:
    """Velocities as twists; where nothing was measured the covariance is -1, as ROS has it."""
    rows = [
        {"twist": {"twist": {"linear": linear}, "covariance": [first] + [0.0] * 35}}
        for linear, first in (
            (NO_LOCK, -1.0) if row in LOST else (velocity(row), 1e-4)
            for row in range(ROWS)
        )
    ]
    kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
    return rows_of("/dvl", kind, rows, "dvl_link")


def read(foreign: Foreign, entry: Entry) -> Sequence:
    """With a mounted Doppler log."""
    return foreign.read(imu(ROWS), entry, tree("dvl_link", w=1.0))


# Each driver has its own mark of a missing bottom lock.
WITHOUT_LOCK: dict[str, tuple[Entry, str]] = {
    "Water Linked: four good beams and a velocity": (
        report(beam_velocities_valid=True, lost={"beam_velocities_valid": False}),
        "20 with beam_velocities_valid not true",
    ),
    "Nortek Nucleus, lock by its flag, never an altitude": (
        report(beam_velocities_valid=True, num_good_beams=3, altitude=0.0,
               lost={"beam_velocities_valid": False, "num_good_beams": 0}),
        "20 with beam_velocities_valid not true",
    ),
    "a flag that is always true, altitude -1": (
        report(beam_velocities_valid=True, lost={"altitude": -1.0}), "20 with altitude below 0"),
    "no flag, two beams": (report(lost={"num_good_beams": 2}), "20 with fewer than 3 good beams"),
    "no flag, zeros": (report(lost={"velocity": NO_LOCK}), "20 with a velocity of 0 in one step"),
    "PD0, its value for not measured": (
        report(lost={"velocity": vector(-32.768, -32.768, -32.768)}),
        "20 with one value beyond 30 m/s in all components",
    ),
    "twists, a covariance of -1 where nothing was measured": (
        twists(), "20 with a covariance that says invalid",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("entry", "reason"), WITHOUT_LOCK.values(), ids=WITHOUT_LOCK)
def test_velocities_without_bottom_lock_are_left_out(foreign, entry, reason):
    sequence = read(foreign, entry)
    assert sequence.notes["log.dropped"] == f"dvl: {reason}"
    is_left_out = ~np.isin(foreign.stamps(ROWS), sequence.dvl.stamps_ns)
    np.testing.assert_array_equal(np.flatnonzero(is_left_out), LOST)


def test_a_velocity_mode_that_is_never_filled_does_not_count(foreign):
    sequence = read(foreign, report(velocity_mode=0, lost={}))
    assert len(sequence.dvl) == ROWS
    unfilled = "velocity_mode and beam_velocities_valid are 0 in every message"
    assert unfilled in sequence.notes["log.warnings"]


DENIED = {
    f"{name}_covariance": [-1.0] + [0.0] * 8
    for name in ("orientation", "angular_velocity", "linear_acceleration")
}


def test_an_imu_that_denies_all_that_it_measures_is_used_with_a_warning(foreign):
    """A driver that has no covariances writes -1 into each, which by the definition means: not measured."""
    rows = [
        {
            "angular_velocity": vector(0.01 * np.sin(row), 0, 0.1),
            "linear_acceleration": vector(0.1 * np.cos(row), 0, 9.8),
        }
        for row in range(ROWS)
    ]
    entry = rows_of("/imu", "sensor_msgs/msg/Imu", rows, "imu_link", **DENIED)
    sequence = foreign.read(entry, report(lost={}))
    assert len(sequence.imu) == ROWS
    assert np.isfinite(sequence.imu.specific_force).all()
    settings = (
        "`angular_velocity_status = false` and `linear_acceleration_status = false`"
    )
    assert settings in sequence.notes["log.warnings"]


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


def test_a_coarse_velocity_that_stays_the_same_is_not_held():
    t = np.arange(120) * 0.1
    coarse = np.round(np.column_stack([np.sin(t), np.cos(0.7 * t), 0 * t]), 1)
    assert (np.diff(coarse, axis=0) == 0).all(axis=1).sum() > 20
    assert not repeats(coarse).any()


@pytest.mark.parametrize("times", [2, 5])
def test_held_velocities_are_used_once(foreign, times):
    """Water Linked's driver publishes ``~/odom`` once for each of two reports."""
    rows = [
        {"twist": {"twist": {"linear": velocity(row // times)}}} for row in range(ROWS)
    ]
    kind = "nav_msgs/msg/Odometry"
    odometry = rows_of("/dvl/odom", kind, rows, "odom", child_frame_id="dvl_link")
    sequence = read(foreign, odometry)
    np.testing.assert_array_equal(sequence.dvl.stamps_ns, foreign.stamps(ROWS)[::times])
    assert "that repeat the velocity before" in sequence.notes["log.dropped"]


def test_a_sensor_that_got_stuck_once_does_not_hold_velocities(foreign):
    stuck = report(lost={"velocity": velocity(20)})
    assert len(read(foreign, stuck).dvl) == ROWS
