"""Detections of a log that cannot be are named, and never believed."""

from typing import Any

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.landmark_messages import detection_warnings
from sonar_graph.logs.inspection import inspect_log
from sonar_graph.logs.reading import read_log
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.slam.keyframes import sound_detections


def one_of(bench: Any, **changed: Any) -> Any:
    """A log with a sound frame of one detection, and a changed one of two."""
    t0 = bench.t0_ns
    frames = [bench.detections(t0, [3.0], [5]), bench.detections(t0 + 10**8, [1.0, 2.0], [5, 6]) | changed]
    return bench.write(*bench.basics(), ("/landmarks", "detections", frames))


def test_a_sound_log_gives_no_warning(bench: Any) -> None:
    assert not [text for text in inspect_log(one_of(bench)).warnings if "detections" in text]


@pytest.mark.parametrize("wrong", [[97.0, 0.5], [0.5, -0.1], [1.1, 0.5]])
def test_rows_with_impossible_probabilities_are_left_out_and_told(bench: Any, wrong: list[float]) -> None:
    path = one_of(bench, id_probability=wrong)
    detections = read_log(path).detections
    assert detections is not None
    assert len(detections) == 2
    (told,) = [text for text in inspect_log(path).left_out if "probabilities" in text]
    assert told.startswith("detections: 1 with probabilities that are not between 0 and 1 or more than 1 in sum")


@pytest.mark.parametrize("too_large", [2**56, 2**63 - 1])
def test_an_identity_for_which_no_key_has_room_is_named_with_its_message(bench: Any, too_large: int) -> None:
    path = one_of(bench, candidate_ids=[5, too_large])
    with pytest.raises(
        LogError, match=r"topic /landmarks: message 1 has an identity of 2\^56 or more; number"
    ) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value) in inspect_log(path).damage
    assert read_log(one_of(bench, candidate_ids=[5, 2**56 - 1])).detections is not None


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"range_m": [-1.0, 2.0]}, "1 of 3 rows have a range that is not above 0 and at most 100 km"),
        ({"range_m": [1e10, 1e200]}, "2 of 3 rows have a range that is not above 0 and at most 100 km"),
        ({"covariance": [0.0] * 4 + [0.01, 0, 0, 0.02]}, "1 of 3 rows have a covariance that is not positive definite"),
        ({"covariance": [1.0, 1, 1, 1] * 2}, "2 of 3 rows have a covariance that is not positive definite"),
        ({"track": [7, 7]}, "1 of 3 rows have the track number of another row of their frame, in 1 frames"),
    ],
)
def test_what_estimators_do_not_use_is_told_and_kept(bench: Any, changed: dict[str, Any], said: str) -> None:
    path = one_of(bench, **changed)
    (told,) = [text for text in inspect_log(path).warnings if "detections" in text]
    assert told.startswith(f"detections: {said}")
    sequence = read_log(path)
    assert sequence.detections is not None
    assert len(sequence.detections) == 3
    assert told in sequence.notes["log.warnings"]


@pytest.mark.parametrize("cross", [0.0, 0.9, -1.1, np.inf, np.nan])
@pytest.mark.parametrize(
    "variances", [(1.0, 1.0), (-1.0, -1.0), (0.0, 1.0), (np.inf, 1.0), (1.0, np.inf), (np.nan, 1.0)]
)
def test_a_covariance_is_told_of_where_estimators_refuse_it(variances: tuple[float, float], cross: float) -> None:
    cov = np.array([[[variances[0], cross], [cross, variances[1]]]])
    row = LandmarkDetections(np.array([5]), np.ones(1), np.zeros(1), cov, np.array([[1]]), np.array([[0.9]]))
    assert bool(list(detection_warnings(row, 0, 9))) == (not sound_detections(row)[0])


def test_unknown_covariances_and_tracks_that_come_again_later_are_sound(bench: Any) -> None:
    path = one_of(bench, covariance=[np.nan] * 8, track=[3, 4])
    assert not [text for text in inspect_log(path).warnings if "detections" in text]


@pytest.mark.parametrize(("off_s", "where"), [(-5, "before the first"), (60, "after the last")])
def test_detections_that_no_odometry_covers_are_told(bench: Any, off_s: int, where: str) -> None:
    frames = [bench.detections(bench.t0_ns + off_s * 10**9, [1.0, 2.0], [5, 6])]
    path = bench.write(*bench.basics(), ("/landmarks", "detections", frames))
    (told,) = [text for text in inspect_log(path).warnings if "detections" in text]
    assert told.startswith(f"detections: 2 of 2 rows have a stamp {where} odometry")
