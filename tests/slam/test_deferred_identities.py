"""Identities that come late, change, or never come: the graph is that of the last beliefs, whatever came before."""

from collections import Counter
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L
from hypothesis import given, settings
from hypothesis import strategies as st

import sonar_graph.slam.smoother as smoother_module
from sonar_graph.calibration import FloorPrior
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.sequence import NS_PER_S, Sequence
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam.isam2 import Isam2, Isam2Params
from sonar_graph.slam.smoother import Smoother
from sonar_graph.states import Outcome

from .rail import STEP_S, rail
from .test_sightings import CALIBRATION, NS, T0_NS, TRUSTING, Dive, spherical

FLAT = [0.2, 0.2, 0.2, 0.2]
IDS = [4, 5, 6, 7]
LATE = {Outcome.USED_LATER, Outcome.MOVED}


def believing(sequence: Sequence, id_probability: Floats) -> Sequence:
    assert sequence.detections is not None
    return replace(sequence, detections=replace(sequence.detections, id_probability=id_probability))


def from_the_start(sequence: Sequence) -> Sequence:
    """The same, had each track's last belief been its first."""
    seen = sequence.detections
    assert seen is not None
    beliefs = seen.id_probability.copy()
    for number in set(seen.track.tolist()) - {-1}:
        rows = np.flatnonzero(seen.track == number)
        beliefs[rows] = beliefs[rows[-1]]
    return believing(sequence, beliefs)


def run(sequence: Sequence, rate_hz: float = 2.0, **params) -> Isam2:
    estimator = Isam2(sequence.calibration, Isam2Params(**params))
    for step in sequence.replay(sequence.instants(rate_hz)):
        estimator.process(step)
    return estimator


def rows_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> dict[tuple, list[Floats]]:
    """Each factor by its kind and variables: whitened error and derivatives at some values."""
    found: dict[tuple, list[Floats]] = {}
    for i in range(graph.size()):
        factor = graph.at(i)
        A, b = factor.linearize(values).jacobian()
        found.setdefault((type(factor).__name__, *factor.keys()), []).append(np.column_stack([A, b]))
    return {name: sorted(rows, key=lambda row: tuple(row.ravel())) for name, rows in found.items()}


def largest_difference(one: Isam2, other: Isam2) -> float:
    """Between equal factors of two graphs, in standard deviations of what they measure; at the values of one."""
    values, _ = other._smoother.solve_history()
    a, b = rows_of(one.graph, values), rows_of(other.graph, values)
    assert {name: len(rows) for name, rows in a.items()} == {name: len(rows) for name, rows in b.items()}
    return max(
        np.abs(x - y).max() / max(1.0, np.abs(y).max()) for name in a for x, y in zip(a[name], b[name], strict=True)
    )


def assert_marginals_agree(one: Isam2, other: Isam2, tolerance: float) -> None:
    """Of every variable, at the values of one, in the units of its standard deviations."""
    values, _ = other._smoother.solve_history()
    a, b = (gtsam.Marginals(each.graph, values) for each in (one, other))
    for key in values.keys():  # noqa: SIM118  # gtsam.Values is no mapping
        P, Q = a.marginalCovariance(key), b.marginalCovariance(key)
        sigma = np.sqrt(np.diag(Q))
        assert np.abs((P - Q) / np.outer(sigma, sigma)).max() < tolerance


def assert_outcomes_account(estimator: Isam2, sequence: Sequence) -> Counter:
    """One row a detection, in order."""
    log = estimator.detections()
    assert sequence.detections is not None
    assert log.stamps_ns.tolist() == sequence.detections.stamps_ns.tolist()
    return Counter(log.outcomes)


# Where all is linear ------------------------------------------------------------------------------------------------


def on_the_rail(beliefs_of_7: list[list[float]], beliefs_of_4: list[float]) -> Sequence:
    """One track a landmark; what is believed of 7 in its first, second, ... frame, the last for the rest."""
    sequence, _ = rail()
    seen = sequence.detections
    assert seen is not None
    track = np.where(seen.candidate_ids[:, 0] == 7, 70, 40)
    beliefs = np.tile(np.array(beliefs_of_4), (len(seen), 1))
    for n, row in enumerate(np.flatnonzero(track == 70)):
        beliefs[row] = beliefs_of_7[min(n, len(beliefs_of_7) - 1)]
    ids = np.tile(IDS, (len(seen), 1))
    return replace(sequence, detections=replace(seen, candidate_ids=ids, id_probability=beliefs, track=track))


SURE = {i: [float(i == j) for j in IDS] for i in IDS}
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
    estimator = run(sequence, 1 / STEP_S, kernel="none", motion_noise_share=0.0, lag_s=lag_s)
    known = run(from_the_start(sequence), 1 / STEP_S, kernel="none", motion_noise_share=0.0, lag_s=lag_s)
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
    estimator = run(wrong, 1 / STEP_S, kernel="none", deferred_identity=False)
    assert estimator.landmarks().ids.tolist() == [4, 6, 7]
    late = on_the_rail(HISTORIES["late"], NEARLY_4)
    estimator = run(late, 1 / STEP_S, kernel="none", deferred_identity=False)
    assert Counter(estimator.detections().outcomes)[Outcome.NO_IDENTITY] == 6
    assert abs(estimator.landmarks().positions[1, 0] - mean["l7"]) > 2e-4


# In the basin -------------------------------------------------------------------------------------------------------


BASIN = {"duration_s": 130.0, "laps": 1, "seed": 3, "tracks": True}
TROUBLES = {
    "late": {"id_delay_s": 4.0},
    "wrong": {"wrong_id_rate": 1.0, "wrong_id_share": 0.8},
    "late and wrong": {"id_delay_s": 2.0, "wrong_id_rate": 1.0, "wrong_id_share": 0.6},
}


@pytest.mark.parametrize("lag_s", [15.0, 2.0])
@pytest.mark.parametrize("trouble", TROUBLES)
def test_what_is_known_late_gives_the_graph_of_what_was_known_from_the_start(trouble: str, lag_s: float):
    """Without a gyro bias no factor depends on an estimate: equal one by one, and so are the marginals."""
    sequence = simulate_basin(BasinOptions(**BASIN, **TROUBLES[trouble], gyro_bias_scale=0.0))
    estimator, known = run(sequence, lag_s=lag_s), run(from_the_start(sequence), lag_s=lag_s)
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
    estimator, known = run(sequence, deferred_identity=False), run(from_the_start(sequence))
    names = [rows_of(each.graph, each.values).keys() for each in (estimator, known)]
    assert names[0] != names[1]
    assert Counter(estimator.detections().outcomes).keys().isdisjoint(LATE)


# Any history of beliefs ---------------------------------------------------------------------------------------------


OBJECTS = np.array([[4.0, 0.8, -1.4], [5.0, 0.2, -1.6], [4.5, 1.6, -1.5]])
BELIEFS = st.sampled_from([SURE[4], SURE[5], SURE[6], [0.9, 0, 0, 0], FLAT, [0.0] * 4])
FRAMES, GAP_S = 6, 0.7


class Watch(Dive):
    """Three objects, each watched in every frame."""

    def watch(self, number: int, beliefs: list[list[float]]) -> None:
        stamp = T0_NS + round(number * GAP_S * NS)
        z = np.array([spherical(0.5 * number * GAP_S, p) for p in OBJECTS])
        self.keyframes.advance(stamp)
        self.sightings.add(detected(stamp, z, beliefs, np.arange(3)))
        self.keyframes.update_if_due()


def detected(stamp: int, z: Floats, beliefs: list[list[float]], track) -> LandmarkDetections:
    n = len(z)
    ids = np.tile(IDS, (n, 1))
    return LandmarkDetections(
        np.full(n, stamp), z[:, 0], z[:, 1], np.full((n, 2, 2), np.nan), ids, np.array(beliefs, float), np.array(track)
    )


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(BELIEFS, min_size=3, max_size=3), min_size=FRAMES - 1, max_size=FRAMES - 1))
def test_whatever_was_believed_before_the_graph_is_that_of_the_last_beliefs(histories: list[list[list[float]]]):
    """Also where tracks change places, all at once, or claim one landmark together."""
    last = [SURE[4], SURE[5], SURE[7]]
    believed, known = (Watch(policy=replace(TRUSTING, gate_probability=1.0, kernel="cauchy")) for _ in range(2))
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


# Bounds and refusals ------------------------------------------------------------------------------------------------


def see(dive: Dive, after_s: float, belief: list[float], track: int = 3, off_m: float = 0.0) -> None:
    stamp = T0_NS + round(after_s * NS)
    range_m, azimuth_rad = spherical(0.5 * after_s, OBJECTS[0])
    dive.keyframes.advance(stamp)
    dive.sightings.add(detected(stamp, np.array([[range_m + off_m, azimuth_rad]]), [belief], [track]))


def test_what_waits_too_long_is_dropped_and_said():
    dive = Dive(policy=replace(TRUSTING, longest_wait_s=2.0))
    for after_s in (0.0, 1.0, 2.5):
        see(dive, after_s, FLAT)
    assert dive.outcomes == [Outcome.FORGOTTEN, Outcome.WAITING, Outcome.WAITING]
    see(dive, 3.0, SURE[5])
    assert dive.outcomes == [Outcome.FORGOTTEN, Outcome.USED_LATER, Outcome.USED_LATER, Outcome.USED]
    dive = Dive(policy=replace(TRUSTING, longest_wait_s=2.0))
    see(dive, 0.0, FLAT)
    dive.keyframes.advance(T0_NS + 5 * NS)
    dive.sightings.forget()
    assert dive.outcomes == [Outcome.FORGOTTEN]
    assert not dive.sightings.ids


def test_what_is_of_no_landmark_to_the_end_is_said_to_have_no_identity():
    dive = Dive(policy=replace(TRUSTING, longest_wait_s=2.0))
    see(dive, 0.0, FLAT)
    see(dive, 1.0, [0.05] * 4)
    assert dive.outcomes == [Outcome.WAITING, Outcome.WAITING]
    dive.keyframes.advance(T0_NS + 5 * NS)
    dive.sightings.forget()
    assert dive.outcomes == [Outcome.NO_IDENTITY, Outcome.NO_IDENTITY]


def test_what_was_taken_back_is_given_to_no_other_landmark_after_too_long():
    dive = Dive(policy=replace(TRUSTING, longest_wait_s=2.0))
    see(dive, 0.0, SURE[5])
    see(dive, 1.0, FLAT)
    see(dive, 1.5, [0.0] * 4)
    see(dive, 2.6, SURE[5])
    assert dive.outcomes == [Outcome.TAKEN_BACK, Outcome.USED_LATER, Outcome.USED_LATER, Outcome.USED]


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


def test_a_track_that_is_over_keeps_its_identity():
    dive = Dive(policy=replace(TRUSTING, longest_wait_s=1.0))
    see(dive, 0.0, SURE[5])
    see(dive, 2.0, SURE[6])
    assert dive.outcomes == [Outcome.NEW, Outcome.NEW]


def test_a_track_of_no_known_landmark_is_taken_back_with_its_landmark():
    dive = Dive()
    before = dive.smoother.graph.size()
    see(dive, 0.0, SURE[5])
    see(dive, 0.5, SURE[5])
    assert dive.sightings.ids == {5}
    see(dive, 1.0, [0.05] * 4)
    assert dive.outcomes == [Outcome.TAKEN_BACK, Outcome.TAKEN_BACK, Outcome.WAITING]
    assert not dive.sightings.ids
    assert not dive.smoother.values.exists(L(5))
    assert {gtsam.Symbol(key).chr() for key in dive.smoother.graph.keyVector()} == {ord("x")}
    assert dive.smoother.graph.size() == before + len(dive.keyframes.stamps_ns)


def test_a_doubtful_row_of_a_known_track_waits_for_the_next_sure_one():
    dive = Dive()
    see(dive, 0.0, SURE[5])
    see(dive, 0.5, [0.1, 0.6, 0.1, 0.1])
    assert dive.outcomes == [Outcome.NEW, Outcome.WAITING]
    see(dive, 1.0, SURE[5])
    assert dive.outcomes == [Outcome.NEW, Outcome.USED_LATER, Outcome.USED]


def test_what_was_refused_for_one_landmark_is_not_refused_for_good():
    dive = Dive()
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[5])
    see(dive, 0.6, SURE[5], off_m=0.5)
    assert dive.outcomes[-1] == Outcome.GATED
    see(dive, 0.8, [0.0] * 4)
    assert dive.outcomes == [Outcome.TAKEN_BACK] * 3 + [Outcome.WAITING] * 2
    see(dive, 1.0, SURE[6])
    assert dive.outcomes[:5] == [Outcome.MOVED] * 3 + [Outcome.USED_LATER] * 2


def test_of_tracks_that_claim_a_landmark_at_once_the_more_probable_gets_the_earlier_frames():
    dive = Watch(policy=replace(TRUSTING, gate_probability=1.0))
    dive.watch(0, [FLAT, FLAT, FLAT])
    dive.watch(1, [[0.0, 0.8, 0.0, 0.0], SURE[5], FLAT])
    repeated, later = Outcome.REPEATED, Outcome.USED_LATER
    assert dive.outcomes == [repeated, later, Outcome.WAITING, repeated, Outcome.USED, Outcome.WAITING]


def test_a_displaced_sighting_is_used_when_its_place_becomes_free_though_its_track_is_gone():
    dive = Watch(policy=replace(TRUSTING, gate_probability=1.0))
    known = Watch(policy=replace(TRUSTING, gate_probability=1.0))
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


def test_a_landmark_may_begin_late_while_what_waits_makes_the_window_restart(monkeypatch):
    monkeypatch.setattr(smoother_module, "FIRST_RESTART", 5)
    dive = Dive(smoother=Smoother(1e9, 1e-6, 1e-9, greatest_waiting_gain=1e9))
    restarts = []
    restart = Smoother._restart
    monkeypatch.setattr(Smoother, "_restart", lambda self, time_s: restarts.append(time_s) or restart(self, time_s))
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[4])
        see(dive, after_s + 0.1, FLAT, track=5, off_m=0.3)
    see(dive, 0.6, SURE[6], track=5, off_m=0.3)
    assert restarts
    assert dive.outcomes[1::2] == [Outcome.USED_LATER] * 3
    assert dive.sightings.ids == {4, 6}


def test_late_sightings_pass_the_gate_one_by_one():
    dive = Dive()
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[5])
    see(dive, 1.0, FLAT, track=4)
    see(dive, 1.2, FLAT, track=4, off_m=0.5)
    see(dive, 1.4, SURE[5], track=4)
    assert dive.outcomes[3:] == [Outcome.USED_LATER, Outcome.GATED, Outcome.USED]


def test_while_sightings_wait_the_window_stays_open_for_them(monkeypatch):
    """Late factors then cost no solution of the history; of a track that is of no landmark they may."""
    solves = []
    solve = Smoother._solve
    monkeypatch.setattr(Smoother, "_solve", lambda self: solves.append(1) or solve(self))
    for beliefs, expected in (([FLAT] * 9, 0), ([FLAT] * 2 + [[0.0] * 4] * 7, 1)):
        dive = Dive(lag_s=0.5)
        solves.clear()
        for k, belief in enumerate([*beliefs, SURE[5]]):
            see(dive, float(k), belief)
        assert len(solves) == expected
        assert dive.outcomes == [Outcome.USED_LATER] * 9 + [Outcome.USED]


def test_late_sightings_pass_the_gate_at_keyframes_that_have_left_the_window():
    dive = Dive(lag_s=0.5)
    for after_s in (0.0, 0.2, 0.4):
        see(dive, after_s, SURE[5])
    for after_s, off_m in ((6.0, 0.0), (6.2, 3.0)):
        see(dive, after_s, SURE[6], track=4, off_m=off_m)
    see(dive, 9.0, SURE[5], track=4)
    assert dive.outcomes[3:] == [Outcome.MOVED, Outcome.GATED, Outcome.USED]


def test_detections_of_no_track_are_dealt_with_at_once():
    dive = Dive()
    see(dive, 0.0, FLAT, track=-1)
    see(dive, 0.5, SURE[5], track=-1)
    see(dive, 1.0, SURE[6], track=-1)
    assert dive.outcomes == [Outcome.NO_IDENTITY, Outcome.NEW, Outcome.NEW]


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
        estimator = Isam2(each.calibration, Isam2Params(waiting_gain=0.0, lag_s=1e6))
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
