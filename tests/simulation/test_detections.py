"""Detections come from landmarks inside the fan, at the stated rates, with the stated noise."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sonar_graph.calibration import Mounting, SonarCalibration
from sonar_graph.errors import SimulationError
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.simulation.detections import (
    FieldOfView,
    SimulatedRecogniser,
    Tracking,
    Watched,
    World,
    inside,
    landmarks_in_sonar,
    range_azimuth_elevation,
    simulate_detections,
    world_on_floor,
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
    return simulate_detections(PATH, STAMPS, sonar, FAN, recogniser, world, np.random.default_rng(12))


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


def test_landmark_heights_obey_the_floor_prior():
    xy = np.arange(2000.0).reshape(1000, 2)
    world = world_on_floor(xy, -1.7, 0.03, np.random.default_rng(0))
    low, high = stats.chi2.interval(0.9999, 1000)
    assert low < np.sum(((world.landmark_positions[:, 2] + 1.7) / 0.03) ** 2) < high
    np.testing.assert_array_equal(world.landmark_positions[:, :2], xy)


def test_landmarks_are_numbered_from_one_and_truth_claims_no_covariance():
    landmarks = world_on_floor(np.zeros((3, 2)), -1.0, 0.01, np.random.default_rng(0)).landmark_map()
    assert landmarks.ids.tolist() == [1, 2, 3]
    assert np.isnan(landmarks.covariances).all()


NS = 1_000_000_000


def basin(**options) -> LandmarkDetections:
    return simulate_basin(BasinOptions(duration_s=260.0, laps=2, seed=5, **options)).detections


def tracks_of(found: LandmarkDetections) -> list[LandmarkDetections]:
    return [found.rows(found.track == number) for number in range(found.track.max() + 1)]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 2_000_000_000)), min_size=1, max_size=40))
def test_a_track_is_of_one_landmark_and_has_no_gap(steps: list[tuple[int, int]]):
    landmark = np.array([index for index, _ in steps])
    stamps_ns = np.cumsum([gap for _, gap in steps])
    watched = Watched.of(landmark, stamps_ns, Tracking())
    for number, true in enumerate(watched.landmark.tolist()):
        rows = np.flatnonzero(watched.track == number)
        assert set(landmark[rows].tolist()) == {true}
        assert (np.diff(stamps_ns[rows]) <= NS).all()
        assert watched.age_s[rows] == pytest.approx((stamps_ns[rows] - stamps_ns[rows[0]]) / NS)
        assert watched.lifetime_s[number] == pytest.approx(watched.age_s[rows].max())
    for index in range(3):
        rows = np.flatnonzero(landmark == index)
        is_new = np.diff(watched.track[rows]) != 0
        assert is_new.tolist() == (np.diff(stamps_ns[rows]) > NS).tolist()


def test_without_tracks_nothing_is_of_one_and_tracks_alone_change_nothing_else():
    plain, tracked = basin(), basin(tracks=True)
    assert set(plain.track.tolist()) == {-1}
    for name in ("stamps_ns", "range_m", "azimuth_rad", "candidate_ids", "id_probability"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(tracked, name))
    false = plain.id_probability.max(axis=1) < 0.9
    assert false.any()
    np.testing.assert_array_equal(tracked.track < 0, false)
    assert len(tracks_of(tracked)) >= 8


def test_an_identity_comes_when_its_track_is_old_enough():
    for track in tracks_of(basin(tracks=True, id_delay_s=4.0)):
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        sure = track.id_probability.max(axis=1) > 0.9
        np.testing.assert_array_equal(sure, age_s >= 4.0)
        assert track.id_probability[~sure] == pytest.approx(0.2)


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_wrong_identity_is_that_of_one_other_landmark_for_a_share_of_the_track(share: float):
    right = [track.most_probable()[0][-1] for track in tracks_of(basin(tracks=True))]
    wrong = tracks_of(basin(tracks=True, id_delay_s=2.0, wrong_id_rate=1.0, wrong_id_share=share))
    for true, track in zip(right, wrong, strict=True):
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        ids, probability = track.most_probable()
        is_wrong = (ids != true) & (probability > 0.9)
        expected = (age_s >= 2.0) & ((age_s < 2.0 + share * (age_s[-1] - 2.0)) | (share == 1))
        np.testing.assert_array_equal(is_wrong, expected)
        assert len(set(ids[is_wrong].tolist())) <= 1


@pytest.mark.slow
def test_the_share_of_wrong_tracks_is_as_asked():
    """Thirty runs of eight tracks or more: 0.3 give or take four standard errors."""
    wrong = []
    for seed in range(30):
        options = {"duration_s": 260.0, "laps": 2, "seed": seed, "tracks": True}
        plain = simulate_basin(BasinOptions(**options)).detections
        mixed = simulate_basin(BasinOptions(**options, wrong_id_rate=0.3, wrong_id_share=1.0)).detections
        pairs = zip(tracks_of(plain), tracks_of(mixed), strict=True)
        wrong += [a.most_probable()[0][0] != b.most_probable()[0][0] for a, b in pairs]
    assert np.mean(wrong) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / len(wrong)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"id_delay_s": 5.0}, "id_delay_s = 5 is the age of a track; set tracks = true"),
        ({"wrong_id_share": 0.3}, r"wrong_id_share = 0\.3 is a share of a track; set tracks = true"),
    ],
)
def test_options_of_tracks_without_tracks_are_refused(options: dict[str, float], message: str):
    with pytest.raises(SimulationError, match=message):
        simulate_basin(BasinOptions(**options))
