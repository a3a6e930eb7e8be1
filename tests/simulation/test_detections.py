"""Detections come from landmarks inside the fan, at the stated rates, with the stated noise."""

import gtsam
import numpy as np
import pytest
from scipy import stats

from sonar_graph.calibration import Mounting, SonarCalibration
from sonar_graph.errors import SimulationError
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.simulation import detections as simulated
from sonar_graph.simulation.sensors import regular_stamps, seconds_since_start
from sonar_graph.simulation.vehicle import VehiclePath, smooth_noise

SONAR = SonarCalibration(
    mounting=Mounting(translation_m=(0.4, 0.1, -0.05), rpy_rad=(0.02, 0.5, -0.1)),
    range_sigma_m=0.015,
    azimuth_sigma_rad=0.007,
)
FAN = simulated.FieldOfView(1.0, 6.0, 0.6, 0.3)
WORLD = simulated.World(
    np.array([3, 7, 8]),
    np.array([[3.0, 0.5, -2.0], [4.0, -1.0, -2.1], [2.5, 0.0, -1.5]]),
    -2.0,
)
STAMPS = regular_stamps(10.0, 600.0, 0.013)
KNOTS_S = np.linspace(0, 600, 1201)
SWAY = np.array([0.8, 0.8, 0.2, 0.1, 0.1, 0.5])
PATH = VehiclePath.through(
    KNOTS_S, smooth_noise(KNOTS_S, SWAY, 6.0, 6, np.random.default_rng(11))
)


def detect(
    sonar: SonarCalibration = SONAR, world: simulated.World = WORLD, **rates: float
) -> LandmarkDetections:
    recogniser = simulated.SimulatedRecogniser(**rates)
    return simulated.simulate_detections(
        PATH, STAMPS, sonar, FAN, recogniser, world, np.random.default_rng(12)
    )


def in_view() -> np.ndarray:
    """Which landmark each frame's fan holds, shape (n, m), by another library."""
    motion = PATH.at(seconds_since_start(STAMPS))
    bodies = zip(motion.world_R_body.as_matrix(), motion.position, strict=True)
    sonars = [gtsam.Pose3(gtsam.Rot3(R), t) * SONAR.mounting.pose() for R, t in bodies]
    seen = [pose.transformTo(WORLD.landmark_positions.T) for pose in sonars]
    x, y, z = np.moveaxis(seen, 1, 0)
    level = np.hypot(x, y)
    distance = np.hypot(level, z)
    return (
        (distance >= 1.0)
        & (distance <= 6.0)
        & (np.abs(np.arctan2(y, x)) <= 0.6)
        & (np.abs(np.arctan2(z, level)) <= 0.3)
    )


def assert_binomial(successes: int, trials: int, probability: float) -> None:
    low, high = stats.binom.interval(0.9999, trials, probability)
    assert low <= successes <= high


def test_a_perfect_recogniser_reports_exactly_what_is_in_view():
    """Confidently, with room for none; where nothing is in view there is no block."""
    found = detect()
    rows, columns = np.nonzero(in_view())
    reported = found.stamps_ns, found.most_probable()[0]
    expected = STAMPS[rows], WORLD.landmark_ids[columns]
    assert set(zip(*reported, strict=True)) == set(zip(*expected, strict=True))
    assert 0.1 < len(rows) / (3 * len(STAMPS)) < 0.9
    assert_binomial(len(detect(detection_probability=0.7)), len(rows), 0.7)
    probability = np.sort(found.id_probability, axis=1)
    assert probability == pytest.approx(np.tile([0.01, 0.01, 0.97], (len(found), 1)))
    far = simulated.World(np.array([1]), np.array([[500.0, 0.0, 0.0]]), 0.0)
    assert detect(world=far) is None


def test_range_and_azimuth_carry_the_noise_of_their_covariance():
    exact = {"range_sigma_m": 1e-12, "azimuth_sigma_rad": 1e-12}
    noisy = detect()
    views, true = (
        np.column_stack([found.range_m, found.azimuth_rad])
        for found in (noisy, detect(SONAR.model_copy(update=exact)))
    )
    sigmas = np.sqrt(np.diagonal(noisy.range_azimuth_cov, axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas, np.tile([0.015, 0.007], (len(noisy), 1)))
    error = (views - true) / sigmas
    low, high = stats.chi2.interval(0.9999, len(error))
    squares = np.sum(error**2, axis=0)
    assert np.all((low < squares) & (squares < high))
    assert np.all(np.abs(error.mean(axis=0)) < 4 / np.sqrt(len(error)))


def test_identities_are_mistaken_at_the_stated_rate():
    true_ids = detect().most_probable()[0]
    ids = detect(wrong_id_rate=0.2).most_probable()[0]
    mistaken = true_ids != ids
    assert_binomial(mistaken.sum(), len(ids), 0.2)
    of_first = ids[mistaken & (true_ids == 3)]
    assert_binomial((of_first == 7).sum(), len(of_first), 0.5)
    one = simulated.World(WORLD.landmark_ids[:1], WORLD.landmark_positions[:1], -2.0)
    lone = detect(world=one, wrong_id_rate=1.0)
    assert np.all(lone.most_probable()[0] == 3)


def test_false_detections_come_at_the_stated_rate_all_over_the_fan():
    false = {"detection_probability": 0, "false_detections_per_frame": 0.5}
    found = detect(**false)
    low, high = stats.poisson.interval(0.9999, 0.5 * len(STAMPS))
    assert low < len(found) < high
    assert stats.kstest(found.range_m, stats.uniform(1.0, 5.0).cdf).pvalue > 1e-4
    assert stats.kstest(found.azimuth_rad, stats.uniform(-0.6, 1.2).cdf).pvalue > 1e-4
    np.testing.assert_allclose(found.id_probability.sum(axis=1), 0.2)
    confused = detect(**false, confident_false_fraction=0.3)
    is_sure = confused.most_probable()[1] > 0.9
    assert_binomial(is_sure.sum(), len(confused), 0.3)


def test_a_share_of_all_detections_names_nothing():
    """The others, and where all of them are, stay as they were."""
    named, some = (
        detect(false_detections_per_frame=0.5, anonymous_share=share)
        for share in (0.0, 0.3)
    )
    is_anonymous = (some.candidate_ids < 0).all(axis=1)
    assert_binomial(is_anonymous.sum(), len(some), 0.3)
    assert np.all(some.id_probability[is_anonymous] == 0)
    places = ("range_m", "azimuth_rad")
    for name in (*places, "id_probability", "candidate_ids"):
        rows = ... if name in places else ~is_anonymous
        assert np.array_equal(getattr(some, name)[rows], getattr(named, name)[rows])
    assert (detect(anonymous_share=1.0).candidate_ids < 0).all()


NS = 1_000_000_000


def basin(**options) -> list[LandmarkDetections]:
    """Detections of each track."""
    common = {"duration_s": 260.0, "laps": 2, "seed": 5}
    found = simulate_basin(BasinOptions(**common | options)).detections
    return [found.rows(found.track == one) for one in range(found.track.max() + 1)]


def test_an_identity_comes_when_its_track_is_old_enough():
    for track in basin(tracks=True, id_delay_s=4.0):
        is_sure = track.id_probability.max(axis=1) > 0.9
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        np.testing.assert_array_equal(is_sure, age_s >= 4.0)
        assert track.id_probability[~is_sure] == pytest.approx(0.2)


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_wrong_identity_is_one_other_landmark_s_for_its_share(share):
    wrong = {"id_delay_s": 2.0, "wrong_id_rate": 1.0, "wrong_id_share": share}
    for right, track in zip(
        basin(tracks=True), basin(tracks=True, **wrong), strict=True
    ):
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        ids, probability = track.most_probable()
        is_wrong = (ids != right.most_probable()[0][-1]) & (probability > 0.9)
        until_s = 2.0 + share * (age_s[-1] - 2.0)
        expected = (age_s >= 2.0) & ((age_s < until_s) | (share == 1))
        np.testing.assert_array_equal(is_wrong, expected)
        assert len(set(ids[is_wrong].tolist())) <= 1


def test_a_track_is_of_one_landmark_and_has_no_gap():
    drawn = np.random.default_rng(5)
    landmark = drawn.integers(0, 3, 60)
    stamps_ns = np.cumsum(drawn.integers(1, 800_000_000, 60))
    watched = simulated.Watched.of(landmark, stamps_ns)
    np.testing.assert_array_equal(watched.landmark[watched.track], landmark)
    for index in range(3):
        rows = np.flatnonzero(landmark == index)
        is_far = np.diff(stamps_ns[rows]) > NS
        assert 5 < is_far.sum() < len(is_far) - 5
        np.testing.assert_array_equal(np.diff(watched.track[rows]) != 0, is_far)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"id_delay_s": 5.0}, "id_delay_s = 5 is the age of a track; set tracks"),
        ({"wrong_id_share": 0.3}, r"wrong_id_share = 0\.3 is a share of a track; set"),
    ],
)
def test_options_of_tracks_without_tracks_are_refused(options, message):
    with pytest.raises(SimulationError, match=message):
        basin(**options)
