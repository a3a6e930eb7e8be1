"""What becomes of messages that come late, twice, or from a clock that was set."""

import numpy as np
import pytest

from sonar_graph import Depth, Dvl, Imu
from sonar_graph.errors import MeasurementError
from sonar_graph.live import Arrivals
from sonar_graph.live.arrivals import AHEAD, LATE

MS = 1_000_000


def imu(at_ms):
    return message("imu", at_ms, Imu, (1, 3), (1, 3))


def dvl(at_ms):
    return message("dvl", at_ms, Dvl, (1, 3), (1, 3, 3))


def depth(at_ms):
    return message("depth", at_ms, Depth, 1, 1)


def message(role, at_ms, kind, *shapes):
    columns = [np.ones(shape) for shape in shapes]
    return role, at_ms * MS, kind(np.array([at_ms * MS]), *columns)


def no_detection(at_ms):
    return "detections", at_ms * MS, None


def ends_ms(arrivals):
    return [step.end_ns // MS for step in arrivals.steps()]


def given(*messages, lateness_s=0.25):
    arrivals = Arrivals(10.0, lateness_s)
    for message in messages:
        assert arrivals.add(*message) is None
    return arrivals


def test_a_step_waits_for_every_sensor_that_has_sent():
    arrivals = given(imu(0), dvl(0), depth(0), imu(150), dvl(150))
    assert ends_ms(arrivals) == []
    arrivals.add(*depth(100))
    assert ends_ms(arrivals) == [100]


def test_a_silent_sensor_delays_a_step_by_the_lateness_budget_only():
    arrivals = given(imu(0), dvl(0), depth(0), imu(349), dvl(349))
    assert ends_ms(arrivals) == []
    arrivals.add(*imu(350))
    assert ends_ms(arrivals) == [100]
    assert arrivals.add(*depth(100)) == LATE
    assert arrivals.add(*depth(101)) is None


def test_a_frame_without_detections_says_that_none_will_come():
    arrivals = given(imu(0), dvl(0), no_detection(0), imu(150), dvl(150))
    assert ends_ms(arrivals) == []
    arrivals.add(*no_detection(120))
    assert ends_ms(arrivals) == [100]


def test_a_stamp_ahead_of_its_arrival_is_refused_and_makes_no_other_late():
    arrivals = Arrivals(10.0)
    for message in (imu(0), dvl(0)):
        arrivals.add(*message, arrival_ns=0)
    assert arrivals.add(*dvl(3_600_000), arrival_ns=100 * MS) == AHEAD
    assert arrivals.add(*imu(100), arrival_ns=100 * MS) is None


def test_after_a_pause_of_everything_stamps_are_believed_again():
    """A connection that broke for a minute, and a clock that was set for all."""
    arrivals = Arrivals(10.0)
    for message in (imu(0), dvl(0)):
        arrivals.add(*message, arrival_ns=0)
    assert arrivals.add(*imu(60_000), arrival_ns=60_000 * MS) is None
    assert arrivals.add(*imu(7_200_000), arrival_ns=60_100 * MS) == AHEAD
    assert arrivals.add(*imu(7_202_000), arrival_ns=62_100 * MS) is None


def test_the_last_steps_end_with_imu_and_doppler_log():
    arrivals = given(imu(0), dvl(0), imu(250), dvl(230), depth(900))
    assert ends_ms(arrivals) == [100, 200, 300, 400, 500, 600]
    arrivals = given(imu(0), dvl(0), imu(250), dvl(230))
    steps = [*arrivals.steps(), *arrivals.rest()]
    assert [step.end_ns // MS for step in steps] == [100, 200]


@pytest.mark.parametrize(
    ("rate_hz", "lateness_s"), [(0.0, 0.1), (np.nan, 0.1), (1.0, -0.1), (1.0, np.inf)]
)
def test_impossible_choices_are_refused(rate_hz, lateness_s):
    with pytest.raises(MeasurementError, match=r"rate|budget"):
        Arrivals(rate_hz, lateness_s)
