"""Landmarks that nothing but their place tells apart."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.slam.landmarks import unknown as module
from sonar_graph.slam.landmarks.joint_compatibility import UNPAIRED, Innovations, Pairing, pair_jointly
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome

from .graph_comparison import assert_marginals_agree, largest_difference
from .late_identities import assert_outcomes_account, run

TWO_LAPS = {"duration_s": 260.0, "laps": 2, "speed_m_s": 0.4, "seed": 3, "gyro_bias_scale": 0.0}
CLEAN = {"tracks": True, "detection_probability": 1.0, "false_detections_per_frame": 0.0}
ASSOCIATED = {"identity__unknown__policy": "associate", "identity__unknown__gate_probability": 1 - 1e-9}
USED = {Outcome.USED, Outcome.NEW, Outcome.PLACED_LATER, Outcome.USED_LATER, Outcome.MOVED}


def detections_of(sequence: Sequence) -> LandmarkDetections:
    assert sequence.detections is not None
    return sequence.detections


def anonymous_where(sequence: Sequence, rows: np.ndarray) -> Sequence:
    """Some detections name nothing."""
    seen = detections_of(sequence)
    ids, probability = seen.candidate_ids.copy(), seen.id_probability.copy()
    ids[rows], probability[rows] = -1, 0.0
    return replace(sequence, detections=replace(seen, candidate_ids=ids, id_probability=probability))


def everywhere(sequence: Sequence) -> np.ndarray:
    return np.ones(len(detections_of(sequence)), dtype=bool)


def with_names(graph_ids: list[int], positions: np.ndarray, sequence: Sequence) -> list[int]:
    """The true landmark nearest to each of the map."""
    true = sequence.true_landmarks
    assert true is not None
    nearest = np.argmin(np.linalg.norm(positions[:, None, :2] - true.positions[None, :, :2], axis=-1), axis=1)
    assert len(graph_ids) == len(nearest)
    return true.ids[nearest].tolist()


def test_without_names_the_basin_is_that_with_names():
    """Four landmarks, every detection used for the right one, and the poses of a run that knew them."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN))
    known = run(sequence)
    estimator = run(anonymous_where(sequence, everywhere(sequence)), **ASSOCIATED)
    landmarks = estimator.landmarks()
    assert landmarks.ids.tolist() == [FIRST_ANONYMOUS_ID + k for k in range(4)]
    name_of = dict(zip(landmarks.ids.tolist(), with_names(landmarks.ids, landmarks.positions, sequence), strict=True))
    log = estimator.detections()
    assert set(log.outcomes) <= USED
    assert [name_of[i] for i in log.landmark_ids.tolist()] == detections_of(sequence).most_probable()[0].tolist()
    assert estimator.trajectory().positions == pytest.approx(known.trajectory().positions, abs=1e-4)


def test_by_default_they_are_refused():
    sequence = simulate_basin(BasinOptions(**TWO_LAPS))
    estimator = run(anonymous_where(sequence, everywhere(sequence)))
    assert set(estimator.detections().outcomes) == {Outcome.NO_IDENTITY}
    assert len(estimator.landmarks()) == 0


def test_where_all_are_named_nothing_changes():
    """Bit for bit, with false detections too, of which a recogniser says that they are of no landmark it knows."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, false_detections_per_frame=0.5))
    one, other = run(sequence), run(sequence, **ASSOCIATED)
    assert np.array_equal(one.trajectory().positions, other.trajectory().positions)
    assert one.detections().outcomes == other.detections().outcomes


def test_a_landmark_begins_with_as_many_sightings_as_asked():
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN))
    blind = anonymous_where(sequence, everywhere(sequence))
    for least in (1, 3, 8):
        outcomes = Counter(run(blind, **ASSOCIATED, identity__unknown__sightings=least).detections().outcomes)
        assert outcomes[Outcome.PLACED_LATER] == 4 * (least - 1)
        assert outcomes[Outcome.USED_LATER] == 0
        assert outcomes[Outcome.NEW] == 4


def test_the_wider_the_aperture_the_later_a_landmark_begins():
    """Without a floor the elevation has to come from views, unless the aperture bounds it."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN, range_sigma_m=0.08))
    blind = anonymous_where(sequence, everywhere(sequence))
    later = []
    for aperture_rad in (0.2, 0.8):
        sonar = blind.calibration.sonar.model_copy(update={"elevation_aperture_rad": aperture_rad})
        calibration = blind.calibration.model_copy(update={"sonar": sonar, "floor": None})
        estimator = run(replace(blind, calibration=calibration), **ASSOCIATED)
        later.append(Counter(estimator.detections().outcomes)[Outcome.PLACED_LATER] / len(estimator.landmarks()))
    assert later[0] == 4
    assert later[1] > 6


def test_scattered_detections_of_nothing_begin_no_landmark():
    """As many in a place as would begin one do not come within the time that they may wait."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, false_detections_per_frame=0.05, detection_probability=0.0))
    blind = anonymous_where(sequence, everywhere(sequence))
    estimator = run(blind, identity__unknown__policy="associate")
    assert len(estimator.landmarks()) == 0
    outcomes = assert_outcomes_account(estimator, blind)
    assert outcomes[Outcome.FORGOTTEN] > 30
    assert outcomes.keys() <= {Outcome.FORGOTTEN, Outcome.WAITING}
    assert len(run(blind, identity__unknown__policy="associate", identity__unknown__sightings=1).landmarks()) > 4


# Merging ------------------------------------------------------------------------------------------------------------


def named_late(share: float) -> tuple[Sequence, Sequence]:
    """All named, and the same where the detections of a first share of the run name nothing."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN))
    seen = detections_of(sequence)
    until_ns = seen.stamps_ns[0] + round(share * (seen.stamps_ns[-1] - seen.stamps_ns[0]))
    return sequence, anonymous_where(sequence, seen.stamps_ns < until_ns)


@pytest.mark.parametrize("lag_s", [1e9, 15.0, 2.0])
def test_a_landmark_that_is_named_later_gives_the_graph_of_one_known_from_the_start(lag_s: float):
    """Factor by factor, and so are the marginals."""
    sequence, late = named_late(0.4)
    estimator, known = run(late, **ASSOCIATED, smoother__lag_s=lag_s), run(sequence, smoother__lag_s=lag_s)
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4]
    assert Counter(estimator.detections().outcomes)[Outcome.MOVED] > 20
    assert largest_difference(estimator, known) < 1e-6
    assert_marginals_agree(estimator, known, 1e-6)
    assert estimator.detections().landmark_ids.tolist() == known.detections().landmark_ids.tolist()


def test_without_merging_they_stay_two(monkeypatch: pytest.MonkeyPatch):
    _, late = named_late(0.4)
    monkeypatch.setattr(module.LandmarkMerging, "nearest", lambda *_: None)
    assert len(run(late, **ASSOCIATED).landmarks()) > 4


def test_with_a_bounded_history_none_is_merged_that_has_left_the_window():
    """Factors in a marginal cannot be moved; pairing works all the same."""
    sequence, late = named_late(0.4)
    merged, kept = (run(late, **ASSOCIATED, history__policy=history).landmarks() for history in ("whole", "bounded"))
    assert len(kept) > len(merged) == 4
    blind = run(anonymous_where(sequence, everywhere(sequence)), **ASSOCIATED, history__policy="bounded")
    assert len(blind.landmarks()) == 4
    assert set(blind.detections().outcomes) <= USED


def blind_between(first_s: float, last_s: float, estimator_calls: list[int]):
    """No pairing in a number of frames, as if the vehicle's error had led it astray."""

    def pair(innovations: Innovations, probability: float) -> Pairing:
        estimator_calls.append(len(estimator_calls))
        if first_s <= len(estimator_calls) < last_s and innovations.innovation.shape[1] >= 4:
            return Pairing((UNPAIRED,) * len(innovations.innovation), 0.0)
        return pair_jointly(innovations, probability)

    return pair


def test_a_duplicate_is_merged_into_the_graph_of_one_landmark(monkeypatch: pytest.MonkeyPatch):
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN))
    blind = anonymous_where(sequence, everywhere(sequence))
    known = run(blind, **ASSOCIATED)
    calls: list[int] = []
    first = len(detections_of(sequence)) * 2 // 3
    monkeypatch.setattr(module, "pair_jointly", blind_between(first, first + 8, calls))
    estimator = run(blind, **ASSOCIATED)
    outcomes = Counter(estimator.detections().outcomes)
    assert outcomes[Outcome.NEW] + outcomes[Outcome.MOVED] > 4
    assert outcomes[Outcome.MOVED] >= 5
    assert estimator.landmarks().ids.tolist() == known.landmarks().ids.tolist()
    assert largest_difference(estimator, known) < 1e-6
    assert_marginals_agree(estimator, known, 1e-6)


def test_two_that_one_frame_shows_are_never_merged():
    """Two landmarks closer than the noise, both always seen; merging would need them apart."""
    sequence = simulate_basin(BasinOptions(**TWO_LAPS, **CLEAN))
    seen = detections_of(sequence)
    twice = np.repeat(np.arange(len(seen)), 2)
    doubled = seen.rows(twice)
    ids = doubled.candidate_ids[:, :1].copy()
    ids[::2, 0] = doubled.most_probable()[0][::2]
    ids[1::2, 0] = -1
    tracks = np.where((doubled.track >= 0) & (np.arange(len(doubled)) % 2 == 1), doubled.track + 1000, doubled.track)
    doubled = replace(doubled, candidate_ids=ids, id_probability=(ids >= 0).astype(float), track=tracks)
    estimator = run(replace(sequence, detections=doubled), **ASSOCIATED)
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4, *(FIRST_ANONYMOUS_ID + k for k in range(4))]


def test_half_named_ends_in_names_only():
    options = BasinOptions(**TWO_LAPS, anonymous_share=0.5)
    sequence = simulate_basin(options)
    assert 0.4 < np.mean((detections_of(sequence).candidate_ids < 0).all(axis=1)) < 0.6
    estimator = run(sequence, identity__unknown__policy="associate")
    assert estimator.landmarks().ids.tolist() == [1, 2, 3, 4]
    ignoring = Counter(run(sequence).detections().outcomes)
    outcomes = assert_outcomes_account(estimator, sequence)
    assert sum(outcomes[used] for used in USED) > 1.7 * sum(ignoring[used] for used in USED)


def test_the_outcome_does_not_depend_on_how_often_one_asks():
    sequence = anonymous_where(simulate_basin(BasinOptions(**TWO_LAPS)), slice(None))
    maps = [run(sequence, rate, identity__unknown__policy="associate").landmarks() for rate in (0.3, 5.0)]
    assert maps[0].ids.tolist() == maps[1].ids.tolist()
    assert maps[0].positions == pytest.approx(maps[1].positions, abs=1e-4)
