"""Laws of soft scores and of the measured model, its file and its marks."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.devices import (
    DEFAULT_DESIGNS,
    LandmarkDesign,
    landmark_designs,
    load_designs,
)
from sonar_graph.errors import CalibrationError
from sonar_graph.sonar import (
    EVIDENCE,
    Confusion,
    confusion_for,
    mark_of,
    read_confusion,
    soft_scores,
)

RING = LandmarkDesign(9, "ring", 0.3, np.zeros((4, 4)))
DESIGNS = [RING, replace(RING, id=10)]
ROWS = ((0.8, 0.1, 0.1), (0.2, 0.7, 0.1), (0.5, 0.1, 0.4))


def model(
    rows: tuple[tuple[float, ...], ...] = ROWS, designs: Sequence[LandmarkDesign] = ()
) -> Confusion:
    return Confusion(
        ids=tuple(range(9, 8 + len(rows))), matrix=rows, designs=tuple(map(mark_of, designs)),
        weights=tuple(range(len(EVIDENCE))), looks=2.0, range_sigma_m=0.01, across_sigma_m=0.004,
        range_bound_m=1e-3, across_bound_m=1e-3, bound_power=1.5,
    )  # fmt: skip


def test_scores_are_the_posterior_of_one_look():
    scores = soft_scores(np.array([[3.0, -6.0, 0.0]]), 2.0)[0]
    np.testing.assert_allclose(scores, np.exp([1, -2, 0]) / np.exp([1, -2, 0]).sum())
    assert np.isfinite(soft_scores(np.array([[1e4, -1e4, 0.0]]), 1.0)).all()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({}, None),
        ({"matrix": [[1.5, -0.5, 0.0], *ROWS[1:]]}, "each row must be probabilities"),
        ({"matrix": [[0.8, 0.2], *ROWS[1:]]}, "matrix: expected 3 rows of 3 for 2 ids"),
        ({"matrix": [[0.9, 0.1, 0.0], *ROWS[1:]]}, "an entry is 0"),
        (
            {"designs": [{"name": "ring", "digest": ""}]},
            "expected one for each of 2 ids, not 1",
        ),
        ({"looks": float("inf")}, "looks"),
        ({"ids": [1, 1]}, "ids: expected each once, not 1, 1"),
        ({"weights": [1.0, 2.0]}, "weights: expected 11, for prior, outline"),
        ({"error_correlation": 0.8}, "an earlier version .* measure it again"),
        (None, "not JSON"),
    ],
)
def test_a_file_comes_back_and_a_wrong_one_is_named_with_the_reason(
    tmp_path, change, complaint
):
    path = tmp_path / "model.json"
    written = model(designs=DESIGNS)
    path.write_text(
        "{"
        if change is None
        else json.dumps(json.loads(written.model_dump_json()) | change)
    )
    if complaint is None:
        assert read_confusion(path) == written
        return
    with pytest.raises(CalibrationError, match=complaint) as refusal:
        read_confusion(path)
    assert "model.json" in str(refusal.value)


@pytest.mark.parametrize(
    "change",
    [{"name": "plate"}, {"size_m": 0.31}, {"height_m": 0.02}, {"mask": np.eye(4)}],
)
def test_designs_that_only_have_the_same_numbers_are_refused(change):
    measured = model(designs=DESIGNS)
    measured.check_designs(DESIGNS)
    with pytest.raises(
        CalibrationError,
        match=r"mine: measured for another landmark 9 \(ring\) than .*calibrate",
    ):
        measured.check_designs([replace(RING, **change), DESIGNS[1]], "mine")
    with pytest.raises(
        CalibrationError,
        match=r"measured for landmarks 9, 10, the designs are 10, 9; give",
    ):
        measured.check_designs(DESIGNS[::-1])
    with pytest.raises(CalibrationError, match="designs: is missing"):
        model().check_designs(DESIGNS)


def test_designs_that_ship_have_a_measured_model_and_others_an_assumed_one():
    for shipped in (
        DEFAULT_DESIGNS,
        load_designs(
            Path(landmark_designs.__file__).with_name("default_landmarks.toml")
        ),
    ):
        assert "simulated basins" in confusion_for(shipped).provenance["origin"]
    other = confusion_for([RING])
    assert other.ids == (9,)
    assert "assumed" in other.provenance["origin"]
    assert other.weights == confusion_for(DEFAULT_DESIGNS).weights
    np.testing.assert_allclose(other.array().sum(axis=1), 1)
    other.check_designs([RING])
