"""Laws of the fitted model, and the model measured on a lane whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.errors import CalibrationError
from sonar_graph.logs import read_log
from sonar_graph.recognition import confusion_fit
from sonar_graph.sonar import (
    EVIDENCE,
    Confusion,
    IdentityParams,
    ObjectSighting,
    confusion_for,
    soft_scores,
)
from sonar_graph.sonar.bayes import bounded_evidence

BOUND = np.array([0.003, 0.0008])
IDS = np.array([5, 3])
RANGE_M = np.array([2.0, 1.5])
AZIMUTH_RAD = np.array([0.1, -0.2])


def test_a_sighting_is_of_what_truly_lies_there():
    there = confusion_fit.TrueObjects(IDS, RANGE_M, AZIMUTH_RAD)
    behind = confusion_fit.TrueObjects(
        IDS, RANGE_M, np.array([0.1 + np.pi, -0.2 - np.pi])
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


@given(st.integers(0, 27))
def test_true_ranges_and_azimuths_are_those_of_the_simulator(lane, second: int):
    stamp_ns = int(lane.sequence.truth.stamps_ns[50 * second])
    _, range_m, azimuth_rad = confusion_fit.true_objects(lane.sequence, stamp_ns)
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


def test_logs_count_together(lane_log, measured):
    run = read_log(lane_log)
    twice = confusion_fit.calibrate(
        [(lane_log, run), (lane_log, replace(run, notes={}))]
    )
    said = twice.provenance
    once = measured.provenance
    assert (said["logs"], said["what they are"]) == (
        "lane.mcap, lane.mcap",
        "a lane; recorded",
    )
    for name in ("frames of landmark 1", "tracks of landmark 1"):
        assert int(said[name]) == 2 * int(once[name])
    assert (
        np.diag(twice.matrix) > np.diag(measured.matrix)
    ).all()  # more tracks allow more certainty


STRANGERS = tuple(replace(d, id=d.id + 6) for d in DEFAULT_DESIGNS[:2])
"""The designs of two landmarks under other identities."""


@pytest.mark.parametrize(
    ("changes", "designs", "words"),
    [
        ({"truth": None}, None, r"lane\.mcap: has no true poses and true landmarks"),
        (
            {},
            STRANGERS,
            r"lane\.mcap: its true landmarks are 1, 2, 3, 4, the designs are 7, 8: ",
        ),
    ],
)
def test_logs_in_which_landmarks_cannot_be_labelled_are_refused_by_name(
    lane_log, changes, designs, words
):
    with pytest.raises(CalibrationError, match=words):
        confusion_fit.calibrate(
            [(lane_log, replace(read_log(lane_log), **changes))], designs=designs
        )


def test_frames_outside_the_truth_are_not_labelled(lane_log, measured):
    run = read_log(lane_log)
    late = run.truth.rows(
        run.truth.stamps_ns >= run.truth.stamps_ns[len(run.truth.stamps_ns) // 3]
    )
    model = confusion_fit.calibrate([(lane_log, replace(run, truth=late))])
    assert "landmark 1: " in model.provenance["confusion matrix"]
    assert model.matrix[0] == PRIOR.matrix[0]
    assert "confusion matrix" not in measured.provenance


PRIOR = confusion_for(DEFAULT_DESIGNS)


def _fits(
    per_class: int, noise: float, seed: int = 0, scale: float = 1.0
) -> confusion_fit.LabelledFits:
    """Evidence whose log odds by the shipped weights are 3 times ``scale`` for the true design and -3 for others."""
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(3), per_class)
    wanted = 3 * scale * np.array([[1, -1], [-1, 1], [-1, -1]])[label]
    direction = np.zeros(len(EVIDENCE))
    direction[1] = 1 / PRIOR.weights[1]
    error = np.where(
        (label < 2)[:, None], rng.normal(0, [0.01, 0.002], (len(label), 2)), np.nan
    )
    odds = wanted + rng.normal(0, noise, wanted.shape)
    n = len(label)
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


def _posteriors(fits: confusion_fit.LabelledFits, model: Confusion) -> np.ndarray:
    sums, counted, _, _ = confusion_fit.track_sums(fits)
    odds = np.pad(model.log_odds(sums), ((0, 0), (0, 1)))
    return bounded_evidence(
        IdentityParams().birth(2), odds, counted, model.looks, model.doubt
    )


def test_posteriors_of_tracks_are_calibrated_where_many_were_seen():
    """Landmarks are a twelfth as many as unknown objects, as the prior assumes."""
    of = [_fits(800, 4.0, seed) for seed in (0, 1)]
    rows = np.flatnonzero((of[0].label == 2) | (np.arange(2400) % 24 == 0))
    learnt, unseen = (some(fits, rows) for fits in of)
    model = confusion_fit.estimate_confusion(learnt, (1, 2), {})
    found = _posteriors(unseen, model)
    label = confusion_fit.track_sums(unseen)[2]
    confidence = found.max(axis=1)
    right = found.argmax(axis=1) == label
    assert abs(confidence.mean() - right.mean()) < 0.04


def test_matrix_is_the_posterior_mean_of_the_scores_of_each_class():
    fits = _fits(100, 1.0)
    model = confusion_fit.estimate_confusion(fits, (1, 2), {"origin": "made up"})
    scores = soft_scores(
        np.pad(model.log_odds(fits.evidence), ((0, 0), (0, 1))), model.looks
    )
    for k in range(3):
        trials = (200, 200, 100)[k]
        expected = (trials * scores[fits.label == k].mean(axis=0) + 0.5) / (
            trials + 1.5
        )
        np.testing.assert_allclose(np.array(model.matrix)[k], expected)
    assert model.provenance["origin"] == "made up"
    assert model.provenance["frames of landmark 1"] == "100"
    sigmas = model.range_sigma_m, model.across_sigma_m
    assert sigmas == pytest.approx((0.01, 0.002), rel=0.2)


def some(
    fits: confusion_fit.LabelledFits, rows: np.ndarray
) -> confusion_fit.LabelledFits:
    return confusion_fit.LabelledFits(*(column[rows] for column in vars(fits).values()))


def test_a_class_with_too_few_frames_is_named():
    with pytest.raises(CalibrationError, match="no landmark: 5"):
        confusion_fit.estimate_confusion(
            some(_fits(100, 0.1), np.arange(205)), (1, 2), {}
        )


def test_sigmas_are_root_mean_squares_at_the_usual_bound():
    """A landmark that is always seen 3 cm too far errs by that, and not by the spread about the mean."""
    fits = replace(_fits(300, 0.1), range_per_height=np.zeros(900))
    off = replace(fits, error_m=fits.error_m + np.array([0.03, -0.005]))
    model = confusion_fit.estimate_confusion(off, (1, 2), {})
    sigmas = np.hypot([0.03, 0.005], [0.01, 0.002])
    assert [model.range_sigma_m, model.across_sigma_m] == pytest.approx(
        sigmas, rel=0.05
    )
    # of 600 tracks; one is lost to the height
    squares = np.nansum(off.error_m**2, axis=0)
    # counts as eight tracks
    before = np.diag(PRIOR.range_azimuth_cov(BOUND[None], np.ones(1))[0])
    np.testing.assert_allclose(
        np.diag(model.range_azimuth_cov(BOUND[None], np.ones(1))[0]),
        (squares + 8 * before) / [607, 608],
        rtol=1e-9,
    )


@pytest.mark.parametrize(("power", "within"), [(1.0, 0.05), (2.2, 0.05)])
def test_the_power_of_the_bound_fits_good_and_bad_fits_alike(
    power: float, within: float
):
    """Bounds spread over a factor of 30, of range and azimuth apart, and errors that grow with their power."""
    fits = replace(_fits(2000, 0.1), range_per_height=np.zeros(6000))
    rng = np.random.default_rng(3)
    times = np.exp(rng.uniform(-1.7, 1.7, (6000, 2)))
    spread = replace(fits, bound_m=BOUND * times, error_m=fits.error_m * times**power)
    model = confusion_fit.estimate_confusion(spread, (1, 2), {})
    assert model.bound_power == pytest.approx(power, rel=within)
    seen = fits.label < 2
    nis = spread.error_m**2 / np.diagonal(
        model.range_azimuth_cov(spread.bound_m, np.ones(6000)), axis1=1, axis2=2
    )
    for rows in (seen[:, None] & (times > 2), seen[:, None] & (times < 0.5)):
        assert nis[rows].mean() == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize("rho", [0.0, 0.7])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_reports_of_a_track_are_as_many_as_the_mean_of_its_frames_is_worth(
    rho: float, offset: float
):
    """Autoregressive errors in 400 tracks of 60 frames in 30 s, alone and with an offset of each track."""
    rng = np.random.default_rng(5)
    tracks = 400
    frames = 60
    errors = rng.standard_normal((tracks, frames, 2))
    for k in range(1, frames):
        errors[:, k] = rho * errors[:, k - 1] + np.sqrt(1 - rho**2) * errors[:, k]
    errors += offset * rng.standard_normal((tracks, 1, 2))
    errors /= np.sqrt(1 + offset**2)
    of = np.tile(np.arange(tracks), frames)
    stamp_ns = np.repeat(np.arange(frames), tracks) * 10**9 // 2
    found_s = confusion_fit.report_interval_s(
        errors.transpose(1, 0, 2).reshape(-1, 2), of, stamp_ns, 0.0
    )
    lag = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    product = (rho**lag + offset**2 * np.ones_like(lag)) / (1 + offset**2)
    common = (product.sum() - frames) / (frames * (frames - 1))
    assert found_s == pytest.approx(
        29.5 * common * tracks / (tracks + 16), rel=0.1, abs=0.3
    )
