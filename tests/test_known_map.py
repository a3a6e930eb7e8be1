"""Runs with a map of known landmarks: every estimator starts with it, and notices what moved."""

import re
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from baselines.ekf_slam import EkfSlam
from baselines.invariant_ekf import InvariantEkf
from sonar_graph.calibration import UNKNOWN_HEIGHT, Calibration, KnownMap, Start
from sonar_graph.diagnosis.truth_check import map_findings
from sonar_graph.errors import CalibrationError, LogError, SettingError
from sonar_graph.estimator import known_map_of
from sonar_graph.evaluation import compare
from sonar_graph.map_file import in_map, read_map, write_map
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.models import (
    LOCATED_AGAIN,
    KnownLandmarks,
    elevation_on_floor,
    locate,
)
from sonar_graph.navigation import Odometry, make_estimator
from sonar_graph.navigation.map_check import map_fit
from sonar_graph.navigation.map_start import (
    BodyInFrame,
    FoundStart,
    IdentityWeights,
    MapLocator,
    MapSighting,
    Ray,
    agreement,
    located,
    map_data,
    moved_landmarks,
    refined,
    sightings_covariance,
    spread,
    turn,
)
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.given_map import given_map_table, located_line
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.slam import Isam2

SIGMA_M = 0.05


@pytest.fixture(scope="module", params=[EkfSlam, InvariantEkf, Isam2])
def kind(request) -> type:
    return request.param


@pytest.fixture(scope="module")
def dive() -> Sequence:
    return simulate_mission(MissionOptions(duration_s=90.0, landmarks=12, seed=4))


@pytest.fixture(scope="module")
def sparse(dive) -> Sequence:
    """The dive with every fourth frame: a check of the map fits it many times."""
    _, frame = np.unique(dive.detections.stamps_ns, return_inverse=True)
    return replace(dive, detections=dive.detections.rows(frame % 4 == 0))


@pytest.fixture(scope="module")
def known(dive) -> KnownMap:
    return surveyed(dive)


@pytest.fixture(scope="module")
def right(dive, known, kind):
    """The estimator after the dive in the right map, and its estimates."""
    return run(kind, with_map(dive, known))


def surveyed(dive: Sequence, seed: int = 0, **changes: object) -> KnownMap:
    """The true landmarks with errors of a survey."""
    truth = dive.true_landmarks
    errors = SIGMA_M * np.random.default_rng(seed).standard_normal((len(truth), 3))
    return KnownMap.of(truth.ids, truth.positions + errors, sigma_m=SIGMA_M, **changes)


def displaced(known: KnownMap, ids: list[int], shift_m) -> KnownMap:
    """The map with some landmarks elsewhere; ``shift_m`` has the shape (3,) or (n, 3)."""
    places = np.array(known.positions_m)
    places[[known.ids.index(i) for i in ids]] += shift_m
    return KnownMap.of(known.ids, places, sigma_m=SIGMA_M)


def transformed(known: KnownMap, T: np.ndarray) -> KnownMap:
    return KnownMap.of(known.ids, known.positions_m @ T.T, sigma_m=SIGMA_M)


def renamed(known: KnownMap, ids) -> KnownMap:
    return KnownMap.of(ids, known.positions_m, sigma_m=SIGMA_M)


def with_another(known: KnownMap) -> KnownMap:
    """The map with a landmark 99 that no dive sees."""
    places = [*known.positions_m, (25.0, 0.0, -2.0)]
    return KnownMap.of([*known.ids, 99], places, sigma_m=SIGMA_M)


def erring_together(known: KnownMap, *common_m: float) -> KnownMap:
    """The map with an error that all its places share, of these sigmas along x, y and z."""
    n = len(known.ids)
    joint = known.joint() + np.kron(np.ones((n, n)), np.diag(common_m) ** 2)
    return KnownMap.of(known.ids, known.positions_m, covariance_m2=joint)


def with_calibration_of(dive: Sequence, **changes: object) -> Sequence:
    return replace(dive, calibration=dive.calibration.model_copy(update=changes))


def with_map(dive: Sequence, known: KnownMap | None, start: Start | None = None):
    return with_calibration_of(dive, map=known, start=start or dive.calibration.start)


def showing(dive: Sequence, ids: list[int]) -> Sequence:
    """The dive with the sightings of some landmarks."""
    is_shown = np.isin(dive.detections.most_probable()[0], ids)
    return replace(dive, detections=dive.detections.rows(is_shown))


def run(kind: type, dive: Sequence, rate_hz: float = 2.0):
    """The estimator after the dive, and its causal estimates by stamp."""
    estimator = make_estimator(kind, dive.calibration)
    told = {}
    for window in dive.replay(dive.instants(rate_hz)):
        told[window.end_ns] = estimator.process(window)
    return estimator, told


def errors_m(dive: Sequence, told: dict) -> np.ndarray:
    """Distances from the truth, of all estimates."""
    stamps = [stamp for stamp, estimate in told.items() if estimate is not None]
    truth = dive.true_poses.at(np.array(stamps)).positions
    found = np.array([told[stamp].world_T_body.translation() for stamp in stamps])
    return np.linalg.norm(found - truth, axis=1)


def rms_m(dive: Sequence, told: dict) -> float:
    return float(np.sqrt(np.mean(errors_m(dive, told) ** 2)))


@pytest.mark.parametrize("kind", [EkfSlam, InvariantEkf])
def test_a_filter_begins_with_places_and_covariance_of_the_map(kind):
    """Wherever the vehicle starts, and however unsure of its pose."""
    rng = np.random.default_rng(1)
    root = rng.standard_normal((9, 9))
    known = KnownMap.of(
        [7, 3, 5], rng.normal(0, 9, (3, 3)), covariance_m2=root @ root.T
    )
    start = Start(
        position_m=(3.0, -2.0, -1.0),
        rpy_rad=(0.1, -0.2, 2.0),
        position_sigma_m=(1.0, 2.0, 0.5),
        rpy_sigma_rad=(0.1, 0.1, 0.3),
    )
    calibration = Calibration(map=known, start=start)
    slam = kind(calibration, Odometry(calibration))
    positions, joint = slam.points([0, 1, 2])
    np.testing.assert_allclose(positions, known.positions_m)
    np.testing.assert_allclose(joint, known.joint(), atol=1e-9)


def test_a_map_makes_a_dive_more_accurate_and_stays_consistent(dive, kind, right):
    _, without = run(kind, with_map(dive, None))
    estimator, told = right
    assert rms_m(dive, told) < 0.6 * rms_m(dive, without)
    found = known_map_of(estimator)
    truth = dive.true_landmarks
    rows = np.searchsorted(truth.ids, found.ids)
    e = (np.array(found.positions_m) - truth.positions[rows]).ravel()
    assert 0.3 < e @ np.linalg.solve(found.joint(), e) / e.size < 2.0


def test_a_fixed_map_is_reported_as_given_and_serves_like_another(dive, kind, right):
    fixed = surveyed(dive, is_fixed=True)
    estimator, told = run(kind, with_map(dive, fixed))
    landmarks = estimator.landmarks()
    rows = np.argsort(fixed.ids)
    np.testing.assert_array_equal(
        landmarks.positions, np.array(fixed.positions_m)[rows]
    )
    np.testing.assert_allclose(
        landmarks.covariances, np.tile(SIGMA_M**2 * np.eye(3), (12, 1, 1))
    )
    assert rms_m(dive, told) == rms_m(dive, right[1])


def test_landmarks_that_moved_are_mapped_anew_and_named_as_the_unseen(
    dive, known, kind, right
):
    wrong = with_another(displaced(known, [1, 2], (1.0, 0.0, 0.0)))
    estimator, told = run(kind, with_map(dive, wrong))
    assert rms_m(dive, told) < 1.2 * rms_m(dive, right[1]) + 1e-3
    moved, unseen = estimator.withheld()
    assert moved.startswith("moved since the map was made: landmarks 1, 2:")
    assert unseen == "of the map not seen: landmark 99"
    found = estimator.landmarks()
    away = found.positions[:2] - dive.true_landmarks.positions[:2]
    assert np.linalg.norm(away, axis=1).max() < 0.3


def test_an_identity_that_two_objects_have_does_not_bend_the_pose(
    dive, known, kind, right
):
    """One of them is mapped again; the sightings of the other are refused."""
    ids = dive.detections.candidate_ids.copy()
    ids[ids == known.ids[0]] = known.ids[3]
    both = replace(dive, detections=replace(dive.detections, candidate_ids=ids))
    estimator, told = run(kind, with_map(both, known))
    assert rms_m(dive, told) < 1.3 * rms_m(dive, right[1]) + 1e-2
    assert f"landmark {known.ids[3]}:" in estimator.withheld()[0]


COMMON_M = 0.5


def variance_of_mean_x(found: KnownMap, moved: int | None = None) -> float:
    """Of the landmarks that have not moved."""
    stayed = np.array(found.ids) != moved
    mean_x = np.kron(stayed / stayed.sum(), [1.0, 0.0, 0.0])  # (3 n,)
    return mean_x @ found.joint() @ mean_x


@pytest.mark.parametrize("shift_m", [0.0, 3.0])
def test_what_landmarks_of_a_map_share_stays_also_if_one_moved(
    dive, known, kind, shift_m
):
    """Sightings tell only the pose in the map: the place of all is that of map and start, weighed."""
    start_m = 1.0
    moved = erring_together(displaced(known, [1], (shift_m, 0.0, 0.0)), *[COMMON_M] * 3)
    start = dive.calibration.start.model_copy(
        update={"position_sigma_m": (start_m, start_m, 0.05)}
    )
    estimator, _ = run(kind, with_map(dive, moved, start))
    variance = variance_of_mean_x(known_map_of(estimator), 1)
    assert variance == pytest.approx(1.0 / (COMMON_M**-2 + start_m**-2), rel=0.01)


def test_a_start_found_in_a_map_takes_nothing_off_what_all_landmarks_share(dive, known):
    """The start has the map's error in it: it tells nothing of the map, dive by dive."""
    shared = erring_together(known, *[COMMON_M] * 3)
    estimator, _ = run(EkfSlam, with_map(dive, shared, unknown_start(dive)))
    variance = variance_of_mean_x(known_map_of(estimator))
    assert variance == pytest.approx(COMMON_M**2, rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_wrong_identities_do_not_make_a_right_start_begin_again(dive, seed):
    rng = np.random.default_rng(seed)
    seen = dive.detections
    is_wrong = rng.random(len(seen)) < 0.15
    known = surveyed(dive, seed)
    names = rng.choice(known.ids, len(is_wrong))[:, None]
    ids = np.where(is_wrong[:, None], names, seen.candidate_ids)
    misnamed = replace(dive, detections=replace(seen, candidate_ids=ids))
    locator = locator_after(with_map(misnamed, known, unknown_start(dive)))
    assert locator.found is not None
    assert locator.again_s() == []


RIGHT = (0.0, 0.0)
WRONG = (1.0, -0.2)
"""Innovations of range (m) and azimuth (rad) that agree with the map, and that contradict it."""


def judged(
    sightings: list[tuple[int, tuple[float, float]]], step_s: float = 10.0
) -> KnownLandmarks:
    """A map of five landmarks after sightings, one each step."""
    known = KnownLandmarks(KnownMap.of(range(5), np.zeros((5, 3)), sigma_m=0.1))
    S = np.diag([0.1, 0.02]) ** 2
    for k, (landmark_id, innovation) in enumerate(sightings):
        known.judge(landmark_id, round(k * step_s * 1e9), np.array(innovation), S)
    return known


AGREE = [(i, RIGHT) for i in (1, 2, 3)]
SCATTERED = [(0, e) for e in ((4.0, 0.3), (-2.0, 0.1), (1.0, -0.5), (6.0, 0.0))]
JUDGED = {
    "two contradictions": ([(0, WRONG)] * 2, []),
    "three contradictions": ([(0, WRONG)] * 3, [0]),
    "as many agree": ([(0, RIGHT)] * 3 + [(0, WRONG)] * 3, []),
    "two landmarks": ([(0, WRONG)] * 3 + [(4, WRONG)] * 3, [0, 4]),
    "wrong identities here and there": (SCATTERED, []),
    # innovations change a little from one sighting to the next
    "a slow vehicle": (SCATTERED + [(0, (1.0 + 0.2 * k, -0.2)) for k in range(4)], [0]),
    # the difference of two innovations has twice the covariance of one
    "alike": ([(0, (range_m, 0.0)) for range_m in (1.0, 1.45, 1.0)], [0]),
    "unlike": ([(0, (range_m, 0.0)) for range_m in (1.0, 1.6, 1.0)], []),
}


@pytest.mark.parametrize(("sightings", "moved"), JUDGED.values(), ids=JUDGED)
def test_a_landmark_moved_if_most_sightings_contradict_it_alike(sightings, moved):
    assert judged(AGREE + sightings).moved == moved


def test_a_landmark_that_only_contradicts_the_map_does_not_vouch_for_it():
    """One landmark agrees, as one that has moved and was seen first does: it outvotes nobody."""
    known = judged([(1, RIGHT)] * 9 + [(2, WRONG)] * 2 + [(0, WRONG)] * 3)
    assert known.moved == []
    assert any("too few others agree" in message for message in known.messages())


def test_contradictions_within_seconds_that_show_no_place_are_refused_and_named():
    """A fast vehicle passes, or wrong identities follow each other: nothing is mapped where none of them stands."""
    known = judged(AGREE + SCATTERED, step_s=1.0)
    assert known.moved == []
    assert 0 in known.held
    line, _ = known.messages()
    assert "moved since the map was made: landmark 0: sightings are refused" in line


def ahead(dive: Sequence, ranges_m, angles_rad, z_m: float) -> np.ndarray:
    """Places seen from the start at these distances and angles, shape (n, 3)."""
    level = np.array(ranges_m) * [np.cos(angles_rad), np.sin(angles_rad)]
    points = np.vstack([level, np.full(len(ranges_m), z_m)])
    return dive.calibration.start.pose().transformFrom(points).T


def in_view(dive: Sequence, places: np.ndarray) -> Sequence:
    """The first seconds of the dive, with every landmark in each frame."""
    stamps_ns = dive.start_ns + np.arange(1, 17) * 500_000_000
    poses = dive.true_poses.at(stamps_ns)
    body_T_sonar = dive.calibration.sonar.mounting.pose()
    in_sonar = []
    for R, t in zip(poses.rotations().as_matrix(), poses.positions, strict=True):
        world_T_sonar = gtsam.Pose3(gtsam.Rot3(R), t).compose(body_T_sonar)
        in_sonar += [world_T_sonar.transformTo(place) for place in places]
    x, y, _ = np.transpose(in_sonar)
    n = len(x)
    detections = LandmarkDetections(
        stamps_ns=np.repeat(stamps_ns, len(places)),
        candidate_ids=np.tile(np.arange(len(places)), len(stamps_ns))[:, None],
        id_probability=np.ones((n, 1)),
        range_m=np.linalg.norm(in_sonar, axis=1),
        azimuth_rad=np.arctan2(y, x),
        range_azimuth_cov=np.full((n, 2, 2), np.nan),
    )
    return replace(dive, detections=detections, true_landmarks=None)


def with_sonar(dive: Sequence, aperture_rad: float, **mounting: object) -> Sequence:
    sonar = dive.calibration.sonar
    changes = {
        "elevation_aperture_rad": aperture_rad,
        "mounting": sonar.mounting.model_copy(update=mounting),
    }
    return with_calibration_of(dive, sonar=sonar.model_copy(update=changes))


LOOKING_DOWN = {"rpy_rad": (0.0, 0.7, 0.0)}


def test_two_landmarks_that_moved_are_released_in_one_frame(dive):
    """Once a sixth that agrees outvotes them both."""
    angles_rad = [-0.3, 0.0, 0.4, 0.2, -0.15, 0.1]
    places = ahead(dive, [4.0, 5.0, 4.0, 6.0, 6.0, 7.0], angles_rad, -1.0)
    right = KnownMap.of(range(6), places, sigma_m=SIGMA_M)
    known = displaced(right, [0, 2], [(1.0, 0.5, 0.0), (-0.8, 0.7, 0.0)])
    estimator, _ = run(Isam2, with_map(in_view(dive, places), known))
    (message,) = estimator.withheld()
    assert message.startswith("moved since the map was made: landmarks 0, 2:")


def unknown_start(dive: Sequence, off_m: float = 0.0) -> Start:
    """A start far from the true one in place and heading, and so much too high."""
    start = dive.calibration.start
    roll, pitch, yaw = start.rpy_rad
    changes = {
        "position_m": (300.0, -80.0, start.position_m[2] + off_m),
        "rpy_rad": (roll, pitch, yaw + 2.5),
        "source": "map",
    }
    return start.model_copy(update=changes)


@pytest.fixture(scope="module")
def lost(dive, known) -> Sequence:
    """The dive in the right map, from an unknown start."""
    return with_map(dive, known, unknown_start(dive))


def test_an_unknown_start_is_found_in_the_map(lost, kind):
    _, told = run(kind, lost)
    estimates = list(told.values())
    located = next(k for k, estimate in enumerate(estimates) if estimate is not None)
    assert 0 < located < 40
    assert all(estimate is not None for estimate in estimates[located:])
    assert rms_m(lost, told) < 0.1
    assert errors_m(lost, told).max() < 0.5


def test_a_start_that_is_found_does_not_depend_on_how_the_log_is_cut(lost):
    _, seldom = run(EkfSlam, lost, rate_hz=1.0)
    _, often = run(EkfSlam, lost, rate_hz=4.0)
    common = [s for s in seldom if seldom[s] is not None and often.get(s) is not None]
    assert len(common) > 50
    for stamp in common:
        one = seldom[stamp]
        other = often[stamp]
        np.testing.assert_array_equal(
            one.world_T_body.matrix(), other.world_T_body.matrix()
        )
        np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize(
    ("aperture_rad", "named"), [(0.4, ["map: heights"]), (2.0, [])]
)
def test_landmarks_below_the_aperture_do_not_bend_a_found_start_and_are_named(
    dive, aperture_rad, named
):
    """A sonar shows what is near beyond its aperture; 4 m away and 2.5 m below, elevation shortens the way by 0.9 m.

    Its tilt, its aperture or the heights may be wrong.
    """
    places = ahead(dive, [3.5, 5.0, 4.0], [-0.5, 0.1, 0.6], -2.5)
    seen = with_sonar(in_view(dive, places), aperture_rad)
    known = KnownMap.of(range(3), places, sigma_m=SIGMA_M)
    below = with_map(seen, known, unknown_start(dive))
    locator = locator_after(below)
    assert locator.found is not None
    _, x, y = locator.found.parameters
    np.testing.assert_allclose([x, y], dive.calibration.start.position_m[:2], atol=0.1)
    assert not named or all(sighting.rise_m for sighting in locator.sightings)
    acting = [f for f in map_findings(below) if f.acts]
    assert [f.quantity for f in acting] == named
    assert all("`elevation_aperture_rad` under [sonar]" in f.line for f in acting)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilted_start_moves_all_places_as_their_columns_say(dive, axis):
    """Roll and pitch of the start turn what a sonar that looks down has seen; numerically."""
    places = ahead(dive, [3.2, 3.6], [-0.3, 0.6], -3.0)
    # heights by odometry alone: a depth turns with the arm of its port, some centimetres
    looking_down = replace(with_sonar(dive, 1.0, **LOOKING_DOWN), depth=None)
    seen = in_view(looking_down, places)
    known = KnownMap.of(range(2), places, sigma_m=SIGMA_M)
    sigmas_rad = (0.02, 0.03, 1.0)

    def sightings(turn_rad: float) -> list[MapSighting]:
        start = unknown_start(dive)
        rpy = np.array(start.rpy_rad)
        rpy[axis] += turn_rad
        turned = {"rpy_rad": tuple(rpy), "rpy_sigma_rad": sigmas_rad}
        of_turned = with_map(seen, known, start.model_copy(update=turned))
        return sightings_of(MapLocator(of_turned.calibration), seen)

    step_rad = 1e-4
    for before, at, after in zip(
        sightings(-step_rad), sightings(0.0), sightings(step_rad), strict=True
    ):
        slope = (after.q - before.q) / (2.0 * step_rad)
        column = at.by_common[:, 3 + axis]
        np.testing.assert_allclose(
            slope * sigmas_rad[axis], column, rtol=0.01, atol=1e-4
        )


def test_a_map_that_errs_as_a_whole_is_found_as_another():
    """Placed to 100 m: distances between its landmarks are those of a survey."""
    rng = np.random.default_rng(2)
    known = erring_together(random_map(rng, 6), 100.0, 100.0, 0.0)
    sightings = [seen_from_start(known, i) for i in range(3) for _ in range(4)]
    start = located(sightings, known)
    assert start is not None
    assert len(start.agreeing) == 3


def test_two_landmarks_at_their_usual_distance_are_no_start_in_a_large_map():
    """Numbers run along the survey, five metres apart, here as in another place."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        here = surveyed_way(rng, 200)
        there = surveyed_way(rng, 200)
        known = KnownMap.of(
            range(200), np.column_stack([here, np.full(200, -3.0)]), sigma_m=0.05
        )
        seen = there[20:22, None] - there[20] + 0.08 * rng.standard_normal((2, 4, 2))
        S = 0.08**2 * np.eye(2)
        sightings = [MapSighting(20 + i, q, S) for i in range(2) for q in seen[i]]
        assert located(sightings, known) is None


def surveyed_way(rng: np.random.Generator, count: int) -> np.ndarray:
    """Places along a way that turns a little, shape (count, 2)."""
    headings = np.cumsum(0.1 * rng.standard_normal(count))
    steps = 5.0 + 0.5 * rng.standard_normal(count)
    ways = steps[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    return np.cumsum(ways, axis=0)


def test_a_found_start_has_the_height_of_the_depths(dive, known, lost):
    """A start that is 3 m too high, to 2 m: odometry alone would carry that on."""
    start = unknown_start(dive, 3.0)
    sigmas_m = (*start.position_sigma_m[:2], 2.0)
    unsure = start.model_copy(update={"position_sigma_m": sigmas_m})
    high = with_map(dive, known, unsure)
    at_depth = locator_after(high).found.parameters
    np.testing.assert_allclose(
        at_depth, locator_after(lost).found.parameters, atol=0.05
    )
    # a pressure port 2 m below the vehicle's origin measures another height of the same vehicle
    port = dive.calibration.depth.model_copy(update={"port_m": (0.0, 0.0, -2.0)})
    lower = replace(dive.depth, z_m=dive.depth.z_m - 2.0)
    below = replace(with_calibration_of(high, depth=port), depth=lower)
    np.testing.assert_allclose(
        locator_after(below).found.parameters, at_depth, atol=0.02
    )


def locator_after(dive: Sequence) -> MapLocator:
    locator = MapLocator(dive.calibration)
    for window in dive.replay(dive.instants(2.0)):
        locator.add(window)
    return locator


def sightings_of(locator: MapLocator, dive: Sequence) -> list[MapSighting]:
    """Of the whole dive, without a look for the start."""
    for window in dive.replay(dive.instants(1.0)):
        [*locator.frames_seen(window)]
    return locator.sightings


@pytest.mark.parametrize("elevation_rad", [-0.6, 0.0, 0.3])
@pytest.mark.parametrize("roll_rad", [0.0, 0.4])
def test_a_place_is_as_uncertain_as_range_azimuth_pose_and_heights_make_it(
    elevation_rad, roll_rad
):
    """By Monte Carlo: draw all of them, and place the landmark at the height of the map again."""
    rng = np.random.default_rng(2)
    o_T_body = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll_rad, 0.1, 0.7), np.array([3, 1, -2]))
    body_T_sonar = gtsam.Pose3(gtsam.Rot3.Ry(0.2), np.array([0.3, 0.0, 0.1]))
    ray = Ray(8.0, 0.3, elevation_rad)
    floor_z = locate(o_T_body.compose(body_T_sonar), *ray)[2]
    sigmas = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03])
    height_m = 0.05
    floor_m = 0.08
    R_z = np.diag([0.03**2, 0.01**2])
    body = BodyInFrame(o_T_body, np.diag(sigmas**2), height_m**2)
    S = spread(body, body_T_sonar, ray, R_z, floor_m**2).S
    drawn = []
    for _ in range(4000):
        pose = o_T_body.compose(gtsam.Pose3.Expmap(sigmas * rng.standard_normal(6)))
        # the mean of MOST_OF_LANDMARK sightings has these errors in full
        by_heights = 2.0 * np.hypot(height_m, floor_m) * rng.standard_normal()
        o_T_sonar = pose.compose(body_T_sonar)
        z = np.array([8.0, 0.3]) + [0.03, 0.01] * rng.standard_normal(2)
        e = elevation_on_floor(o_T_sonar, *z, floor_z + by_heights, 2 * np.pi)
        drawn.append(locate(o_T_sonar, *z, e)[:2])
    found = np.cov(np.array(drawn).T)
    ratios = np.linalg.eigvals(np.linalg.solve(S, found))
    assert (np.abs(ratios - 1.0) < 0.15).all(), ratios


def test_a_height_that_nothing_tells_is_uncertain_in_a_map(dive, known, tmp_path):
    write_map(tmp_path / "map.toml", known)
    start = dive.calibration.start.model_copy(update={"source": "vehicle"})
    for note, is_told in (
        (f"start pose not stated: {UNKNOWN_HEIGHT}", False),
        ("height by the first depths", True),
    ):
        unplaced = replace(with_map(dive, None, start), notes={"log.start": note})
        found = in_map(unplaced, tmp_path / "map.toml")
        sigma_m = found.calibration.start.position_sigma_m[2]
        assert sigma_m < 0.1 if is_told else sigma_m > 1.0
        warnings = found.notes.get("log.warnings", "")
        assert ("state it as z of `position_m" in warnings) != is_told
        assert is_told != bool(warnings)


def test_a_start_in_the_map_without_a_map_is_refused_with_what_to_give(dive, kind):
    lost = with_map(dive, None, unknown_start(dive))
    for refused in (
        lambda: in_map(lost, None),
        lambda: make_estimator(kind, lost.calibration),
    ):
        with pytest.raises(CalibrationError, match="--map, or state `position_m`"):
            refused()
    assert in_map(with_map(dive, None), None).calibration.map is None


def test_the_prior_of_a_found_start_is_as_uncertain_as_it_was_found():
    """Heading and place each by their own sigma, three times as large."""
    locator = MapLocator(Calibration(map=random_map(np.random.default_rng(1), 3)))
    P = np.diag([0.05, 0.3, 0.4]) ** 2
    locator.found = FoundStart(
        np.array([0.7, 4.0, 5.0]), P, 0.0 * P, 0.0, frozenset({0, 1})
    )
    start = locator.start()
    assert start.rpy_rad[2] == pytest.approx(0.7)
    assert start.position_m[:2] == pytest.approx((4.0, 5.0))
    assert start.rpy_sigma_rad[2] == pytest.approx(0.15)
    assert start.position_sigma_m[:2] == pytest.approx((1.2, 1.2))


FROM_THE_START = np.array([40.0, 60.0])
"""Place of the start in a map, m."""
SEEN_M2 = np.diag([0.1**2, 0.1**2])


def random_map(rng: np.random.Generator, count: int) -> KnownMap:
    places = np.column_stack([rng.uniform(0, 100, (count, 2)), np.full(count, -4.0)])
    return KnownMap.of(range(count), places, sigma_m=0.05)


def seen_from_start(known: KnownMap, row: int, shift_m: float = 0.0) -> MapSighting:
    """A landmark where the map has it, or to the east of it."""
    place = np.array(known.positions_m[row][:2])
    return MapSighting(row, place - FROM_THE_START + [shift_m, 0.0], SEEN_M2)


@pytest.mark.parametrize(("others", "is_found"), [(1, True), (7, False)])
def test_three_landmarks_that_agree_are_no_start_where_most_do_not(others, is_found):
    """Seven wrong identities of ten mean a map of another place, one of four does not."""
    rng = np.random.default_rng(1)
    known = random_map(rng, 10)
    right = [seen_from_start(known, i) for i in range(3)]
    wrong = [
        MapSighting(3 + i, rng.uniform(-50, 50, 2), SEEN_M2) for i in range(others)
    ]
    found = located(right + wrong, known)
    assert (found is not None) == is_found
    if found is not None:
        np.testing.assert_allclose(found.parameters, [0.0, *FROM_THE_START], atol=0.5)


def test_the_evidence_of_a_start_is_the_integral_over_all_starts():
    """(2), by importance sampling: a uniform prior over headings and the area, one wrong identity anywhere in it."""
    rng = np.random.default_rng(2)
    known = random_map(rng, 5)
    right = [seen_from_start(known, i, 0.03 * (-1) ** i) for i in range(4)]
    wrong = MapSighting(4, np.array([40.0, -30.0]), SEEN_M2)
    data = map_data([*right, wrong], known)
    found = refined(np.array([0.0, *FROM_THE_START]), data)
    assert found.agreeing == {0, 1, 2, 3}
    about = multivariate_normal(found.parameters, 2.0 * found.covariance, seed=rng)
    drawn = about.rvs(20_000)  # (n, 3)
    log_density = -about.logpdf(drawn)
    for k, (psi, *t) in enumerate(drawn):
        R = Rotation.from_euler("z", psi).as_matrix()[:2, :2]
        W = R @ SEEN_M2 @ R.T + 0.05**2 * np.eye(2)
        e = [known.positions_m[s.row][:2] - R @ s.q - t for s in right]
        log_density[k] += multivariate_normal.logpdf(e, np.zeros(2), W).sum()
    expected = logsumexp(log_density) - np.log(len(drawn))
    expected -= np.log(2.0 * np.pi * data.area_m2)
    expected += data.weights.right[:4].sum()
    expected += data.weights.wrong[4] - np.log(data.near_m2)
    assert found.log_evidence == pytest.approx(expected, abs=0.05)


def test_a_third_landmark_far_from_two_others_agrees_with_their_start():
    """Two landmarks 1 m apart leave the heading to 0.1 rad, by which a third one 40 m away is metres off."""
    places = np.array([[0.0, 0.0, -4.0], [1.0, 0.0, -4.0], [40.0, 5.0, -4.0]])
    known = KnownMap.of(range(3), places, sigma_m=0.05)
    S = np.diag([0.02**2, 0.05**2])
    errors = np.array([[0.0, 0.1], [0.0, -0.05], [0.0, 0.0]])
    sightings = [MapSighting(i, places[i, :2] + errors[i], S) for i in range(3)]
    found = located(sightings, known)
    assert found is not None
    assert found.agreeing == {0, 1, 2}
    np.testing.assert_allclose(found.parameters[0], 0.0, atol=0.01)


@pytest.mark.parametrize(("error", "agrees"), [((0.0, 3.0), True), ((3.0, 0.0), False)])
def test_the_covariance_of_a_sighting_turns_with_the_heading(error, agrees):
    """One that is sure of its y in the level frame is sure of its x in a world turned by a right angle."""
    known = KnownMap.of([0], [(10.0, 5.0, -4.0)], sigma_m=0.05)
    start = np.array([0.5 * np.pi, 2.0, 1.0])
    q = turn(-start[0]) @ (np.array([10.0, 5.0]) - start[1:] - error)
    data = map_data([MapSighting(0, q, np.diag([1.0, 0.1]) ** 2)], known)
    _, found = agreement(start, np.zeros((3, 3)), np.array([False]), data)
    assert found.tolist() == [agrees]


@pytest.mark.parametrize("has_depth", [True, False])
def test_sightings_err_together_as_their_joint_covariance_says(has_depth: bool):
    """By the true poses: squares over it average to 1, over that of each alone they do not."""
    joint = []
    apart = []
    for seed in range(12):
        world = simulate_mission(
            MissionOptions(duration_s=90.0, landmarks=12, seed=seed)
        )
        noise = np.random.default_rng(seed).standard_normal((len(world.dvl), 3))
        rough = np.tile(0.2**2 * np.eye(3), (len(noise), 1, 1))
        velocity = world.dvl.velocity + 0.2 * noise
        dvl = replace(world.dvl, velocity=velocity, velocity_cov=rough)
        world = replace(world, dvl=dvl)
        truth = world.true_landmarks
        exact = KnownMap.of(truth.ids, truth.positions, sigma_m=1e-6)
        world = with_map(world, exact, replace_start(world))
        world = replace(world, depth=world.depth if has_depth else None)
        sightings = sightings_of(MapLocator(world.calibration), world)
        sightings = sightings[:: max(1, len(sightings) // 20)]
        pose = world.true_poses.at(np.array([world.start_ns]))
        yaw = pose.rotations().as_euler("ZYX")[0, 0]
        q = np.array(exact.positions_m)[[s.row for s in sightings]]
        level = (q - pose.positions[0])[:, :2] @ turn(yaw)
        e = (level - [s.q for s in sightings]).ravel()
        Q = sightings_covariance(sightings)
        alone = [s.q for s in sightings] - level
        joint.append(e @ np.linalg.solve(Q, e) / e.size)
        S = np.array([s.S for s in sightings])
        squared = np.einsum("ki,kij,kj->k", alone, np.linalg.inv(S), alone)
        apart.append(squared.mean() / 2.0)
    assert 0.6 < np.mean(joint) < 1.4, joint
    # each alone has the error of odometry as often as it was seen
    assert np.std(apart) > 1.5 * np.std(joint)


def test_gaps_of_the_doppler_log_leave_a_joint_covariance_and_the_start(dive, known):
    """A gap is bridged anew at its end, so that errors of odometry are smaller after it than within."""
    t = (dive.dvl.stamps_ns - dive.start_ns) * 1e-9
    is_measured = ~((t > 3.0) & (t < 9.0)) & ~((t > 20.0) & (t < 34.0))
    gaps = replace(dive, dvl=dive.dvl.rows(np.flatnonzero(is_measured)))
    locator = locator_after(with_map(gaps, known, replace_start(dive)))
    sightings = locator.newest()
    C = [s.C_odometry for s in locator.sightings]
    steps = [np.linalg.eigvalsh(b - a)[0] for a, b in pairwise(C)]
    # otherwise there is nothing to show
    assert min(steps) < -1e-4
    assert np.linalg.eigvalsh(sightings_covariance(sightings))[0] > 0.0
    assert locator.found is not None
    x, y, _ = replace_start(dive).position_m
    np.testing.assert_allclose(locator.found.parameters[1:], [x, y], atol=0.5)


def replace_start(world: Sequence) -> Start:
    """The true height and tilt."""
    pose = world.true_poses.at(np.array([world.start_ns]))
    yaw, pitch, roll = pose.rotations().as_euler("ZYX")[0].tolist()
    changes = {
        "position_m": tuple(pose.positions[0].tolist()),
        "rpy_rad": (roll, pitch, yaw),
        "source": "map",
    }
    return world.calibration.start.model_copy(update=changes)


STEP_M = 0.6


def groups_in_a_row(known: KnownMap, rng: np.random.Generator) -> list[MapSighting]:
    """Each landmark as seen once, from group to group; odometry errs between groups by `STEP_M`, and within by nothing."""
    by_place = np.hstack([np.zeros((2, 3)), np.eye(2, 3)])
    C = np.zeros((6, 6))
    drift_m = np.zeros(2)
    sightings = []
    for row, place in enumerate(known.positions_m):
        if row % 3 == 0:
            C = C + np.diag([0, 0, 0, STEP_M**2, STEP_M**2, 0])
            drift_m = drift_m + STEP_M * rng.standard_normal(2)
        q = np.array(place[:2]) + drift_m + 0.02 * rng.standard_normal(2)
        S = C[3:5, 3:5] + 0.02**2 * np.eye(2)
        sightings.append(MapSighting(row, q, S, 0.0, by_place, C))
    return sightings


def test_a_mirror_image_fits_groups_in_a_row_only_as_if_they_erred_apart():
    """Each group has a shape that no drift of odometry mirrors."""
    rng = np.random.default_rng(4)
    in_row = np.array([[10.0 * k, 0.1 * k] for k in range(4)])
    groups = [place + rng.uniform(-0.4, 0.4, (3, 2)) for place in in_row]
    places = np.concatenate(groups)
    known = KnownMap.of(
        range(12), np.column_stack([places, -4 * np.ones(12)]), sigma_m=0.01
    )
    mirrored = KnownMap.of(
        known.ids, known.positions_m * np.array([1, -1, 1]), sigma_m=0.01
    )
    sightings = groups_in_a_row(known, rng)
    apart = [s._replace(C_odometry=np.zeros((6, 6))) for s in sightings]
    assert located(sightings, known) is not None
    assert located(sightings, mirrored) is None
    # the negative control: without what they share it would be claimed
    assert located(apart, mirrored) is not None


@pytest.mark.parametrize("common_m", [0.02, 0.5])
def test_a_landmark_that_moved_less_than_the_map_errs_as_a_whole_is_left_out(common_m):
    """By the others: what all places of a map share moves the start, and hides no single one."""
    rng = np.random.default_rng(5)
    places = np.column_stack([rng.uniform(0, 30, (6, 2)), np.full(6, -4.0)])
    sure = KnownMap.of(range(6), places, sigma_m=0.03)
    known = erring_together(sure, *[common_m] * 3)
    S = 0.03**2 * np.eye(2)
    seen = [
        MapSighting(k, places[k, :2] + [0.8 * (k == 2), 0.0], S) for k in range(6)
    ] * 3
    found = located(seen, known)
    assert found is not None
    assert found.agreeing == {0, 1, 3, 4, 5}
    assert moved_landmarks(found, map_data(seen, known)) == [2]


def test_right_lines_of_a_map_that_errs_twice_as_stated_are_seldom_named(dive, known):
    """The misfit of the landmarks that agree counts: each of these maps has a line beyond the gate."""
    misled = 0
    for seed in (0, 4, 5):
        erring = surveyed(dive, seed)
        surer = KnownMap.of(erring.ids, erring.positions_m, sigma_m=0.5 * SIGMA_M)
        misled += bool(map_fit(with_map(dive, surer, unknown_start(dive))).elsewhere)
    assert misled <= 1
    wrong = displaced(known, known.ids[3:4], (0.4, 0.3, 0.0))
    fit = map_fit(with_map(dive, wrong, unknown_start(dive)))
    assert fit.elsewhere == known.ids[3:4]


def test_an_identity_seen_once_is_weighed_by_the_share_of_new_landmarks():
    """Two of four were seen once, the others four and three times: v = 3 / 8, of which one is the next landmark."""
    weights = IdentityWeights.of(np.array([1, 1, 4, 3]))
    b = 0.1 / (0.9 * 3 / 8)
    np.testing.assert_allclose(np.exp(weights.right), [1.0, 1.0, 0.9, 0.9])
    np.testing.assert_allclose(np.exp(weights.wrong), [b, b, 0.1, 0.1])
    np.testing.assert_allclose(np.exp(weights.elsewhere), [1.0 + b, 1.0 + b, 1.0, 1.0])
    # without another place for them, all landmarks are right or wrong
    right, wrong, elsewhere = (np.exp(column) for column in weights)
    np.testing.assert_allclose(right + wrong, elsewhere)


def first_seen(dive: Sequence, count: int) -> list[int]:
    """Identities of the landmarks that the dive sees first."""
    return list(dict.fromkeys(dive.detections.most_probable()[0].tolist()))[:count]


def test_a_moved_landmark_that_is_seen_first_does_not_bend_a_found_start(
    dive, known, kind
):
    """The estimator weighs its sightings before the start is known, and the prior is loose."""
    (first,) = first_seen(dive, 1)
    known = displaced(known, [first], (0.5, 0.5, 0.0))
    estimator, told = run(kind, with_map(dive, known, unknown_start(dive)))
    assert rms_m(dive, told) < 0.1
    assert f"moved since the map was made: landmark {first}:" in estimator.withheld()[0]


def test_a_place_that_most_landmarks_refute_is_none(dive, known, kind):
    """The four that are seen last fit somewhere; all others stand elsewhere than the map has them from there."""
    others = first_seen(dive, len(known.ids))[:-4]
    # so far in ways of their own that no two fit together
    far_m = np.random.default_rng(5).uniform(20.0, 60.0, (len(others), 2))
    wrong = displaced(known, others, np.column_stack([far_m, 0.0 * far_m[:, 0]]))
    estimator, told = run(kind, with_map(dive, wrong, unknown_start(dive)))
    assert not [stamp for stamp, estimate in told.items() if estimate is not None]
    assert "stand elsewhere" in estimator.withheld()[0]


def test_a_start_by_landmarks_that_moved_together_is_given_up(dive, known, kind):
    """Three that are seen first agree with a place 2 m off; those that are seen later do not."""
    moved = first_seen(dive, 3)
    wrong = with_map(
        dive, displaced(known, moved, (2.0, 0.0, 0.0)), unknown_start(dive)
    )
    estimator, told = run(kind, wrong)
    errors = errors_m(dive, told)
    assert max(errors) > 1.0
    assert errors[-1] < 0.2
    again, named, *_ = estimator.withheld()
    # however the log is cut into calls
    otherwise, _ = run(kind, wrong, 0.3)
    assert otherwise.withheld() == estimator.withheld()
    assert again.startswith("located again in the map after")
    listed = ", ".join(map(str, sorted(moved)))
    assert (
        f"landmarks {listed}:" in named or "..".join(listed.split(", ")[::2]) in named
    )


FEET = 1.0 / 0.3048
MISTAKEN = {
    "upside down": (np.diag([1.0, 1.0, -1.0]), "z_m has the wrong sign"),
    "feet": (FEET * np.eye(3), "it is in feet"),
    "mirrored": (np.eye(3)[[1, 0, 2]], "x_m and y_m are swapped"),
    "NED": (np.diag([1.0, 1.0, -1.0])[[1, 0, 2]], "the axes are north, east, down"),
}


@pytest.mark.parametrize(("T", "message"), MISTAKEN.values(), ids=MISTAKEN)
def test_a_map_with_other_axes_or_units_is_named_with_the_remedy(
    sparse, known, T, message
):
    mistaken = transformed(known, T)
    (finding,) = map_findings(with_map(sparse, mistaken, unknown_start(sparse)))
    assert finding.grave
    assert message in finding.text()
    x, y, z = known.positions_m[0]
    assert f"landmark 1 at ({x:.2f}, {y:.2f}, {z:.2f}) m" in finding.text()


@pytest.mark.parametrize("shown", [[1], [1, 2]])
def test_a_wrong_sign_of_z_is_named_by_one_landmark(dive, known, shown):
    """By the vertical aperture: at the other side of the surface none of them could be seen."""
    mistaken = with_map(dive, transformed(known, np.diag([1.0, 1.0, -1.0])))
    (finding,) = map_findings(showing(mistaken, shown))
    assert finding.grave
    assert "z_m has the wrong sign" in finding.text()


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        (range(1, 13), "fit the map"),
        ([1, 2], "fewer than three of its landmarks"),
    ],
)
def test_a_right_map_is_said_to_fit_if_enough_of_it_is_seen(dive, known, shown, said):
    (finding,) = map_findings(showing(with_map(dive, known), shown))
    assert not finding.acts
    assert said in finding.text()
    assert not list(map_findings(with_map(dive, None)))


def stated_rise_m(finding) -> float:
    assert "another zero than the depth" in finding.text()
    return float(re.findall(r"[+-][0-9.]+", finding.line)[0])


@pytest.mark.parametrize("rise_m", [-6.0, -4.0, 4.0])
def test_heights_from_another_zero_are_named_with_what_to_add(sparse, known, rise_m):
    mistaken = displaced(known, known.ids, (0.0, 0.0, -rise_m))
    (finding,) = map_findings(with_map(sparse, mistaken, unknown_start(sparse)))
    assert finding.acts
    assert abs(stated_rise_m(finding) - rise_m) < 0.8


@pytest.mark.parametrize("rise_m", [0.0, -0.5, 0.7])
def test_a_tilted_sonar_shows_by_how_much_all_heights_are_off(dive, rise_m):
    """They are within its aperture, but nearer landmarks stand elsewhere than the map has them."""
    angles_rad = [-0.6, 0.1, 0.6, -0.2, 0.3, 0.7, -0.7]
    places = ahead(dive, [2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0], angles_rad, -3.0)
    seen = in_view(with_sonar(dive, 1.5, **LOOKING_DOWN), places)
    known = KnownMap.of(range(7), places - [0.0, 0.0, rise_m], sigma_m=SIGMA_M)
    findings = map_findings(with_map(seen, known, unknown_start(dive)))
    found_m = [stated_rise_m(f) for f in findings if f.acts]
    assert found_m == pytest.approx([rise_m] if rise_m else [], abs=0.25)


@pytest.mark.parametrize("pair", [(1, 2), (5, 12)])
def test_two_exchanged_identities_are_named(sparse, known, pair):
    a, b = pair
    mistaken = renamed(known, [{a: b, b: a}.get(i, i) for i in known.ids])
    for start in (None, unknown_start(sparse)):
        (finding,) = map_findings(with_map(sparse, mistaken, start))
        assert finding.grave
        assert finding.line == f"exchange the ids {a} and {b} in the map"


def test_landmarks_that_moved_are_no_exchanged_identities(sparse, known):
    moved = displaced(known, [1, 2], (3.0, 0.0, 0.0))
    (finding,) = [f for f in map_findings(with_map(sparse, moved)) if f.acts]
    assert finding.quantity == "map: landmarks elsewhere"
    assert finding.cause.startswith("landmarks 1, 2: seen several times")


def test_a_survey_that_errs_more_than_it_states_is_no_set_of_moved_landmarks(sparse):
    """Errors of 10 cm beside sigmas of 2 cm: a few of twelve landmarks disagree, and moved by chance no farther."""
    truth = sparse.true_landmarks
    errors = 0.1 * np.random.default_rng(1).standard_normal((len(truth), 3))
    known = KnownMap.of(truth.ids, truth.positions + errors, sigma_m=0.02)
    (finding,) = (f for f in map_findings(with_map(sparse, known)) if f.acts)
    assert "its sigmas are too small" in finding.text()


def test_a_map_of_another_place_is_not_passed_in_silence(dive, known):
    """With a stated start nothing agrees, which puts the results in doubt; with none the reason is given."""
    other = renamed(known, np.random.default_rng(3).permutation(known.ids).tolist())
    (finding,) = map_findings(with_map(dive, other))
    assert finding.acts
    assert "the sightings give no single place in it" in finding.text()
    estimator, _ = run(EkfSlam, with_map(dive, other))
    assert any(
        "contradict the map beyond doubt" in line for line in estimator.withheld()
    )
    comparison = compare(with_map(dive, other, unknown_start(dive)), ["ekf-slam"])
    (failed,) = comparison.failed_runs
    assert failed.reason.startswith("not yet located in the map")
    assert comparison.environment["scored instants"] == "none: no run has a pose"


def test_a_stated_start_that_the_map_contradicts_is_named(dive, known):
    start = dive.calibration.start
    x, y, z = start.position_m
    moved = start.model_copy(update={"position_m": (x + 20.0, y, z)})
    _, finding = map_findings(with_map(dive, known, moved))
    assert f"not at ({x + 20.0:.2f}, {y:.2f}) m" in finding.text()
    assert 'start.source = "map"' in finding.line


def test_identities_of_another_map_are_named_before_the_run_and_by_it(dive, known):
    other = with_map(dive, renamed(known, range(21, 33)), unknown_start(dive))
    said = "none of the map's identities 21..32 was seen; seen: 1..12"
    (finding,) = map_findings(other)
    assert said in finding.text()
    estimator, _ = run(EkfSlam, other)
    (message,) = estimator.withheld()
    assert said.replace("the map's", "its") in message


def test_a_second_dive_starts_with_the_map_of_the_first(dive, tmp_path):
    estimator, _ = run(Isam2, with_map(dive, None))
    write_map(tmp_path / "map.toml", known_map_of(estimator))
    known = read_map(tmp_path / "map.toml").map
    assert known == known_map_of(estimator)
    again = simulate_mission(MissionOptions(duration_s=60.0, landmarks=12, seed=4))
    _, told = run(EkfSlam, with_map(again, known, unknown_start(again)))
    assert rms_m(again, told) < 0.15


HEAD = "id,x_m,y_m,z_m,sigma_m\n"
BAD = {
    "no columns": (
        "id,x_m\n1,2\n",
        "y_m and z_m: missing: expected the columns id, x_m, y_m, z_m and either sigma_m",
    ),
    "empty": (HEAD, "no landmark: give a line for each"),
    "a word": (HEAD + "1,a,2,3,0.1\n", "line 2: x_m: expected a number, not 'a'"),
    "a short row": (
        HEAD + "1,2.0\n",
        "line 2: y_m: expected a number, not an empty cell",
    ),
    "twice": (HEAD + "1,0,2,3,0.1\n1,0,2,3,0.1\n", "line 3: landmark 1 stands twice"),
    "an id that no graph has": (
        HEAD + f"{2**56},0,2,3,0.1\n",
        f"line 2: id: give identities below {2**56}",
    ),
    "an exact place": (
        "id,x_m,y_m,z_m,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz\n4,0,2,3,0,0,0,0,0,0\n",
        "landmark 4: expected variances above 0",
    ),
    "half an id": (HEAD + "1.5,0,2,3,0.1\n", "line 2: id: expected a whole number"),
    "no sigma": (HEAD + "1,0,2,3,0\n", "line 2: sigma_m: expected a sigma above 0 m"),
    "a negative identity": (HEAD + "-1,0,2,3,0.1\n", "whole numbers from 0 on"),
    "a huge sigma": (HEAD + "1,0,2,3,1e200\n", "line 2: sigma_m: expected a sigma"),
    "too many cells": (
        HEAD + "1,0,2,3,0.1,7\n",
        "line 2: 6 cells, the heading names 5",
    ),
    "a grouped number": (HEAD + "1_0,0,2,3,0.1\n", "line 2: id: expected a number"),
    "a column twice": (
        "id,x_m,x_m,y_m,z_m,sigma_m\n1,0,9,2,3,0.1\n",
        "two columns are called x_m",
    ),
    "one sigma of three": (
        "id,x_m,y_m,z_m,sigma_x_m,sigma_m\n1,0,2,3,0.1,0.2\n",
        "expected all of sigma_x_m, sigma_y_m, sigma_z_m, or sigma_m alone",
    ),
    "semicolons": (HEAD.replace(",", ";"), "separate them by commas"),
    "tabs": (HEAD.replace(",", "\t"), "separate them by commas, with points"),
    "a grid of a country": (
        HEAD + "1,512345,2,3,0.1\n",
        "give metres from an origin near by",
    ),
}


def test_identities_of_a_spreadsheet_are_read_behind_its_mark_unrounded(tmp_path):
    path = tmp_path / "map.csv"
    text = HEAD + "9007199254740993,0,2,3,0.1\n4.0,1,2,3,0.1\n"
    path.write_text(text, encoding="utf-8-sig")
    assert read_map(path).map.ids == (9007199254740993, 4)


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_a_bad_map_is_refused_with_file_and_remedy(tmp_path, text, message):
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=r"map\.csv") as refused:
        read_map(path)
    assert message in str(refused.value)
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("wrong", ["true", "1.0", '"1"', "-1"])
def test_an_identity_that_is_no_whole_number_is_refused(tmp_path, wrong):
    path = tmp_path / "map.toml"
    write_map(path, KnownMap.of([1, 2], np.zeros((2, 3)), sigma_m=0.1))
    path.write_text(path.read_text().replace("ids = [1, 2]", f"ids = [2, {wrong}]"))
    with pytest.raises(LogError, match=r"map\.toml: ids: .*whole numbers from 0 on"):
        read_map(path)


def test_a_folder_of_results_is_refused_with_the_map_in_it(tmp_path):
    inside = tmp_path / "runs" / "isam2"
    inside.mkdir(parents=True)
    write_map(inside / "map.toml", KnownMap.of([1], np.zeros((1, 3)), sigma_m=0.1))
    with pytest.raises(LogError, match=r"not a folder, such as .*isam2.map\.toml$"):
        read_map(tmp_path)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(2), "expected 3 rows of 3 numbers"),
        (
            np.diag([1.0, 1.0, -1.0]),
            "landmark 1: expected a covariance without negative",
        ),
        (
            np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]),
            "expected a symmetric matrix, not 0.5 in row 1, column 2",
        ),
    ],
)
def test_a_covariance_that_is_none_is_refused(covariance, message):
    with pytest.raises(SettingError, match=message):
        KnownMap.of([1], [[0.0, 0.0, 0.0]], covariance_m2=covariance)


def test_a_map_of_the_same_log_is_doubted_and_one_of_another_dive_is_not(tmp_path):
    """Both dives bear one name and begin at one stamp."""
    first, second = (
        simulate_mission(MissionOptions(duration_s=30.0, landmarks=6, seed=seed))
        for seed in (1, 2)
    )
    (result,) = compare(first, ["ekf-slam"]).runs
    write_map(tmp_path / "map.toml", result.known_map)
    again = in_map(first, tmp_path / "map.toml")
    assert "made from the same log" in again.notes["log.warnings"]
    assert "log.warnings" not in in_map(second, tmp_path / "map.toml").notes


def test_the_page_of_a_located_dive_shows_the_map(dive, known):
    """What moved comes first; estimates and truth are shown in the map's world, without alignment."""
    given = with_another(displaced(known, known.ids[2:3], (1.5, 0.5, 0.0)))
    compared = compare(
        with_map(dive, given, unknown_start(dive)), ["isam2", "ekf-slam"]
    )
    assert compared.sequence.truth is dive.truth
    table = given_map_table(compared)
    rows = [[cell.text for cell in row] for row in table.rows]
    assert rows[0][0] == "3"
    assert all(cell.endswith("moved") for cell in rows[0][3:])
    assert [row[0] for row in rows if row[3:] == ["not seen"] * 2] == ["99"]
    assert located_line(compared).startswith("Located in the map: isam2: after ")
    smoothed = compared.runs[0].smoothed
    assert len(smoothed) > len(compared.runs[0].causal)
    truth = dive.true_poses.at(smoothed.stamps_ns[:5])
    away = smoothed.positions[:5] - truth.positions
    assert np.abs(away).max() < 0.3
    page = render_report(compared)
    assert 'id="show-raw" checked' in page
    assert "map that was given" in page
    assert "Thick lines lead from the given places" in page
    assert "start heading" not in compared.sequence.notes.get("log.sensors", "")
    again = replace(
        compared.runs[0], withheld=[f"{LOCATED_AGAIN} after 9.0 s: landmarks"]
    )
    told = located_line(replace(compared, runs=[again]))
    assert told.endswith(f"{LOCATED_AGAIN} after 9.0 s.")


def test_the_page_calls_places_that_no_sighting_confirms_refused(dive, known):
    """In the map of another place the landmarks stay where they were given, which says nothing about them."""
    elsewhere = displaced(known, known.ids, (30.0, 0.0, 0.0))
    table = given_map_table(compare(with_map(dive, elsewhere), ["ekf-slam"]))
    cells = {row[-1].text for row in table.rows}
    assert "refused" in cells
    assert cells <= {"refused", "not seen"}


def test_a_map_in_a_world_of_its_own_does_not_make_a_right_dive_wrong(dive, known):
    """Of a dive that states no start: the truth of the next one is brought into the world of that vehicle."""
    start = dive.calibration.start
    changes = {
        "source": "vehicle",
        "position_m": (0.0, 0.0, start.position_m[2]),
        "rpy_rad": (*start.rpy_rad[:2], 0.0),
    }
    own = start.model_copy(update=changes)
    (first,) = compare(with_map(dive, None, own), ["ekf-slam"]).runs
    assert first.known_map.has_own_world
    again = compare(with_map(dive, first.known_map, unknown_start(dive)), ["ekf-slam"])
    assert again.runs[0].known_map.has_own_world
    assert again.score_of("ekf-slam", "causal.ate_raw_m").value < 0.2
    (stated,) = compare(with_map(dive, known), ["ekf-slam"]).runs
    assert not stated.known_map.has_own_world
