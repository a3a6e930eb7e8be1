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
from sonar_graph.sonar.bayes import IdentityParams, bounded_evidence
from sonar_graph.sonar.confusion import Confusion, confusion_for, soft_scores
from sonar_graph.sonar.evidence import EVIDENCE
from sonar_graph.sonar.recogniser import Recogniser, RecogniserParams

BOUND, MOVED = np.array([0.003, 0.0008]), np.array([0.0, 0.004])
IDS, RANGE_M, AZIMUTH_RAD = (
    np.array([5, 3]),
    np.array([2.0, 1.5]),
    np.array([0.1, -0.2]),
)


def sighting(
    range_m: float, azimuth_rad: float, *, is_compared: bool = True
) -> ObjectSighting:
    evidence = np.outer([0.9, 0.3], np.ones(len(EVIDENCE)))
    if not is_compared:
        return ObjectSighting(None, range_m, azimuth_rad, np.eye(2), 0.5)
    fit = DesignFit(
        evidence, 0.95, np.zeros(2), np.zeros((2, 2)), np.zeros(2, int), np.full(2, -1)
    )
    return ObjectSighting(fit, range_m, azimuth_rad, np.eye(2), 0.5, BOUND, MOVED)


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
        assert (
            confusion_fit.label_of(sighting(*place), IDS, RANGE_M, AZIMUTH_RAD)[0]
            == label
        ), place
        assert (
            confusion_fit.label_of(sighting(*place), IDS, RANGE_M, behind)[0]
            == confusion_fit.NONE
        ), place


def test_sightings_become_columns_with_their_errors():
    # no design is of landmark 5
    gathered, stranger = map(confusion_fit.LabelledSightings, ((3, 5), (3, 9)))
    fitted = sighting(2.01, 0.102)
    for news, seen in enumerate(
        (
            fitted,
            sighting(1.49, -0.2),
            sighting(3.0, 0.1),
            sighting(2.2, 0.1),
            sighting(2.0, 0.1, is_compared=False),
        )
    ):
        gathered.add(seen, 1000 + news, (0, 7), news / 4, IDS, RANGE_M, AZIMUTH_RAD)
    stranger.add(fitted, 1000, (0, 1), 1.0, IDS, RANGE_M, AZIMUTH_RAD)
    fits = gathered.fits()
    # in the order of the designs; what is unclear or not compared is left out
    assert fits.label.tolist() == [
        1,
        0,
        2,
    ]
    np.testing.assert_allclose(fits.evidence, np.tile(fitted.fit.evidence, (3, 1, 1)))
    np.testing.assert_allclose(fits.bound_m, [BOUND] * 3)
    np.testing.assert_allclose(fits.moved_m, [MOVED] * 3)
    np.testing.assert_allclose(fits.news, [0, 0.25, 0.5])
    np.testing.assert_allclose(fits.range_per_height, 0.5)
    assert fits.stamp_ns.tolist() == [1000, 1001, 1002]
    np.testing.assert_allclose(
        fits.error_m[:2], [[0.01, 0.004], [-0.01, 0]], atol=1e-12
    )
    assert np.isnan(fits.error_m[2]).all()
    assert stranger.fits().evidence.shape == (0, 2, len(EVIDENCE))


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


def test_a_model_measured_on_a_log_is_of_its_landmarks_and_says_where_it_comes_from(
    lane, measured
):
    assert measured.ids == (1, 2, 3, 4)
    matrix, said = np.array(measured.matrix), measured.provenance
    assert (matrix.argmax(axis=1) == np.arange(5)).all()
    assert np.diag(matrix).mean() > 0.4
    assert said["logs"] == "lane.mcap"
    assert said["what they are"] == lane.sequence.notes["ours"] == "a lane"
    counts = [
        int(said[f"frames of {name}"])
        for name in (*(f"landmark {k}" for k in measured.ids), "no landmark")
    ]
    assert min(counts) >= 8
    assert measured.range_sigma_m < 0.02
    assert measured.across_sigma_m < 0.02
    assert (
        Recogniser(
            lane.sequence.calibration, params=RecogniserParams(confusion=measured)
        ).confusion
        is measured
    )


def test_logs_count_together(lane_log, measured):
    run = read_log(lane_log)
    twice = confusion_fit.calibrate(
        [(lane_log, run), (lane_log, replace(run, notes={}))]
    )
    said, once = twice.provenance, measured.provenance
    assert (said["logs"], said["what they are"]) == (
        "lane.mcap, lane.mcap",
        "a lane; recorded",
    )
    for name in ("frames of landmark 1", "tracks of landmark 1"):
        assert int(said[name]) == 2 * int(once[name])
    assert (
        np.diag(twice.matrix) > np.diag(measured.matrix)
    ).all()  # more tracks allow more certainty


def test_frames_that_come_too_late_count_nothing_again(lane, measured, tmp_path):
    """Every fifth frame is followed by an older one, which is refused while the sightings before it are still known."""
    rows = [
        row
        for k in range(len(lane.frames))
        for row in ([k, k - 3] if k % 5 == 4 else [k])
    ]
    late = lane.write(tmp_path / "lane.mcap", [lane.one(row) for row in rows])
    assert len(rows) > len(lane.frames) + 20
    assert confusion_fit.calibrate([(late, read_log(late))]) == measured


STRANGERS = tuple(replace(d, id=d.id + 6) for d in DEFAULT_DESIGNS[:2])
"""The designs of two landmarks under other identities."""


@pytest.mark.parametrize(
    ("changes", "designs", "words"),
    [
        ({"truth": None}, None, r"lane\.mcap: has no true poses and true landmarks"),
        (
            {"true_landmarks": None},
            None,
            r"lane\.mcap: has no true poses and true landmarks",
        ),
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


def test_what_a_cover_moves_is_no_part_of_the_usual_sigma():
    """A quarter of the landmarks' sightings errs by 5 cm more, and says so; where all do, all count."""
    fits, rng = _fits(200, 1.0), np.random.default_rng(2)
    is_landmark = fits.label < 2
    is_covered = is_landmark & (rng.random(len(fits.label)) < 0.25)
    moved = np.where(is_covered[:, None], 0.05, 0.0)
    hidden = replace(
        fits, error_m=fits.error_m + moved * rng.choice([-1, 1], moved.shape)
    )
    plain, told, untold = (
        confusion_fit.estimate_confusion(one, (5, 3), {})
        for one in (replace(fits, error_m=np.where(is_covered[:, None], np.nan, fits.error_m)),
                    replace(hidden, moved_m=moved), hidden)
    )  # fmt: skip
    assert (told.range_sigma_m, told.across_sigma_m) == pytest.approx(
        (plain.range_sigma_m, plain.across_sigma_m), rel=0.1
    )
    assert untold.across_sigma_m > 4 * told.across_sigma_m
    everywhere = replace(hidden, moved_m=np.where(is_landmark[:, None], 0.01, 0.0))
    assert confusion_fit.estimate_confusion(
        everywhere, (5, 3), {}
    ).across_sigma_m == pytest.approx(untold.across_sigma_m)


def _posteriors(fits: confusion_fit.LabelledFits, model: Confusion) -> np.ndarray:
    sums, counted, _, _ = confusion_fit.track_sums(fits)
    odds = np.pad(model.log_odds(sums), ((0, 0), (0, 1)))
    return bounded_evidence(
        IdentityParams().birth(2), odds, counted, model.looks, model.doubt
    )


def test_posteriors_of_tracks_are_calibrated_where_many_were_seen():
    """Landmarks are a twelfth as many as unknown objects, as the prior says."""
    of = [_fits(800, 4.0, seed) for seed in (0, 1)]
    rows = np.flatnonzero((of[0].label == 2) | (np.arange(2400) % 24 == 0))
    learnt, unseen = (some(fits, rows) for fits in of)
    model = confusion_fit.estimate_confusion(learnt, (1, 2), {})
    found, label = _posteriors(unseen, model), confusion_fit.track_sums(unseen)[2]
    confidence, right = found.max(axis=1), found.argmax(axis=1) == label
    assert abs(confidence.mean() - right.mean()) < 0.04


def test_a_few_tracks_move_the_weights_little_and_many_more():
    few, many = (
        confusion_fit.estimate_confusion(_fits(n, 2.0, scale=0.3), (1, 2), {})
        for n in (8, 1000)
    )
    off = [
        abs(np.array(m.weights) / np.array(PRIOR.weights) - 1).max()
        for m in (few, many)
    ]
    assert off[0] < 0.1 < off[1]
    assert few.looks == pytest.approx(PRIOR.looks, rel=0.1)


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


def test_a_height_of_the_faces_is_a_bias_and_not_noise():
    """Faces 24 mm over the landmarks' places are seen 12 mm nearer where the sonar is half as high as they are far."""
    fits = _fits(300, 1.0)
    near = replace(fits, error_m=fits.error_m - np.array([0.012, 0.0]))
    model = confusion_fit.estimate_confusion(near, (1, 2), {})
    assert model.height_bias_m == pytest.approx(0.024, abs=0.002)
    assert model.range_sigma_m == pytest.approx(0.01, rel=0.1)
    unknown = replace(near, range_per_height=np.zeros(900))
    assert confusion_fit.estimate_confusion(unknown, (1, 2), {}).height_bias_m == 0.0


def some(
    fits: confusion_fit.LabelledFits, rows: np.ndarray
) -> confusion_fit.LabelledFits:
    return confusion_fit.LabelledFits(*(column[rows] for column in vars(fits).values()))


def test_a_track_counts_once_for_the_height_however_long_it_is_watched():
    """Two landmarks, 1 and 3 cm higher than their places; the second is watched for ten frames as long."""
    fits = some(_fits(20, 0.1), np.array([0, *[1] * 10]))
    off = np.array([-0.01, *[-0.03] * 10])
    fits = replace(
        fits, error_m=np.column_stack([off, 0 * off]), range_per_height=np.ones(11)
    )
    assert confusion_fit.without_height(fits)[0] == pytest.approx(0.02)


def test_landmarks_and_others_count_by_the_prior_however_many_tracks_there_are_of_each():
    """40 tracks of landmarks and 4 of others, and one that was never seen from a new place, which is none."""
    fits = some(_fits(20, 0.1), np.arange(45))
    _, _, label, share = confusion_fit.track_sums(replace(fits, news=np.arange(45) > 0))
    unknown = IdentityParams().unknown_prior
    assert len(label) == 44
    assert [share[label < 2].sum(), share[label == 2].sum()] == pytest.approx(
        [44 * (1 - unknown), 44 * unknown]
    )


def test_a_class_with_too_few_frames_is_named():
    with pytest.raises(CalibrationError, match="no landmark: 5"):
        confusion_fit.estimate_confusion(
            some(_fits(100, 0.1), np.arange(205)), (1, 2), {}
        )


def test_a_design_that_was_not_seen_keeps_the_row_of_no_calibration_and_moves_nothing_else():
    """Landmark 2 of two is missing; no landmark at all, or nothing that is none, is refused."""
    first, second = (replace(DEFAULT_DESIGNS[0], id=k) for k in (1, 2))
    fits = _fits(100, 0.1)
    seen = some(fits, np.flatnonzero(fits.label != 1))
    model = confusion_fit.estimate_confusion(seen, (1, 2), {}, (first, second))
    alone = confusion_fit.estimate_confusion(fits, (1, 2), {}, (first, second))
    assert (
        model.matrix[1] == confusion_for((first, second)).matrix[1] != alone.matrix[1]
    )
    assert model.matrix[0][0] == pytest.approx(alone.matrix[0][0], abs=0.05)
    assert model.range_sigma_m == pytest.approx(alone.range_sigma_m, rel=0.2)
    assert (
        model.provenance["confusion matrix"]
        == "too few frames, so as without calibration: landmark 2: 0"
    )
    assert "confusion matrix" not in alone.provenance
    for label in (0, 2):
        only = some(fits, np.flatnonzero(fits.label == label))
        with pytest.raises(CalibrationError, match="too few labelled frames"):
            confusion_fit.estimate_confusion(only, (1, 2), {}, (first, second))


def test_sigmas_are_root_mean_squares_at_the_usual_bound():
    """A landmark that is always seen 3 cm too far errs by that, and not by the spread about the mean."""
    fits = replace(_fits(300, 0.1), range_per_height=np.zeros(900))
    off = replace(fits, error_m=fits.error_m + np.array([0.03, -0.005]))
    model = confusion_fit.estimate_confusion(off, (1, 2), {})
    sigmas = np.hypot([0.03, 0.005], [0.01, 0.002])
    assert [model.range_sigma_m, model.across_sigma_m] == pytest.approx(
        sigmas, rel=0.05
    )
    # of 600 tracks, one of which is lost to the height
    squares = np.nansum(off.error_m**2, axis=0)
    # counts as eight tracks
    before = np.diag(PRIOR.range_azimuth_cov(BOUND[None], np.ones(1))[0])
    np.testing.assert_allclose(
        np.diag(model.range_azimuth_cov(BOUND[None], np.ones(1))[0]),
        (squares + 8 * before) / [607, 608],
        rtol=1e-9,
    )


def test_a_few_tracks_move_the_sigmas_little_and_many_more():
    """Errors three times those that the shipped model expects, in four tracks and in 400."""
    rng, sigma = (
        np.random.default_rng(2),
        np.sqrt(np.diag(PRIOR.range_azimuth_cov(BOUND[None], np.ones(1))[0])),
    )
    times, prior = [], confusion_fit.Accuracy.of(PRIOR)
    for tracks in (4, 400):
        error = 3 * sigma * rng.choice([-1.0, 1.0], (tracks, 2))
        found = confusion_fit.accuracy(
            error, np.tile(BOUND, (tracks, 1)), np.arange(tracks), prior
        )
        times.append(found.usual_sigmas_m / sigma)
    np.testing.assert_allclose(times[0], np.sqrt((4 * 9 + 8) / np.array([11, 12])))
    np.testing.assert_allclose(times[1], 3, rtol=0.02)


@pytest.mark.parametrize(("power", "within"), [(1.0, 0.05), (2.2, 0.05)])
def test_the_power_of_the_bound_is_found_and_its_covariances_fit_good_and_bad_fits_alike(
    power: float, within: float
):
    """Bounds spread over a factor of 30, of range and azimuth apart, and errors that grow with their power."""
    fits, rng = (
        replace(_fits(2000, 0.1), range_per_height=np.zeros(6000)),
        np.random.default_rng(3),
    )
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


def test_a_few_tracks_leave_the_power_of_the_bound_as_it_is():
    """Eight tracks of each class whose errors do not depend on the bound at all."""
    spread = replace(
        _fits(8, 0.1), bound_m=BOUND * np.exp(np.linspace(-0.3, 0.3, 24))[:, None]
    )
    model = confusion_fit.estimate_confusion(spread, (1, 2), {})
    assert 0.8 * PRIOR.bound_power < model.bound_power <= PRIOR.bound_power


def test_a_track_counts_once_for_the_accuracy_however_long_it_is_watched():
    """One track errs by 1 cm for 100 frames, another one by 3 cm for one."""
    error = np.array([[0.01, 0.001]] * 100 + [[0.03, 0.003]])
    _, sigmas, _ = confusion_fit.accuracy(
        error, np.tile(BOUND, (101, 1)), np.arange(101) // 100
    )
    # in range one of two tracks is lost to the height
    np.testing.assert_allclose(sigmas**2, [2 * 5e-4, 5e-6])


def test_frames_of_a_track_count_together():
    """Every frame of the first class five times over, on the same tracks."""
    fits = _fits(60, 1.0)
    more = some(fits, np.concatenate([np.repeat(np.arange(60), 5), np.arange(60, 180)]))
    more = replace(more, news=np.where(more.label == 0, 0.2, 1.0))
    one, other = (confusion_fit.estimate_confusion(f, (1, 2), {}) for f in (fits, more))
    np.testing.assert_allclose(other.weights, one.weights, rtol=0.01)
    np.testing.assert_allclose(other.matrix, one.matrix, atol=2e-3)


@pytest.mark.parametrize("rho", [0.0, 0.7])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_reports_of_a_track_are_as_many_as_the_mean_of_its_frames_is_worth(
    rho: float, offset: float
):
    """Autoregressive errors in 400 tracks of 60 frames in 30 s, alone and with an offset of each track."""
    rng, tracks, frames = np.random.default_rng(5), 400, 60
    errors = rng.standard_normal((tracks, frames, 2))
    for k in range(1, frames):
        errors[:, k] = rho * errors[:, k - 1] + np.sqrt(1 - rho**2) * errors[:, k]
    errors += offset * rng.standard_normal((tracks, 1, 2))
    errors /= np.sqrt(1 + offset**2)
    of, stamp_ns = (
        np.tile(np.arange(tracks), frames),
        np.repeat(np.arange(frames), tracks) * 10**9 // 2,
    )
    found_s = confusion_fit.report_interval_s(
        errors.transpose(1, 0, 2).reshape(-1, 2), of, stamp_ns, 0.0
    )
    lag = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    product = (rho**lag + offset**2 * np.ones_like(lag)) / (1 + offset**2)
    common = (product.sum() - frames) / (frames * (frames - 1))
    assert found_s == pytest.approx(
        29.5 * common * tracks / (tracks + 16), rel=0.1, abs=0.3
    )


def test_the_interval_of_reports_of_a_few_tracks_is_mostly_the_prior():
    errors, of = (
        np.tile(np.random.default_rng(1).standard_normal((20, 2)), (2, 1)),
        np.repeat(np.arange(4), 10),
    )
    stamp_ns = np.arange(40) * 10**9
    assert confusion_fit.report_interval_s(errors, of, stamp_ns, 3.0) == pytest.approx(
        3.0, abs=1.0
    )
    assert (
        confusion_fit.report_interval_s(np.full((40, 2), np.nan), of, stamp_ns, 3.0)
        == 3.0
    )


def test_roughness_is_the_range_of_all_but_one_track_in_twenty_however_long_they_are():
    fits = _fits(67, 0.1)
    level = np.arange(201) / 10
    fits.evidence[..., EVIDENCE.index("beyond")] = level[:, None]
    low, high = confusion_fit.roughness_of_tracks(
        some(fits, np.append(np.arange(201), [200] * 50))
    )
    assert [low, high] == pytest.approx([0.5, 19.5])
    assert (
        confusion_fit.roughness_of_tracks(some(fits, np.arange(201)), (-1.0, 99.0))[1]
        < 20
    )
    few = some(fits, np.arange(30, 36))  # three frames a track
    assert len(np.unique(few.track)) < confusion_fit.LEAST_FOR_ENDS
    assert confusion_fit.roughness_of_tracks(few, (0.5, 3.2)) == (
        0.5,
        pytest.approx(3.5, abs=0.2),
    )
