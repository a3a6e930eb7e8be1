"""Laws of the whole recogniser, on small images of designs."""

from functools import cache
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration, SonarCalibration, SonarImage
from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import Floats
from sonar_graph.sonar import (
    REPORTED,
    RecognisedFrame,
    Recogniser,
    RecogniserParams,
    SonarStep,
    confusion_for,
)
from sonar_graph.sonar.cfar import DetectionParams
from sonar_graph.sonar.recogniser import NOT_INDEPENDENT, each_once

from .polar_images import AZIMUTHS_RAD, RANGES_M, ROTATION, VIEW, frame, image_db

DECIBELS = Calibration(
    sonar=SonarCalibration(image=SonarImage(decibel_span=80.0, full_scale=80.0))
)
FRAME_NS = 200_000_000
DISC, SQUARE, TRIANGLE, CROSS = range(4)
COVARIANCE = np.diag([1e-8] * 6)
EVERY = RecogniserParams(independent=False)
"""A detection in every frame, for laws about frames."""


@cache
def picture(
    design: int | None, x_m: float, y_m: float, heading_rad: float, seed: int
) -> Floats:
    known = None if design is None else DEFAULT_DESIGNS[design]
    return image_db(
        known, (x_m, y_m), heading_rad, ROTATION, np.random.default_rng(seed)
    )


def look(
    recogniser: Recogniser, number: int, image: Floats, left_m: float
) -> RecognisedFrame:
    """Result of a frame after a move to the left: along y, as the sonar is tilted about that axis."""
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, left_m, 0.0]))
    step = SonarStep(pose, COVARIANCE) if number else None
    return recogniser.process(frame(image, number * FRAME_NS), step, VIEW)


def pass_by(
    recogniser: Recogniser, frames: int = 9, step_m: float = 0.05
) -> list[RecognisedFrame]:
    """Results of frames in which the sonar moves to the left past a square straight ahead."""
    places = [(k, round((frames // 2 - k) * step_m, 6)) for k in range(frames)]
    return [
        look(recogniser, k, picture(SQUARE, 1.7, y, 0.4, k), step_m) for k, y in places
    ]


def standing(
    recogniser: Recogniser, frames: range, design: int | None = SQUARE, y_m: float = 0.0
) -> list:
    """Results of frames from one place."""
    return [look(recogniser, k, picture(design, 1.7, y_m, 0.4, k), 0.0) for k in frames]


def outcomes_of_tracks(result: RecognisedFrame) -> list[str]:
    return [fate.outcome for fate in result.fates if fate.track >= 0]


@pytest.mark.parametrize(
    ("settings", "y_m", "reasons"),
    [
        ({"least_frames": 4}, 0.0, ["seen in fewer than 4 frames"] * 3),
        ({"least_existence": 0.5}, 0.0, ["exists with less than 0.5"]),
        ({"least_existence": 0.0}, 0.45, ["too little of it is in view"] * 5),
    ],
)
def test_a_track_is_reported_from_the_frame_that_is_enough(settings, y_m, reasons):
    detection = DetectionParams(keep_at_edge=y_m > 0)
    settings = {"least_frames": 1, "independent": False} | settings
    params = RecogniserParams(detection=detection, **settings)
    results = standing(Recogniser(DECIBELS, params=params), range(5), y_m=y_m)
    for number, result in enumerate(results):
        outcomes = outcomes_of_tracks(result)
        is_enough = number >= len(reasons)
        assert (result.detections is not None) == is_enough
        if is_enough:
            assert REPORTED in outcomes
        else:
            assert set(outcomes) == {f"not reported: {reasons[number]}"}


def test_a_track_ends_with_a_row_and_the_next_has_another_number():
    recogniser = Recogniser(DECIBELS, params=EVERY)
    seen = standing(recogniser, range(4), DISC)
    assert [track.id for track in seen[-1].tracks] == [0]
    blank = standing(recogniser, range(4, 30), None)
    assert not any(result.detections for result in blank)
    ends = [outcome for result in blank for outcome in outcomes_of_tracks(result)]
    assert "track ended: exists with less than 0.01" in ends
    last = standing(recogniser, range(30, 36))
    ((track,),) = {tuple(one.detections.track) for one in last if one.detections}
    reported = [fate.track for fate in last[-1].fates if fate.outcome == REPORTED]
    assert reported == [track]
    assert track > 0


def test_other_designs_and_blocks_of_more_frames_are_refused():
    model = RecogniserParams(confusion=confusion_for(DEFAULT_DESIGNS[:2]))
    words = r" 1, 2, the designs are 1, 2, 3, 4; .*calibrate"
    with pytest.raises(CalibrationError, match=words):
        Recogniser(DECIBELS, params=model)
    assert Recogniser(DECIBELS, DEFAULT_DESIGNS[:2], model).ids.tolist() == [1, 2]
    recogniser = Recogniser(DECIBELS, params=EVERY)
    both = np.stack([picture(DISC, 1.7, 0.0, 0.0, k) for k in (1, 2)])
    block = SonarFrames(np.array([0, FRAME_NS]), both, RANGES_M, AZIMUTHS_RAD)
    with pytest.raises(MeasurementError, match=r"2 frames; give blocks of one"):
        recogniser.process(block, None, VIEW)


def test_the_motion_over_a_bad_frame_counts_once():
    good, bad = (Recogniser(DECIBELS, params=EVERY) for _ in range(2))
    for recogniser in (good, bad):
        pass_by(recogniser, 5)
    assert not look(bad, 5, np.zeros((96, 512), np.float32), 0.35).is_used
    last = picture(SQUARE, 1.7, -0.15, 0.4, 6)
    expected = look(good, 6, last, 0.05).detections
    found = look(bad, 6, last, -0.3).detections
    assert found.track.tolist() == expected.track.tolist()
    np.testing.assert_allclose(found.id_probability, expected.id_probability, atol=1e-6)


def test_two_discs_at_once_are_not_both_the_disc():
    """Two discs in one image: one is the landmark, the other is believed to be none."""
    recogniser = Recogniser(DECIBELS, params=EVERY)
    for k in range(9):
        y_m = round(0.2 - 0.05 * k, 6)
        left = picture(DISC, 1.7, y_m + 0.2, 0.4, k)
        right = picture(DISC, 1.75, y_m - 0.2, 0.4, k)
        found = look(recogniser, k, np.maximum(left, right), 0.05).detections
        if found is not None and len(found) == 2:
            pair = found.id_probability
            assert pair.argmax(axis=1)[pair.max(axis=1) > 0.5].tolist() in ([], [DISC])
    assert pair[:, DISC].min() == 0


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 4))
def test_no_landmark_is_the_most_probable_identity_of_two_tracks(seed, tracks, known):
    surer = np.array([[0.7, 0.1, 0.2], [0.9, 0.05, 0.05]])
    np.testing.assert_allclose(each_once(surer), [[0.0, 0.1, 0.9], [0.9, 0.05, 0.05]])
    beliefs = np.random.default_rng(seed).dirichlet(np.full(known + 1, 0.4), tracks)
    found = each_once(beliefs)
    np.testing.assert_allclose(found.sum(axis=1), 1)
    counts, before = (
        np.bincount(b.argmax(axis=1), minlength=known + 1)[:known].max()
        for b in (found, beliefs)
    )
    assert counts <= 1
    if before <= 1:
        np.testing.assert_array_equal(found, beliefs)


def test_a_track_is_reported_as_often_as_its_errors_are_independent():
    # one frame in four
    model = confusion_for(DEFAULT_DESIGNS).model_copy(update={"report_interval_s": 0.8})
    named = {}
    for independent in (False, True):
        params = RecogniserParams(confusion=model, independent=independent)
        found = pass_by(Recogniser(DECIBELS, params=params), frames=15, step_m=0.02)
        named[independent] = {
            k: int(one.detections.most_probable()[0][0])
            for k, one in enumerate(found)
            if one.detections is not None
        }
    every, reported = named.values()
    assert len(every) == 13, "from the third frame on"
    assert min(reported) == min(every)
    for before, now in pairwise(reported):
        assert now - before == 4 or reported[before] != reported[now]
    changes = np.count_nonzero(np.diff(list(every.values())))
    assert len(reported) <= 2 + len(every) // 4 + changes
    outcomes = [outcome for one in found for outcome in outcomes_of_tracks(one)]
    assert outcomes.count(NOT_INDEPENDENT) == len(every) - len(reported)
