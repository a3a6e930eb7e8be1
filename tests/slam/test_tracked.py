"""Identities that are known late, change or are repeated: the graph is that of a run that had known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sonar_graph.measurements import NO_TRACK
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2, RobustKernel
from sonar_graph.states import Outcome
from sonar_graph.testing import laws
from sonar_graph.testing.laws import EstimatorRun, unlike

from .dive import NS, T0_NS, TRUSTING, UNGATED, Dive
from .graphs import assert_same_factors, assert_same_graph
from .late_identities import (
    BASIN,
    FLAT,
    IDS,
    LATE,
    POLICIES,
    SURE,
    TROUBLES,
    Watch,
    assert_outcomes_account,
    from_the_start,
    run,
    see,
)
from .made import isam2_params
from .rail import STEP_S, rail


@pytest.mark.parametrize("lag_s", [15.0, 2.0])
@pytest.mark.parametrize("trouble", TROUBLES)
def test_late_identities_give_the_graph_of_identities_known_at_once(trouble, lag_s):
    """Without a gyro bias no factor depends on an estimate: equal one by one, and so are the marginals."""
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES[trouble], gyro_bias_scale=0.0)
    )
    estimator = run(sequence, smoother__lag_s=lag_s)
    known = run(from_the_start(sequence), smoother__lag_s=lag_s)
    assert_same_graph(estimator, known)
    assert assert_outcomes_account(estimator, sequence).keys() & LATE
    assert not assert_outcomes_account(known, sequence).keys() & LATE


NEW = Outcome.NEW
USED = Outcome.USED
NONE = [0.0] * 4
BELIEFS = st.sampled_from([SURE[4], SURE[5], SURE[6], [0.9, 0, 0, 0], FLAT, NONE])
FRAMES = 6


@settings(max_examples=20, deadline=None)
@given(
    st.lists(
        st.lists(BELIEFS, min_size=3, max_size=3),
        min_size=FRAMES - 1,
        max_size=FRAMES - 1,
    ),
    st.sampled_from([[4, 5, 7], [4, 5]]),
)
def test_the_graph_is_that_of_the_last_identities(histories, ids):
    """Also where tracks change places, all at once, claim one landmark together, or end as none."""
    last = [SURE[4], SURE[5], SURE[7] if 7 in ids else NONE]
    believed, known = (
        Watch(identity=UNGATED, kernel=RobustKernel(width=2.0)) for _ in range(2)
    )
    for number in range(FRAMES):
        believed.watch(number, histories[number] if number < FRAMES - 1 else last)
        known.watch(number, last)
    assert_same_factors(
        believed.smoother.graph, known.smoother.graph, known.smoother.values
    )
    assert believed.sightings.landmarks.ids == ids
    log = believed.sightings.journal.log()
    outcomes = np.reshape(log.outcomes, (FRAMES, 3))[:, : len(ids)]
    assert set(outcomes.ravel()) <= {USED, NEW, *LATE}
    named = log.landmark_ids.reshape(FRAMES, 3)[:, : len(ids)]
    assert named.tolist() == [ids] * FRAMES


CUT = {
    "robust": {},
    "associate": POLICIES["associate"],
    "remembered": {
        "history__policy": "bounded",
        "history__remembered_s": 40.0,
        "smoother__lag_s": 3.0,
    },
    "bounded gate that associates": {
        "identity__policy": "gate",
        "identity__unknown__policy": "associate",
        "identity__longest_wait_s": 2.0,
        "history__policy": "bounded",
        "smoother__lag_s": 3.0,
    },
    "max-mixture, short": {"identity__policy": "max-mixture", "smoother__lag_s": 3.0},
}
SELDOM_HZ = 0.1


def answers(
    policy: str, seed: int | None, source: type[Odometry] = Odometry
) -> EstimatorRun:
    """At tens of seconds, of identities that are late, wrong and missing.

    Calls every ten seconds, with one request at the end; with a seed also calls a quarter to two seconds apart:
    requests come at every eighth call and every third frame. Frames fall on epochs, between rows of the IMU.
    """
    sequence = simulate_basin(
        BasinOptions(**BASIN, **TROUBLES["late and wrong"], anonymous_share=0.3)
    )
    frames_ns = np.unique(sequence.detections.stamps_ns)
    dvl_ns = sequence.dvl.stamps_ns.copy()
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
def test_no_bit_depends_on_how_a_log_is_cut_into_calls_or_on_questions(policy):
    seldom = answers(policy, None)
    assert len(seldom.estimates) > 10
    assert unlike(seldom, answers(policy, 1)) == []


WAITING = Outcome.WAITING
USED_LATER = Outcome.USED_LATER
FORGOTTEN = Outcome.FORGOTTEN
TAKEN_BACK = Outcome.TAKEN_BACK
DOUBTFUL = [0.1, 0.6, 0.1, 0.1]
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


NODES = 10
ROWS = len(rail(NODES)[1].ranges)
BELIEFS_OF_REPEATED_TRACKS = [*SURE.values(), FLAT, NONE, [0.0, 0.9, 0.0, 0.05]]


def said(tracks: list[int], beliefs: list[list[float]]) -> Sequence:
    sequence = rail(NODES)[0]
    ids = np.tile(IDS, (ROWS, 1))
    stated = {
        "track": np.array(tracks),
        "candidate_ids": ids,
        "id_probability": np.array(beliefs, dtype=float),
    }
    return replace(sequence, detections=replace(sequence.detections, **stated))


@pytest.mark.parametrize("policy", ["robust", "gate", "max-mixture"])
@settings(max_examples=4, phases=[Phase.explicit, Phase.generate])
@given(
    st.lists(st.integers(NO_TRACK, 1), min_size=ROWS, max_size=ROWS),
    st.lists(st.sampled_from(BELIEFS_OF_REPEATED_TRACKS), min_size=ROWS, max_size=ROWS),
)
def test_a_run_is_that_without_second_rows_of_tracks(policy, tracks, beliefs):
    sequence = said(tracks, beliefs)
    seen = sequence.detections
    of_policy = {"keyframes__motion_noise_share": 0.0} | POLICIES[policy]
    estimator = run(sequence, 1 / STEP_S, **of_policy)
    outcomes = estimator.detections().outcomes
    is_kept = np.array([why is not Outcome.TRACK_REPEATED for why in outcomes])
    may_be_used = {
        (stamp_ns, track if track != NO_TRACK else -2 - row)
        for row, (stamp_ns, track) in enumerate(
            zip(seen.stamps_ns, tracks, strict=True)
        )
    }
    assert len(outcomes) == ROWS
    assert is_kept.sum() == len(may_be_used)
    without = replace(sequence, detections=seen.rows(is_kept))
    alone = run(without, 1 / STEP_S, **of_policy)
    assert np.array_equal(estimator.landmarks().ids, alone.landmarks().ids)
    for one, other in (
        (estimator.landmarks(), alone.landmarks()),
        (estimator.trajectory(), alone.trajectory()),
    ):
        assert np.array_equal(one.positions, other.positions)
