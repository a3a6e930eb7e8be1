"""What becomes of messages that come late, twice, or from a clock that was set."""

import numpy as np
import pytest

from sonar_graph import Depth, Dvl, Imu
from sonar_graph.errors import MeasurementError
from sonar_graph.live import Arrivals
from sonar_graph.live.arrivals import AHEAD, LATE

MS = 1_000_000


def ends_ms(arrivals):
    return [step.end_ns // MS for step in arrivals.steps()]


def given(lateness_s=0.25, **sensors):
    """What has come of each sensor at these times, row by row of the sensors."""
    arrivals = Arrivals(10.0, lateness_s)
    for role, times_ms in sensors.items():
        for at_ms in times_ms:
            assert arrivals.add(*row(role, at_ms)) is None
    return arrivals


@pytest.mark.parametrize("role", ["depth", "detections"])
def test_a_step_waits_for_every_sensor_that_has_sent(role):
    """A frame without detections says that none will come."""
    arrivals = given(imu=(0, 150), dvl=(0, 150), **{role: (0,)})
    assert ends_ms(arrivals) == []
    arrivals.add(*row(role, 120))
    assert ends_ms(arrivals) == [100]


def test_a_silent_sensor_delays_a_step_by_the_lateness_budget_only():
    arrivals = given(imu=(0, 349), dvl=(0, 349), depth=(0,))
    assert ends_ms(arrivals) == []
    arrivals.add(*row("imu", 350))
    assert ends_ms(arrivals) == [100]
    assert arrivals.add(*row("depth", 100)) == LATE
    assert arrivals.add(*row("depth", 101)) is None


def test_a_stamp_ahead_of_its_arrival_is_refused_and_makes_no_other_late():
    """After a pause of everything stamps are believed again: a connection that broke, and a clock that was set for all."""
    for rows in (
        [("dvl", 3_600_000, 100, AHEAD), ("imu", 100, 100, None)],
        [
            ("imu", 60_000, 60_000, None),
            ("imu", 7_200_000, 60_100, AHEAD),
            ("imu", 7_202_000, 62_100, None),
        ],
    ):
        arrivals = Arrivals(10.0)
        begun = [("imu", 0, 0, None), ("dvl", 0, 0, None)]
        for role, at_ms, arrival_ms, refusal in begun + rows:
            refused = arrivals.add(*row(role, at_ms), arrival_ns=arrival_ms * MS)
            assert refused == refusal


def test_the_last_steps_end_with_imu_and_doppler_log():
    motion = {"imu": (0, 250), "dvl": (0, 230)}
    arrivals = given(**motion, depth=(900,))
    assert ends_ms(arrivals) == [100, 200, 300, 400, 500, 600]
    arrivals = given(**motion)
    steps = [*arrivals.steps(), *arrivals.rest()]
    assert [step.end_ns // MS for step in steps] == [100, 200]


@pytest.mark.parametrize(
    ("rate_hz", "lateness_s"), [(0.0, 0.1), (np.nan, 0.1), (1.0, -0.1), (1.0, np.inf)]
)
def test_impossible_choices_are_refused(rate_hz, lateness_s):
    with pytest.raises(MeasurementError, match=r"rate|budget"):
        Arrivals(rate_hz, lateness_s)


KINDS = {
    "imu": (Imu, (1, 3), (1, 3)),
    "dvl": (Dvl, (1, 3), (1, 3, 3)),
    "depth": (Depth, 1, 1),
}


def row(role, at_ms):
    """A message of a sensor; of detections, a frame without any."""
    block = None
    if role in KINDS:
        kind, *shapes = KINDS[role]
        block = kind(np.array([at_ms * MS]), *map(np.ones, shapes))
    return role, at_ms * MS, block
