"""Frames in which a track has several rows: one is used, and the run is that without the others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from sonar_graph.measurements import NO_TRACK, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.slam import frontend as sightings_module
from sonar_graph.slam.isam2 import Isam2
from sonar_graph.slam.landmarks.tracked import NO_LANDMARK, UNDECIDED, best_of_tracks, of_no_landmark, once_a_track
from sonar_graph.states import DetectionJournal, Outcome

from .late_identities import FLAT, IDS, SURE, assert_outcomes_account, run
from .rail import STEP_S, rail

POLICIES = {
    "robust": {},
    "gate": {"identity__policy": "gate", "identity__gate_probability": 0.99},
    "bounded": {"history__policy": "bounded", "smoother__lag_s": 3.0},
    "short": {"smoother__lag_s": 1.6},
    "associate": {"identity__unknown__policy": "associate"},
    "max-mixture": {"identity__policy": "max-mixture"},
    "gnc": {"identity__policy": "gnc"},
}
NODES = 10
ROWS = len(rail(NODES)[1].ranges)
BELIEFS = [*SURE.values(), FLAT, [0.0] * 4, [0.0, 0.9, 0.0, 0.05]]


def said(tracks: list[int], beliefs: list[list[float]]) -> Sequence:
    sequence, _ = rail(NODES)
    seen = sequence.detections
    assert seen is not None
    ids = np.tile(IDS, (len(seen), 1))
    found = replace(seen, track=np.array(tracks), candidate_ids=ids, id_probability=np.array(beliefs, dtype=float))
    return replace(sequence, detections=found)


def result(estimator: Isam2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    smoothed, landmarks = estimator.trajectory(), estimator.landmarks()
    return landmarks.ids, landmarks.positions, smoothed.positions


@pytest.mark.parametrize("policy", POLICIES)
@settings(max_examples=4, phases=[Phase.explicit, Phase.generate])
@given(data=st.data())
def test_a_run_is_that_without_second_rows_of_tracks(policy: str, data: st.DataObject):
    tracks = data.draw(st.lists(st.integers(NO_TRACK, 1), min_size=ROWS, max_size=ROWS))
    beliefs = data.draw(st.lists(st.sampled_from(BELIEFS), min_size=ROWS, max_size=ROWS))
    sequence = said(tracks, beliefs)
    with pytest.MonkeyPatch.context() as monkeypatch:
        heard = Heard(monkeypatch)
        estimator = run(sequence, 1 / STEP_S, keyframes__motion_noise_share=0.0, **POLICIES[policy])
    outcomes = assert_outcomes_account(estimator, sequence)
    assert outcomes[Outcome.TRACK_REPEATED] == ROWS - len(once(sequence))
    without = replace(sequence, detections=LandmarkDetections.concatenate(heard.rows))
    alone = run(without, 1 / STEP_S, keyframes__motion_noise_share=0.0, **POLICIES[policy])
    for with_others, known in zip(result(estimator), result(alone), strict=True):
        assert np.array_equal(with_others, known)


def once(sequence: Sequence) -> set[tuple[int, int]]:
    """What may be used: each track once a frame, and all rows of none."""
    seen = sequence.detections
    assert seen is not None
    pairs = zip(seen.stamps_ns.tolist(), seen.track.tolist(), range(len(seen)), strict=True)
    return {(stamp_ns, track if track != NO_TRACK else -2 - row) for stamp_ns, track, row in pairs}


class Heard:
    """Keeps what the estimator's sightings are given once second rows are gone."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rows: list[LandmarkDetections] = []
        monkeypatch.setattr(sightings_module, "once_a_track", self._once)

    def _once(self, *arguments) -> LandmarkDetections:
        self.rows.append(once_a_track(*arguments))
        return self.rows[-1]


def frame(track: list[int], beliefs: list[list[float]]) -> LandmarkDetections:
    n = len(track)
    stamps, covs = np.zeros(n, dtype=np.int64), np.full((n, 2, 2), np.nan)
    ids = np.tile(IDS, (n, 1))
    return LandmarkDetections(stamps, np.ones(n), np.zeros(n), covs, ids, np.array(beliefs, float), np.array(track))


def test_the_row_stays_that_the_tracks_identity_explains_best():
    rows = frame([3, 3, NO_TRACK, 8], [[0.9, 0, 0, 0], [0, 0, 0.8, 0], SURE[4], FLAT])
    assert best_of_tracks(rows, lambda _: 6).tolist() == [False, True, True, True]
    assert best_of_tracks(rows, lambda _: 4).tolist() == [True, False, True, True]


def test_of_a_track_that_counts_as_nothing_the_most_probable_row_stays_and_of_equals_the_first():
    rows = frame([3, 3, 3, NO_TRACK, NO_TRACK], [FLAT, [0, 0.8, 0, 0], [0, 0, 0.8, 0], FLAT, FLAT])
    assert best_of_tracks(rows, of_no_landmark).tolist() == [False, True, False, True, True]


def test_an_identity_that_a_row_names_twice_has_the_sum_of_both_posteriors():
    rows = replace(frame([3, 3], [[0, 0.6, 0, 0], [0.4, 0.4, 0, 0]]), candidate_ids=np.zeros((2, 4), int))
    assert best_of_tracks(rows, lambda _: 0).tolist() == [False, True]


def test_rows_that_are_not_used_stand_in_the_journal_with_frame_identity_and_reason():
    rows, journal = frame([-7, -7, NO_TRACK, -7], [SURE[4], SURE[6], SURE[7], SURE[5]]), DetectionJournal()
    rows = replace(rows, stamps_ns=np.full(4, 8))
    kept, log = once_a_track(rows, lambda _: 6, journal), journal.log()
    assert kept.most_probable()[0].tolist() == [6, 7]
    assert (log.stamps_ns.tolist(), log.landmark_ids.tolist()) == ([8, 8], [4, 5])
    assert log.outcomes == [Outcome.TRACK_REPEATED] * 2


@pytest.mark.parametrize("counts_as", [UNDECIDED, NO_LANDMARK])
def test_the_posterior_of_no_identity_speaks_for_no_row(counts_as: int):
    rows = replace(frame([3, 3], [[0.9, 0.1, 0, 0], [0, 0.5, 0, 0]]), candidate_ids=np.array([[-1, *IDS[1:]]] * 2))
    assert best_of_tracks(rows, lambda _: counts_as).tolist() == [False, True]


def test_where_tracks_are_not_used_all_rows_are():
    sequence = said([0] * ROWS, [SURE[4] if i == 0 else SURE[7] for i in first_of_frame()])
    outcomes = assert_outcomes_account(run(sequence, 1 / STEP_S, identity__longest_wait_s=0), sequence)
    assert outcomes[Outcome.TRACK_REPEATED] == 0
    assert outcomes[Outcome.USED] + outcomes[Outcome.NEW] == ROWS


def first_of_frame() -> list[int]:
    """Place of each of the rail's rows in its frame."""
    seen = rail(NODES)[0].detections
    assert seen is not None
    return [int(np.count_nonzero(seen.stamps_ns[:row] == seen.stamps_ns[row])) for row in range(len(seen))]


@pytest.mark.parametrize("policy", POLICIES)
def test_two_rows_of_a_known_track_that_name_others_do_not_end_the_run(policy: str):
    tracks = [40 if i == 0 else 70 for i in first_of_frame()]
    beliefs = [SURE[4] if i == 0 else SURE[7] for i in first_of_frame()]
    two = [row for row, i in enumerate(first_of_frame()) if i == 1][1]
    tracks[two], beliefs[two - 1], beliefs[two] = 40, SURE[5], SURE[6]
    sequence = said(tracks, beliefs)
    outcomes = assert_outcomes_account(run(sequence, 1 / STEP_S, **POLICIES[policy]), sequence)
    assert outcomes[Outcome.TRACK_REPEATED] == 1
