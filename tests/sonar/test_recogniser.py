"""Laws of the whole recogniser, on small images of designs."""

from collections import Counter
from dataclasses import replace
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
from sonar_graph.sonar import recogniser as module
from sonar_graph.sonar.cfar import DetectionParams
from sonar_graph.sonar.recogniser import each_once

from .polar_images import AZIMUTHS_RAD, RANGES_M, ROTATION, VIEW, image_db, polar

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


def frame(number: int, image: Floats) -> SonarFrames:
    return SonarFrames(
        np.array([number * FRAME_NS]), image[None], RANGES_M, AZIMUTHS_RAD
    )


def moved(
    ahead_m: float = 0.0, left_m: float = 0.0, turned: gtsam.Rot3 | None = None
) -> SonarStep:
    """Level: in the axes of a sonar that is tilted about its y axis, left is along y."""
    return SonarStep(
        gtsam.Pose3(turned or gtsam.Rot3(), np.array([ahead_m, left_m, 0.0])),
        COVARIANCE,
    )


def aside(metres: float, number: int = 1) -> SonarStep | None:
    """To the left, but for the first frame."""
    return moved(left_m=metres) if number else None


def pass_by(
    recogniser: Recogniser, design: int | None, frames: int = 9, step_m: float = 0.05
) -> list:
    """Detections of frames in which the sonar moves to the left past something straight ahead."""
    places = [(k, round((frames // 2 - k) * step_m, 6)) for k in range(frames)]
    return [
        recogniser.process(
            frame(k, picture(design, 1.7, y, 0.4, k)), aside(step_m, k), VIEW
        ).detections
        for k, y in places
    ]


@pytest.mark.parametrize("design", [DISC, SQUARE, TRIANGLE, CROSS])
def test_a_landmark_passed_by_is_named_and_lies_where_geometry_says(design: int):
    # as these pictures show them
    flush = [replace(one, relief_m=0.0) for one in DEFAULT_DESIGNS]
    last = pass_by(Recogniser(DECIBELS, flush, EVERY), design)[-1]
    assert last.candidate_ids.tolist() == [[1, 2, 3, 4]]
    ids, probability = last.most_probable()
    assert ids.tolist() == [design + 1]
    assert probability[0] > 0.9
    assert last.id_probability.sum() <= 1 + 1e-12
    r, a = polar((1.7, -0.2))
    errors = np.array([last.range_m[0] - r, last.azimuth_rad[0] - a])
    # 0.999 of chi2 with two degrees
    assert errors @ np.linalg.solve(last.range_azimuth_cov[0], errors) < 13.8
    assert np.abs(errors) == pytest.approx([0, 0], abs=0.015)
    assert last.stamps_ns.tolist() == [8 * FRAME_NS]


def standing(
    recogniser: Recogniser, frames: range, design: int | None = SQUARE, y_m: float = 0.0
) -> list:
    """Results of frames from one place."""
    return [
        recogniser.process(
            frame(k, picture(design, 1.7, y_m, 0.4, k)), aside(0.0, k), VIEW
        )
        for k in frames
    ]


def outcomes_of_tracks(result: RecognisedFrame) -> list[str]:
    return [fate.outcome for fate in result.fates if fate.track >= 0]


@pytest.mark.parametrize(
    ("settings", "y_m", "reasons"),
    [
        ({"least_frames": 4}, 0.0, ["seen in fewer than 4 frames"] * 3),
        (
            {"least_frames": 1, "least_existence": 0.5},
            0.0,
            ["exists with less than 0.5"],
        ),
        (
            {"least_frames": 1, "least_existence": 0.0},
            0.45,
            ["too little of it is in view"] * 5,
        ),
    ],
)
def test_a_track_is_reported_from_the_frame_that_is_enough(settings, y_m, reasons):
    params = RecogniserParams(
        detection=DetectionParams(keep_at_edge=y_m > 0), independent=False, **settings
    )
    results = standing(Recogniser(DECIBELS, params=params), range(5), y_m=y_m)
    for result, reason in zip(results, reasons, strict=False):
        assert result.detections is None
        assert set(outcomes_of_tracks(result)) == {f"not reported: {reason}"}
    for result in results[len(reasons) :]:
        assert result.detections is not None
        assert REPORTED in outcomes_of_tracks(result)


def test_a_track_ends_with_a_row_and_the_next_has_another_number():
    recogniser = Recogniser(DECIBELS, params=EVERY)
    seen = standing(recogniser, range(4), DISC)
    assert [track.id for track in seen[-1].tracks] == [0]
    blank = standing(recogniser, range(4, 30), None)
    assert all(result.detections is None for result in blank)
    ends = [outcome for result in blank for outcome in outcomes_of_tracks(result)]
    assert "track ended: exists with less than 0.01" in ends
    last = standing(recogniser, range(30, 36))
    tracks = [one.detections.track.tolist() for one in last if one.detections]
    assert len(set(map(tuple, tracks))) == 1
    assert tracks[0] == [
        fate.track for fate in last[-1].fates if fate.outcome == REPORTED
    ]
    assert tracks[0][0] > 0


def test_linear_samples_and_the_plane_of_the_image_give_nearly_the_same():
    """Patches are compared in that plane where no floor is known."""
    scale = Calibration(
        sonar=SonarCalibration(image=SonarImage(scale="linear", full_scale=1e8))
    )
    recognisers = tuple(
        Recogniser(of, params=EVERY) for of in (DECIBELS, scale, DECIBELS)
    )
    for k in range(4):
        image = np.maximum(picture(DISC, 1.7, 0.0, 0.4, k), 0.0)
        given = (
            (image, VIEW),
            ((1e3 * 10 ** (image / 20)).astype(np.float32), VIEW),
            (image, None),
        )
        found = [
            r.process(frame(k, im), aside(0.0, k), v).detections
            for r, (im, v) in zip(recognisers, given, strict=True)
        ]
    plain, linear, flat = ((one.range_m, one.azimuth_rad) for one in found)
    np.testing.assert_allclose(linear, plain, atol=1e-4)
    np.testing.assert_allclose(
        found[1].id_probability, found[0].id_probability, atol=0.01
    )
    np.testing.assert_allclose(flat, plain, atol=0.04)


def test_other_designs_and_blocks_of_more_frames_are_refused():
    model = RecogniserParams(confusion=confusion_for(DEFAULT_DESIGNS[:2]))
    with pytest.raises(
        CalibrationError, match=r" 1, 2, the designs are 1, 2, 3, 4; .*calibrate"
    ):
        Recogniser(DECIBELS, params=model)
    assert Recogniser(DECIBELS, DEFAULT_DESIGNS[:2], model).ids.tolist() == [1, 2]
    recogniser = Recogniser(DECIBELS, params=EVERY)
    both = np.stack([picture(DISC, 1.7, 0.0, 0.0, k) for k in (1, 2)])
    with pytest.raises(
        MeasurementError, match=r"a block of 2 frames; give blocks of one"
    ):
        recogniser.process(
            SonarFrames(np.array([0, FRAME_NS]), both, RANGES_M, AZIMUTHS_RAD),
            None,
            VIEW,
        )


def test_a_bad_frame_has_no_sighting_and_its_motion_counts_once():
    good = Recogniser(DECIBELS, params=EVERY)
    bad = Recogniser(DECIBELS, params=EVERY)
    for recogniser in (good, bad):
        pass_by(recogniser, SQUARE, 5)
    result = bad.process(frame(5, np.zeros((96, 512), np.float32)), aside(0.35), VIEW)
    assert (result.is_used, result.detections, result.tracks) == (False, None, ())
    assert [fate[:2] for fate in result.fates] == [(5 * FRAME_NS, -1)]
    assert result.fates[0].is_of_frame
    assert result.fates[0].outcome == "frame not used: all samples are zero"
    last = frame(6, picture(SQUARE, 1.7, -0.15, 0.4, 6))
    expected = good.process(last, aside(0.05), VIEW)
    found = bad.process(last, aside(-0.3), VIEW)
    np.testing.assert_allclose(found.detections.range_m, expected.detections.range_m)
    np.testing.assert_allclose(
        found.detections.id_probability, expected.detections.id_probability, atol=1e-6
    )
    assert [f.track for f in found.fates if f.track >= 0] == [
        f.track for f in expected.fates if f.track >= 0
    ]


def test_a_sonar_that_comes_to_rest_keeps_its_belief():
    """The same picture from the same place, an unseen bit brighter every other time: no copy of the frame before."""
    recogniser = Recogniser(DECIBELS, params=EVERY)
    image = picture(SQUARE, 1.7, -0.2, 0.4, 8)
    before = pass_by(recogniser, SQUARE)[-1]
    for k in range(60):
        found = recogniser.process(
            frame(9 + k, image + np.float32(1e-3 * (k % 2))), aside(0.0), VIEW
        ).detections
    assert before.id_probability[0, SQUARE] > 0.9
    np.testing.assert_allclose(found.id_probability, before.id_probability, rtol=1e-9)


def test_two_discs_at_once_are_not_both_the_disc():
    """Two discs in one image: one is the landmark, the other is believed to be none."""
    recogniser = Recogniser(DECIBELS, params=EVERY)
    for k in range(9):
        y_m = round(0.2 - 0.05 * k, 6)
        left = picture(DISC, 1.7, y_m + 0.2, 0.4, k)
        right = picture(DISC, 1.75, y_m - 0.2, 0.4, k)
        found = recogniser.process(
            frame(k, np.maximum(left, right)), aside(0.05, k), VIEW
        ).detections
        if found is not None and len(found) == 2:
            pair = found.id_probability
            assert pair.argmax(axis=1)[pair.max(axis=1) > 0.5].tolist() in ([], [DISC])
    assert pair[:, DISC].min() == 0


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 4))
def test_no_landmark_is_the_most_probable_identity_of_two_tracks(
    seed: int, tracks: int, known: int
):
    surer = np.array([[0.7, 0.1, 0.2], [0.9, 0.05, 0.05]])
    np.testing.assert_allclose(each_once(surer), [[0.0, 0.1, 0.9], [0.9, 0.05, 0.05]])
    beliefs = np.random.default_rng(seed).dirichlet(np.full(known + 1, 0.4), tracks)
    found = each_once(beliefs)
    np.testing.assert_allclose(found.sum(axis=1), 1)
    before, after = (
        [k for k in b.argmax(axis=1).tolist() if k < known] for b in (beliefs, found)
    )
    assert len(set(after)) == len(after)
    if len(set(before)) == len(before):
        np.testing.assert_array_equal(found, beliefs)


def test_a_track_is_reported_as_often_as_its_errors_are_independent():
    # one frame in four
    model = confusion_for(DEFAULT_DESIGNS).model_copy(update={"report_interval_s": 0.8})
    named = {}
    for independent in (True, False):
        recogniser = Recogniser(
            DECIBELS, params=RecogniserParams(confusion=model, independent=independent)
        )
        found = pass_by(recogniser, SQUARE, frames=15, step_m=0.02)
        named[independent] = {
            k: int(one.most_probable()[0][0])
            for k, one in enumerate(found)
            if one is not None
        }
    assert len(named[False]) == 13, "from the third frame on"
    reports = sorted(named[True])
    assert reports[0] == min(named[False])
    believed = [named[False][k] for k in sorted(named[False])]
    for before, now in pairwise(reports):
        assert now - before == 4 or named[True][before] != named[True][now]
    assert len(reports) <= 2 + len(believed) // 4 + int(np.sum(np.diff(believed) != 0))
    assert recogniser_said(model)[module.NOT_INDEPENDENT] == len(named[False]) - len(
        reports
    )


def recogniser_said(model) -> Counter:
    recogniser = Recogniser(DECIBELS, params=RecogniserParams(confusion=model))
    said = Counter()
    for k in range(15):
        y = round((15 // 2 - k) * 0.02, 6)
        result = recogniser.process(
            frame(k, picture(SQUARE, 1.7, y, 0.4, k)), aside(0.02, k), VIEW
        )
        said.update(outcomes_of_tracks(result))
    return said
