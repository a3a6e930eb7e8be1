"""From a log with images to detections that are right: the whole chain, on a lane whose truth is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.errors import LogError, MeasurementError
from sonar_graph.evaluation.comparison import compare
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.writing import write_log
from sonar_graph.measurements import Floats, Ints, LandmarkDetections, SonarFrames
from sonar_graph.recognition.recognition_record import Recognition
from sonar_graph.recognition.session import RecognitionSession, one_by_one, recognise, recognise_images, with_detections
from sonar_graph.simulation.sonar_image.imaging_sonar import DIDSON
from sonar_graph.sonar.bayes import IdentityParams
from sonar_graph.sonar.confusion import confusion_for
from sonar_graph.sonar.recogniser import REPORTED, RecogniserParams
from tests.recognition.imaged_lane import TOPIC

if TYPE_CHECKING:
    from tests.recognition.imaged_lane import Lane

SURE = 0.9


def truth_of(lane: Lane, found: LandmarkDetections) -> tuple[Ints, Floats, Floats]:
    """Identity (negative: no landmark) and true range and azimuth of the object nearest to each detection."""
    row = np.searchsorted(lane.frames.stamps_ns, found.stamps_ns)
    ids, errors = [], []
    for frame, r, a in zip(row.tolist(), found.range_m, found.azimuth_rad, strict=True):
        truth = lane.truth[frame]
        q = truth.points_m[0]
        at = int(np.argmin(np.hypot(np.linalg.norm(q, axis=1) - r, r * (np.arctan2(q[:, 1], q[:, 0]) - a))))
        ids.append(int(truth.ids[at]))
        errors.append((r - np.linalg.norm(q[at]), a - np.arctan2(q[at, 1], q[at, 0])))
    return np.array(ids), *np.array(errors).T


def accepted(found: LandmarkDetections, ids: Ints) -> set[tuple[int, int]]:
    """Pairs of true identity and the one that was named with certainty."""
    named, probability = found.most_probable()
    return set(zip(ids[probability > SURE].tolist(), named[probability > SURE].tolist(), strict=True))


def recognised(lane: Lane, frames: Iterable[SonarFrames] | None = None, **settings: object) -> Recognition:
    session = RecognitionSession(lane.sequence, pictures=False, **settings)
    for frame in one_by_one(lane.frames) if frames is None else frames:
        session.take(frame)
    return session.finish()


def test_every_landmark_is_recognised_by_its_name_and_nothing_else_is(lane, lane_recognition):
    found = lane_recognition.detections
    ids, _, _ = truth_of(lane, found)
    assert accepted(found, ids) == {(1, 1), (2, 2), (3, 3), (4, 4)}
    assert {-1, -2} <= set(ids.tolist())  # stone and patch were tracked, and are named by nothing
    assert lane_recognition.outcomes[REPORTED] == len(found)
    assert lane_recognition.warnings == []
    named, probability = found.most_probable()
    none = 1 - found.id_probability.sum(axis=1)
    assert (none[ids < 0] > 0.5).all()
    assert np.mean((named == ids)[ids > 0] & (probability > 0.5)[ids > 0]) > 0.8


def test_range_and_azimuth_are_as_accurate_as_their_covariance_says(lane, lane_recognition):
    found = lane_recognition.detections
    ids, range_error_m, azimuth_error_rad = truth_of(lane, found)
    errors = np.column_stack([range_error_m, azimuth_error_rad])
    sure = (ids > 0) & (found.most_probable()[1] > SURE)
    fitted = sure & (found.range_azimuth_cov[:, 0, 0] < 0.03**2)  # the others are about to leave the beam
    assert fitted.sum() > 40
    assert np.sqrt(np.mean(range_error_m[fitted] ** 2)) < 0.010
    assert np.sqrt(np.mean(range_error_m[sure] ** 2)) < 0.025
    assert np.degrees(np.sqrt(np.mean(azimuth_error_rad[sure] ** 2))) < 0.5
    nis = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found.range_azimuth_cov), errors)[sure]
    assert 0.5 < nis.mean() / 2 < 2.2
    assert np.mean(nis < 9.21) > 0.93


def test_designs_under_other_names_give_other_names(lane):
    """Negative control: names come from the designs and from nothing else."""
    turned = tuple(replace(d, id=d.id % 4 + 1) for d in DEFAULT_DESIGNS)
    turned = tuple(sorted(turned, key=lambda d: d.id))
    model = confusion_for(DEFAULT_DESIGNS).model_copy(update={"designs": confusion_for(turned).designs})
    found = recognised(lane, designs=turned, params=RecogniserParams(confusion=model)).detections
    pairs = accepted(found, truth_of(lane, found)[0])
    assert len(pairs) >= 3
    assert all(named == true % 4 + 1 for true, named in pairs)


def test_landmarks_of_other_designs_are_not_accepted(lane):
    """Negative control: a bar and a small ring are not in the lane."""
    bar, ring = np.full((60, 60), np.nan), np.full((60, 60), np.nan)
    bar[26:34] = 12.0
    x, y = np.meshgrid(*2 * [np.arange(60) - 29.5])
    ring[(np.hypot(x, y) < 29) & (np.hypot(x, y) > 20)] = 12.0
    designs = [LandmarkDesign(7, "bar", 0.5, bar), LandmarkDesign(8, "ring", 0.5, ring)]
    found = recognised(lane, designs=designs).detections
    _, probability = found.most_probable()
    assert set(np.unique(found.candidate_ids).tolist()) == {7, 8}
    assert np.mean(probability > SURE) < 0.05


def test_a_lane_without_landmarks_yields_none(lane):
    """Negative control: the same frames with the order of their beams shuffled hold nothing that persists."""
    order = np.random.default_rng(0).permutation(len(lane.frames.azimuths_rad))
    shuffled = replace(lane.frames, intensity=np.ascontiguousarray(lane.frames.intensity[:, order]))
    found = recognised(lane, one_by_one(shuffled)).detections
    assert found is None or not accepted(found, truth_of(lane, found)[0])


def test_a_log_gives_what_its_images_give(lane, lane_log, lane_recognition):
    counts: list[int] = []
    sequence = read_log(lane_log)
    assert sequence.detections is None
    result = recognise_images(lane_log, sequence, progress=counts.append)
    assert counts == list(range(1, len(lane.frames) + 1))
    assert result.frames == len(lane.frames)
    assert result.outcomes == lane_recognition.outcomes
    for name in ("stamps_ns", "range_m", "azimuth_rad", "range_azimuth_cov", "candidate_ids", "id_probability"):
        expected = getattr(lane_recognition.detections, name)
        np.testing.assert_allclose(getattr(result.detections, name), expected, atol=1e-4, err_msg=name)


def test_recognise_gives_the_sequence_with_the_detections_of_its_log_or_frames(lane, tmp_path):
    frames = [lane.one(k) for k in range(FRAMES)]
    expected = with_detections(lane.sequence, recognised(lane, frames))
    log = lane.write(tmp_path / "lane.mcap", frames)
    for found in (recognise(frames, lane.sequence), recognise(log), recognise(str(log), topics={"sonar": TOPIC})):
        assert_same_detections(found.detections, expected.detections)
        assert found.notes["detections"] == f"recognised in {FRAMES} sonar images"
        np.testing.assert_array_equal(found.imu.stamps_ns, lane.sequence.imu.stamps_ns)
    write_log(tmp_path / "bare.mcap", lane.sequence)
    assert recognise_images(tmp_path / "bare.mcap", lane.sequence) is None
    with pytest.raises(LogError, match=r"bare\.mcap: has no sonar images; `sonar-graph inspect"):
        recognise(tmp_path / "bare.mcap")
    with pytest.raises(LogError, match="no sonar frame"):
        recognise([], lane.sequence)
    with pytest.raises(MeasurementError, match="need a sequence"):
        recognise(frames)


def test_both_estimators_are_given_the_same_detections(lane, lane_recognition, monkeypatch):
    """The very same block, which adds to the notes and leaves the rest of the sequence alone."""
    from sonar_graph.evaluation import run as module

    sequence = with_detections(lane.sequence, lane_recognition)
    assert sequence.detections is lane_recognition.detections
    assert sequence.imu is lane.sequence.imu
    assert sequence.notes == lane.sequence.notes | lane_recognition.notes
    given: dict[str, list[Floats]] = {}
    load = module.load_estimator

    def spying(name: str) -> type:
        class Spy(load(name)):
            def process(self, measurements):
                if measurements.detections is not None:
                    block = measurements.detections
                    given.setdefault(name, []).append(np.column_stack([block.range_m, block.id_probability]))
                return super().process(measurements)

        return Spy

    monkeypatch.setattr(module, "load_estimator", spying)
    result = compare(sequence, ["isam2", "ekf-slam"], {}, rate_hz=2.0)
    assert [run.status for run in result.runs] == ["ok", "ok"]
    one, other = (np.concatenate(given[name]) for name in ("isam2", "ekf-slam"))
    np.testing.assert_array_equal(one, other)
    assert len(one) > 0.9 * len(sequence.detections)


def test_pictures_come_once_a_second_and_show_what_was_recognised(lane, lane_recognition):
    pictures = lane_recognition.pictures
    stamps_ns = np.array([picture.stamp_ns for picture in pictures])
    assert len(pictures) > 20
    assert np.diff(stamps_ns).min() >= 10**9
    assert all(picture.jpeg[:2] == b"\xff\xd8" for picture in pictures)
    shown = [picture for picture in pictures if picture.landmark_ids]
    detections = lane_recognition.detections
    for picture in shown:
        ids, probability = detections.rows(detections.stamps_ns == picture.stamp_ns).most_probable()
        assert picture.landmark_ids == tuple(ids.tolist())
        assert picture.probabilities == tuple(probability.tolist())
    assert len(shown) > 10


def test_of_many_pictures_every_second_one_is_given_up(lane, monkeypatch):
    monkeypatch.setattr("sonar_graph.recognition.session.MOST_PICTURES", 6)
    session = RecognitionSession(lane.sequence)
    for frame in one_by_one(lane.frames):
        session.take(frame)
        assert len(session.result.pictures) <= 6
    stamps_ns = np.array([picture.stamp_ns for picture in session.result.pictures])
    assert len(stamps_ns) >= 3
    assert np.ptp(np.diff(stamps_ns)) <= 10**9
    assert np.diff(stamps_ns).min() >= 4 * 10**9


def bad_frames(lane: Lane, at: int) -> dict[str, SonarFrames]:
    """Frames that must not be used, each to come instead of frame ``at``; by words of the reason."""
    frame, image = lane.one(at), lane.one(at).intensity
    bright = np.where(np.arange(image.shape[2]) < 300, 255, image).astype(np.uint8)
    return {
        "wrong size": replace(frame, intensity=image[:, :, :500], ranges_m=frame.ranges_m[:500]),
        "zero": replace(frame, intensity=np.zeros_like(image)),
        "saturated": replace(frame, intensity=bright),
        "not finite": replace(frame, intensity=np.where(np.arange(image.shape[2]) == 3, np.nan, image)),
        "out of order": lane.one(at - 10),
        "duplicated": lane.one(at - 1),
    }


BAD = ["wrong size", "zero", "saturated", "not finite", "out of order", "duplicated"]
AT, FRAMES = 30, 50


def with_one_replaced(lane: Lane, frame: SonarFrames | None) -> list[SonarFrames]:
    """The first frames, with another one or (None) a gap instead of frame `AT`."""
    frames = [lane.one(k) for k in range(FRAMES)]
    frames[AT : AT + 1] = [] if frame is None else [frame]
    return frames


@pytest.fixture(scope="module")
def without(lane) -> LandmarkDetections:
    """What is recognised when frame `AT` is not there at all."""
    return recognised(lane, with_one_replaced(lane, None)).detections


def assert_same_detections(found: LandmarkDetections, expected: LandmarkDetections) -> None:
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(found.range_m, expected.range_m, atol=1e-4)
    np.testing.assert_allclose(found.id_probability, expected.id_probability, atol=1e-2)


@pytest.mark.parametrize("is_from_log", [False, True], ids=["given", "in a log"])
@pytest.mark.parametrize("reason", BAD)
def test_a_bad_frame_is_named_in_a_warning_and_not_used(lane, without, reason, is_from_log, tmp_path):
    bad = bad_frames(lane, AT)[reason]
    if reason == "not finite":  # all frames of a log have one type of samples
        frames = [replace(f, intensity=f.intensity.astype(np.float32)) for f in with_one_replaced(lane, bad)]
    else:
        frames = with_one_replaced(lane, bad)
    if is_from_log:
        log = lane.write(tmp_path / "bad.mcap", frames)
        result = recognise_images(log, read_log(log))
    else:
        result = recognised(lane, frames)
    ((stamp_ns, warning),) = result.warnings
    assert stamp_ns == bad.stamps_ns[0]
    assert warning.startswith("frame not used: ")
    assert reason in warning
    assert result.outcomes[warning] == 1
    assert result.frames == FRAMES
    assert_same_detections(result.detections, without)


def test_the_notes_say_how_detections_came_about_and_warnings_are_counted_although_not_all_are_kept(lane, monkeypatch):
    monkeypatch.setattr("sonar_graph.recognition.session.MOST_WARNINGS", 3)
    params = RecogniserParams(identity=IdentityParams(rule="jeffrey"))
    zero = [replace(lane.one(FRAMES + k), intensity=np.zeros_like(lane.one(0).intensity)) for k in range(10)]
    result = recognised(lane, [*(lane.one(k) for k in range(FRAMES)), *zero], params=params)
    assert len(result.warnings) == 3
    assert result.outcomes["frame not used: all samples are zero"] == 10
    assert accepted(result.detections, truth_of(lane, result.detections)[0]) >= {(1, 1)}
    assert result.notes["detections"] == f"recognised in {FRAMES + 10} sonar images"
    assert result.notes["detections.designs"] == "1: disc, 2: square, 3: triangle, 4: cross"
    assert result.notes["detections.rule"] == "jeffrey"
    assert result.notes["detections.model"] != "not said"
    assert result.notes["detections.warnings"] == "10 x frame not used: all samples are zero"


def test_a_bad_first_frame_costs_hardly_more_than_itself(lane):
    """The first frame must not become the measure of all others."""
    frames = [bad_frames(lane, 11)["wrong size"], *(lane.one(k) for k in range(12, FRAMES))]
    result = recognised(lane, frames)
    assert 1 <= len(result.warnings) <= 3
    assert all("window" in reason for _, reason in result.warnings)
    assert accepted(result.detections, truth_of(lane, result.detections)[0]) >= {(1, 1)}


def test_frames_without_odometry_are_named_and_the_others_are_used(lane):
    sequence = lane.sequence
    late_ns, early_ns = sequence.end_ns + 1, sequence.start_ns - 1
    frames = [
        replace(lane.one(0), stamps_ns=np.array([early_ns])),
        *(lane.one(k) for k in range(20)),
        replace(lane.one(20), stamps_ns=np.array([late_ns])),
        *(lane.one(k) for k in range(20, 30)),
    ]
    result = recognised(lane, frames)
    assert result.warnings == [
        (stamp_ns, "frame not used: no IMU and Doppler log at its stamp") for stamp_ns in (early_ns, late_ns)
    ]
    assert_same_detections(result.detections, recognised(lane, [lane.one(k) for k in range(30)]).detections)


@pytest.mark.parametrize(("lens", "is_right"), [("didson", True), ("as-logged", False)])
def test_the_lens_of_the_calibration_puts_azimuths_right(lane, lens, is_right):
    sonar = lane.sequence.calibration.sonar.model_copy(update={"lens": lens})
    calibration = lane.sequence.calibration.model_copy(update={"sonar": sonar})
    told = replace(lane.frames, azimuths_rad=DIDSON.linear_azimuths_rad())
    session, errors = RecognitionSession(replace(lane.sequence, calibration=calibration), pictures=False), []
    for frame, truth in zip(one_by_one(told), lane.truth, strict=True):
        found = session.take(frame)
        for row, landmark in enumerate([] if found is None else found.most_probable()[0].tolist()):
            at = np.flatnonzero(truth.ids == landmark)
            errors += [found.azimuth_rad[row] - truth.azimuth_rad()[0, a] for a in at]
    assert len(errors) > 50
    assert (np.degrees(np.median(np.abs(errors))) < 0.1) == is_right
