"""Detections of a straight dive: gate, first place of a landmark, noise of the motion, waiting; steps of a policy."""

import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import chi2

from sonar_graph.calibration import Start
from sonar_graph.models import range_azimuth_jacobians
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import Outcome

from .dive import CALIBRATION, SONAR, Dive, spherical
from .graphs import block_of
from .made import smoother_with

BEAM = np.array([np.cos(0.2) * np.cos(0.4), np.sin(0.2) * np.cos(0.4), -np.sin(0.4)])
"""Centre beam of a sonar that looks 0.4 rad down and 0.2 rad to the left."""
CERTAIN = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)


def dive_with(smoother: Smoother | None = None, **changes) -> Dive:
    return Dive(CALIBRATION.model_copy(update=changes), smoother=smoother)


def settle(dive: Dive, updates: int = 1) -> None:
    for _ in range(updates):
        dive.smoother.update(dive.keyframes.newest_s)


def test_innovation_and_its_covariance_are_those_of_the_joint_prediction():
    """S = H P H^T + R by numpy, with P the window's joint covariance."""
    dive = Dive()
    truth = np.array([3.0, 0.8, -1.4])
    dive.see(0.0, (5, *spherical(0.0, truth)))
    settle(dive)
    landmark = dive.smoother.values.atPoint3(L(5))
    P = block_of(dive.smoother.joint_covariance([X(0), L(5)]), [X(0), L(5)])
    world_T_body = dive.smoother.values.atPose3(X(0))

    z, *by = range_azimuth_jacobians(world_T_body, SONAR.mounting.pose(), landmark)
    H = np.hstack(by)
    dive.see(0.0, (5, *(z + np.array([0.03, -0.02]))))
    log = dive.sightings.journal.log()
    assert log.outcomes[-1] is Outcome.USED
    assert log.innovations[-1] == pytest.approx([0.03, -0.02], abs=1e-9)
    assert np.allclose(
        log.innovation_covs[-1],
        H @ P @ H.T + np.diag([0.02**2, 0.01**2]),
        rtol=1e-5,
        atol=1e-10,
    )


@pytest.mark.parametrize("beyond", [False, True])
def test_the_gate_is_the_chi_square_quantile(beyond):
    """An innovation just inside it is used; just outside it is refused and leaves the graph as it was."""
    dive = Dive()
    dive.see(0.0, (5, 3.0, 0.0))
    dive.see(0.0, (5, 9.0, 0.0))
    assert dive.outcomes == [Outcome.NEW, Outcome.GATED]
    before = dive.smoother.graph.size()
    information = np.linalg.inv(dive.sightings.journal.log().innovation_covs[-1])
    edge_m = np.sqrt(chi2.ppf(0.99, 2) / information[0, 0])
    dive.see(0.0, (5, 3.0 + edge_m * (1.001 if beyond else 0.999), 0.0))
    assert dive.outcomes[-1] is (Outcome.GATED if beyond else Outcome.USED)
    assert dive.smoother.graph.size() == before + (0 if beyond else 2)
    assert dive.sightings.journal.log().innovations[1] == pytest.approx(
        [6.0, 0.0], abs=1e-6
    )


def test_a_frame_older_than_what_was_processed_is_late():
    dive = Dive()
    dive.see(3.0, (5, 3.0, 0.0))
    before = dive.smoother.graph.size()
    dive.see(2.99, (5, 3.0, 0.0), (6, 2.0, 0.0))
    assert dive.outcomes == [Outcome.NEW, Outcome.LATE, Outcome.LATE]
    assert dive.smoother.graph.size() == before


def waiting(greatest_gain: float) -> Dive:
    """A landmark that has been seen once by a vehicle that is sure of where it is."""
    dive = dive_with(smoother_with(waiting_gain=greatest_gain), start=CERTAIN)
    dive.see(0.0, (5, 3.0, 0.0))
    return dive


def range_variance(dive: Dive) -> float:
    return float(BEAM @ dive.smoother.marginals.marginalCovariance(L(5)) @ BEAM)


def test_sightings_wait_until_together_they_add_enough_information():
    """After n sightings range and azimuth are known to 1/n of the noise: the next adds 1/n, but a refused one 0."""
    dive = waiting(0.45)
    known = []
    for _ in range(6):
        known.append(0.02**2 / range_variance(dive))
        dive.see(0.0, (5, 3.0, 0.0))
    assert known == pytest.approx([1, 2, 3, 3, 5, 5], rel=1e-3)
    dive.see(0.0, (5, 9.0, 0.0))
    assert 0.02**2 / range_variance(dive) == pytest.approx(5, rel=1e-3)
    assert dive.outcomes == [Outcome.NEW] + [Outcome.USED] * 6 + [Outcome.GATED]
