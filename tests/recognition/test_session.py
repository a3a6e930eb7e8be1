"""From a log with images to detections that are right: the whole chain, on a lane whose truth is known."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.errors import LogError, MeasurementError
from sonar_graph.images import SonarFrames
from sonar_graph.logs import write_log
from sonar_graph.measurements import Floats, Ints, LandmarkDetections
from sonar_graph.recognition import (
    Recognition,
    RecognitionSession,
    one_by_one,
    recognise,
    recognise_images,
    with_detections,
)
from sonar_graph.simulation.sonar_image.imaging_sonar import DIDSON
from sonar_graph.sonar import (
    REPORTED,
    IdentityParams,
    Recogniser,
    RecogniserParams,
    confusion_for,
)
from tests.recognition.imaged_lane import TOPIC, Lane

SURE = 0.9


def truth_of(lane: Lane, found: LandmarkDetections) -> tuple[Ints, Floats]:
    """Identity (negative: no landmark) of the object nearest to each detection, and errors of range and azimuth."""
    ids = []
    errors = []
    rows = np.searchsorted(lane.frames.stamps_ns, found.stamps_ns)
    for row, r, a in zip(rows, found.range_m, found.azimuth_rad, strict=True):
        truth = lane.truth[row]
        off = np.column_stack([r - truth.range_m()[0], a - truth.azimuth_rad()[0]])
        at = np.argmin(np.hypot(off[:, 0], r * off[:, 1]))
        ids.append(truth.ids[at])
        errors.append(off[at])
    return np.array(ids), np.array(errors)


def accepted(lane: Lane, found: LandmarkDetections) -> set[tuple[int, int]]:
    """Pairs of true identity and the one that was named with certainty."""
    named, probability = found.most_probable()
    pairs = np.column_stack([truth_of(lane, found)[0], named])
    return set(map(tuple, pairs[probability > SURE].tolist()))


def recognised(
    lane: Lane, frames: Iterable[SonarFrames] | None = None, **settings: object
) -> Recognition:
    recogniser = Recogniser(lane.sequence.calibration, **settings)
    session = RecognitionSession(lane.sequence, recogniser)
    for frame in one_by_one(lane.frames) if frames is None else frames:
        session.take(frame)
    return session.finish()


def test_every_landmark_is_recognised_by_its_name_and_nothing_else_is(
    lane, lane_recognition
):
    found = lane_recognition.detections
    ids, _ = truth_of(lane, found)
    assert accepted(lane, found) == {(1, 1), (2, 2), (3, 3), (4, 4)}
    # stone and patch were tracked, and are named by nothing
    assert {-1, -2} <= set(ids.tolist())
    assert lane_recognition.outcomes[REPORTED] == len(found)
    assert lane_recognition.warnings == []
    named, probability = found.most_probable()
    assert (1 - found.id_probability.sum(axis=1)[ids < 0] > 0.5).all()
    assert np.mean(((named == ids) & (probability > 0.5))[ids > 0]) > 0.8


EVERY = RecogniserParams(independent=False)
"""A detection in every frame, for laws about frames."""


def test_range_and_azimuth_are_as_accurate_as_their_covariance_says(lane):
    found = recognised(lane, params=EVERY).detections
    ids, errors = truth_of(lane, found)
    covariance = found.range_azimuth_cov
    sure = (ids > 0) & (found.most_probable()[1] > SURE)
    # the others are about to leave the beam
    fitted = sure & (covariance[:, 0, 0] < 0.03**2)
    assert fitted.sum() > 40
    assert np.sqrt(np.mean(errors[fitted, 0] ** 2)) < 0.010
    range_rms_m, azimuth_rms_rad = np.sqrt(np.mean(errors[sure] ** 2, axis=0))
    assert range_rms_m < 0.025
    assert np.degrees(azimuth_rms_rad) < 0.5
    weighed = np.linalg.solve(covariance, errors[..., None])[..., 0]
    nis = np.vecdot(errors, weighed)[sure]
    assert 0.5 < nis.mean() / 2 < 2.2
    assert np.mean(nis < 9.21) > 0.93


def test_designs_under_other_names_give_other_names(lane):
    """Negative control: names come from the designs and from nothing else."""
    renamed = [replace(design, id=design.id % 4 + 1) for design in DEFAULT_DESIGNS]
    turned = sorted(renamed, key=lambda design: design.id)
    marks = {"designs": confusion_for(turned).designs}
    model = confusion_for(DEFAULT_DESIGNS).model_copy(update=marks)
    params = RecogniserParams(confusion=model)
    pairs = accepted(lane, recognised(lane, designs=turned, params=params).detections)
    assert len(pairs) >= 3
    assert all(named == true % 4 + 1 for true, named in pairs)


def test_a_lane_without_landmarks_yields_none(lane):
    """Negative control: the same frames with the order of their beams shuffled hold nothing that persists."""
    order = np.random.default_rng(0).permutation(len(lane.frames.azimuths_rad))
    image = np.ascontiguousarray(lane.frames.intensity[:, order])
    shuffled = one_by_one(replace(lane.frames, intensity=image))
    found = recognised(lane, shuffled).detections
    assert found is None or not accepted(lane, found)


def test_recognise_adds_the_detections_of_a_log_or_of_frames(lane, tmp_path):
    frames = first_frames(lane)
    expected = with_detections(lane.sequence, recognised(lane, frames))
    log = lane.write(tmp_path / "lane.mcap", frames)
    for found in (
        recognise(frames, lane.sequence),
        recognise(str(log), topics={"sonar": TOPIC}),
    ):
        assert_same_detections(found.detections, expected.detections)
        assert found.notes["detections"] == f"recognised in {FRAMES} sonar images"
        np.testing.assert_array_equal(found.imu.stamps_ns, lane.sequence.imu.stamps_ns)
    bare = tmp_path / "bare.mcap"
    write_log(bare, lane.sequence)
    assert recognise_images(bare, lane.sequence) is None
    with pytest.raises(LogError, match=r"bare\.mcap: has no sonar images; `sonar-"):
        recognise(bare)
    with pytest.raises(LogError, match="no sonar frame"):
        recognise([], lane.sequence)
    with pytest.raises(MeasurementError, match="need a sequence"):
        recognise(frames)


def bad_frame(lane: Lane, reason: str) -> SonarFrames:
    """A frame that must not be used, to come instead of frame `AT`."""
    frame = lane.one(AT)
    image = frame.intensity
    if reason == "wrong size":
        ranges_m = frame.ranges_m[:500]
        return replace(frame, intensity=image[:, :, :500], ranges_m=ranges_m)
    if reason == "out of order":
        return lane.one(AT - 10)
    return replace(frame, intensity=np.where(np.arange(512) == 3, np.nan, image))


AT = 30
FRAMES = 50


def first_frames(lane: Lane) -> list[SonarFrames]:
    return [lane.one(k) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def without(lane) -> LandmarkDetections:
    """What is recognised when frame `AT` is not there at all."""
    frames = first_frames(lane)
    del frames[AT]
    return recognised(lane, frames).detections


def assert_same_detections(
    found: LandmarkDetections, expected: LandmarkDetections
) -> None:
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    for name, atol in (
        ("range_m", 1e-4),
        ("azimuth_rad", 1e-4),
        ("id_probability", 1e-2),
    ):
        columns = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(*columns, atol=atol)


@pytest.mark.parametrize("reason", ["wrong size", "not finite", "out of order"])
def test_a_bad_frame_is_named_in_a_warning_and_not_used(lane, without, reason):
    frames = first_frames(lane)
    frames[AT] = bad_frame(lane, reason)
    result = recognised(lane, frames)
    ((stamp_ns, warning),) = result.warnings
    assert stamp_ns == frames[AT].stamps_ns[0]
    assert warning.startswith("frame not used: ")
    assert reason in warning
    assert (result.outcomes[warning], result.frames) == (1, FRAMES)
    assert_same_detections(result.detections, without)


def test_the_notes_give_the_origin_of_detections_and_count_warnings(lane, monkeypatch):
    monkeypatch.setattr("sonar_graph.recognition.session.MOST_WARNINGS", 3)
    params = RecogniserParams(identity=IdentityParams(rule="jeffrey"))
    frames = first_frames(lane)
    for k in range(10):
        last = lane.one(FRAMES + k)
        frames.append(replace(last, intensity=np.zeros_like(last.intensity)))
    result = recognised(lane, frames, params=params)
    zero = "frame not used: all samples are zero"
    assert len(result.warnings) == 3
    assert result.outcomes[zero] == 10
    assert accepted(lane, result.detections) >= {(1, 1)}
    assert "simulated basins" in result.notes.pop("detections.model")
    assert result.notes == {
        "detections": f"recognised in {FRAMES + 10} sonar images",
        "detections.designs": "1: disc, 2: square, 3: triangle, 4: cross",
        "detections.rule": "jeffrey",
        "detections.warnings": f"10 x {zero}",
    }


def test_frames_without_odometry_are_named_and_the_others_are_used(lane):
    good = first_frames(lane)[:30]
    ends_ns = [lane.sequence.start_ns - 1, lane.sequence.end_ns + 1]
    early, late = (replace(good[0], stamps_ns=np.array([ns])) for ns in ends_ns)
    result = recognised(lane, [early, *good[:20], late, *good[20:]])
    reason = "frame not used: no IMU and Doppler log at its stamp"
    assert result.warnings == [(ns, reason) for ns in ends_ns]
    assert_same_detections(result.detections, recognised(lane, good).detections)


def test_the_lens_of_the_calibration_puts_azimuths_right(lane, without):
    """Of a log with equally spaced beams, which err by 1.25 degrees, 4 cm at 2 m."""
    run = lane.sequence
    sonar = run.calibration.sonar.model_copy(update={"lens": "didson"})
    calibration = run.calibration.model_copy(update={"sonar": sonar})
    told = replace(lane, sequence=replace(run, calibration=calibration))
    even_rad = DIDSON.linear_azimuths_rad()
    frames = [replace(one, azimuths_rad=even_rad) for one in first_frames(lane)]
    del frames[AT]
    assert_same_detections(recognised(told, frames).detections, without)
