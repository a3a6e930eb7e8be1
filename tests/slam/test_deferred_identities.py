"""Identities that come late, change, or never come: the graph is that of the last beliefs, whatever came before."""

from collections import Counter

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import FloorPrior
from sonar_graph.sequence import NS_PER_S
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2, RobustKernel
from sonar_graph.states import Outcome

from .dive import CALIBRATION, UNGATED, Dive
from .graph_comparison import assert_marginals_agree, largest_difference, rows_of
from .late_identities import (
    BASIN,
    FLAT,
    GAP_S,
    LATE,
    OBJECTS,
    SURE,
    TROUBLES,
    Watch,
    assert_outcomes_account,
    from_the_start,
    on_the_rail,
    run,
    see,
)
from .made import isam2_params
from .rail import STEP_S, rail

NEARLY_4 = [0.9, 0.0, 0.0, 0.0]
HISTORIES = {
    "late": [FLAT] * 6 + [SURE[7]],
    "another that is new": [SURE[5]] * 6 + [SURE[7]],
    "another that is seen beside it, less surely": [SURE[4]] * 6 + [SURE[7]],
    "undecided, wrong, wrong, none, right": [FLAT] * 2 + [SURE[5]] * 3 + [SURE[6]] * 3 + [[0.0] * 4] * 2 + [SURE[7]],
    "wrong to the frame before the last": [SURE[6]] * 14 + [SURE[7]],
}


@pytest.mark.parametrize("lag_s", [1e9, 2.6, 0.6], ids=["all", "five poses", "one pose"])
@pytest.mark.parametrize("history", HISTORIES)
def test_on_the_rail_the_end_is_least_squares_with_the_right_identities(history: str, lag_s: float):
    """Poses, landmarks and their variances as numpy has them but for the little that a first direction weighs.

    As known from the start to 1e-8, and the window's landmarks to 1e-6.
    """
    _, numbers = rail()
    nodes = len(numbers.displacements_m) + 1
    mean, variance = numbers.solution(nodes)
    sequence = on_the_rail(HISTORIES[history], NEARLY_4)
    estimator = run(
        sequence, 1 / STEP_S, kernel__shape="none", keyframes__motion_noise_share=0.0, smoother__lag_s=lag_s
    )
    known = run(
        from_the_start(sequence),
        1 / STEP_S,
        kernel__shape="none",
        keyframes__motion_noise_share=0.0,
        smoother__lag_s=lag_s,
    )
    smoothed, landmarks = estimator.trajectory(), estimator.landmarks()
    assert smoothed.positions[:, 0] == pytest.approx([mean[f"x{k}"] for k in range(1, nodes)], abs=2e-4)
    assert smoothed.positions[:, 0] == pytest.approx(known.trajectory().positions[:, 0], abs=1e-8)
    assert smoothed.covariances[:, 3, 3] == pytest.approx(known.trajectory().covariances[:, 3, 3], rel=1e-6)
    assert landmarks.ids.tolist() == [4, 7]
    assert landmarks.positions[:, 0] == pytest.approx([mean["l4"], mean["l7"]], abs=2e-4)
    assert landmarks.covariances[:, 0, 0] == pytest.approx([variance["l4"], variance["l7"]], rel=1e-3)
    assert estimator.values.atPoint3(L(7)) == pytest.approx(known.values.atPoint3(L(7)), abs=1e-6)
    outcomes = assert_outcomes_account(estimator, sequence)
    assert sum(outcomes[used] for used in (Outcome.USED, Outcome.NEW, *LATE)) == len(numbers.ranges)


def test_without_deferring_the_rail_does_not_end_there():
    _, numbers = rail()
    mean, _ = numbers.solution(len(numbers.displacements_m) + 1)
    wrong = on_the_rail(HISTORIES["wrong to the frame before the last"], NEARLY_4)
    estimator = run(wrong, 1 / STEP_S, kernel__shape="none", identity__longest_wait_s=0)
    assert estimator.landmarks().ids.tolist() == [4, 6, 7]
    late = on_the_rail(HISTORIES["late"], NEARLY_4)
    estimator = run(late, 1 / STEP_S, kernel__shape="none", identity__longest_wait_s=0)
    assert Counter(estimator.detections().outcomes)[Outcome.NO_IDENTITY] == 6
    assert abs(estimator.landmarks().positions[1, 0] - mean["l7"]) > 2e-4


@pytest.mark.parametrize("lag_s", [15.0, 2.0])
@pytest.mark.parametrize("trouble", TROUBLES)
def test_what_is_known_late_gives_the_graph_of_what_was_known_from_the_start(trouble: str, lag_s: float):
    """Without a gyro bias no factor depends on an estimate: equal one by one, and so are the marginals."""
    sequence = simulate_basin(BasinOptions(**BASIN, **TROUBLES[trouble], gyro_bias_scale=0.0))
    estimator, known = run(sequence, smoother__lag_s=lag_s), run(from_the_start(sequence), smoother__lag_s=lag_s)
    assert largest_difference(estimator, known) < 1e-6
    assert_marginals_agree(estimator, known, 1e-6)
    assert assert_outcomes_account(estimator, sequence).keys() & LATE
    assert not assert_outcomes_account(known, sequence).keys() & LATE


@pytest.mark.parametrize("trouble", TROUBLES)
def test_with_a_gyro_bias_the_graphs_differ_by_where_odometry_was_linearised(trouble: str):
    """Marginals to 1e-6 all the same, and the solutions to a hundredth of a standard deviation."""
    sequence = simulate_basin(BasinOptions(**BASIN, **TROUBLES[trouble]))
    estimator, known = run(sequence), run(from_the_start(sequence))
    assert largest_difference(estimator, known) < 1e-3
    assert_marginals_agree(estimator, known, 1e-6)
    one, other = estimator.trajectory(), known.trajectory()
    sigma = np.sqrt(np.einsum("nii->ni", other.covariances)[:, 3:])
    assert np.abs((one.positions - other.positions) / sigma).max() < 0.01


def test_a_wrong_identity_that_is_not_taken_back_leaves_another_graph():
    sequence = simulate_basin(BasinOptions(**BASIN, **TROUBLES["wrong"], gyro_bias_scale=0.0))
    estimator, known = run(sequence, identity__longest_wait_s=0), run(from_the_start(sequence))
    names = [rows_of(each.graph, each.values).keys() for each in (estimator, known)]
    assert names[0] != names[1]
    assert Counter(estimator.detections().outcomes).keys().isdisjoint(LATE)


BELIEFS = st.sampled_from([SURE[4], SURE[5], SURE[6], [0.9, 0, 0, 0], FLAT, [0.0] * 4])
FRAMES = 6


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(BELIEFS, min_size=3, max_size=3), min_size=FRAMES - 1, max_size=FRAMES - 1))
def test_whatever_was_believed_before_the_graph_is_that_of_the_last_beliefs(histories: list[list[list[float]]]):
    """Also where tracks change places, all at once, or claim one landmark together."""
    last = [SURE[4], SURE[5], SURE[7]]
    believed, known = (Watch(identity=UNGATED, kernel=RobustKernel(width=2.0)) for _ in range(2))
    for number in range(FRAMES):
        believed.watch(number, histories[number] if number < FRAMES - 1 else last)
        known.watch(number, last)
    values = known.smoother.values
    a, b = rows_of(believed.smoother.graph, values), rows_of(known.smoother.graph, values)
    assert a.keys() == b.keys()
    for name, rows in b.items():
        np.testing.assert_allclose(a[name], rows, atol=1e-7 * max(1.0, np.abs(rows).max()))
    assert believed.sightings.ids == {4, 5, 7}
    assert len(believed.outcomes) == 3 * FRAMES
    assert set(believed.outcomes) <= {Outcome.USED, Outcome.NEW, *LATE}
    ids = believed.sightings.journal.log().landmark_ids
    assert ids.tolist() == [4, 5, 7] * FRAMES


def test_whether_it_stands_on_the_floor_is_judged_where_it_was_seen():
    """An object high above the floor and one on it, known late: what is said of heights is as if known at once."""
    for height_m, factors_on_height in ((OBJECTS[0][2] - 1.2, 0), (OBJECTS[0][2], 1)):
        floor = FloorPrior(z_m=height_m, sigma_m=0.01)
        late, known = (Dive(CALIBRATION.model_copy(update={"floor": floor})) for _ in range(2))
        for dive, first in ((late, FLAT), (known, SURE[5])):
            see(dive, 0.0, first)
            see(dive, 0.5, SURE[5])
        values = known.smoother.values
        a, b = rows_of(late.smoother.graph, values), rows_of(known.smoother.graph, values)
        assert {name: len(rows) for name, rows in a.items()} == {name: len(rows) for name, rows in b.items()}
        assert len(b.get(("PriorFactorPoint3", L(5)), [])) == factors_on_height


def test_a_displaced_sighting_is_used_when_its_place_becomes_free_though_its_track_is_gone():
    dive = Watch(identity=UNGATED)
    known = Watch(identity=UNGATED)
    for each, first in ((dive, SURE[5]), (known, SURE[4])):
        each.watch(0, [FLAT, SURE[5], FLAT])
        each.watch(1, [first, [0.0, 0.9, 0.0, 0.0], FLAT])
    assert dive.outcomes[3:5] == [Outcome.USED, Outcome.REPEATED]
    for each in (dive, known):
        see(each, 2 * GAP_S, SURE[4], track=0)
    assert dive.outcomes[3:5] == [Outcome.MOVED, Outcome.USED_LATER]
    values = known.smoother.values
    a, b = rows_of(dive.smoother.graph, values), rows_of(known.smoother.graph, values)
    assert a.keys() == b.keys()
    for name, rows in b.items():
        np.testing.assert_allclose(a[name], rows, atol=1e-7 * max(1.0, np.abs(rows).max()))


def test_an_earlier_sighting_becomes_the_one_that_a_landmark_begins_with():
    """Seen first without a track, then known to have been seen before: what is said once is said there."""
    dive = Dive()
    see(dive, 0.0, FLAT, track=4)
    see(dive, 0.5, SURE[5], track=-1)
    see(dive, 1.0, SURE[5], track=4)
    graph = dive.smoother.graph
    begun = [graph.at(i) for i in range(graph.size()) if isinstance(graph.at(i), gtsam.BearingRangeFactor3D)]
    assert [gtsam.Symbol(factor.keys()[0]).index() for factor in begun] == [0]
    assert dive.outcomes == [Outcome.USED_LATER, Outcome.NEW, Outcome.USED]


def test_the_causal_estimate_after_a_flip_does_not_wait_for_the_end():
    """Within a hundredth of a standard deviation of having known, right at the frame that says so."""
    sequence = simulate_basin(BasinOptions(**BASIN, **TROUBLES["wrong"]))
    ends = [{}, {}]
    for end, each in zip(ends, (sequence, from_the_start(sequence)), strict=True):
        estimator = Isam2(each.calibration, isam2_params(smoother__waiting_gain=0.0, smoother__lag_s=1e6))
        for step in each.replay(each.instants(2.0)):
            estimate = estimator.process(step)
            if estimate is not None:
                end[estimate.stamp_ns] = estimate
    last_ns = max(ends[1])
    for stamp_ns in (last_ns, last_ns - NS_PER_S):
        one, other = ends[0][stamp_ns], ends[1][stamp_ns]
        off = gtsam.Pose3.Logmap(other.world_T_body.between(one.world_T_body))
        assert np.abs(off / np.sqrt(np.diag(other.covariance))).max() < 0.05


def test_the_end_does_not_depend_on_how_the_log_is_cut():
    """Estimates at the whole seconds, asked for alone and among others."""
    sequence = simulate_basin(BasinOptions(**BASIN, **TROUBLES["late and wrong"]))
    estimators = [Isam2(sequence.calibration), Isam2(sequence.calibration)]
    found: list[dict[int, gtsam.Pose3]] = [{}, {}]
    for estimator, rate_hz, at in zip(estimators, (1.0, 4.0), found, strict=True):
        for step in sequence.replay(sequence.instants(rate_hz)):
            estimate = estimator.process(step)
            if estimate is not None:
                at[estimate.stamp_ns] = estimate.world_T_body
    shared = found[0].keys() & found[1].keys()
    assert len(shared) > 100
    assert max(np.abs(found[0][ns].matrix() - found[1][ns].matrix()).max() for ns in shared) < 1e-12
    assert estimators[0].detections().outcomes == estimators[1].detections().outcomes
