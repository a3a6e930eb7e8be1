"""Landmarks without names: paired, begun and merged by geometry."""

import math
from collections import Counter
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import chi2, multivariate_normal

from sonar_graph.calibration import SonarCalibration
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.slam import AssociatedUnknown
from sonar_graph.slam.landmarks import (
    AmendableJournal,
    LandmarkGraph,
    NamelessLandmarks,
    SightingFactors,
)
from sonar_graph.slam.landmarks.landmark_graph import Assignment
from sonar_graph.slam.landmarks.sighting import Sighting, late_view
from sonar_graph.slam.landmarks.unknown import ODDS, nearest_duplicates
from sonar_graph.slam.smoother import JointCovariance, Sightline, Smoother
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome

from .graphs import assert_same_graph
from .late_identities import assert_outcomes_account, run
from .made import plain, pose_prior, smoother_with

TWO_LAPS = {
    "duration_s": 260.0,
    "laps": 2,
    "speed_m_s": 0.4,
    "seed": 3,
    "gyro_bias_scale": 0.0,
}
CLEAN = {
    "tracks": True,
    "detection_probability": 1.0,
    "false_detections_per_frame": 0.0,
}
ASSOCIATED = {
    "identity__unknown__policy": "associate",
    "identity__unknown__gate_probability": 1 - 1e-9,
    "smoother__relinearize_threshold": 1e-3,
}
USED = {
    Outcome.USED,
    Outcome.NEW,
    Outcome.PLACED_LATER,
    Outcome.USED_LATER,
    Outcome.MOVED,
}


def anonymous_where(sequence: Sequence, rows: np.ndarray) -> Sequence:
    """Some detections name nothing."""
    seen = sequence.detections
    ids = seen.candidate_ids.copy()
    probability = seen.id_probability.copy()
    ids[rows], probability[rows] = -1, 0.0
    return replace(
        sequence,
        detections=replace(seen, candidate_ids=ids, id_probability=probability),
    )


@cache
def clean() -> Sequence:
    return simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN))


def blind(sequence: Sequence | None = None) -> Sequence:
    """Nothing has a name."""
    return anonymous_where(sequence or clean(), np.s_[:])


def test_without_names_the_basin_is_that_with_names():
    """Four landmarks, every detection used for the right one, and the poses of a run that knew them."""
    sequence = clean()
    true = clean().true_landmarks
    known = run(sequence, smoother__relinearize_threshold=1e-3)
    estimator = run(blind(), **ASSOCIATED)
    landmarks = estimator.landmarks()
    assert landmarks.ids.tolist() == [FIRST_ANONYMOUS_ID + k for k in range(4)]
    apart_m = np.linalg.norm(
        landmarks.positions[:, None, :2] - true.positions[None, :, :2], axis=-1
    )
    name_of = dict(
        zip(
            landmarks.ids.tolist(),
            true.ids[np.argmin(apart_m, axis=1)].tolist(),
            strict=True,
        )
    )
    log = estimator.detections()
    assert set(log.outcomes) <= USED
    assert [
        name_of[i] for i in log.landmark_ids.tolist()
    ] == sequence.detections.most_probable()[0].tolist()
    assert estimator.trajectory().positions == pytest.approx(
        known.trajectory().positions, abs=1e-4
    )


def test_where_all_are_named_nothing_changes():
    """Bit for bit, with false detections too, which a recogniser reports as of no landmark it knows."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, false_detections_per_frame=0.5))
    one = run(sequence, smoother__relinearize_threshold=1e-3)
    other = run(sequence, **ASSOCIATED)
    assert np.array_equal(one.trajectory().positions, other.trajectory().positions)
    assert one.detections().outcomes == other.detections().outcomes


def test_a_landmark_begins_with_as_many_sightings_as_asked():
    for least in (1, 8):
        outcomes = Counter(
            run(blind(), **ASSOCIATED, identity__unknown__sightings=least)
            .detections()
            .outcomes
        )
        assert outcomes[Outcome.PLACED_LATER] == 4 * (least - 1)
        assert outcomes[Outcome.USED_LATER] == 0
        assert outcomes[Outcome.NEW] == 4


def test_scattered_detections_of_nothing_begin_no_landmark():
    """As many in a place as would begin one do not come within the time that they may wait."""
    options = BasinOptions(
        **TWO_LAPS, false_detections_per_frame=0.05, detection_probability=0.0
    )
    nothing = blind(simulate_basin(options))
    estimator = run(nothing, identity__unknown__policy="associate")
    assert len(estimator.landmarks()) == 0
    outcomes = assert_outcomes_account(estimator, nothing)
    assert outcomes[Outcome.FORGOTTEN] > 30
    assert outcomes.keys() <= {Outcome.FORGOTTEN, Outcome.WAITING}
    assert (
        len(
            run(
                nothing,
                identity__unknown__policy="associate",
                identity__unknown__sightings=1,
            ).landmarks()
        )
        > 4
    )


def named_late(sequence: Sequence | None = None, share: float = 0.4) -> Sequence:
    """The detections of a first share of the run name nothing."""
    seen = (sequence or clean()).detections
    until_ns = seen.stamps_ns[0] + round(
        share * (seen.stamps_ns[-1] - seen.stamps_ns[0])
    )
    return anonymous_where(sequence or clean(), seen.stamps_ns < until_ns)


@pytest.mark.parametrize(("history", "lag_s"), [("whole", 12.0), ("bounded", 3.0)])
def test_what_waits_leaves_with_its_keyframe(history, lag_s):
    """False detections of a first part, without names, wait when the second begins, in which landmarks are merged."""
    sequence = named_late(
        simulate_basin(
            BasinOptions(**TWO_LAPS, tracks=True, false_detections_per_frame=0.05)
        )
    )
    settings = {
        "history__policy": history,
        "smoother__lag_s": lag_s,
        "smoother__stale_shift_m": 0.01,
    }
    estimator = run(sequence, identity__unknown__policy="associate", **settings)
    outcomes = assert_outcomes_account(estimator, sequence)
    assert outcomes[Outcome.FORGOTTEN] > 10
    assert outcomes[Outcome.WAITING] == 0
    assert {1, 2, 3, 4} <= set(estimator.landmarks().ids.tolist())


@pytest.mark.parametrize("lag_s", [15.0, 2.0])
def test_a_landmark_named_later_gives_the_graph_of_one_known_at_once(
    lag_s,
):
    """Factor by factor, and so are the marginals."""
    estimator = run(named_late(), **ASSOCIATED, smoother__lag_s=lag_s)
    known = run(clean(), smoother__lag_s=lag_s)
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4]
    assert Counter(estimator.detections().outcomes)[Outcome.MOVED] > 20
    assert_same_graph(estimator, known)
    assert (
        estimator.detections().landmark_ids.tolist()
        == known.detections().landmark_ids.tolist()
    )


NOISE = np.diag([4e-4, 1e-4])


def ahead(
    landmarks: LandmarkGraph, range_m: float, azimuth_rad: float = 0.0
) -> Sighting:
    """A sighting from the first pose."""
    line = Sightline(X(0), gtsam.Pose3(), np.array([range_m, azimuth_rad]))
    return Sighting(
        0, landmarks.journal.record(0, -1, Outcome.WAITING), line, NOISE, None
    )


def anonymous(
    range_m: float,
    density_m2: float,
    least_sightings: int = 1,
    aperture_rad: float = 0.3,
) -> tuple[NamelessLandmarks, Smoother]:
    """A known pose, and a landmark straight ahead."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    maker = SightingFactors(
        SonarCalibration(elevation_aperture_rad=aperture_rad), plain
    )
    landmarks = LandmarkGraph(smoother, maker, AmendableJournal())
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    smoother.add({"prior": pose_prior(X(0), gtsam.Pose3(), 1e-4)})
    smoother.update(0.0)
    landmarks.apply([Assignment(ahead(landmarks, range_m), Outcome.USED, 7)], 0.0)
    smoother.flush(0.0)
    policy = AssociatedUnknown(
        gate_probability=0.99,
        density_m2=density_m2,
        sightings=least_sightings,
        longest_wait_s=60.0,
    )
    return NamelessLandmarks(landmarks, None, policy), smoother


@pytest.mark.parametrize("range_m", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_landmark_has_to_be_denser_than_what_is_not_in_the_map(range_m, share):
    """So many a square metre are ``range`` times as many a metre of range and radian of azimuth."""
    z = np.array([range_m + 0.02, 0.01])
    _, smoother = anonymous(range_m, 1.0)
    sighting = Sighting(0, 0, Sightline(X(0), gtsam.Pose3(), z), NOISE, None)
    view = late_view(sighting, smoother.values, smoother.joint_covariance([X(0), L(7)]))
    expected, cov = view.expect([L(7)], smoother.values.atPoint3(L(7))[None])
    density = multivariate_normal.pdf(z, expected[0], cov[0] + NOISE)
    policied, _ = anonymous(range_m, share * density / (ODDS * z[0]))
    (paired,) = policied.pair(view, z[None], NOISE[None], set())
    assert paired.landmark_id == (7 if share < 1.0 else None)
    (named,) = policied.pair(view, z[None], NOISE[None], {7})
    assert named.landmark_id is None, "the landmark is named elsewhere in the frame"


PROBABILITY = 0.99
NOISE_M = 0.02


def one_of_two(
    apart_m: float, own_sigma: float, density_m2: float, frames: list[int], name: int
) -> tuple[int, int] | None:
    """Of two landmarks, one of them named, apart along x and known to this beside a common error of 3 m."""
    smoother = smoother_with()
    maker = SightingFactors(SonarCalibration(), plain)
    landmarks = LandmarkGraph(smoother, maker, AmendableJournal())
    smoother.add_pose(X(0), gtsam.Pose3(), 0.0)
    line = Sightline(X(0), gtsam.Pose3(), np.array([2.0, 0.0]))
    noise = np.diag([NOISE_M**2, (NOISE_M / 2) ** 2])
    ids = [name, FIRST_ANONYMOUS_ID]
    for landmark_id, stamp_ns in zip(ids, frames, strict=True):
        row = landmarks.journal.record(stamp_ns, -1, Outcome.WAITING)
        seen = Sighting(stamp_ns, row, line, noise, None)
        landmarks.apply([Assignment(seen, Outcome.USED, landmark_id)], 0.0)
    values = gtsam.Values()
    for landmark_id, x in zip(ids, (0.0, apart_m), strict=True):
        values.insert(L(landmark_id), np.array([x, 2.0, 0.0]))
    common = 3.0**2 * np.kron(np.ones((2, 2)), np.eye(3))
    cov = common + own_sigma**2 * np.eye(6)
    joint = JointCovariance(cov, {L(ids[0]): 0, L(ids[1]): 3})
    params = AssociatedUnknown(gate_probability=PROBABILITY, density_m2=density_m2)
    return nearest_duplicates(landmarks, values, joint, params)


@pytest.mark.parametrize("name", [5, FIRST_ANONYMOUS_ID + 1])
@pytest.mark.parametrize("own_sigma", [0.05, 1.0])
def test_two_are_one_within_the_gate_where_they_are_dense(own_sigma, name):
    """``P_aa + P_bb - P_ab - P_ba`` and the noise of a sighting: what both share does not count."""
    variance = 2 * own_sigma**2 + NOISE_M**2
    reach_m = math.sqrt(chi2.ppf(PROBABILITY, 3) * variance)
    density_m2 = 1 / (2 * math.pi * variance) / ODDS
    merged = (min(name, FIRST_ANONYMOUS_ID), max(name, FIRST_ANONYMOUS_ID))
    assert one_of_two(0.98 * reach_m, own_sigma, 1e-9, [1, 2], name) == merged
    assert one_of_two(1.02 * reach_m, own_sigma, 1e-9, [1, 2], name) is None
    assert one_of_two(0.0, own_sigma, 0.99 * density_m2, [1, 2], name) == merged
    assert one_of_two(0.0, own_sigma, 1.01 * density_m2, [1, 2], name) is None
    assert one_of_two(0.0, own_sigma, 1e-9, [1, 1], name) is None


def test_the_only_landmark_without_a_name_is_merged():
    """Its identity is the lowest that stands for no name."""
    ids, _ = clean().detections.most_probable()
    rows = np.flatnonzero(ids == 1)
    sequence = anonymous_where(clean(), rows[: len(rows) // 2])
    estimator = run(sequence, **ASSOCIATED)
    assert Outcome.MOVED in estimator.detections().outcomes
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize("range_m", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_candidate_known_to_a_tenth_of_its_range_begins_a_landmark(range_m, share):
    """One sighting in an aperture whose standard deviation is about 0.1 rad."""
    made, _ = anonymous(range_m, 1e-3, aperture_rad=share * 0.1 * math.sqrt(12.0))
    sighting = Sighting(
        1, 1, Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.4])), NOISE, None
    )
    assert made.is_placed([sighting]) == (share < 1.0)
