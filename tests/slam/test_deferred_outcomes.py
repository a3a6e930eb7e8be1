"""What is said of detections that wait: used later, moved, taken back, refused or forgotten."""

import gtsam
from gtsam.symbol_shorthand import L

from sonar_graph.slam.smoother import incremental as smoother_module
from sonar_graph.slam.smoother.incremental import Smoother
from sonar_graph.states import Outcome

from .dive import NS, T0_NS, TRUSTING, UNGATED, Dive
from .late_identities import FLAT, SURE, Watch, see
from .made import smoother_with


def test_what_waits_too_long_is_dropped_and_said():
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": 2.0}))
    for after_s in (0.0, 1.0, 2.5):
        see(dive, after_s, FLAT)
    assert dive.outcomes == [Outcome.FORGOTTEN, Outcome.WAITING, Outcome.WAITING]
    see(dive, 3.0, SURE[5])
    assert dive.outcomes == [Outcome.FORGOTTEN, Outcome.USED_LATER, Outcome.USED_LATER, Outcome.USED]
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": 2.0}))
    see(dive, 0.0, FLAT)
    dive.keyframes.advance(T0_NS + 5 * NS)
    dive.sightings.forget()
    assert dive.outcomes == [Outcome.FORGOTTEN]
    assert not dive.sightings.ids


def test_what_is_of_no_landmark_to_the_end_is_said_to_have_no_identity():
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": 2.0}))
    see(dive, 0.0, FLAT)
    see(dive, 1.0, [0.05] * 4)
    assert dive.outcomes == [Outcome.WAITING, Outcome.WAITING]
    dive.keyframes.advance(T0_NS + 5 * NS)
    dive.sightings.forget()
    assert dive.outcomes == [Outcome.NO_IDENTITY, Outcome.NO_IDENTITY]


def test_what_was_taken_back_is_given_to_no_other_landmark_after_too_long():
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": 2.0}))
    see(dive, 0.0, SURE[5])
    see(dive, 1.0, FLAT)
    see(dive, 1.5, [0.0] * 4)
    see(dive, 2.6, SURE[5])
    assert dive.outcomes == [Outcome.TAKEN_BACK, Outcome.USED_LATER, Outcome.USED_LATER, Outcome.USED]


def test_a_track_that_is_over_keeps_its_identity():
    dive = Dive(identity=TRUSTING.model_copy(update={"longest_wait_s": 1.0}))
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
    dive = Watch(identity=UNGATED)
    dive.watch(0, [FLAT, FLAT, FLAT])
    dive.watch(1, [[0.0, 0.8, 0.0, 0.0], SURE[5], FLAT])
    repeated, later = Outcome.REPEATED, Outcome.USED_LATER
    assert dive.outcomes == [repeated, later, Outcome.WAITING, repeated, Outcome.USED, Outcome.WAITING]


def test_a_landmark_may_begin_late_while_what_waits_makes_the_window_restart(monkeypatch):
    monkeypatch.setattr(smoother_module, "FIRST_RESTART", 5)
    dive = Dive(smoother=smoother_with(1e9, 1e-6, 1e-9, waiting_gain=1e9))
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
