"""Identities that are known late, change or are repeated: the graph is that of a run that had known."""

from collections import Counter
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import FloorPrior
from sonar_graph.measurements import NO_TRACK
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2, RobustKernel
from sonar_graph.slam.landmarks.landmark_graph import IN_GRAPH
from sonar_graph.slam.smoother import Smoother
from sonar_graph.slam.smoother import smoother as smoother_module
from sonar_graph.states import Outcome
from sonar_graph.testing import laws
from sonar_graph.testing.laws import EstimatorRun, unlike

from .dive import CALIBRATION, NS, T0_NS, TRUSTING, UNGATED, Dive, spherical
from .graphs import assert_same_factors, assert_same_graph, factors_of, rows_of
from .late_identities import (
    BASIN,
    FLAT,
    GAP_S,
    IDS,
    LATE,
    OBJECTS,
    POLICIES,
    SURE,
    TROUBLES,
    Watch,
    assert_outcomes_account,
    from_the_start,
    on_the_rail,
    run,
    see,
)
from .made import counted, isam2_params, smoother_with
from .rail import STEP_S, rail

NEARLY_4 = [0.9, 0.0, 0.0, 0.0]
HISTORIES = {
    "late": [FLAT] * 6 + [SURE[7]],
    "another that is new": [SURE[5]] * 6 + [SURE[7]],
    "another that is seen beside it, less surely": [SURE[4]] * 6 + [SURE[7]],
    "undecided, wrong, wrong, none, right": [FLAT] * 2
    + [SURE[5]] * 3
    + [SURE[6]] * 3
    + [[0.0] * 4] * 2
    + [SURE[7]],
    "wrong to the frame before the last": [SURE[6]] * 14 + [SURE[7]],
}


@pytest.mark.parametrize(
    "lag_s", [1e9, 2.6, 0.6], ids=["all", "five poses", "one pose"]
)
@pytest.mark.parametrize("history", HISTORIES)
def test_on_the_rail_the_end_is_least_squares_with_the_right_identities(
    history: str, lag_s: float
):
    """Poses, landmarks and their variances as numpy has them but for the little that a first direction weighs.

    As known from the start to 1e-8, and the window's landmarks to 1e-6.
    """
    _, numbers = rail()
    nodes = len(numbers.displacements_m) + 1
    mean, variance = numbers.solution(nodes)
    sequence = on_the_rail(HISTORIES[history], NEARLY_4)
    settings = {
        "kernel__shape": "none",
        "keyframes__motion_noise_share": 0.0,
        "smoother__lag_s": lag_s,
    }
    estimator, known = (
        run(given, 1 / STEP_S, **settings)
        for given in (sequence, from_the_start(sequence))
    )
    smoothed, landmarks = estimator.trajectory(), estimator.landmarks()
    assert smoothed.positions[:, 0] == pytest.approx(
        [mean[f"x{k}"] for k in range(1, nodes)], abs=2e-4
    )
    assert smoothed.positions[:, 0] == pytest.approx(
        known.trajectory().positions[:, 0], abs=1e-8
    )
    assert smoothed.covariances[:, 3, 3] == pytest.approx(
        known.trajectory().covariances[:, 3, 3], rel=1e-6
    )
    assert landmarks.ids.tolist() == [4, 7]
    assert landmarks.positions[:, 0] == pytest.approx(
        [mean["l4"], mean["l7"]], abs=2e-4
    )
    assert landmarks.covariances[:, 0, 0] == pytest.approx(
        [variance["l4"], variance["l7"]], rel=1e-3
    )
    # across, ranges tell next to nothing
    live = [given.values.atPoint3(L(7))[0] for given in (estimator, known)]
    assert live[0] == pytest.approx(live[1], abs=1e-6)
    outcomes = assert_outcomes_account(estimator, sequence)
    assert sum(outcomes[used] for used in (Outcome.USED, Outcome.NEW, *LATE)) == len(
        numbers.ranges
    )


@pytest.mark.parametrize("lag_s", [15.0, 2.0])
@pytest.mark.parametrize("trouble", TROUBLES)
def test_what_is_known_late_gives_the_graph_of_what_was_known_from_the_start(
    trouble: str, lag_s: float
):
    """Without a gyro bias no factor depends on an estimate: equal one by one, and so are the marginals."""
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES[trouble], gyro_bias_scale=0.0)
    )
    estimator, known = (
        run(sequence, smoother__lag_s=lag_s),
        run(from_the_start(sequence), smoother__lag_s=lag_s),
    )
    assert_same_graph(estimator, known)
    assert assert_outcomes_account(estimator, sequence).keys() & LATE
    assert not assert_outcomes_account(known, sequence).keys() & LATE


BELIEFS = st.sampled_from([SURE[4], SURE[5], SURE[6], [0.9, 0, 0, 0], FLAT, [0.0] * 4])
FRAMES = 6


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.lists(BELIEFS, min_size=3, max_size=3),
        min_size=FRAMES - 1,
        max_size=FRAMES - 1,
    )
)
def test_whatever_identities_came_before_the_graph_is_that_of_the_last_ones(
    histories: list[list[list[float]]],
):
    """Also where tracks change places, all at once, or claim one landmark together."""
    last = [SURE[4], SURE[5], SURE[7]]
    believed, known = (
        Watch(identity=UNGATED, kernel=RobustKernel(width=2.0)) for _ in range(2)
    )
    for number in range(FRAMES):
        believed.watch(number, histories[number] if number < FRAMES - 1 else last)
        known.watch(number, last)
    assert_same_factors(
        believed.smoother.graph, known.smoother.graph, known.smoother.values
    )
    assert believed.sightings.landmarks.ids == [4, 5, 7]
    assert len(believed.outcomes) == 3 * FRAMES
    assert set(believed.outcomes) <= {Outcome.USED, Outcome.NEW, *LATE}
    ids = believed.sightings.journal.log().landmark_ids
    assert ids.tolist() == [4, 5, 7] * FRAMES


def test_whether_it_stands_on_the_floor_is_judged_where_it_was_seen():
    """An object high above the floor and one on it, known late: the factors of heights are as if known at once."""
    for height_m, factors_on_height in ((OBJECTS[0][2] - 1.2, 0), (OBJECTS[0][2], 1)):
        floor = FloorPrior(z_m=height_m, sigma_m=0.01)
        late, known = (
            Dive(CALIBRATION.model_copy(update={"floor": floor})) for _ in range(2)
        )
        for dive, first in ((late, FLAT), (known, SURE[5])):
            see(dive, 0.0, first)
            see(dive, 0.5, SURE[5])
        names, expected = (
            sorted(
                (type(factor).__name__, *factor.keys())
                for factor in factors_of(each.smoother.graph)
            )
            for each in (late, known)
        )
        assert names == expected
        assert names.count(("PriorFactorPoint3", L(5))) == factors_on_height


def test_a_displaced_sighting_is_used_when_its_place_becomes_free_though_its_track_is_gone():
    dive, known = Watch(identity=UNGATED), Watch(identity=UNGATED)
    for each, first in ((dive, SURE[5]), (known, SURE[4])):
        each.watch(0, [FLAT, SURE[5], FLAT])
        each.watch(1, [first, [0.0, 0.9, 0.0, 0.0], FLAT])
    assert dive.outcomes[3:5] == [Outcome.USED, Outcome.REPEATED]
    for each in (dive, known):
        see(each, 2 * GAP_S, SURE[4], track=0)
    assert dive.outcomes[3:5] == [Outcome.MOVED, Outcome.USED_LATER]
    assert_same_factors(
        dive.smoother.graph, known.smoother.graph, known.smoother.values
    )


CUT = {
    **POLICIES,
    "plain": {"kernel__shape": "none"},
    "each alone": {"identity__longest_wait_s": 0.0},
    "remembered": {"history__policy": "bounded", "history__remembered_s": 40.0, "smoother__lag_s": 3.0},
    "bounded gate that associates": {
        "identity__policy": "gate", "identity__unknown__policy": "associate", "identity__longest_wait_s": 2.0,
        "history__policy": "bounded", "smoother__lag_s": 3.0,
    },
    "max-mixture, short": {"identity__policy": "max-mixture", "smoother__lag_s": 3.0},
    "max-mixture, plain": {"identity__policy": "max-mixture", "kernel__shape": "none", "identity__longest_wait_s": 3.0},
}  # fmt: skip
SELDOM_HZ = 0.1


def answers(
    policy: str, seed: int | None, source: type[Odometry] = Odometry
) -> EstimatorRun:
    """At tens of seconds, of identities that are late, wrong and missing.

    Calls every ten seconds, and asked only at the end; with a seed also calls a quarter to two seconds apart, of which
    every eighth asks, and at every third frame. Frames fall on epochs, between rows of the IMU.
    """
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES["late and wrong"], anonymous_share=0.3)
    )
    frames_ns, dvl_ns = (
        np.unique(sequence.detections.stamps_ns),
        sequence.dvl.stamps_ns.copy(),
    )
    dvl_ns[dvl_ns.searchsorted(frames_ns)] = frames_ns
    sequence = replace(sequence, dvl=replace(sequence.dvl, stamps_ns=dvl_ns))
    instants = tens = sequence.instants(SELDOM_HZ)
    if seed is not None:
        quarters = np.random.default_rng(seed).integers(1, 9, 1000)
        between = tens[0] + np.cumsum(quarters) * NS // 4
        instants = np.union1d(
            tens, np.append(between[between < tens[-1]], frames_ns[::3])
        )
    made = laws.run(
        lambda calibration, _: Isam2(calibration, source(calibration), isam2_params(**CUT[policy])),
        sequence, instants, ask_every=0 if seed is None else 8,
    )  # fmt: skip
    told = [estimate for estimate in made.estimates if estimate.stamp_ns in tens]
    return replace(
        made,
        estimates=told,
        trajectory=made.trajectory.rows(np.isin(made.trajectory.stamps_ns, tens)),
    )


@pytest.mark.parametrize("policy", CUT)
def test_no_bit_depends_on_how_a_log_is_cut_into_calls_or_on_questions(policy: str):
    seldom = answers(policy, None)
    assert len(seldom.estimates) > 10
    assert unlike(seldom, answers(policy, 1)) == []


class CountingOdometry(Odometry):
    """Motions that depend in the last digits on how often one was asked for."""

    asked = 0

    def motion(self, *interval: Any) -> PreintegratedMotion:
        motion = super().motion(*interval)
        self.asked += 1
        drift = gtsam.Pose3(gtsam.Rot3(), np.array([1e-13 * self.asked, 0.0, 0.0]))
        return replace(motion, i_T_j=motion.i_T_j.compose(drift))


def test_cut_invariance_sees_a_trillionth_of_a_metre():
    differing = unlike(
        answers("robust", None, CountingOdometry),
        answers("robust", 1, CountingOdometry),
    )
    assert differing == [
        "causal estimates",
        "trajectory()",
        "landmarks()",
        "detections()",
    ]


@pytest.mark.parametrize("asked", [False, True])
def test_a_track_that_is_over_decides_no_longer_which_of_its_rows_counts(asked: bool):
    """Also without a question for the outcomes in between, which forgets the track."""
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": 1.0}))
    see(dive, 0.0, SURE[5])
    if asked:
        dive.keyframes.advance(T0_NS + 3 * NS)
        dive.sightings.log()
    z = [spherical(1.5, p) for p in OBJECTS[:2]]
    dive.show(
        T0_NS + 3 * NS, z, IDS, [[0.0, 0.75, 0.0, 0.0], [0.0, 0.0, 0.9, 0.0]], [3, 3]
    )
    assert dive.outcomes[1:] == [Outcome.TRACK_REPEATED, Outcome.NEW]


@pytest.mark.parametrize("policy", POLICIES)
def test_the_journal_has_the_landmark_of_each_sighting_in_the_graph(policy: str):
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES["late and wrong"], anonymous_share=0.3)
    )
    estimator = run(sequence, **POLICIES[policy])
    landmarks = estimator._frontend.landmarks
    log, inside = (
        landmarks.journal.log(),
        {s.row: i for i in landmarks.ids for s in landmarks.sightings(i)},
    )
    for row, landmark_id in inside.items():
        assert (log.landmark_ids[row], log.outcomes[row] in IN_GRAPH) == (
            landmark_id,
            True,
        )
    is_used = {row for row, outcome in enumerate(log.outcomes) if outcome in IN_GRAPH}
    assert len(is_used) > 10
    assert is_used == set(inside) or any(map(landmarks.is_rooted, landmarks.ids))


NEW, USED, WAITING = Outcome.NEW, Outcome.USED, Outcome.WAITING
USED_LATER, FORGOTTEN, TAKEN_BACK = (
    Outcome.USED_LATER,
    Outcome.FORGOTTEN,
    Outcome.TAKEN_BACK,
)
NONE, DOUBTFUL = [0.0] * 4, [0.1, 0.6, 0.1, 0.1]
TOLD = {
    "too late": (2.0, [(0.0, FLAT), (1.0, FLAT), (2.5, FLAT)], [FORGOTTEN, WAITING, WAITING]),
    "of no landmark": (2.0, [(0.0, FLAT), (0.5, NONE), (3.0, None)], [Outcome.NO_IDENTITY, Outcome.NO_IDENTITY]),
    "too late without another frame": (2.0, [(0.0, FLAT), (5.0, None)], [FORGOTTEN]),
    "the rest in time": (2.0, [(0.9, FLAT), (1.0, FLAT), (3.0, SURE[5])], [FORGOTTEN, USED_LATER, USED]),
    "taken back, and too late for another landmark": (
        2.0, [(0.0, SURE[5]), (1.0, FLAT), (1.5, NONE), (2.6, SURE[5])], [TAKEN_BACK, USED_LATER, USED_LATER, USED],
    ),
    "over, then of another identity": (1.0, [(0.0, SURE[5]), (2.0, SURE[6])], [NEW, NEW]),
    "doubtful once known": (60.0, [(0.0, SURE[5]), (0.5, DOUBTFUL)], [NEW, WAITING]),
    "doubtful, then sure": (60.0, [(0.0, SURE[5]), (0.5, DOUBTFUL), (1.0, SURE[5])], [NEW, USED_LATER, USED]),
}  # fmt: skip


@pytest.mark.parametrize(
    ("longest_wait_s", "seen", "outcomes"), TOLD.values(), ids=TOLD
)
def test_a_track_waits_for_an_identity_no_longer_than_asked(
    longest_wait_s, seen, outcomes
):
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": longest_wait_s}))
    for after_s, belief in seen:
        if belief:
            see(dive, after_s, belief)
    dive.keyframes.advance(T0_NS + round(seen[-1][0] * NS))
    assert dive.sightings.log().outcomes == outcomes


@pytest.mark.parametrize("lag_s", [1e9, 0.5], ids=["in the window", "left it"])
def test_late_sightings_pass_the_gate_one_by_one(lag_s: float):
    """Also at keyframes that have left the window; what they were of meanwhile does not matter."""
    dive = Dive(lag_s=lag_s)
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[5])
    for after_s, off_m in ((6.0, 0.0), (6.2, 3.0)):
        see(dive, after_s, FLAT if lag_s > 1.0 else SURE[6], track=4, off_m=off_m)
    see(dive, 9.0, SURE[5], track=4)
    assert dive.outcomes[3:] == [
        USED_LATER if lag_s > 1.0 else Outcome.MOVED,
        Outcome.GATED,
        USED,
    ]


def test_what_was_refused_for_one_landmark_is_not_refused_for_good():
    dive = Dive()
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[5])
    see(dive, 0.6, SURE[5], off_m=0.5)
    assert dive.outcomes[-1] == Outcome.GATED
    see(dive, 0.8, NONE)
    assert dive.outcomes == [TAKEN_BACK] * 3 + [WAITING] * 2
    see(dive, 1.0, SURE[6])
    assert dive.outcomes[:5] == [Outcome.MOVED] * 3 + [USED_LATER] * 2


def test_of_tracks_that_claim_a_landmark_at_once_the_more_probable_gets_the_earlier_frames():
    dive = Watch(identity=UNGATED)
    dive.watch(0, [FLAT, FLAT, FLAT])
    dive.watch(1, [[0.0, 0.8, 0.0, 0.0], SURE[5], FLAT])
    assert dive.outcomes == [
        Outcome.REPEATED,
        USED_LATER,
        WAITING,
        Outcome.REPEATED,
        USED,
        WAITING,
    ]


def test_a_landmark_may_begin_late_while_what_waits_makes_the_window_restart(
    monkeypatch,
):
    dive = Dive(
        smoother=smoother_with(1e9, 1e-6, 1e-9, waiting_gain=1e9, is_bounded=True)
    )
    restarts = counted(monkeypatch, Smoother, "_restart")
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[4])
        see(dive, after_s + 0.1, FLAT, track=5, off_m=0.3)
    see(dive, 0.6, SURE[6], track=5, off_m=0.3)
    assert restarts
    assert dive.outcomes[1::2] == [Outcome.USED_LATER] * 3
    assert dive.sightings.landmarks.ids == [4, 6]


def test_late_factors_cost_no_solution_of_the_history(monkeypatch):
    """Neither those of a track that waited nor of one that was of no landmark."""
    solves = counted(monkeypatch, smoother_module, "solve_in_sight")
    for beliefs in ([FLAT] * 9, [FLAT] * 2 + [[0.0] * 4] * 7):
        dive = Dive(lag_s=0.5)
        for k, belief in enumerate([*beliefs, SURE[5]]):
            see(dive, float(k), belief)
        assert not solves
        assert dive.outcomes == [Outcome.USED_LATER] * 9 + [Outcome.USED]


NODES = 10
ROWS = len(rail(NODES)[1].ranges)
BELIEFS_OF_REPEATED_TRACKS = [*SURE.values(), FLAT, [0.0] * 4, [0.0, 0.9, 0.0, 0.05]]


def said(tracks: list[int], beliefs: list[list[float]]) -> Sequence:
    sequence, ids = rail(NODES)[0], np.tile(IDS, (ROWS, 1))
    stated = {
        "track": np.array(tracks),
        "candidate_ids": ids,
        "id_probability": np.array(beliefs, dtype=float),
    }
    return replace(sequence, detections=replace(sequence.detections, **stated))


@pytest.mark.parametrize("policy", POLICIES)
@settings(max_examples=4, phases=[Phase.explicit, Phase.generate])
@given(data=st.data())
def test_a_run_is_that_without_second_rows_of_tracks(policy: str, data: st.DataObject):
    tracks = data.draw(st.lists(st.integers(NO_TRACK, 1), min_size=ROWS, max_size=ROWS))
    beliefs = data.draw(
        st.lists(
            st.sampled_from(BELIEFS_OF_REPEATED_TRACKS), min_size=ROWS, max_size=ROWS
        )
    )
    sequence = said(tracks, beliefs)
    estimator = run(
        sequence, 1 / STEP_S, keyframes__motion_noise_share=0.0, **POLICIES[policy]
    )
    outcomes = assert_outcomes_account(estimator, sequence)
    is_kept = np.array(
        [
            outcome is not Outcome.TRACK_REPEATED
            for outcome in estimator.detections().outcomes
        ]
    )
    pairs = enumerate(zip(sequence.detections.stamps_ns.tolist(), tracks, strict=True))
    may_be_used = {
        (stamp_ns, track if track != NO_TRACK else -2 - row)
        for row, (stamp_ns, track) in pairs
    }
    assert outcomes[Outcome.TRACK_REPEATED] == ROWS - len(may_be_used)
    without = replace(sequence, detections=sequence.detections.rows(is_kept))
    alone = run(
        without, 1 / STEP_S, keyframes__motion_noise_share=0.0, **POLICIES[policy]
    )
    assert np.array_equal(estimator.landmarks().ids, alone.landmarks().ids)
    assert np.array_equal(estimator.landmarks().positions, alone.landmarks().positions)
    assert np.array_equal(
        estimator.trajectory().positions, alone.trajectory().positions
    )


PLACES_IN_FRAME = [int(i == 7) for _, i, _ in rail(NODES)[1].ranges]


def test_where_tracks_are_not_used_all_rows_are():
    sequence = said(
        [0] * ROWS, [SURE[7] if place else SURE[4] for place in PLACES_IN_FRAME]
    )
    outcomes = assert_outcomes_account(
        run(sequence, 1 / STEP_S, identity__longest_wait_s=0), sequence
    )
    assert outcomes[Outcome.TRACK_REPEATED] == 0
    assert outcomes[Outcome.USED] + outcomes[Outcome.NEW] == ROWS


@pytest.mark.parametrize("policy", POLICIES)
def test_two_rows_of_a_known_track_that_name_others_do_not_end_the_run(policy: str):
    tracks, beliefs = (
        [of[place] for place in PLACES_IN_FRAME]
        for of in ((40, 70), (SURE[4], SURE[7]))
    )
    two = np.flatnonzero(PLACES_IN_FRAME)[1]
    tracks[two], beliefs[two - 1], beliefs[two] = 40, SURE[5], SURE[6]
    sequence = said(tracks, beliefs)
    outcomes = assert_outcomes_account(
        run(sequence, 1 / STEP_S, **POLICIES[policy]), sequence
    )
    assert outcomes[Outcome.TRACK_REPEATED] == 1


def test_without_deferring_the_rail_does_not_end_there():
    mean, _ = rail()[1].solution(21)
    wrong = on_the_rail(HISTORIES["wrong to the frame before the last"], NEARLY_4)
    estimator = run(wrong, 1 / STEP_S, kernel__shape="none", identity__longest_wait_s=0)
    assert estimator.landmarks().ids.tolist() == [4, 6, 7]
    late = on_the_rail(HISTORIES["late"], NEARLY_4)
    estimator = run(late, 1 / STEP_S, kernel__shape="none", identity__longest_wait_s=0)
    assert Counter(estimator.detections().outcomes)[Outcome.NO_IDENTITY] == 6
    assert abs(estimator.landmarks().positions[1, 0] - mean["l7"]) > 2e-4


def test_a_wrong_identity_that_is_not_retracted_leaves_another_graph():
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES["wrong"], gyro_bias_scale=0.0)
    )
    estimator, known = (
        run(sequence, identity__longest_wait_s=0),
        run(from_the_start(sequence)),
    )
    names = [rows_of(each.graph, each.values).keys() for each in (estimator, known)]
    assert names[0] != names[1]
    assert Counter(estimator.detections().outcomes).keys().isdisjoint(LATE)


def test_an_earlier_sighting_becomes_the_one_that_a_landmark_begins_with():
    """Seen first without a track, then known to have been seen before: the earlier sighting has the direction."""
    dive = Dive()
    see(dive, 0.0, FLAT, track=4)
    see(dive, 0.5, SURE[5], track=-1)
    see(dive, 1.0, SURE[5], track=4)
    begun = [
        factor
        for factor in factors_of(dive.smoother.graph)
        if isinstance(factor, gtsam.BearingRangeFactor3D)
    ]
    assert [gtsam.Symbol(factor.keys()[0]).index() for factor in begun] == [0]
    assert dive.outcomes == [Outcome.USED_LATER, Outcome.NEW, Outcome.USED]
