"""Laws of the fitted model, and the model measured on a lane whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS
from sonar_graph.errors import CalibrationError
from sonar_graph.logs.reading import read_log
from sonar_graph.recognition import confusion_fit
from sonar_graph.sonar.appearance import DesignFit, ObjectSighting
from sonar_graph.sonar.bayes import virtual_evidence
from sonar_graph.sonar.confusion import Confusion, soft_scores
from sonar_graph.sonar.recogniser import Recogniser, RecogniserParams

IDS, RANGE_M, AZIMUTH_RAD = np.array([5, 3]), np.array([2.0, 1.5]), np.array([0.1, -0.2])


def sighting(range_m: float, azimuth_rad: float, *, is_fitted: bool = True, is_compared: bool = True) -> ObjectSighting:
    fit = DesignFit(np.array([0.9, 0.3]), 0.95, 0, 0.0, np.zeros(2)) if is_compared else None
    return ObjectSighting(fit, range_m, azimuth_rad, np.eye(2), is_fitted)


def test_a_sighting_is_of_what_truly_lies_there():
    behind = np.array([0.1 + np.pi, -0.2 - np.pi])
    for place, label in (
        ((2.07, 0.1), 5),
        ((2.0, 0.1 + 0.07 / 2), 5),
        ((1.5, -0.2), 3),
        ((2.09, 0.1), confusion_fit.NO_LABEL),
        ((2.0, 0.1 + 0.09 / 2), confusion_fit.NO_LABEL),
        ((2.39, 0.1), confusion_fit.NO_LABEL),
        ((2.41, 0.1), confusion_fit.NONE),
        ((2.0, 0.1 + 0.42 / 2), confusion_fit.NONE),
    ):
        assert confusion_fit.label_of(sighting(*place), IDS, RANGE_M, AZIMUTH_RAD)[0] == label, place
        assert confusion_fit.label_of(sighting(*place), IDS, RANGE_M, behind)[0] == confusion_fit.NONE, place


def test_sightings_become_columns_with_their_errors():
    gathered, stranger = map(confusion_fit.LabelledSightings, ((3, 5), (3, 9)))  # no design is of landmark 5
    fitted, other = sighting(2.01, 0.102), sighting(1.49, -0.2, is_fitted=False)
    for seen in (fitted, other, sighting(3.0, 0.1), sighting(2.2, 0.1), sighting(2.0, 0.1, is_compared=False)):
        gathered.add(seen, (0, 7), IDS, RANGE_M, AZIMUTH_RAD)
    stranger.add(fitted, (0, 1), IDS, RANGE_M, AZIMUTH_RAD)
    fits = gathered.fits()
    assert fits.label.tolist() == [1, 0, 2]  # in the order of the designs; what is unclear or not compared is left out
    np.testing.assert_allclose(fits.correlation, np.tile([0.9, 0.3], (3, 1)))
    np.testing.assert_allclose(fits.visible, 0.95)
    np.testing.assert_allclose(fits.range_azimuth_error[0], [0.01, 0.002])
    assert np.isnan(fits.range_azimuth_error[1:]).all()  # a centroid's error is not that of a fitted centre
    assert stranger.fits().correlation.shape == (0, 2)


@given(st.integers(0, 27))
def test_true_ranges_and_azimuths_are_those_of_the_simulator(lane, second: int):
    stamp_ns = int(lane.sequence.truth.stamps_ns[50 * second])
    range_m, azimuth_rad = confusion_fit.true_ranges_azimuths(lane.sequence, stamp_ns)
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
    return confusion_fit.calibrate([(lane_log, read_log(lane_log))])


def test_a_model_measured_on_a_log_is_of_its_landmarks_and_says_where_it_comes_from(lane, measured):
    assert measured.ids == (1, 2, 3, 4)
    matrix, said = np.array(measured.matrix), measured.provenance
    assert (matrix.argmax(axis=1) == np.arange(5)).all()
    assert np.diag(matrix).mean() > 0.4
    assert said["logs"] == "lane.mcap"
    assert said["what they are"] == lane.sequence.notes["ours"] == "a lane"
    counts = [int(said[f"frames of {name}"]) for name in (*(f"landmark {k}" for k in measured.ids), "no landmark")]
    assert min(counts) >= 8
    assert measured.range_sigma_m < 0.02
    assert np.degrees(measured.azimuth_sigma_rad) < 0.5
    assert Recogniser(lane.sequence.calibration, params=RecogniserParams(confusion=measured)).confusion is measured


def test_logs_count_together(lane_log, measured):
    run = read_log(lane_log)
    twice = confusion_fit.calibrate([(lane_log, run), (lane_log, replace(run, notes={}))])
    said, once = twice.provenance, measured.provenance
    assert (said["logs"], said["what they are"]) == ("lane.mcap, lane.mcap", "a lane; recorded")
    for name in ("frames of landmark 1", "tracks of landmark 1"):
        assert int(said[name]) == 2 * int(once[name])
    assert (np.diag(twice.matrix) > np.diag(measured.matrix)).all()  # more tracks allow more certainty


def test_frames_that_come_too_late_count_nothing_again(lane, measured, tmp_path):
    """Every fifth frame is followed by an older one, which is refused while the sightings before it are still known."""
    rows = [row for k in range(len(lane.frames)) for row in ([k, k - 3] if k % 5 == 4 else [k])]
    late = lane.write(tmp_path / "lane.mcap", [lane.one(row) for row in rows])
    assert len(rows) > len(lane.frames) + 20
    assert confusion_fit.calibrate([(late, read_log(late))]) == measured


STRANGERS = tuple(replace(d, id=d.id + 6) for d in DEFAULT_DESIGNS[:2])
"""The designs of two landmarks under other identities."""


@pytest.mark.parametrize(
    ("changes", "designs", "words"),
    [
        ({"truth": None}, None, r"lane\.mcap: without true poses and true landmarks"),
        ({"true_landmarks": None}, None, r"lane\.mcap: without true poses and true landmarks"),
        ({}, STRANGERS, r"lane\.mcap: its true landmarks are 1, 2, 3, 4, the designs are 7, 8: "),
        ({}, (DEFAULT_DESIGNS[0], STRANGERS[1]), r"landmark 8: 0"),
        ({"truth": "late"}, None, "landmark 1: "),  # frames outside the truth are not labelled
    ],
)
def test_logs_in_which_landmarks_cannot_be_labelled_are_refused_by_name(lane_log, changes, designs, words):
    run = read_log(lane_log)
    if changes.get("truth"):
        stamps_ns = run.truth.stamps_ns
        changes = {"truth": run.truth.rows(stamps_ns >= stamps_ns[len(stamps_ns) // 3])}
    with pytest.raises(CalibrationError, match=words):
        confusion_fit.calibrate([(lane_log, replace(run, **changes))], designs=designs)


def _fits(per_class: int, noise: float, seed: int = 0) -> confusion_fit.LabelledFits:
    """Correlations of 0.9 with the true design and 0.7 with others; of 0.6 with all where there is none."""
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(3), per_class)
    means = np.array([[0.9, 0.7], [0.7, 0.9], [0.6, 0.6]])[label]
    error = np.where((label < 2)[:, None], rng.normal(0, [0.01, 0.002], (len(label), 2)), np.nan)
    return confusion_fit.LabelledFits(
        means + rng.normal(0, noise, means.shape), np.ones(len(label)), label, np.arange(len(label)), error
    )


def test_scores_that_are_fitted_are_calibrated():
    fitted, unseen = confusion_fit.estimate_confusion(_fits(400, 0.08), (1, 2), {}), _fits(400, 0.08, seed=1)
    scores = soft_scores(unseen.correlation, unseen.visible, fitted.sharpness, fitted.threshold)
    confidence, right = scores.max(axis=1), scores.argmax(axis=1) == unseen.label
    assert abs(confidence.mean() - right.mean()) < 0.04
    assert 0.6 < fitted.threshold < 0.9


def test_matrix_is_the_posterior_mean_of_the_scores_of_each_class():
    fits = _fits(100, 0.1)
    model = confusion_fit.estimate_confusion(fits, (1, 2), {"origin": "made up"})
    scores = soft_scores(fits.correlation, fits.visible, model.sharpness, model.threshold)
    for k in range(3):
        trials = (200, 200, 100)[k]
        expected = (trials * scores[fits.label == k].mean(axis=0) + 0.5) / (trials + 1.5)
        np.testing.assert_allclose(np.array(model.matrix)[k], expected)
    assert model.provenance["origin"] == "made up"
    assert model.provenance["frames of landmark 1"] == "100"
    sigmas = model.range_sigma_m, model.azimuth_sigma_rad
    assert sigmas == pytest.approx((0.01, 0.002), rel=0.2)


@pytest.mark.parametrize("tracks", [5, 100])
def test_frames_that_never_were_confused_are_as_sure_as_their_tracks_allow_within_a_standard_error(tracks: int):
    """With n tracks, those of all landmarks or those of none, (n + 1/2) / (n + 3/2) is certainty. The loss is the
    entropy of that, half a nat over all tracks, and a little for what two numbers cannot fit."""
    fits = _fits(200, 0.01)
    fits = replace(fits, track=np.arange(600) % tracks + 1000 * fits.label)
    model = confusion_fit.estimate_confusion(fits, (1, 2), {})
    scores = soft_scores(fits.correlation, fits.visible, model.sharpness, model.threshold)
    posterior = virtual_evidence(np.full((600, 3), 1 / 3), scores, model.array(), model.base(), np.ones(600))
    n = np.array([2 * tracks, 2 * tracks, tracks])[fits.label]
    sure, unsure = (n + 0.5) / (n + 1.5), 0.5 / (n + 1.5)
    own = np.eye(3, dtype=bool)[fits.label]
    entropy = -(sure * np.log(sure) + 2 * unsure * np.log(unsure)).mean()
    loss = -np.where(own, sure[:, None], unsure[:, None]) * np.log(posterior)
    assert 0.49 <= (loss.sum(axis=1).mean() - entropy) * 3 * tracks <= 1.0
    assert posterior[own].mean() < sure.mean() + 0.001
    assert model.provenance["tracks of landmark 2"] == str(tracks)
    assert model.sharpness < 100


def some(fits: confusion_fit.LabelledFits, rows: np.ndarray) -> confusion_fit.LabelledFits:
    return confusion_fit.LabelledFits(*(column[rows] for column in vars(fits).values()))


def test_a_class_with_too_few_frames_is_named():
    with pytest.raises(CalibrationError, match="no landmark: 5"):
        confusion_fit.estimate_confusion(some(_fits(100, 0.1), np.arange(205)), (1, 2), {})


def test_sigmas_are_root_mean_squares_of_a_landmark_that_is_wholly_in_view():
    """A landmark that is always seen 3 cm too far errs by that, and not by the spread about the mean."""
    fits = _fits(300, 0.1)
    off = replace(fits, range_azimuth_error=fits.range_azimuth_error + np.array([0.03, -0.005]))
    cut = replace(fits, visible=np.full(900, 0.7), range_azimuth_error=fits.range_azimuth_error / 0.7**2)
    model, partly = (confusion_fit.estimate_confusion(f, (1, 2), {}) for f in (off, cut))
    sigmas = np.hypot([0.03, 0.005], [0.01, 0.002])
    assert [model.range_sigma_m, model.azimuth_sigma_rad] == pytest.approx(sigmas, rel=0.05)
    assert partly.range_sigma_m == pytest.approx(0.01, rel=0.15)
    variances = np.nanmean(cut.range_azimuth_error**2, axis=0)
    np.testing.assert_allclose(np.diag(partly.range_azimuth_cov(0.7)), variances, rtol=1e-9)


def test_a_class_that_was_seen_more_often_counts_no_more():
    """Every frame of the first class five times over, on the same tracks."""
    fits = _fits(60, 0.1)
    more = some(fits, np.concatenate([np.repeat(np.arange(60), 5), np.arange(60, 180)]))
    one, other = (confusion_fit.estimate_confusion(f, (1, 2), {}) for f in (fits, more))
    assert other.sharpness == pytest.approx(one.sharpness, rel=0.01)
    assert other.threshold == pytest.approx(one.threshold, abs=0.002)
    np.testing.assert_allclose(other.matrix, one.matrix, atol=2e-3)


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_the_correlation_of_errors_is_that_of_successive_frames_of_a_track(rho):
    rng = np.random.default_rng(5)
    tracks, frames = 40, 100
    errors = rng.standard_normal((tracks, frames, 2))
    for k in range(1, frames):
        errors[:, k] = rho * errors[:, k - 1] + np.sqrt(1 - rho**2) * errors[:, k]
    order = rng.permuted(np.tile(np.arange(tracks), frames))  # tracks are seen side by side
    row = np.zeros(tracks, dtype=int)
    error, track = [], []
    for which in order.tolist():
        error.append(errors[which, row[which]])
        track.append(which)
        row[which] += 1
    fits = replace(_fits(2, 0.1), track=np.array(track), range_azimuth_error=np.array(error) * [1e-3, 4e-4])
    assert confusion_fit.error_correlation(fits) == pytest.approx(rho, abs=0.03)
    unknown = replace(fits, range_azimuth_error=np.full((len(order), 2), np.nan))
    assert confusion_fit.error_correlation(unknown) == 0.0
