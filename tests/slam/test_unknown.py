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
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam.landmarks import unknown as module
from sonar_graph.slam.landmarks.landmark_graph import (
    AmendableJournal,
    Assignment,
    LandmarkGraph,
)
from sonar_graph.slam.landmarks.sighting import Sighting, SightingFactors, late_view
from sonar_graph.slam.landmarks.unknown import (
    ODDS,
    UNPAIRED,
    AssociatedUnknown,
    Innovations,
    NamelessLandmarks,
    Pairing,
    nearest_duplicates,
    pair_jointly,
)
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
    ids, probability = seen.candidate_ids.copy(), seen.id_probability.copy()
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
    sequence, true = clean(), clean().true_landmarks
    known, estimator = (
        run(sequence, smoother__relinearize_threshold=1e-3),
        run(blind(), **ASSOCIATED),
    )
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
    """Bit for bit, with false detections too, of which a recogniser says that they are of no landmark it knows."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, false_detections_per_frame=0.5))
    one, other = (
        run(sequence, smoother__relinearize_threshold=1e-3),
        run(sequence, **ASSOCIATED),
    )
    assert np.array_equal(one.trajectory().positions, other.trajectory().positions)
    assert one.detections().outcomes == other.detections().outcomes


def test_a_landmark_begins_with_as_many_sightings_as_asked():
    for least in (1, 3, 8):
        outcomes = Counter(
            run(blind(), **ASSOCIATED, identity__unknown__sightings=least)
            .detections()
            .outcomes
        )
        assert outcomes[Outcome.PLACED_LATER] == 4 * (least - 1)
        assert outcomes[Outcome.USED_LATER] == 0
        assert outcomes[Outcome.NEW] == 4


def test_the_wider_the_aperture_the_later_a_landmark_begins():
    """Without a floor the elevation has to come from views, unless the aperture bounds it."""
    sequence, later = (
        blind(simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN, range_sigma_m=0.08))),
        [],
    )
    for aperture_rad in (0.2, 0.8):
        sonar = sequence.calibration.sonar.model_copy(
            update={"elevation_aperture_rad": aperture_rad}
        )
        calibration = sequence.calibration.model_copy(
            update={"sonar": sonar, "floor": None}
        )
        estimator = run(replace(sequence, calibration=calibration), **ASSOCIATED)
        later.append(
            Counter(estimator.detections().outcomes)[Outcome.PLACED_LATER]
            / len(estimator.landmarks())
        )
    assert later[0] == 4
    assert later[1] > 6


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


@pytest.mark.parametrize("history", ["whole", "bounded"])
@pytest.mark.parametrize("lag_s", [12.0, 3.0])
def test_what_waits_leaves_with_its_keyframe_also_while_all_that_is_seen_has_a_name(
    history: str, lag_s: float
):
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


@pytest.mark.parametrize("lag_s", [1e9, 15.0, 2.0])
def test_a_landmark_that_is_named_later_gives_the_graph_of_one_known_from_the_start(
    lag_s: float,
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


def test_with_a_bounded_history_none_is_merged_that_has_left_the_window():
    """Factors in a marginal cannot be moved; pairing works all the same."""
    merged, kept = (
        run(named_late(), **ASSOCIATED, history__policy=of).landmarks()
        for of in ("whole", "bounded")
    )
    assert len(kept) > len(merged) == 4
    paired = run(blind(), **ASSOCIATED, history__policy="bounded")
    assert len(paired.landmarks()) == 4
    assert set(paired.detections().outcomes) <= USED


def test_a_duplicate_is_merged_into_the_graph_of_one_landmark(
    monkeypatch: pytest.MonkeyPatch,
):
    """Eight frames in which nothing is paired, as if the vehicle's error had led it astray."""
    known, calls = run(blind(), **ASSOCIATED), 0
    first = len(clean().detections) * 2 // 3

    def pair(innovations: Innovations, probability: float) -> Pairing:
        nonlocal calls
        calls += 1
        if first <= calls < first + 8 and innovations.innovation.shape[1] >= 4:
            return Pairing((UNPAIRED,) * len(innovations.innovation), 0.0)
        return pair_jointly(innovations, probability)

    monkeypatch.setattr(module, "pair_jointly", pair)
    estimator = run(blind(), **ASSOCIATED)
    outcomes = Counter(estimator.detections().outcomes)
    assert outcomes[Outcome.NEW] + outcomes[Outcome.MOVED] > 4
    assert outcomes[Outcome.MOVED] >= 5
    assert estimator.landmarks().ids.tolist() == known.landmarks().ids.tolist()
    assert_same_graph(estimator, known)


def test_half_named_ends_in_names_only():
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, anonymous_share=0.5))
    assert 0.4 < np.mean((sequence.detections.candidate_ids < 0).all(axis=1)) < 0.6
    estimator = run(sequence, identity__unknown__policy="associate")
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4]
    ignoring = Counter(run(sequence).detections().outcomes)
    outcomes = assert_outcomes_account(estimator, sequence)
    assert sum(outcomes[used] for used in USED) > 1.7 * sum(
        ignoring[used] for used in USED
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
def test_a_landmark_has_to_be_denser_than_what_is_not_in_the_map(
    range_m: float, share: float
) -> None:
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


@pytest.mark.parametrize("range_m", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_candidate_begins_a_landmark_when_it_is_known_to_a_tenth_of_its_range(
    range_m: float, share: float
) -> None:
    """One sighting in an aperture whose standard deviation is about 0.1 rad."""
    made, _ = anonymous(range_m, 1e-3, aperture_rad=share * 0.1 * math.sqrt(12.0))
    sighting = Sighting(
        1, 1, Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.4])), NOISE, None
    )
    assert made.is_placed([sighting]) == (share < 1.0)


PROBABILITY = 0.99
NOISE_M = 0.02


def nearest(
    points: dict[int, list[float]],
    cov: np.ndarray,
    named: list[int],
    frames: dict[int, list[int]],
    log_rival: float = 0.0,
    ranges_m: tuple[float, ...] = (2.0, 2.0),
    rooted: tuple[int, ...] = (),
) -> tuple[int, int] | None:
    """Of landmarks at points with a joint covariance, each seen in some frames; rooted ones also before the window."""
    smoother = smoother_with(1e9, 0.1, 1e9)
    landmarks = LandmarkGraph(
        smoother, SightingFactors(SonarCalibration(), plain), AmendableJournal()
    )
    values, ids = (
        gtsam.Values(),
        {i: i if i in named else FIRST_ANONYMOUS_ID + i for i in points},
    )
    for (i, point), range_m in zip(points.items(), ranges_m, strict=True):
        values.insert(L(ids[i]), np.array(point))
        for stamp_ns in frames[i]:
            noise = np.diag([NOISE_M**2, (NOISE_M / 2) ** 2])
            sighting = Sighting(
                stamp_ns,
                0,
                Sightline(X(0), gtsam.Pose3(), np.array([range_m, 0.0])),
                noise,
                None,
            )
            landmarks._insert(sighting, ids[i], None)
        if i in rooted:
            landmarks._rooted[ids[i]] = sighting
    joint = JointCovariance(cov, {L(ids[i]): 3 * k for k, i in enumerate(points)})
    policy = AssociatedUnknown(
        gate_probability=PROBABILITY, density_m2=math.exp(log_rival) / ODDS
    )
    found = nearest_duplicates(landmarks, values, joint, policy)
    return found and (found[0] % FIRST_ANONYMOUS_ID, found[1] % FIRST_ANONYMOUS_ID)


def shared(count: int, common_sigma: float, own_sigma: float) -> np.ndarray:
    """An error that all share, and one of each."""
    return common_sigma**2 * np.kron(
        np.ones((count, count)), np.eye(3)
    ) + own_sigma**2 * np.eye(3 * count)


APART, TOGETHER = {5: [1], 7: [2]}, {5: [0.0] * 3, 7: [0.0] * 3}


def assert_gate(
    sigma_m: float, own_sigma: float, common_sigma: float, named: list[int], **how
) -> None:
    """Two landmarks are one up to the quantile of a difference that is uncertain by this beside their own errors."""
    reach = math.sqrt(chi2.ppf(PROBABILITY, 3) * (2 * own_sigma**2 + sigma_m**2))
    for factor, merged in ((0.98, (5, 7)), (1.02, None)):
        points = {5: [1.0, 2.0, 0.0], 7: [1.0 + factor * reach, 2.0, 0.0]}
        assert (
            nearest(
                points,
                shared(2, common_sigma, own_sigma),
                named,
                APART,
                log_rival=-10.0,
                **how,
            )
            == merged
        )


@pytest.mark.parametrize("named", [[5], []])
def test_two_within_the_gate_of_their_difference_are_one(named: list[int]):
    """``P_aa + P_bb - P_ab - P_ba``: what both share does not count."""
    assert_gate(NOISE_M, 0.05, 3.0, named)


@pytest.mark.parametrize(
    "ranges_m", [(0.5, 0.5), (2.0, 2.0), (6.0, 6.0), (2.0, 6.0), (6.0, 2.0)]
)
def test_the_noise_of_two_sightings_is_the_larger_one_and_across_the_beam_where_that_is_larger(
    ranges_m,
):
    """``max(range sigma, range times azimuth sigma)`` beside two landmarks that are known well."""
    sigma_m = max(NOISE_M, max(ranges_m) * NOISE_M / 2)
    assert_gate(sigma_m, 0.001, 1.0, [], ranges_m=ranges_m)


def test_two_of_one_frame_stay_two_and_so_do_those_that_left_the_window():
    for frames, rooted, merged in (
        ([2, 3], (), None),
        ([3, 4], (), (5, 7)),
        ([3, 4], (7,), None),
    ):
        assert (
            nearest(
                TOGETHER,
                shared(2, 1.0, 0.05),
                [],
                {5: [1, 2], 7: frames},
                rooted=rooted,
            )
            == merged
        )


@pytest.mark.parametrize("own_sigma", [0.1, 1.0])
def test_a_wide_difference_says_nothing(own_sigma: float):
    """Compatible with zero, but no denser there, horizontally, than other landmarks are."""
    density = 1 / (2 * math.pi * (2 * own_sigma**2 + NOISE_M**2))
    for share, merged in ((0.99, (5, 7)), (1.01, None)):
        assert (
            nearest(
                TOGETHER,
                shared(2, 1.0, own_sigma),
                [],
                APART,
                math.log(share * density),
            )
            == merged
        )


def test_without_merging_they_stay_two(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "nearest_duplicates", lambda *_: None)
    assert len(run(named_late(), **ASSOCIATED).landmarks()) > 4


def test_the_first_landmark_without_a_name_is_merged_also_when_it_is_the_only_one():
    """Its identity is the lowest that stands for no name."""
    ids, _ = clean().detections.most_probable()
    rows = np.flatnonzero(ids == 1)
    sequence = anonymous_where(clean(), rows[: len(rows) // 2])
    estimator = run(sequence, **ASSOCIATED)
    assert Outcome.MOVED in estimator.detections().outcomes
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4]
