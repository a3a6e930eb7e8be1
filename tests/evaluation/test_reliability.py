from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binned_statistic

from sonar_graph.calibration import Calibration, Mounting, SonarCalibration
from sonar_graph.evaluation.consistency import NONE, UNJUDGED, confidences, reliability, reliability_of, true_identities
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory


def test_expected_error_of_five_detections_by_hand():
    """Two at 0.95 and both right, one at 0.85 and wrong, two at 0.55 of which one is right: (0.1 + 0.85 + 0.1) / 5."""
    found = reliability(np.array([0.95, 0.95, 0.85, 0.55, 0.55]), np.array([1.0, 1.0, 0.0, 1.0, 0.0]))
    assert found.count.tolist() == [0, 0, 0, 0, 0, 2, 0, 0, 1, 2]
    assert found.right[[5, 8, 9]].tolist() == [0.5, 0.0, 1.0]
    assert found.confidence[[5, 8, 9]] == pytest.approx([0.55, 0.85, 0.95])
    assert found.expected_error == pytest.approx((0.1 + 0.85 + 0.1) / 5)
    assert np.isnan(found.right[0])


@given(st.integers(1, 200), st.integers(0, 2**32 - 1))
def test_bins_are_those_of_another_implementation(n, seed):
    rng = np.random.default_rng(seed)
    confidence, right = rng.uniform(0, 1, n), rng.integers(0, 2, n).astype(float)
    found = reliability(confidence, right)
    means = [binned_statistic(confidence, v, "mean", 10, (0, 1)).statistic for v in (confidence, right)]
    count = binned_statistic(confidence, right, "count", 10, (0, 1)).statistic
    np.testing.assert_array_equal(found.count, count)
    np.testing.assert_allclose([found.confidence, found.right], means)
    expected = sum(k / n * abs(c - r) for k, c, r in zip(count, *means, strict=True) if k)
    assert found.expected_error == pytest.approx(expected)


def test_certainty_counts_in_the_last_bin():
    assert reliability(np.array([1.0]), np.array([1.0])).count.tolist() == [0] * 9 + [1]


def test_confidence_is_that_of_the_most_probable_class_none_of_them_included():
    detections = LandmarkDetections(
        np.zeros(3, int),
        np.ones(3),
        np.zeros(3),
        np.zeros((3, 2, 2)),
        np.tile([4, 9], (3, 1)),
        np.array([[0.1, 0.7], [0.3, 0.1], [0.5, 0.5]]),
    )
    confidence, named = confidences(detections)
    assert confidence == pytest.approx([0.7, 0.6, 0.5])
    assert named.tolist() == [9, NONE, 4]


MOUNTING = Mounting(translation_m=(0.3, 0.1, -0.1), rpy_rad=(0.0, 0.5, 0.1))
LANDMARKS_M = np.array([[3.0, 0.5, -1.0], [5.0, -2.0, -1.1]])
IDS = np.array([11, 7])


def turning_truth() -> Trajectory:
    stamps_ns = np.arange(11) * 10**8
    yaw = Rotation.from_euler("ZYX", np.column_stack([0.3 * np.arange(11), 0.02 * np.arange(11), np.zeros(11)]))
    positions = np.column_stack([0.1 * np.arange(11), np.zeros(11), np.full(11, -0.5)])
    return Trajectory.without_covariances(stamps_ns, positions, yaw.as_quat())


def seen_at(stamp_ns: int, point: np.ndarray) -> tuple[float, float]:
    """Range and azimuth of a world point, with transforms written out."""
    truth = turning_truth()
    row = truth.stamps_ns.tolist().index(stamp_ns)
    in_body = truth.rotations()[row].inv().apply(point - truth.positions[row])
    q = Rotation.from_euler("ZYX", [0.1, 0.5, 0.0]).inv().apply(in_body - [0.3, 0.1, -0.1])
    return float(np.linalg.norm(q)), float(np.arctan2(q[1], q[0]))


def run_with(rows: list[tuple[int, float, float]], named: list[int], probability: list[float]) -> Sequence:
    n = len(rows)
    stamps, ranges_m, azimuths_rad = zip(*rows, strict=True)
    detections = LandmarkDetections(
        np.array(stamps),
        np.array(ranges_m),
        np.array(azimuths_rad),
        np.zeros((n, 2, 2)),
        np.array(named)[:, None],
        np.array(probability)[:, None],
    )
    return Sequence(
        "hand",
        Calibration(sonar=SonarCalibration(mounting=MOUNTING)),
        imu=None,  # type: ignore[arg-type]
        dvl=None,  # type: ignore[arg-type]
        detections=detections,
        truth=turning_truth(),
        true_landmarks=LandmarkMap(IDS, LANDMARKS_M, np.full((2, 3, 3), np.nan)),
    )


def test_a_detection_is_of_the_landmark_that_lies_there():
    """Two stamps, detections 10 cm off, 25 cm off (cannot be told) and 60 cm off (none)."""
    rows = []
    for stamp_ns, landmark in ((2 * 10**8, 0), (6 * 10**8, 1)):
        r, a = seen_at(stamp_ns, LANDMARKS_M[landmark])
        rows += [
            (stamp_ns, r + 0.1, a),
            (stamp_ns, r, a + 0.1 / r),
            (stamp_ns, r + 0.25, a),
            (stamp_ns, r, a + 0.6 / r),
        ]
    run = run_with(rows, [0] * 8, [1.0] * 8)
    labels = true_identities(run, run.detections)
    assert labels.tolist() == [11, 11, UNJUDGED, NONE, 7, 7, UNJUDGED, NONE]


def test_azimuths_are_compared_round_the_circle():
    r, a = seen_at(0, LANDMARKS_M[0])
    run = run_with([(0, r, a - 2 * np.pi), (0, r, a + np.pi)], [0, 0], [1.0, 1.0])
    assert true_identities(run, run.detections).tolist() == [11, NONE]


def test_what_lies_outside_the_truth_is_not_judged():
    r, a = seen_at(0, LANDMARKS_M[0])
    run = run_with([(-5, r, a), (0, r, a), (10**9, r, a), (10**9 + 1, r, a)], [0] * 4, [1.0] * 4)
    labels = true_identities(run, run.detections)
    assert labels[[0, 3]].tolist() == [UNJUDGED, UNJUDGED]
    assert labels[1] == 11
    early = run_with([(-5, r, a)], [0], [1.0])
    assert true_identities(early, early.detections).tolist() == [UNJUDGED]
    assert reliability_of(early) is None


def test_a_sequence_is_judged_by_what_is_true():
    """One right at 0.95, one taken for another at 0.85, one that is none and called so at 0.75, one left out."""
    r, a = seen_at(2 * 10**8, LANDMARKS_M[0])
    there, away, unclear = (2 * 10**8, r, a), (2 * 10**8, r, a + 0.6 / r), (2 * 10**8, r + 0.25, a)
    run = run_with([there, there, away, unclear], [11, 7, 11, 11], [0.95, 0.85, 0.25, 0.5])
    found = reliability_of(run)
    assert found is not None
    assert found.count.tolist() == [0] * 7 + [1, 1, 1]
    assert found.right[7:].tolist() == [1.0, 0.0, 1.0]
    assert found.expected_error == pytest.approx((0.25 + 0.85 + 0.05) / 3)


@pytest.mark.parametrize("missing", ["detections", "truth", "true_landmarks"])
def test_nothing_is_judged_without_truth(missing):
    r, a = seen_at(0, LANDMARKS_M[0])
    run = run_with([(0, r, a)], [11], [0.9])
    assert reliability_of(run) is not None
    assert reliability_of(replace(run, **{missing: None})) is None
