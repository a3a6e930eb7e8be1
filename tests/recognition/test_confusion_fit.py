"""Laws of the fitted model, and the model measured on a lane whose truth is known."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.errors import CalibrationError
from sonar_graph.logs import read_log
from sonar_graph.recognition import confusion_fit
from sonar_graph.sonar import (
    EVIDENCE,
    IdentityParams,
    ObjectSighting,
    confusion_for,
    soft_scores,
)
from sonar_graph.sonar.bayes import bounded_evidence

BOUND = np.array([0.003, 0.0008])


def test_a_sighting_is_of_what_truly_lies_there():
    seen_m = np.array([2.0, 1.5])
    seen_rad = np.array([0.1, -0.2])
    there, behind = (
        confusion_fit.TrueObjects(np.array([5, 3]), seen_m, seen_rad + turn_rad)
        for turn_rad in (0.0, np.array([np.pi, -np.pi]))
    )
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
        seen = ObjectSighting(None, *place, np.eye(2))
        assert there.label_of(seen)[0] == label, place
        assert behind.label_of(seen)[0] == confusion_fit.NONE, place


def test_true_ranges_and_azimuths_are_those_of_the_simulator(lane):
    run = lane.sequence
    body_T_sonar = run.calibration.sonar.mounting.pose()
    for second in range(28):
        stamp_ns = int(run.truth.stamps_ns[50 * second])
        _, range_m, azimuth_rad = confusion_fit.true_objects(run, stamp_ns)
        motion = lane.path.at(np.array([float(second)]))
        attitude = gtsam.Rot3(motion.world_R_body[0].as_matrix())
        sonar = gtsam.Pose3(attitude, motion.position[0]) * body_T_sonar
        q = sonar.transformTo(run.true_landmarks.positions.T)
        assert range_m == pytest.approx(np.linalg.norm(q, axis=0), abs=1e-6)
        assert azimuth_rad == pytest.approx(np.arctan2(q[1], q[0]), abs=1e-6)


@pytest.fixture(scope="module", autouse=True)
def few_frames_are_enough():
    """A lane is shorter than what one would calibrate on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sonar_graph.recognition.confusion_fit.LEAST_FRAMES", 8)
        yield


def test_logs_count_together(lane_log, measured):
    run = read_log(lane_log)
    both = [(lane_log, run), (lane_log, replace(run, notes={}))]
    twice = confusion_fit.calibrate(both)
    said = twice.provenance
    assert said["logs"] == "lane.mcap, lane.mcap"
    assert said["what they are"] == "a lane; recorded"
    for name in ("frames of landmark 1", "tracks of landmark 1"):
        assert int(said[name]) == 2 * int(measured.provenance[name])
    # more tracks allow more certainty
    assert (np.diag(twice.matrix) > np.diag(measured.matrix)).all()


STRANGERS = tuple(replace(d, id=d.id + 6) for d in DEFAULT_DESIGNS[:2])
"""The designs of two landmarks under other identities."""


@pytest.mark.parametrize(
    ("changes", "designs", "words"),
    [
        ({"truth": None}, None, "has no true poses and true landmarks"),
        ({}, STRANGERS, "its true landmarks are 1, 2, 3, 4, the designs are 7, 8: "),
    ],
)
def test_logs_in_which_landmarks_cannot_be_labelled_are_refused_by_name(
    lane_log, changes, designs, words
):
    run = replace(read_log(lane_log), **changes)
    with pytest.raises(CalibrationError, match=rf"lane\.mcap: {words}"):
        confusion_fit.calibrate([(lane_log, run)], designs=designs)


def test_frames_outside_the_truth_are_not_labelled(lane_log, measured):
    run = read_log(lane_log)
    late = run.truth.rows(slice(len(run.truth.stamps_ns) // 3, None))
    model = confusion_fit.calibrate([(lane_log, replace(run, truth=late))])
    assert "landmark 1: " in model.provenance["confusion matrix"]
    assert model.matrix[0] == PRIOR.matrix[0]
    assert "confusion matrix" not in measured.provenance


PRIOR = confusion_for(DEFAULT_DESIGNS)


def _fits(per_class: int, noise: float, seed: int = 0) -> confusion_fit.LabelledFits:
    """Evidence whose log odds by the shipped weights are 3 for the true design and -3 for others."""
    rng = np.random.default_rng(seed)
    n = 3 * per_class
    label = np.repeat(np.arange(3), per_class)
    wanted = 3 * np.array([[1, -1], [-1, 1], [-1, -1]])[label]
    direction = np.zeros(len(EVIDENCE))
    direction[1] = 1 / PRIOR.weights[1]
    error = rng.normal(0, [0.01, 0.002], (n, 2))
    error[label == 2] = np.nan
    odds = wanted + rng.normal(0, noise, wanted.shape)
    return confusion_fit.LabelledFits(
        odds[..., None] * direction,
        np.tile(BOUND, (n, 1)),
        np.zeros((n, 2)),
        label,
        np.arange(n),
        np.ones(n),
        error,
        np.full(n, 0.5),
        np.arange(n) * 10**9,
    )


def _padded(odds: np.ndarray) -> np.ndarray:
    """With those of none."""
    return np.pad(odds, ((0, 0), (0, 1)))


def test_posteriors_of_tracks_are_calibrated_where_many_were_seen():
    """Landmarks are a twelfth as many as unknown objects, as the prior assumes."""
    of = [_fits(800, 4.0, seed) for seed in (0, 1)]
    rows = np.flatnonzero((of[0].label == 2) | (np.arange(2400) % 24 == 0))
    learnt, unseen = (some(fits, rows) for fits in of)
    model = confusion_fit.estimate_confusion(learnt, (1, 2), {})
    sums, counted, label, _ = confusion_fit.track_sums(unseen)
    odds = _padded(model.log_odds(sums))
    share = model.looks, model.doubt
    found = bounded_evidence(IdentityParams().birth(2), odds, counted, *share)
    right = found.argmax(axis=1) == label
    assert abs(found.max(axis=1).mean() - right.mean()) < 0.04


def test_matrix_is_the_posterior_mean_of_the_scores_of_each_class():
    fits = _fits(100, 1.0)
    model = confusion_fit.estimate_confusion(fits, (1, 2), {"origin": "made up"})
    scores = soft_scores(_padded(model.log_odds(fits.evidence)), model.looks)
    mean = scores.reshape(3, 100, 3).mean(axis=1)
    trials = np.array([[200], [200], [100]])
    np.testing.assert_allclose(model.matrix, (trials * mean + 0.5) / (trials + 1.5))
    assert model.provenance["origin"] == "made up"
    assert model.provenance["frames of landmark 1"] == "100"
    sigmas = model.range_sigma_m, model.across_sigma_m
    assert sigmas == pytest.approx((0.01, 0.002), rel=0.2)


def some(
    fits: confusion_fit.LabelledFits, rows: np.ndarray
) -> confusion_fit.LabelledFits:
    return confusion_fit.LabelledFits(*(column[rows] for column in vars(fits).values()))


def test_a_class_with_too_few_frames_is_named():
    few = some(_fits(100, 0.1), np.arange(205))
    with pytest.raises(CalibrationError, match="no landmark: 5"):
        confusion_fit.estimate_confusion(few, (1, 2), {})


def test_sigmas_are_root_mean_squares_at_the_usual_bound():
    """A landmark that is always seen 3 cm too far errs by that, and not by the spread about the mean."""
    fits = replace(_fits(300, 0.1), range_per_height=np.zeros(900))
    off = replace(fits, error_m=np.add(fits.error_m, [0.03, -0.005]))
    model = confusion_fit.estimate_confusion(off, (1, 2), {})
    sigmas = np.hypot([0.03, 0.005], [0.01, 0.002])
    found = model.range_sigma_m, model.across_sigma_m
    assert found == pytest.approx(sigmas, rel=0.05)
    after, before = (
        np.diag(one.range_azimuth_cov(BOUND[None], np.ones(1))[0])
        for one in (model, PRIOR)
    )
    # of 600 tracks; one is lost to the height; the prior counts as eight tracks
    squares = np.nansum(off.error_m**2, axis=0) + 8 * before
    np.testing.assert_allclose(after, squares / [607, 608], rtol=1e-9)


@pytest.mark.parametrize("power", [1.0, 2.2])
def test_the_power_of_the_bound_fits_good_and_bad_fits_alike(power):
    """Bounds spread over a factor of 30, of range and azimuth apart, and errors that grow with their power."""
    fits = replace(_fits(2000, 0.1), range_per_height=np.zeros(6000))
    rng = np.random.default_rng(3)
    times = np.exp(rng.uniform(-1.7, 1.7, (6000, 2)))
    error_m = fits.error_m * times**power
    spread = replace(fits, bound_m=BOUND * times, error_m=error_m)
    model = confusion_fit.estimate_confusion(spread, (1, 2), {})
    assert model.bound_power == pytest.approx(power, rel=0.05)
    cov = model.range_azimuth_cov(spread.bound_m, np.ones(6000))
    nis = error_m**2 / np.diagonal(cov, axis1=1, axis2=2)
    for is_such in (times > 2, times < 0.5):
        assert np.nanmean(nis[is_such]) == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize("rho", [0.0, 0.7])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_reports_of_a_track_are_as_many_as_the_mean_of_its_frames_is_worth(rho, offset):
    """Autoregressive errors in 400 tracks of 60 frames in 30 s, alone and with an offset of each track."""
    rng = np.random.default_rng(5)
    tracks = 400
    frames = 60
    errors = rng.standard_normal((frames, tracks, 2))
    for k in range(1, frames):
        errors[k] = rho * errors[k - 1] + np.sqrt(1 - rho**2) * errors[k]
    errors += offset * rng.standard_normal((tracks, 2))
    errors /= np.sqrt(1 + offset**2)
    number, of = np.divmod(np.arange(frames * tracks), tracks)
    stamp_ns = number * 10**9 // 2
    found_s = confusion_fit.report_interval_s(errors.reshape(-1, 2), of, stamp_ns, 0.0)
    lag = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    product = (rho**lag + offset**2) / (1 + offset**2)
    common = (product.sum() - frames) / (frames * (frames - 1))
    expected_s = 29.5 * common * tracks / (tracks + 16)
    assert found_s == pytest.approx(expected_s, rel=0.1, abs=0.3)
