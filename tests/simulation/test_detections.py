"""Detections come from landmarks inside the fan, at the stated rates, with the stated noise."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sonar_graph.calibration import Mounting, SonarCalibration
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.simulation.detections import (
    FieldOfView,
    SimulatedRecogniser,
    World,
    inside,
    landmarks_in_sonar,
    range_azimuth_elevation,
    simulate_detections,
)
from sonar_graph.simulation.sensors import regular_stamps, seconds_since_start
from sonar_graph.simulation.vehicle import VehiclePath, smooth_noise

SONAR = SonarCalibration(
    mounting=Mounting(translation_m=(0.4, 0.1, -0.05), rpy_rad=(0.02, 0.5, -0.1)),
    range_sigma_m=0.015,
    azimuth_sigma_rad=0.007,
)
FAN = FieldOfView(1.0, 6.0, 0.6, 0.3)
WORLD = World(np.array([3, 7, 8]), np.array([[3.0, 0.5, -2.0], [4.0, -1.0, -2.1], [2.5, 0.0, -1.5]]), -2.0)
STAMPS = regular_stamps(10.0, 600.0, 0.013)


def path() -> VehiclePath:
    seconds = np.linspace(0, 600, 1201)
    sigma = np.array([0.8, 0.8, 0.2, 0.1, 0.1, 0.5])
    return VehiclePath.through(seconds, smooth_noise(seconds, sigma, 6.0, 6, np.random.default_rng(11)))


PATH = path()


def detect(
    recogniser: SimulatedRecogniser, sonar: SonarCalibration = SONAR, world: World = WORLD
) -> LandmarkDetections:
    found = simulate_detections(PATH, STAMPS, sonar, FAN, recogniser, world, np.random.default_rng(12))
    assert found is not None
    return found


def in_view() -> np.ndarray:
    """By another library: which landmark each frame's fan holds, shape (n, m)."""
    motion = PATH.at(seconds_since_start(STAMPS))
    body_T_sonar = SONAR.mounting.pose()
    seen = np.zeros((len(STAMPS), len(WORLD.landmark_ids)), bool)
    for row, (rotation, position) in enumerate(zip(motion.world_R_body.as_matrix(), motion.position, strict=True)):
        world_T_sonar = gtsam.Pose3(gtsam.Rot3(rotation), position) * body_T_sonar
        for column, landmark in enumerate(WORLD.landmark_positions):
            x, y, z = world_T_sonar.transformTo(landmark)
            distance, azimuth, elevation = np.hypot(np.hypot(x, y), z), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
            seen[row, column] = 1.0 <= distance <= 6.0 and abs(azimuth) <= 0.6 and abs(elevation) <= 0.3
    return seen


def assert_binomial(successes: int, trials: int, probability: float) -> None:
    low, high = stats.binom.interval(0.9999, trials, probability)
    assert low <= successes <= high


def test_points_in_the_sonars_frame_agree_with_gtsam():
    points = landmarks_in_sonar(PATH, STAMPS[:20], SONAR, WORLD)
    motion = PATH.at(seconds_since_start(STAMPS[:20]))
    for row in range(20):
        world_T_body = gtsam.Pose3(gtsam.Rot3(motion.world_R_body.as_matrix()[row]), motion.position[row])
        expected = (world_T_body * SONAR.mounting.pose()).transformTo(WORLD.landmark_positions.T).T
        np.testing.assert_allclose(points[row], expected, atol=1e-12)


@given(st.floats(0.2, 20), st.floats(-3.1, 3.1), st.floats(-1.5, 1.5))
def test_polar_coordinates_invert_their_definition(distance: float, azimuth: float, elevation: float):
    across = distance * np.cos(elevation)
    q = np.array([across * np.cos(azimuth), across * np.sin(azimuth), distance * np.sin(elevation)])
    np.testing.assert_allclose(range_azimuth_elevation(q), [distance, azimuth, elevation], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("range_m", "azimuth_rad", "elevation_rad", "seen"),
    [
        (3.0, 0.0, 0.0, True),
        (1.01, 0.59, 0.29, True),
        (5.99, -0.59, -0.29, True),
        (0.99, 0.0, 0.0, False),
        (6.01, 0.0, 0.0, False),
        (3.0, 0.61, 0.0, False),
        (3.0, -0.61, 0.0, False),
        (3.0, 0.0, 0.31, False),
        (3.0, 0.0, -0.31, False),
        (3.0, np.pi, 0.0, False),
    ],
)
def test_fan_ends_at_its_edges(range_m: float, azimuth_rad: float, elevation_rad: float, seen: bool):
    across = range_m * np.cos(elevation_rad)
    q = [across * np.cos(azimuth_rad), across * np.sin(azimuth_rad), range_m * np.sin(elevation_rad)]
    assert inside(FAN, np.array(q)) == seen


def test_a_perfect_recogniser_reports_exactly_what_is_in_view():
    found = detect(SimulatedRecogniser())
    seen = in_view()
    ids, _ = found.most_probable()
    reported = set(zip(found.stamps_ns.tolist(), ids.tolist(), strict=True))
    rows, columns = np.nonzero(seen)
    assert reported == set(zip(STAMPS[rows].tolist(), WORLD.landmark_ids[columns].tolist(), strict=True))
    assert 0.1 < seen.mean() < 0.9


def test_range_and_azimuth_carry_the_noise_of_their_covariance():
    noisy = detect(SimulatedRecogniser())
    quiet = detect(SimulatedRecogniser(), SONAR.model_copy(update={"range_sigma_m": 1e-12, "azimuth_sigma_rad": 1e-12}))
    sigmas = np.sqrt(np.diagonal(noisy.range_azimuth_cov, axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas, np.tile([0.015, 0.007], (len(noisy), 1)))
    error = np.column_stack([noisy.range_m - quiet.range_m, noisy.azimuth_rad - quiet.azimuth_rad]) / sigmas
    low, high = stats.chi2.interval(0.9999, len(error))
    assert np.all((low < np.sum(error**2, axis=0)) & (np.sum(error**2, axis=0) < high))
    assert np.all(np.abs(error.mean(axis=0)) < 4 / np.sqrt(len(error)))


def test_landmarks_are_missed_at_the_stated_rate():
    trials = int(in_view().sum())
    assert_binomial(len(detect(SimulatedRecogniser(detection_probability=0.7))), trials, 0.7)


def test_identities_are_mistaken_at_the_stated_rate_and_for_all_others_alike():
    right, wrong = detect(SimulatedRecogniser()), detect(SimulatedRecogniser(wrong_id_rate=0.2))
    true_ids, ids = right.most_probable()[0], wrong.most_probable()[0]
    mistaken = true_ids != ids
    assert_binomial(int(mistaken.sum()), len(ids), 0.2)
    of_first = ids[mistaken & (true_ids == 3)]
    assert_binomial(int((of_first == 7).sum()), len(of_first), 0.5)


def test_recognised_posteriors_are_confident_and_leave_room_for_none():
    found = detect(SimulatedRecogniser())
    np.testing.assert_allclose(np.sort(found.id_probability, axis=1), np.tile([0.01, 0.01, 0.97], (len(found), 1)))


def test_false_detections_come_at_the_stated_rate_all_over_the_fan():
    found = detect(SimulatedRecogniser(detection_probability=0, false_detections_per_frame=0.5))
    low, high = stats.poisson.interval(0.9999, 0.5 * len(STAMPS))
    assert low < len(found) < high
    uniform_range = stats.kstest(found.range_m, stats.uniform(1.0, 5.0).cdf).pvalue
    uniform_azimuth = stats.kstest(found.azimuth_rad, stats.uniform(-0.6, 1.2).cdf).pvalue
    assert min(uniform_range, uniform_azimuth) > 1e-4


def test_false_detections_say_none_of_the_known_unless_confusion_is_asked_for():
    doubtful = detect(SimulatedRecogniser(detection_probability=0, false_detections_per_frame=0.5))
    np.testing.assert_allclose(doubtful.id_probability.sum(axis=1), 0.2)
    confused = detect(SimulatedRecogniser(0, 0, false_detections_per_frame=0.5, confident_false_fraction=0.3))
    assert_binomial(int((confused.most_probable()[1] > 0.9).sum()), len(confused), 0.3)


def test_a_lone_landmark_cannot_be_mistaken_for_another():
    lone = World(WORLD.landmark_ids[:1], WORLD.landmark_positions[:1], -2.0)
    found = detect(SimulatedRecogniser(wrong_id_rate=1.0), world=lone)
    assert np.all(found.most_probable()[0] == 3)


def test_nothing_in_view_is_no_block():
    far = World(np.array([1]), np.array([[500.0, 0.0, 0.0]]), 0.0)
    assert simulate_detections(PATH, STAMPS, SONAR, FAN, SimulatedRecogniser(), far, np.random.default_rng(0)) is None


def test_a_share_of_all_detections_names_nothing():
    """The others, and where all of them are, stay as they were."""
    named = detect(SimulatedRecogniser(false_detections_per_frame=0.5))
    some = detect(SimulatedRecogniser(false_detections_per_frame=0.5, anonymous_share=0.3))
    is_anonymous = (some.candidate_ids < 0).all(axis=1)
    assert_binomial(int(is_anonymous.sum()), len(some), 0.3)
    assert np.all(some.id_probability[is_anonymous] == 0)
    assert np.array_equal(some.id_probability[~is_anonymous], named.id_probability[~is_anonymous])
    assert np.array_equal(some.candidate_ids[~is_anonymous], named.candidate_ids[~is_anonymous])
    assert np.array_equal(some.range_m, named.range_m)
    assert np.array_equal(some.azimuth_rad, named.azimuth_rad)
    assert (detect(SimulatedRecogniser(anonymous_share=1.0)).candidate_ids < 0).all()
