"""Where a landmark is put when it is first seen: on the beam, or on a floor, from where the vehicle was."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from sonar_graph.calibration import FloorPrior, Start
from sonar_graph.states import Outcome

from .dive import CALIBRATION, FLOOR, NS, POLICY, SONAR, START_NS, T0_NS, Dive, spherical


def test_a_first_sighting_places_a_landmark_on_the_centre_beam():
    """Range 3 m straight ahead of a sonar that looks 0.4 rad down and 0.2 rad to the left."""
    dive = Dive()
    dive.see(0.0, (5, 3.0, 0.0))
    beam = np.array([np.cos(0.2) * np.cos(0.4), np.sin(0.2) * np.cos(0.4), -np.sin(0.4)])
    assert dive.outcomes == [Outcome.NEW]
    assert dive.smoother.values.atPoint3(L(5)) == pytest.approx(np.array([0.3, 0.1, -0.1]) + 3.0 * beam)


def test_a_known_floor_gives_the_elevation():
    dive = Dive(CALIBRATION.model_copy(update={"floor": FLOOR}))
    truth = np.array([2.6, 0.9, FLOOR.z_m])
    dive.see(0.0, (5, *spherical(0.0, truth)))
    assert dive.smoother.values.atPoint3(L(5)) == pytest.approx(truth, abs=1e-9)
    assert dive.smoother.graph.size() == 1 + 4
    dive.smoother.update(dive.keyframes.newest_s)
    assert np.sqrt(dive.smoother.covariance(L(5))[2, 2]) == pytest.approx(FLOOR.sigma_m, rel=1e-3)


def test_a_floor_out_of_the_aperture_is_believed_all_the_same():
    """0.2 rad below the centre beam, where half the aperture is 0.12 rad: first put on the beam, then on the floor."""
    dive = Dive(CALIBRATION.model_copy(update={"floor": FloorPrior(z_m=-0.1 - 3.0 * np.sin(0.6), sigma_m=0.01)}))
    dive.see(0.0, (5, 3.0, 0.0))
    for _ in range(5):
        dive.smoother.update(dive.keyframes.newest_s)
    assert dive.outcomes == [Outcome.NEW]
    assert dive.smoother.values.atPoint3(L(5))[2] == pytest.approx(-0.1 - 3.0 * np.sin(0.6), abs=1e-3)
    assert dive.smoother.values.atPose3(X(0)).equals(gtsam.Pose3(), 1e-3)


def test_a_landmark_that_cannot_stand_on_the_floor_does_not_drag_the_vehicle_there():
    """0.5 rad below the centre beam is seven sigmas of the aperture: no floor is said, but the aperture is."""
    floor = FloorPrior(z_m=-0.1 - 3.0 * np.sin(0.9), sigma_m=0.01)
    dive, without = Dive(CALIBRATION.model_copy(update={"floor": floor})), Dive()
    for each in (dive, without):
        each.see(0.0, (5, 3.0, 0.0))
        each.smoother.update(each.keyframes.newest_s)
    assert dive.smoother.graph.equals(without.smoother.graph, 1e-12)
    assert dive.smoother.values.atPose3(X(0)).equals(gtsam.Pose3(), 1e-9)


def test_a_doubtful_height_of_the_vehicle_lets_the_floor_be_farther():
    floor = FloorPrior(z_m=-0.1 - 3.0 * np.sin(0.9), sigma_m=0.01)
    start = Start(position_sigma_m=(0.05, 0.02, 2.0), rpy_sigma_rad=(0.01, 0.01, 0.03))
    dive = Dive(CALIBRATION.model_copy(update={"floor": floor, "start": start}))
    dive.see(0.0, (5, 3.0, 0.0))
    for _ in range(5):
        dive.smoother.update(dive.keyframes.newest_s)
    assert dive.smoother.values.atPoint3(L(5))[2] == pytest.approx(floor.z_m, abs=1e-2)


def test_a_frame_between_keyframes_is_seen_from_where_the_vehicle_was():
    """0.35 s after the keyframe the vehicle is 0.175 m further on."""
    dive = Dive()
    dive.see(0.35, (5, 3.0, 0.0))
    beam = np.array([np.cos(0.2) * np.cos(0.4), np.sin(0.2) * np.cos(0.4), -np.sin(0.4)])
    assert dive.keyframes.stamps_ns == [START_NS]
    assert dive.smoother.values.atPoint3(L(5)) == pytest.approx(np.array([0.475, 0.1, -0.1]) + 3.0 * beam)


def test_elevation_is_said_once_for_a_landmark():
    """It does not vary as noise would: many sightings from one place leave its height as unknown as the first."""
    dive = Dive(
        CALIBRATION.model_copy(update={"start": Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)})
    )
    for k in range(9):
        dive.see(0.01 * k, (5, 3.0, 0.0))
    dive.smoother.update(dive.keyframes.newest_s)
    up = np.array([np.cos(0.2) * np.sin(0.4), np.sin(0.2) * np.sin(0.4), np.cos(0.4)])
    cov = dive.smoother.covariance(L(5))
    elevation_sigma = SONAR.elevation_aperture_rad / np.sqrt(12)
    assert np.sqrt(up @ cov @ up) == pytest.approx(3.0 * np.tan(elevation_sigma), rel=0.01)
    assert dive.outcomes == [Outcome.NEW] + [Outcome.USED] * 8


def test_a_frame_that_brings_a_keyframe_hangs_on_it():
    dive = Dive()
    dive.keyframes.params = POLICY.model_copy(update={"motion_noise_share": 0.0})
    dive.see(1.05, (5, 3.0, 0.0))
    assert dive.keyframes.stamps_ns == [START_NS, T0_NS + NS]
    graph = dive.smoother.graph
    assert {tuple(graph.at(k).keys()) for k in range(graph.size())} == {(X(0),), (X(0), X(1)), (X(1), L(5))}
    beam = np.array([np.cos(0.2) * np.cos(0.4), np.sin(0.2) * np.cos(0.4), -np.sin(0.4)])
    seen = np.array([0.3 + 0.5 * 1.05, 0.1, -0.1]) + 3.0 * beam
    assert dive.smoother.values.atPoint3(L(5)) == pytest.approx(seen, abs=1e-6)


def test_a_sightline_begins_where_the_sonar_was_at_the_frame():
    dive = Dive()
    dive.see(0.35, (5, 3.0, 0.0))
    placed = dive.smoother.sightlines.placed_anew(dive.smoother.values, [L(5)])
    assert placed.atPoint3(L(5)) == pytest.approx(dive.smoother.values.atPoint3(L(5)))
