"""Detections come from landmarks inside the fan, at the stated rates, with the stated noise."""

import gtsam
import numpy as np
import pytest
from scipy import stats

from sonar_graph.calibration import Mounting, SonarCalibration
from sonar_graph.errors import SimulationError
from sonar_graph.measurements import Floats, LandmarkDetections
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


def seen_points(frames: int | None = None) -> Floats:
    """By another library: the landmarks in the sonar's frame at every instant, shape (n, m, 3)."""
    motion = PATH.at(seconds_since_start(STAMPS[:frames]))
    body_T_sonar = SONAR.mounting.pose()
    bodies = zip(motion.world_R_body.as_matrix(), motion.position, strict=True)
    poses = [
        gtsam.Pose3(gtsam.Rot3(rotation), position) * body_T_sonar
        for rotation, position in bodies
    ]
    return np.array([pose.transformTo(WORLD.landmark_positions.T).T for pose in poses])


def in_view() -> np.ndarray:
    """Which landmark each frame's fan holds, shape (n, m)."""
    x, y, z = np.moveaxis(seen_points(), -1, 0)
    level = np.hypot(x, y)
    distance = np.hypot(level, z)
    azimuth = np.arctan2(y, x)
    elevation = np.arctan2(z, level)
    return (
        (distance >= 1.0)
        & (distance <= 6.0)
        & (np.abs(azimuth) <= 0.6)
        & (np.abs(elevation) <= 0.3)
    )


def assert_binomial(successes: int, trials: int, probability: float) -> None:
    low, high = stats.binom.interval(0.9999, trials, probability)
    assert low <= successes <= high


def test_a_perfect_recogniser_reports_exactly_what_is_in_view():
    """Confidently, with room for none; where nothing is in view there is no block."""
    found = detect()
    rows, columns = np.nonzero(in_view())
    reported = zip(
        found.stamps_ns.tolist(), found.most_probable()[0].tolist(), strict=True
    )
    assert set(reported) == set(
        zip(STAMPS[rows].tolist(), WORLD.landmark_ids[columns].tolist(), strict=True)
    )
    assert 0.1 < len(rows) / (3 * len(STAMPS)) < 0.9
    assert_binomial(len(detect(detection_probability=0.7)), len(rows), 0.7)
    np.testing.assert_allclose(
        np.sort(found.id_probability, axis=1),
        np.tile([0.01, 0.01, 0.97], (len(found), 1)),
    )
    assert (
        detect(world=simulated.World(np.array([1]), np.array([[500.0, 0.0, 0.0]]), 0.0))
        is None
    )


def test_range_and_azimuth_carry_the_noise_of_their_covariance():
    noisy = detect()
    quiet = detect(
        SONAR.model_copy(update={"range_sigma_m": 1e-12, "azimuth_sigma_rad": 1e-12})
    )
    sigmas = np.sqrt(np.diagonal(noisy.range_azimuth_cov, axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas, np.tile([0.015, 0.007], (len(noisy), 1)))
    error = (
        np.column_stack(
            [noisy.range_m - quiet.range_m, noisy.azimuth_rad - quiet.azimuth_rad]
        )
        / sigmas
    )
    low, high = stats.chi2.interval(0.9999, len(error))
    assert np.all((low < np.sum(error**2, axis=0)) & (np.sum(error**2, axis=0) < high))
    assert np.all(np.abs(error.mean(axis=0)) < 4 / np.sqrt(len(error)))


def test_identities_are_mistaken_at_the_stated_rate():
    true_ids = detect().most_probable()[0]
    ids = detect(wrong_id_rate=0.2).most_probable()[0]
    mistaken = true_ids != ids
    assert_binomial(int(mistaken.sum()), len(ids), 0.2)
    of_first = ids[mistaken & (true_ids == 3)]
    assert_binomial(int((of_first == 7).sum()), len(of_first), 0.5)
    lone = detect(
        world=simulated.World(
            WORLD.landmark_ids[:1], WORLD.landmark_positions[:1], -2.0
        ),
        wrong_id_rate=1.0,
    )
    assert np.all(lone.most_probable()[0] == 3)


def test_false_detections_come_at_the_stated_rate_all_over_the_fan():
    found = detect(detection_probability=0, false_detections_per_frame=0.5)
    low, high = stats.poisson.interval(0.9999, 0.5 * len(STAMPS))
    assert low < len(found) < high
    assert stats.kstest(found.range_m, stats.uniform(1.0, 5.0).cdf).pvalue > 1e-4
    assert stats.kstest(found.azimuth_rad, stats.uniform(-0.6, 1.2).cdf).pvalue > 1e-4
    np.testing.assert_allclose(found.id_probability.sum(axis=1), 0.2)
    confused = detect(
        detection_probability=0,
        false_detections_per_frame=0.5,
        confident_false_fraction=0.3,
    )
    assert_binomial(int((confused.most_probable()[1] > 0.9).sum()), len(confused), 0.3)


def test_a_share_of_all_detections_names_nothing():
    """The others, and where all of them are, stay as they were."""
    named, some = (
        detect(false_detections_per_frame=0.5, anonymous_share=share)
        for share in (0.0, 0.3)
    )
    is_anonymous = (some.candidate_ids < 0).all(axis=1)
    assert_binomial(int(is_anonymous.sum()), len(some), 0.3)
    assert np.all(some.id_probability[is_anonymous] == 0)
    for name in ("id_probability", "candidate_ids"):
        assert np.array_equal(
            getattr(some, name)[~is_anonymous], getattr(named, name)[~is_anonymous]
        )
    assert np.array_equal(
        [some.range_m, some.azimuth_rad], [named.range_m, named.azimuth_rad]
    )
    assert (detect(anonymous_share=1.0).candidate_ids < 0).all()


NS = 1_000_000_000


def basin(**options) -> LandmarkDetections:
    return simulate_basin(
        BasinOptions(**{"duration_s": 260.0, "laps": 2, "seed": 5} | options)
    ).detections


def tracks_of(found: LandmarkDetections) -> list[LandmarkDetections]:
    return [
        found.rows(found.track == number) for number in range(found.track.max() + 1)
    ]


def test_an_identity_comes_when_its_track_is_old_enough():
    for track in tracks_of(basin(tracks=True, id_delay_s=4.0)):
        sure = track.id_probability.max(axis=1) > 0.9
        np.testing.assert_array_equal(
            sure, (track.stamps_ns - track.stamps_ns[0]) / NS >= 4.0
        )
        assert track.id_probability[~sure] == pytest.approx(0.2)


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_wrong_identity_is_one_other_landmark_s_for_its_share(
    share: float,
):
    right = [track.most_probable()[0][-1] for track in tracks_of(basin(tracks=True))]
    wrong = tracks_of(
        basin(tracks=True, id_delay_s=2.0, wrong_id_rate=1.0, wrong_id_share=share)
    )
    for true, track in zip(right, wrong, strict=True):
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        ids, probability = track.most_probable()
        is_wrong = (ids != true) & (probability > 0.9)
        expected = (age_s >= 2.0) & (
            (age_s < 2.0 + share * (age_s[-1] - 2.0)) | (share == 1)
        )
        np.testing.assert_array_equal(is_wrong, expected)
        assert len(set(ids[is_wrong].tolist())) <= 1


def test_a_track_is_of_one_landmark_and_has_no_gap():
    drawn = np.random.default_rng(5)
    landmark = drawn.integers(0, 3, 60)
    stamps_ns = np.cumsum(drawn.integers(1, 800_000_000, 60))
    watched = simulated.Watched.of(landmark, stamps_ns)
    for number, true in enumerate(watched.landmark.tolist()):
        rows = np.flatnonzero(watched.track == number)
        assert set(landmark[rows].tolist()) == {true}
        age_s = (stamps_ns[rows] - stamps_ns[rows[0]]) / 1e9
        np.testing.assert_allclose(watched.age_s[rows], age_s)
        assert watched.lifetime_s[number] == pytest.approx(age_s.max())
    for index in range(3):
        rows = np.flatnonzero(landmark == index)
        is_new = np.diff(watched.track[rows]) != 0
        is_far = np.diff(stamps_ns[rows]) > 1_000_000_000
        assert 5 < is_far.sum() < len(is_far) - 5
        np.testing.assert_array_equal(is_new, is_far)


def test_options_of_tracks_without_tracks_are_refused():
    for options, message in (
        (
            {"id_delay_s": 5.0},
            "id_delay_s = 5 is the age of a track; set tracks = true",
        ),
        (
            {"wrong_id_share": 0.3},
            r"wrong_id_share = 0\.3 is a share of a track; set tracks = true",
        ),
    ):
        with pytest.raises(SimulationError, match=message):
            basin(**options)
