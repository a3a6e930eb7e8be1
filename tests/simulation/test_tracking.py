"""A recogniser that watches: tracks end with the watch, identities come late, and wrong ones are corrected."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.errors import SimulationError
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.simulation.basin import BasinOptions, simulate_basin
from sonar_graph.simulation.detections import Tracking, Watched

NS = 1_000_000_000


def basin(**options) -> LandmarkDetections:
    found = simulate_basin(BasinOptions(duration_s=260.0, laps=2, seed=5, **options)).detections
    assert found is not None
    return found


def tracks_of(found: LandmarkDetections) -> list[LandmarkDetections]:
    return [found.rows(found.track == number) for number in range(found.track.max() + 1)]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(1, 2_000_000_000)), min_size=1, max_size=40))
def test_a_track_is_of_one_landmark_and_has_no_gap(steps: list[tuple[int, int]]):
    landmark = np.array([index for index, _ in steps])
    stamps_ns = np.cumsum([gap for _, gap in steps])
    watched = Watched.of(landmark, stamps_ns, Tracking())
    for number, true in enumerate(watched.landmark.tolist()):
        rows = np.flatnonzero(watched.track == number)
        assert set(landmark[rows].tolist()) == {true}
        assert (np.diff(stamps_ns[rows]) <= NS).all()
        assert watched.age_s[rows] == pytest.approx((stamps_ns[rows] - stamps_ns[rows[0]]) / NS)
        assert watched.lifetime_s[number] == pytest.approx(watched.age_s[rows].max())
    for index in range(3):
        rows = np.flatnonzero(landmark == index)
        is_new = np.diff(watched.track[rows]) != 0
        assert is_new.tolist() == (np.diff(stamps_ns[rows]) > NS).tolist()


def test_without_tracks_nothing_is_of_one_and_tracks_alone_change_nothing_else():
    plain, tracked = basin(), basin(tracks=True)
    assert set(plain.track.tolist()) == {-1}
    for name in ("stamps_ns", "range_m", "azimuth_rad", "candidate_ids", "id_probability"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(tracked, name))
    false = plain.id_probability.max(axis=1) < 0.9
    assert false.any()
    np.testing.assert_array_equal(tracked.track < 0, false)
    assert len(tracks_of(tracked)) >= 8


def test_an_identity_comes_when_its_track_is_old_enough():
    for track in tracks_of(basin(tracks=True, id_delay_s=4.0)):
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        sure = track.id_probability.max(axis=1) > 0.9
        np.testing.assert_array_equal(sure, age_s >= 4.0)
        assert track.id_probability[~sure] == pytest.approx(0.2)


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_a_wrong_identity_is_that_of_one_other_landmark_for_a_share_of_the_track(share: float):
    right = [track.most_probable()[0][-1] for track in tracks_of(basin(tracks=True))]
    wrong = tracks_of(basin(tracks=True, id_delay_s=2.0, wrong_id_rate=1.0, wrong_id_share=share))
    for true, track in zip(right, wrong, strict=True):
        age_s = (track.stamps_ns - track.stamps_ns[0]) / NS
        ids, probability = track.most_probable()
        is_wrong = (ids != true) & (probability > 0.9)
        expected = (age_s >= 2.0) & ((age_s < 2.0 + share * (age_s[-1] - 2.0)) | (share == 1))
        np.testing.assert_array_equal(is_wrong, expected)
        assert len(set(ids[is_wrong].tolist())) <= 1


@pytest.mark.slow
def test_the_share_of_wrong_tracks_is_as_asked():
    """Thirty runs of eight tracks or more: 0.3 give or take four standard errors."""
    wrong = []
    for seed in range(30):
        options = {"duration_s": 260.0, "laps": 2, "seed": seed, "tracks": True}
        plain = simulate_basin(BasinOptions(**options)).detections
        mixed = simulate_basin(BasinOptions(**options, wrong_id_rate=0.3, wrong_id_share=1.0)).detections
        pairs = zip(tracks_of(plain), tracks_of(mixed), strict=True)
        wrong += [a.most_probable()[0][0] != b.most_probable()[0][0] for a, b in pairs]
    assert np.mean(wrong) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / len(wrong)))


def test_a_delay_without_tracks_is_refused():
    with pytest.raises(SimulationError, match="id_delay_s = 5 is the age of a track; set tracks = true"):
        simulate_basin(BasinOptions(id_delay_s=5.0))


def test_a_share_of_tracks_without_tracks_is_refused():
    with pytest.raises(SimulationError, match=r"wrong_id_share = 0\.3 is a share of a track; set tracks = true"):
        simulate_basin(BasinOptions(wrong_id_share=0.3))
