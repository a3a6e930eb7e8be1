from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.sonar.bayes import Rule, jeffrey, news_of_motion, predict, virtual_evidence

RULES: list[Rule] = ["jeffrey", "virtual-evidence"]


def _rows(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.dirichlet(np.ones(shape[-1]), shape[:-1])


def _updated(rule: Rule, predicted: np.ndarray, scores: np.ndarray, confusion: np.ndarray) -> np.ndarray:
    if rule == "jeffrey":
        return jeffrey(predicted, scores, confusion)
    features = confusion.shape[1]
    return virtual_evidence(predicted, scores, confusion, np.full(features, 1 / features), np.ones(len(predicted)))


def _literal(predicted: np.ndarray, scores: np.ndarray, confusion: np.ndarray) -> np.ndarray:
    """Equations (2) and (3) with an index for everything."""
    posterior = np.zeros_like(predicted)
    for m, k in np.ndindex(predicted.shape):
        for j in range(confusion.shape[1]):
            normaliser = sum(confusion[i, j] * predicted[m, i] for i in range(len(confusion)))
            posterior[m, k] += confusion[k, j] * predicted[m, k] / normaliser * scores[m, j]
    return posterior


def confusion_of(accuracy: float, classes: int = 4) -> np.ndarray:
    return np.full((classes, classes), (1 - accuracy) / (classes - 1)) + np.eye(classes) * (
        accuracy - (1 - accuracy) / (classes - 1)
    )


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 4), st.integers(2, 6), st.integers(2, 6))
def test_beliefs_stay_distributions(seed: int, tracks: int, before: int, classes: int, features: int) -> None:
    rng = np.random.default_rng(seed)
    beliefs = _rows(rng, before, classes) if before else np.empty((0, classes))
    predicted = predict(beliefs, _rows(rng, tracks, before + 1), _rows(rng, classes), 0.01)
    np.testing.assert_allclose(predicted.sum(axis=1), 1)
    for rule in RULES:
        after = _updated(rule, predicted, _rows(rng, tracks, features), _rows(rng, classes, features))
        assert (after >= 0).all()
        np.testing.assert_allclose(after.sum(axis=1), 1)


@given(st.integers(0, 2**32 - 1))
def test_renaming_identities_renames_beliefs_and_nothing_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    predicted, scores, confusion = _rows(rng, 3, 5), _rows(rng, 3, 4), _rows(rng, 5, 4)
    classes, tracks = rng.permutation(5), rng.permutation(3)
    for rule in RULES:
        renamed = _updated(rule, predicted[tracks][:, classes], scores[tracks], confusion[classes])
        np.testing.assert_allclose(renamed, _updated(rule, predicted, scores, confusion)[tracks][:, classes])


@given(st.integers(0, 2**32 - 1))
def test_jeffrey_is_equations_2_and_3_as_printed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    predicted, scores, confusion = _rows(rng, 3, 5), _rows(rng, 3, 4), _rows(rng, 5, 4)
    np.testing.assert_allclose(jeffrey(predicted, scores, confusion), _literal(predicted, scores, confusion))


def test_a_perfect_recogniser_that_is_sure_decides_at_once() -> None:
    predicted = np.array([[0.7, 0.1, 0.2]])
    for rule in RULES:
        after = _updated(rule, predicted, np.array([[0.0, 1.0, 0.0]]), np.eye(3))
        np.testing.assert_allclose(after, [[0, 1, 0]], atol=1e-9)


def test_both_rules_are_bayes_for_one_hot_scores() -> None:
    rng = np.random.default_rng(0)
    predicted, confusion = _rows(rng, 1, 4), _rows(rng, 4, 3)
    bayes = predicted * confusion[:, 1]
    for rule in RULES:
        after = _updated(rule, predicted, np.array([[0.0, 1.0, 0.0]]), confusion)
        np.testing.assert_allclose(after, bayes / bayes.sum())


def test_both_rules_agree_on_the_first_frame_from_a_uniform_belief() -> None:
    scores, uniform = np.array([[0.55, 0.25, 0.15, 0.05]]), np.full((1, 4), 0.25)
    first, ours = (_updated(rule, uniform, scores, confusion_of(0.9)) for rule in RULES)
    np.testing.assert_allclose(first, ours)
    np.testing.assert_allclose(first[0, 0], 0.51)
    then = [_updated(rule, first, scores, confusion_of(0.9))[0, 0] for rule in RULES]
    assert then[1] - then[0] > 0.1


def test_jeffrey_saturates_where_the_confusion_matrix_explains_the_scores() -> None:
    scores, confusion = np.array([[0.55, 0.25, 0.15, 0.05]]), confusion_of(0.9)
    belief = ours = np.full((1, 4), 0.25)
    for _ in range(500):
        belief, ours = (_updated(rule, b, scores, confusion) for rule, b in zip(RULES, (belief, ours), strict=True))
    np.testing.assert_allclose(belief[0] @ confusion, scores[0], atol=1e-9)  # C' b = s
    assert belief.max() == pytest.approx(0.596, abs=1e-3)
    assert ours.max() > 0.999


def test_frames_without_information_make_jeffrey_forget() -> None:
    sure, uniform, confusion = np.array([[0.97, 0.01, 0.01, 0.01]]), np.full((1, 4), 0.25), confusion_of(0.9)
    assert jeffrey(sure, uniform, confusion)[0, 0] == pytest.approx(0.827, abs=2e-3)
    np.testing.assert_allclose(_updated("virtual-evidence", sure, uniform, confusion), sure)


@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
def test_order_of_frames_does_not_matter_to_virtual_evidence(seed: int, one: float, other: float) -> None:
    rng = np.random.default_rng(seed)
    start, confusion, base = _rows(rng, 1, 4), _rows(rng, 4, 3), _rows(rng, 3)
    frames = [(_rows(rng, 1, 3), np.array([weight])) for weight in (one, other)]
    ends = []
    for order in (frames, frames[::-1]):
        belief = start
        for scores, weight in order:
            belief = virtual_evidence(belief, scores, confusion, base, weight)
        ends.append(belief)
    np.testing.assert_allclose(*ends, atol=1e-9)


def test_order_of_frames_matters_to_jeffrey() -> None:
    confusion, start = confusion_of(0.9), np.full((1, 4), 0.25)
    one, other = np.array([[0.8, 0.1, 0.05, 0.05]]), np.array([[0.1, 0.8, 0.05, 0.05]])
    forth, back = (jeffrey(jeffrey(start, a, confusion), b, confusion) for a, b in ((one, other), (other, one)))
    assert abs(forth[0, 0] - back[0, 0]) > 0.2


def test_weight_is_a_share_of_the_log_odds() -> None:
    rng = np.random.default_rng(1)
    start, scores, confusion, base = _rows(rng, 1, 3), _rows(rng, 1, 3), _rows(rng, 3, 3), _rows(rng, 3)
    whole = virtual_evidence(start, scores, confusion, base, np.ones(1))
    half = virtual_evidence(start, scores, confusion, base, np.full(1, 0.5))
    twice = virtual_evidence(half, scores, confusion, base, np.full(1, 0.5))
    np.testing.assert_allclose(twice, whole)
    np.testing.assert_allclose(virtual_evidence(start, scores, confusion, base, np.zeros(1)), start)


def test_a_missing_measurement_changes_nothing() -> None:
    predicted = _rows(np.random.default_rng(2), 2, 4)
    for rule in RULES:
        np.testing.assert_array_equal(_updated(rule, predicted, np.zeros((2, 4)), confusion_of(0.9)), predicted)


def test_an_impossible_feature_says_nothing_and_divides_nothing_by_zero() -> None:
    predicted, scores = np.array([[0.5, 0.5, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(jeffrey(predicted, scores, np.eye(3)), predicted)
    assert np.isfinite(_updated("virtual-evidence", predicted, scores, np.eye(3))).all()


def test_a_new_track_has_the_belief_of_birth() -> None:
    birth = np.array([0.1, 0.2, 0.7])
    predicted = predict(np.eye(3)[:1], np.array([[0.0, 1.0]]), birth)
    np.testing.assert_allclose(predicted, [birth])


def test_a_share_of_a_belief_returns_to_that_of_a_new_track() -> None:
    birth = np.array([0.1, 0.2, 0.7])
    predicted = predict(np.eye(3)[:1], np.array([[1.0, 0.0]]), birth, forgetting=0.1)
    np.testing.assert_allclose(predicted, [0.9 * np.eye(3)[0] + 0.1 * birth])


def test_merging_tracks_of_different_identity_is_ambiguous() -> None:
    predicted = predict(np.eye(3)[:2], np.array([[0.5, 0.5, 0.0]]), np.full(3, 1 / 3), forgetting=0.0)
    np.testing.assert_allclose(predicted, [[0.5, 0.5, 0.0]])


def test_half_of_a_frame_is_news_after_the_motion_that_decorrelates_speckle() -> None:
    news = news_of_motion(np.array([0.0, 0.0357, 0.07, 0.14, 1.0]), 0.14)
    np.testing.assert_allclose(news, [0, 0.5, 1 - 0.25**2, 1, 1], atol=0.01)
    assert (np.diff(news_of_motion(np.linspace(0, 0.2, 50), 0.14)) >= 0).all()


def test_virtual_evidence_is_its_equation_as_printed() -> None:
    rng = np.random.default_rng(4)
    start, scores, confusion, base = _rows(rng, 2, 3), _rows(rng, 2, 4), _rows(rng, 3, 4), _rows(rng, 4)
    weights = np.array([1.0, 0.3])
    expected = np.zeros((2, 3))
    for m, k in np.ndindex(2, 3):
        likelihood = sum(confusion[k, j] * scores[m, j] / base[j] for j in range(4))
        expected[m, k] = start[m, k] * likelihood ** weights[m]
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(virtual_evidence(start, scores, confusion, base, weights), expected)


def test_news_follow_from_the_autocorrelation_of_a_triangle() -> None:
    """By numerical convolution: a lens that sends and receives weighs its aperture by a triangle."""
    places = np.linspace(-0.5, 0.5, 2001)
    triangle = np.maximum(0.07 - np.abs(places) / 1.0, 0.0)
    autocorrelation = np.convolve(triangle, triangle, mode="same")
    rho = autocorrelation / autocorrelation.max()
    moved = np.array([0.0, 0.01, 0.03, 0.05, 0.07, 0.09, 0.12, 0.14])
    expected = 1 - np.interp(moved, places, rho) ** 2
    np.testing.assert_allclose(news_of_motion(moved, 0.14), expected, atol=1e-3)
