"""Sightings wait until together they have something to tell."""

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import Start
from sonar_graph.states import Outcome

from .dive import CALIBRATION, NS, T0_NS, Dive
from .made import smoother_with


def waiting(greatest_gain: float) -> Dive:
    """A landmark that has been seen once by a vehicle that is sure of where it is."""
    sure = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)
    dive = Dive(CALIBRATION.model_copy(update={"start": sure}))
    dive.smoother = dive.keyframes.smoother = dive.sightings.smoother = smoother_with(1e9, 1e-6, 1e9, greatest_gain)
    dive.see(0.0, (5, 3.0, 0.0))
    return dive


def range_variance(dive: Dive) -> float:
    beam = np.array([np.cos(0.2) * np.cos(0.4), np.sin(0.2) * np.cos(0.4), -np.sin(0.4)])
    return float(beam @ dive.smoother.covariance(L(5)) @ beam)


def test_sightings_wait_until_together_they_have_something_to_tell():
    """After n sightings range and azimuth are known to 1/n of the noise: the next would add 1/n, and so on."""
    dive, known, waited = waiting(0.45), [], []
    for _ in range(6):
        known.append(0.02**2 / range_variance(dive))
        dive.see(0.0, (5, 3.0, 0.0))
        waited.append(dive.smoother.waiting_gain)
    assert known == pytest.approx([1, 2, 3, 3, 5, 5], rel=1e-3)
    assert waited == pytest.approx([0, 0, 1 / 3, 0, 1 / 5, 2 / 5], rel=1e-3, abs=1e-9)
    assert dive.outcomes == [Outcome.NEW] + [Outcome.USED] * 6


def test_with_no_gain_to_wait_for_none_waits():
    dive = waiting(0.0)
    for n in range(1, 7):
        assert 0.02**2 / range_variance(dive) == pytest.approx(n, rel=1e-3)
        dive.see(0.0, (5, 3.0, 0.0))


@pytest.mark.parametrize("what", ["keyframe", "landmark"])
def test_what_waits_is_used_with_the_next_keyframe_or_landmark(what):
    dive = waiting(1e9)
    for _ in range(3):
        dive.see(0.0, (5, 3.0, 0.0))
    assert range_variance(dive) == pytest.approx(0.02**2, rel=1e-3)
    if what == "keyframe":
        dive.keyframes.advance(T0_NS + 5 * NS)
        dive.keyframes.update_if_due()
    else:
        dive.see(0.0, (6, 3.0, 0.3))
    assert range_variance(dive) == pytest.approx(0.02**2 / 4, rel=0.01)


def test_a_refused_detection_does_not_add_to_what_waits():
    dive = waiting(1e9)
    dive.see(0.0, (5, 9.0, 0.0))
    assert dive.outcomes[-1] is Outcome.GATED
    assert dive.smoother.waiting_gain == 0.0
