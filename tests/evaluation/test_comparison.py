from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from sonar_graph.errors import EvaluationError, UnknownEstimatorError
from sonar_graph.evaluation import SCORES, compare, run_estimator
from sonar_graph.evaluation.scores import (
    landmark_scores,
)
from sonar_graph.logs import read_log, write_log
from sonar_graph.report import sentences
from sonar_graph.report.figures.maps import true_landmarks_drawn
from sonar_graph.report.landmark_table import landmark_table
from sonar_graph.states import Estimate, LandmarkMap
from sonar_graph.testing import small_world

from .conftest import Offset, straight_sequence

KEY = "causal.ate_raw_m"
OWN = "causal.own_map_m"


def test_contradicting_sensors_are_found_in_sequence_and_log(tmp_path, caplog):
    """Also by the checks of single numbers, and reported once: notes of the comparison, log, page and `inspect`."""
    world = small_world()
    velocity = 1.3 * world.dvl.velocity
    velocity[40:60] = velocity[40]
    wrong = replace(world, dvl=replace(world.dvl, velocity=velocity))
    comparison = compare(wrong, ["dead-reckoning"])
    notes = comparison.sequence.notes
    path = tmp_path / "wrong.mcap"
    write_log(path, wrong)
    read = compare(read_log(path), ["dead-reckoning"]).sequence.notes
    doubt = notes["log.doubtful"]
    assert "same to the last bit" in doubt
    assert "ranges to landmarks" in doubt
    for subject in ("log.doubtful", "log.sensors", "log.warnings"):
        assert notes.get(subject) == read.get(subject)
    logged = [r.getMessage() for r in caplog.records if r.name.endswith("evaluation")]
    assert any(doubt in message for message in logged)
    assert f"Doubtful: {doubt}" in sentences.doubtful_lines(comparison)
    again = compare(comparison.sequence, ["dead-reckoning"])
    assert again.sequence.notes == notes


def test_scores_of_a_constant_offset_by_hand_each_with_unit_and_protocol(install):
    given = {"offset": {"offset_m": 0.4, "sigma_m": 0.1}}
    scores = compare(straight_sequence(), ["offset"], given).scores["offset"]
    expected = {
        "causal.ate_raw_m": 0.4,
        "smoothed.ate_raw_m": 0.2,
        "causal.nees_position": 0.4**2 / 0.1**2 / 2,
        "smoothed.nees_position": 0.2**2 / 0.1**2 / 2,
        "landmarks.raw_m": 0.1,
        "landmarks.se2_m": 0.0,
        "landmarks.count": 3,
        "landmarks.nees": 0.1**2 / 0.01 / 2,
        "detections.used": 3,
        "detections.refused": 1,
        "detections.nis": (4.0 + 1.0) / 2 / 2,
    }
    for key in ("ate_yaw_m", "ate_se2_m", "rpe_10s_m", "yaw_rmse_rad"):
        expected[f"causal.{key}"] = 0.0
    found = {key: scores[key].value for key in expected}
    assert found == pytest.approx(expected, abs=1e-9)
    assert abs(found["landmarks.se2_m"]) < 1e-12
    known = set(SCORES)
    assert known - set(scores) <= {"memory.peak_mb", "causal.own_map_m"}
    assert set(scores) <= known
    for key, score in scores.items():
        assert np.isfinite(score.value), key
        assert score.unit, key
        assert score.protocol.endswith("."), key
        assert ".." not in score.protocol, key
    aligned = scores["causal.ate_se2_m"].protocol
    assert "40 of 40 instants" in aligned
    assert "SE(2)" in aligned
    assert scores["smoothed.ate_raw_m"].protocol.startswith("Smoothed")


def test_all_are_scored_at_the_instants_that_all_have(install):
    begin_ns = 4_000_000_000

    class Late(Offset):
        def process(self, measurements):
            is_late = measurements.end_ns >= begin_ns
            return super().process(measurements) if is_late else None

    install(late=Late)
    comparison = compare(straight_sequence(), ["offset", "late"])
    for name in ("offset", "late"):
        assert comparison.errors[name]["causal"].stamps_ns[0] == begin_ns
        protocol = comparison.scores[name][KEY].protocol
        assert "5 without an estimate" in protocol
    assert len(comparison.runs[0].causal or ()) == 40


def test_without_enough_truth_the_rest_is_scored(install):
    """One instant is too little."""
    sequence = straight_sequence()
    short = replace(sequence, truth=sequence.truth.rows(slice(0, 7)))
    for given, told in (
        (straight_sequence(truth=False), "none: the log has no truth"),
        (short, "1 of 40 instants"),
    ):
        comparison = compare(given, ["offset"])
        keys = set(comparison.scores["offset"])
        assert not any(key.startswith(("causal.", "smoothed.")) for key in keys)
        assert {"landmarks.count", "detections.used", "time.total_s"} <= keys
        assert comparison.errors == {}
        assert comparison.environment["scored instants"].startswith(told)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        (([],), EvaluationError, "no estimator"),
        ((["offset", "offset"],), EvaluationError, "more than once: offset"),
        ((["offset"], {"ekf": {}}), EvaluationError, "settings for ekf"),
        ((["offset", "nobody"],), UnknownEstimatorError, "nobody"),
        (("offset",), TypeError, r"estimators is a list: give \['offset'\]"),
    ],
)
def test_mistakes_of_the_user_are_raised_before_anything_runs(
    install, arguments, error, said
):
    def progress(*_):
        pytest.fail("something ran")

    with pytest.raises(error, match=said):
        compare(straight_sequence(), *arguments, progress=progress)


def test_a_path_in_place_of_a_sequence_is_refused_with_what_reads_it():
    told = "expected a Sequence, not str; read_log"
    for call, estimators in ((compare, ["offset"]), (run_estimator, "offset")):
        with pytest.raises(TypeError, match=told):
            call("dive.mcap", estimators)


def test_the_environment_has_versions_machine_and_command(install):
    install(one=Offset, two=Offset)
    calls: list[tuple[str, int, int]] = []

    def progress(*call):
        calls.append(call)

    sequence = straight_sequence(2.0)
    comparison = compare(sequence, ["one", "two"], rate_hz=1.0, progress=progress)
    assert calls == [("one", 1, 2), ("one", 2, 2), ("two", 1, 2), ("two", 2, 2)]
    expected = {"sonar_graph", "python", "gtsam", "machine", "date", "command"}
    assert expected <= set(comparison.environment)
    assert comparison.environment["numpy"] == np.__version__


TURNED = gtsam.Pose3(gtsam.Rot3.Yaw(2.0), np.array([40.0, -7.0, 3.0]))


def surveyed_elsewhere(offset_m: float = 0.0, *, has_truth: bool = False) -> Any:
    """An estimator whose map is right but for landmark 5, and a sequence with true landmarks in a world of their own."""
    ids = np.arange(1, 9)
    places = np.random.default_rng(3).uniform(-9, 9, (8, 3)) * [1, 1, 0]
    found = places.copy()
    found[4, 0] += offset_m
    covs = np.tile(np.diag([1e-4, 4e-4, 1e-4]), (8, 1, 1))

    class Surveyor(Offset):
        def landmarks(self):
            return LandmarkMap(ids, found, covs)

    world = np.array([TURNED.transformFrom(place) for place in places])
    true = LandmarkMap(ids, world, np.full((8, 3, 3), np.nan))
    return Surveyor, replace(straight_sequence(truth=has_truth), true_landmarks=true)


@pytest.mark.parametrize("has_truth", [False, True])
def test_a_map_in_another_world_is_scored_after_alignment(install, has_truth):
    kind, sequence = surveyed_elsewhere(has_truth=has_truth)
    install(surveyor=kind)
    comparison = compare(sequence, ["surveyor"])
    scores = comparison.scores["surveyor"]
    assert scores["landmarks.se2_m"].value == pytest.approx(0.0, abs=1e-9)
    nees = scores["landmarks.nees"]
    assert "aligned" in nees.protocol
    # with a true path the worlds are one
    assert ("landmarks.raw_m" in scores) == has_truth
    assert bool(sentences.doubt_of_identities(comparison)) == has_truth
    assert nees.value > 1e4 if has_truth else nees.value < 1e-9
    if not has_truth:
        said = sentences.headline(comparison)
        assert said.startswith("No true path is known, but the landmarks")
        drawn = true_landmarks_drawn(comparison).positions
        own = comparison.runs[0].landmarks.positions
        np.testing.assert_allclose(drawn, own, atol=1e-9)
        rows = {row[0].text: row[2].text for row in landmark_table(comparison).rows}
        assert "RMS, not aligned" not in rows
        assert rows["ID 1, x"].endswith("(0.000)")


def test_a_wrong_landmark_is_found_in_another_world(install):
    kind, sequence = surveyed_elsewhere(3.0)
    install(surveyor=kind)
    (line,) = sentences.doubt_of_identities(compare(sequence, ["surveyor"]))
    assert "puts landmark 5 far outside its covariance" in line


def test_the_nees_of_an_aligned_map_has_fewer_degrees_of_freedom():
    """Errors drawn from the covariance of the map, which turns with the alignment: 2 k - 3 degrees of freedom."""
    kind, sequence = surveyed_elsewhere()
    exact = kind(sequence.calibration).landmarks()
    found = []
    for seed in range(200):
        noise = np.random.default_rng(seed).standard_normal((8, 3)) * [0.01, 0.02, 0]
        drawn = replace(exact, positions=exact.positions + noise)
        found.append(landmark_scores(drawn, sequence)["landmarks.nees"].value)
    assert np.mean(found) == pytest.approx(1.0, abs=0.1)


IDS = np.array([7, 9, 11])
PLACES = np.array([[1.0, 1, 0], [2, -1, 0], [4, 2, 0]])


class Moving(Offset):
    """A map that wanders, and a pose that wanders with it; the pose is ``offset_m`` off on the map."""

    def wander(self, stamp_ns: int) -> gtsam.Pose3:
        seconds = (stamp_ns - 1_000_000_000) * 1e-9
        place = np.array([0.3 * seconds, 0.0, 0.0])
        return gtsam.Pose3(gtsam.Rot3.Yaw(0.02 * seconds), place)

    def beside(self, stamp_ns: int, offset_m: float) -> Estimate:
        right = super().beside(stamp_ns, offset_m)
        pose = self.wander(stamp_ns).compose(right.world_T_body)
        return replace(right, world_T_body=pose)

    def landmarks(self) -> LandmarkMap:
        wander = self.wander(self.estimates[-1].stamp_ns)
        moved = np.array([wander.transformFrom(place) for place in PLACES])
        return LandmarkMap(IDS, moved, np.tile(np.eye(3) * 0.01, (3, 1, 1)))


class Few(Moving):
    """Learns its third landmark after ten seconds."""

    def landmarks(self) -> LandmarkMap:
        known = super().landmarks()
        n = 3 if self.estimates[-1].stamp_ns > 11_000_000_000 else 2
        return LandmarkMap(known.ids[:n], known.positions[:n], known.covariances[:n])


def test_the_error_on_the_own_map_ignores_motion_of_the_map(install):
    install(moving=Moving, few=Few)
    true = LandmarkMap(IDS, PLACES, np.full((3, 3, 3), np.nan))
    sequence = replace(straight_sequence(), true_landmarks=true)
    given = {"moving": {"offset_m": 0.25}}
    scores = compare(sequence, ["moving"], given).scores["moving"]
    assert scores[OWN].value == pytest.approx(0.25, abs=1e-9)
    assert scores["causal.ate_se2_m"].value > 0.5, "the path counts it"
    both = compare(sequence, ["moving", "few", "offset"]).scores
    alone, moving, few = (
        int(own[OWN].protocol.split()[3])
        for own in (scores, both["moving"], both["few"])
    )
    assert moving == few < alone
    assert OWN not in both["offset"], "its map names two true landmarks"
