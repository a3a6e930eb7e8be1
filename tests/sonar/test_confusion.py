from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.devices import landmark_designs
from sonar_graph.devices.landmark_designs import DEFAULT_DESIGNS, LandmarkDesign, load_designs
from sonar_graph.errors import CalibrationError
from sonar_graph.recognition.confusion_fit import LabelledFits, estimate_confusion
from sonar_graph.sonar.bayes import virtual_evidence
from sonar_graph.sonar.confusion import Confusion, confusion_for, read_confusion, soft_scores


def _fits(per_class: int, noise: float, seed: int = 0) -> LabelledFits:
    """Correlations of 0.9 with the true design and 0.7 with others; of 0.6 with all where there is none."""
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(3), per_class)
    means = np.array([[0.9, 0.7], [0.7, 0.9], [0.6, 0.6]])[label]
    error = np.where((label < 2)[:, None], rng.normal(0, [0.01, 0.002], (len(label), 2)), np.nan)
    return LabelledFits(
        means + rng.normal(0, noise, means.shape), np.ones(len(label)), label, np.arange(len(label)), error
    )


def test_scores_are_probabilities_and_rise_with_correlation():
    scores = soft_scores(np.array([[0.9, 0.5], [0.3, 0.2]]), np.ones(2), 20.0, 0.8)
    np.testing.assert_allclose(scores.sum(axis=1), 1)
    assert scores[0, 0] > 0.9
    assert scores[1, 2] > 0.9
    certain = soft_scores(np.array([[1.0, 1.0]]), np.ones(1), 500.0, 0.8)
    assert np.isfinite(certain).all()


def test_odds_of_scores_are_those_of_the_equation():
    scores = soft_scores(np.array([[0.9, 0.6, -0.4]]), np.array([0.5]), 10.0, 0.7)[0]
    weight = (1 - np.array([0.9, 0.6, 0.0, 0.7]) ** 2) ** (-10.0 * 0.5)
    np.testing.assert_allclose(scores, weight / weight.sum())


def test_scores_of_what_is_hardly_in_view_are_flatter():
    whole, half = (soft_scores(np.array([[0.9, 0.8]]), np.array([v]), 10.0, 0.7)[0] for v in (1.0, 0.5))
    assert half.max() < whole.max()


def test_scores_that_are_fitted_are_calibrated():
    fitted, unseen = estimate_confusion(_fits(400, 0.08), (1, 2), {}), _fits(400, 0.08, seed=1)
    scores = soft_scores(unseen.correlation, unseen.visible, fitted.sharpness, fitted.threshold)
    confidence, right = scores.max(axis=1), scores.argmax(axis=1) == unseen.label
    assert abs(confidence.mean() - right.mean()) < 0.04
    assert 0.6 < fitted.threshold < 0.9


def test_matrix_is_the_mean_score_of_each_class():
    fits = _fits(100, 0.1)
    model = estimate_confusion(fits, (1, 2), {"origin": "made up"})
    scores = soft_scores(fits.correlation, fits.visible, model.sharpness, model.threshold)
    for k in range(3):
        np.testing.assert_allclose(np.array(model.matrix)[k], scores[fits.label == k].mean(axis=0), atol=5e-3)
    assert model.provenance["origin"] == "made up"
    assert model.provenance["frames of landmark 1"] == "100"
    assert model.range_sigma_m == pytest.approx(0.01, rel=0.2)


@pytest.mark.parametrize("tracks", [5, 100])
def test_frames_that_never_were_confused_are_as_sure_as_their_tracks_allow_within_a_standard_error(tracks: int):
    """With n tracks of a class (n + 1) / (n + 2) is certainty. The loss is the entropy of that, half a nat
    over all tracks, and a little for what two numbers cannot fit."""
    fits = _fits(200, 0.01)
    model = estimate_confusion(replace(fits, track=np.arange(600) % tracks + 1000 * fits.label), (1, 2), {})
    scores = soft_scores(fits.correlation, fits.visible, model.sharpness, model.threshold)
    posterior = virtual_evidence(np.full((600, 3), 1 / 3), scores, model.array(), model.base(), np.ones(600))
    n = np.array([2 * tracks, 2 * tracks, tracks])[fits.label]
    sure, unsure = (n + 1) / (n + 2), 1 / (n + 2) / 2
    own = np.eye(3, dtype=bool)[fits.label]
    entropy = -(sure * np.log(sure) + 2 * unsure * np.log(unsure)).mean()
    loss = -np.where(own, sure[:, None], unsure[:, None]) * np.log(posterior)
    assert 0.5 <= (loss.sum(axis=1).mean() - entropy) * 3 * tracks <= 1.0
    assert posterior[own].mean() < sure.mean() + 0.001
    assert model.provenance["tracks of landmark 2"] == str(tracks)


def test_more_tracks_without_confusion_make_scores_sharper_but_never_hard():
    fits = _fits(200, 0.01)
    few, many = (
        estimate_confusion(replace(fits, track=np.arange(600) % n + 1000 * fits.label), (1, 2), {}).sharpness
        for n in (5, 100)
    )
    assert few < many < 100


def test_a_class_with_too_few_frames_is_named():
    fits = _fits(100, 0.1)
    few = LabelledFits(
        *(getattr(fits, n)[:210] for n in ("correlation", "visible", "label", "track", "range_azimuth_error"))
    )
    with pytest.raises(CalibrationError, match="no landmark: 10"):
        estimate_confusion(few, (1, 2), {})


def test_files_come_back_and_wrong_ones_are_named(tmp_path):
    model = estimate_confusion(_fits(50, 0.1), (1, 2), {})
    path = tmp_path / "model.json"
    path.write_text(model.model_dump_json())
    assert read_confusion(path) == model
    values = json.loads(model.model_dump_json())
    values["matrix"][0][0] += 0.5
    path.write_text(json.dumps(values))
    with pytest.raises(CalibrationError, match="each row must be probabilities"):
        read_confusion(path)
    path.write_text("{")
    with pytest.raises(CalibrationError, match="not JSON"):
        read_confusion(path)


def test_designs_that_ship_have_a_measured_model_and_others_an_assumed_one():
    for shipped in (DEFAULT_DESIGNS, load_designs(Path(landmark_designs.__file__).with_name("default_landmarks.toml"))):
        assert "simulated basins" in confusion_for(shipped).provenance["origin"]
    other = confusion_for([LandmarkDesign(9, "ring", 0.3, np.zeros((4, 4)))])
    assert other.ids == (9,)
    assert "assumed" in other.provenance["origin"]
    np.testing.assert_allclose(other.array().sum(axis=1), 1)
    other.check_designs([RING])


RING = LandmarkDesign(9, "ring", 0.3, np.zeros((4, 4)))


@pytest.mark.parametrize("change", [{"name": "plate"}, {"size_m": 0.31}, {"height_m": 0.02}, {"mask": np.eye(4)}])
def test_designs_that_only_have_the_same_numbers_are_refused(tmp_path, change):
    """For a model that came from a file as for any other."""
    path = tmp_path / "model.json"
    path.write_text(estimate_confusion(_fits(50, 0.1), (9, 10), {}, [RING, replace(RING, id=10)]).model_dump_json())
    model = read_confusion(path)
    model.check_designs([RING, replace(RING, id=10)])
    with pytest.raises(CalibrationError, match=r"mine: measured for another landmark 9 \(ring\) than .*calibrate"):
        model.check_designs([replace(RING, **change), replace(RING, id=10)], "mine")
    with pytest.raises(CalibrationError, match=r"measured for landmarks \(9, 10\), the designs are \(10, 9\)"):
        model.check_designs([replace(RING, id=10), RING])


def test_a_model_that_does_not_say_what_it_was_measured_for_is_refused():
    model = estimate_confusion(_fits(50, 0.1), (9, 10), {})
    with pytest.raises(CalibrationError, match="designs: is missing"):
        model.check_designs([RING, replace(RING, id=10)])


def test_marks_that_are_not_one_for_each_identity_are_refused():
    with pytest.raises(ValueError, match="expected one for each of 2 ids, not 1"):
        estimate_confusion(_fits(50, 0.1), (9, 10), {}, [RING])


def _model(*rows: tuple[float, ...]) -> Confusion:
    return Confusion(
        ids=tuple(range(1, len(rows))), matrix=rows, sharpness=9.0, threshold=0.8, range_sigma_m=0.01,
        azimuth_sigma_rad=0.002,
    )  # fmt: skip


def test_what_was_never_seen_is_not_impossible():
    model = _model((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.2, 0.3, 0.5))
    np.testing.assert_allclose(model.array()[0], np.array([1.0, 0.001, 0.001]) / 1.002)
    np.testing.assert_allclose(model.array()[2], [0.2, 0.3, 0.5])


def test_the_base_is_what_is_seen_of_all_classes_together():
    model = _model((0.8, 0.1, 0.1), (0.2, 0.7, 0.1), (0.5, 0.1, 0.4))
    np.testing.assert_allclose(model.base(), [0.5, 0.3, 0.2])


def test_negative_probabilities_are_refused():
    with pytest.raises(ValueError, match="each row must be probabilities"):
        _model((1.5, -0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def test_accuracy_is_that_of_range_and_of_azimuth():
    model = estimate_confusion(_fits(300, 0.1), (1, 2), {})
    assert model.range_sigma_m == pytest.approx(0.01, rel=0.15)
    assert model.azimuth_sigma_rad == pytest.approx(0.002, rel=0.15)


def test_errors_that_are_always_the_same_count_as_errors():
    """A landmark that is always seen 3 cm too far: root mean square, not the spread about the mean."""
    fits = _fits(300, 0.1)
    off = replace(fits, range_azimuth_error=fits.range_azimuth_error + np.array([0.03, -0.005]))
    model = estimate_confusion(off, (1, 2), {})
    assert model.range_sigma_m == pytest.approx(np.hypot(0.03, 0.01), rel=0.05)
    assert model.azimuth_sigma_rad == pytest.approx(np.hypot(0.005, 0.002), rel=0.05)


def test_sigmas_are_those_of_a_landmark_that_is_wholly_in_view():
    fits = _fits(300, 0.1)
    cut = replace(fits, visible=np.full(900, 0.7), range_azimuth_error=fits.range_azimuth_error / 0.7**2)
    model = estimate_confusion(cut, (1, 2), {})
    assert model.range_sigma_m == pytest.approx(0.01, rel=0.15)
    np.testing.assert_allclose(
        np.diag(model.range_azimuth_cov(0.7)), np.nanmean(cut.range_azimuth_error**2, axis=0), rtol=1e-9
    )


def test_a_class_that_was_seen_more_often_counts_no_more():
    """Every frame of the first class five times over, on the same tracks."""
    fits = _fits(60, 0.1)
    rows = np.concatenate([np.repeat(np.arange(60), 5), np.arange(60, 180)])
    more = LabelledFits(*(column[rows] for column in vars(fits).values()))
    one, other = (estimate_confusion(f, (1, 2), {}) for f in (fits, more))
    assert (other.sharpness, other.threshold) == (
        pytest.approx(one.sharpness, rel=0.01),
        pytest.approx(one.threshold, abs=0.002),
    )
    np.testing.assert_allclose(other.matrix, one.matrix, atol=2e-3)
