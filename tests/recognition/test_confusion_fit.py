from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS
from sonar_graph.errors import CalibrationError
from sonar_graph.logs.reading import read_log
from sonar_graph.recognition.confusion_fit import (
    NO_LABEL,
    NONE,
    LabelledSightings,
    calibrate,
    label_of,
    true_ranges_azimuths,
)
from sonar_graph.sonar.appearance import DesignFit, ObjectSighting
from sonar_graph.sonar.confusion import Confusion
from sonar_graph.sonar.recogniser import Recogniser, RecogniserParams

IDS = np.array([5, 3])
RANGE_M, AZIMUTH_RAD = np.array([2.0, 1.5]), np.array([0.1, -0.2])


def sighting(range_m: float, azimuth_rad: float, *, is_fitted: bool = True, is_compared: bool = True) -> ObjectSighting:
    fit = DesignFit(np.array([0.9, 0.3]), 0.95, 0, 0.0, np.zeros(2)) if is_compared else None
    return ObjectSighting(fit, range_m, azimuth_rad, np.eye(2), is_fitted)


@pytest.mark.parametrize(
    ("range_m", "azimuth_rad", "label"),
    [
        (2.07, 0.1, 5),
        (2.0, 0.1 + 0.07 / 2, 5),
        (1.5, -0.2, 3),
        (2.09, 0.1, NO_LABEL),
        (2.0, 0.1 + 0.09 / 2, NO_LABEL),
        (2.39, 0.1, NO_LABEL),
        (2.41, 0.1, NONE),
        (2.0, 0.1 + 0.42 / 2, NONE),
    ],
)
def test_a_sighting_is_of_what_truly_lies_there(range_m: float, azimuth_rad: float, label: int):
    assert label_of(sighting(range_m, azimuth_rad), IDS, RANGE_M, AZIMUTH_RAD)[0] == label


def test_a_landmark_behind_the_sonar_is_not_what_is_seen_in_front():
    behind = np.array([0.1 + np.pi, -0.2 - np.pi])
    assert label_of(sighting(2.0, 0.1), IDS, RANGE_M, behind)[0] == NONE


def test_sightings_become_columns_with_their_errors():
    gathered = LabelledSightings((3, 5))
    for seen in (
        sighting(2.01, 0.102),
        sighting(1.49, -0.2, is_fitted=False),
        sighting(3.0, 0.1),
        sighting(2.2, 0.1),
        sighting(2.0, 0.1, is_compared=False),
    ):
        gathered.add(seen, (0, 7), IDS, RANGE_M, AZIMUTH_RAD)
    fits = gathered.fits()
    assert fits.label.tolist() == [1, 0, 2]  # in the order of the designs; what is unclear or not compared is left out
    np.testing.assert_allclose(fits.correlation, np.tile([0.9, 0.3], (3, 1)))
    np.testing.assert_allclose(fits.visible, 0.95)
    np.testing.assert_allclose(fits.range_azimuth_error[0], [0.01, 0.002])
    assert np.isnan(fits.range_azimuth_error[1:]).all()  # a centroid's error is not that of a fitted centre


def test_landmarks_that_no_design_is_of_are_left_out():
    gathered = LabelledSightings((3, 9))
    gathered.add(sighting(2.0, 0.1), (0, 1), IDS, RANGE_M, AZIMUTH_RAD)
    assert len(gathered.fits().label) == 0
    assert gathered.fits().correlation.shape == (0, 2)


@given(st.integers(0, 27))
def test_true_ranges_and_azimuths_are_those_of_the_simulator(lane, second: int):
    stamp_ns = int(lane.sequence.truth.stamps_ns[50 * second])
    range_m, azimuth_rad = true_ranges_azimuths(lane.sequence, stamp_ns)
    motion = lane.path.at(np.array([float(second)]))
    mounting = lane.sequence.calibration.sonar.mounting
    body_R_sonar = Rotation.from_euler("ZYX", mounting.rpy_rad[::-1])
    for row, landmark in enumerate(lane.sequence.true_landmarks.positions):
        in_body = motion.world_R_body[0].inv().apply(landmark - motion.position[0])
        q = body_R_sonar.inv().apply(in_body - np.array(mounting.translation_m))
        assert range_m[row] == pytest.approx(np.linalg.norm(q), abs=1e-6)
        assert azimuth_rad[row] == pytest.approx(np.arctan2(q[1], q[0]), abs=1e-6)


@pytest.fixture(scope="module", autouse=True)
def few_frames_are_enough():
    """A lane is shorter than what one would calibrate on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sonar_graph.recognition.confusion_fit.LEAST_FRAMES", 8)
        yield


@pytest.fixture(scope="module")
def measured(lane_log) -> Confusion:
    return calibrate([(lane_log, read_log(lane_log))])


def test_a_model_measured_on_a_log_is_of_its_landmarks_and_says_where_it_comes_from(lane, measured):
    assert measured.ids == (1, 2, 3, 4)
    matrix = np.array(measured.matrix)
    assert (matrix.argmax(axis=1) == np.arange(5)).all()
    assert np.diag(matrix).mean() > 0.4
    said = measured.provenance
    assert said["logs"] == "lane.mcap"
    assert said["what they are"] == lane.sequence.notes["ours"] == "a lane"
    assert all(int(said[f"frames of landmark {k}"]) >= 8 for k in (1, 2, 3, 4))
    assert int(said["frames of no landmark"]) >= 8
    assert measured.range_sigma_m < 0.02
    assert np.degrees(measured.azimuth_sigma_rad) < 0.5


def test_a_measured_model_is_one_that_the_recogniser_takes(lane, measured):
    again = Confusion.model_validate_json(measured.model_dump_json())
    assert again == measured
    assert Recogniser(lane.sequence.calibration, params=RecogniserParams(confusion=again)).confusion is again


def test_logs_count_together(lane_log, measured):
    run = read_log(lane_log)
    twice = calibrate([(lane_log, run), (lane_log, replace(run, notes={}))])
    assert twice.provenance["logs"] == "lane.mcap, lane.mcap"
    assert twice.provenance["what they are"] == "a lane; recorded"

    def said(model: Confusion, what: str) -> int:
        return int(model.provenance[f"{what} of landmark 1"])

    assert said(twice, "frames") == 2 * said(measured, "frames")
    assert said(twice, "tracks") == 2 * said(measured, "tracks")
    assert (np.diag(twice.matrix) > np.diag(measured.matrix)).all()  # more tracks allow more certainty


@pytest.mark.parametrize("missing", ["truth", "true_landmarks"])
def test_a_log_without_truth_is_refused_by_name(lane_log, missing):
    run = replace(read_log(lane_log), **{missing: None})
    with pytest.raises(CalibrationError, match=r"lane\.mcap: without true trajectory and true landmarks"):
        calibrate([(lane_log, run)])


def test_frames_that_come_too_late_count_nothing_again(lane, measured, tmp_path):
    """Every fifth frame is followed by an older one, which is refused while the sightings before it are still known."""
    rows = [row for k in range(len(lane.frames)) for row in ([k, k - 3] if k % 5 == 4 else [k])]
    late = lane.write(tmp_path / "lane.mcap", [lane.one(row) for row in rows])
    assert len(rows) > len(lane.frames) + 20
    assert calibrate([(late, read_log(late))]) == measured


def test_landmarks_that_are_not_in_the_log_are_named(lane_log):
    """The designs of two landmarks under other identities."""
    run = read_log(lane_log)
    strangers = tuple(replace(d, id=d.id + 6) for d in DEFAULT_DESIGNS[:2])
    with pytest.raises(
        CalibrationError, match=r"lane\.mcap: its true landmarks are 1, 2, 3, 4, the designs are 7, 8: "
    ):
        calibrate([(lane_log, run)], designs=strangers)
    with pytest.raises(CalibrationError, match=r"landmark 8: 0"):
        calibrate([(lane_log, run)], designs=(DEFAULT_DESIGNS[0], strangers[1]))


def test_frames_outside_the_truth_are_not_labelled(lane_log, measured):
    run = read_log(lane_log)
    middle_ns = int(run.truth.stamps_ns[len(run.truth.stamps_ns) // 3])
    cut = replace(run, truth=run.truth.rows(run.truth.stamps_ns >= middle_ns))
    with pytest.raises(CalibrationError, match="landmark 1: "):
        calibrate([(lane_log, cut)])
