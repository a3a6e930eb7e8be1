"""Detections of landmarks from any recogniser: positions, identities and their posterior."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.landmark_messages import range_and_azimuth

from .conftest import STEP_NS, T0_NS, Case, Entry, rows_of, vector

DIGITS = "9" * 30


def detection(position: tuple[float, ...], *results: tuple[str, float], variance: float = 0.0) -> dict[str, Any]:
    covariance = (np.eye(6) * variance).ravel().tolist()
    pose = {"pose": {"position": vector(*position)}, "covariance": covariance}
    centre = {"position": vector(position[0] + 10, *position[1:])}
    results_ = [{"hypothesis": {"class_id": name, "score": score}, "pose": pose} for name, score in results]
    return {"results": results_, "bbox": {"center": centre}, "id": "track"}


def arrays(*frames: list[dict[str, Any]]) -> Entry:
    rows = [{"detections": frame} for frame in frames]
    return rows_of("/landmarks", "vision_msgs/msg/Detection3DArray", rows, "sonar")


def one(*results: tuple[str, float], **other: Any) -> Entry:
    """A log with one detection, two metres to the left."""
    return arrays([detection((0, 2, 0), *results, **other)])


FRAMES = [
    [],
    [detection((3, 4, 0), ("7", 0.6), ("8", 0.3)), detection((0, -2, 0), ("1", 1.0))],
    [detection((1, 0, 0), ("12", 0.5))],
    [detection((1, 1, 0), ("1", 0.1), ("2", 0.2), ("3", 0.3))],
]
COUNTED = [detection((i + 1, 0, 0), *((str(10 * i + k), 0.1) for k in range(n))) for i, n in enumerate((2, 0, 1, 3))]
OWN = {"range_m": [2.5], "azimuth_rad": [0.1], "covariance": [1.0, 0, 0, 1.0], "candidate_ids": [1]}
# fmt: off
CASES: dict[str, Case] = {
    "positions as range and azimuth, results as the posterior": (
        [arrays(*FRAMES)], "",
        {"detections.stamps_ns": T0_NS + STEP_NS * np.array([1, 1, 2, 3]),
         "detections.range_m": [5, 2, 1, 2**0.5],
         "detections.azimuth_rad": [np.arctan2(4, 3), -np.pi / 2, 0, np.pi / 4],
         "detections.candidate_ids": [[7, 8, -1], [1, -1, -1], [12, -1, -1], [1, 2, 3]],
         "detections.id_probability": [[0.6, 0.3, 0], [1, 0, 0], [0.5, 0, 0], [0.1, 0.2, 0.3]],
         "detections.range_azimuth_cov": np.full((4, 2, 2), np.nan)}, {}),
    "any number of results for each detection": (
        [arrays(COUNTED, COUNTED)], "",
        {"detections.range_m": [1, 3, 4] * 2,
         "detections.candidate_ids": [[0, 1, -1], [20, -1, -1], [30, 31, 32]] * 2},
        {"log.dropped": "detections: 2 without a result"}),
    "classes with names": (
        [one(("buoy", 0.9), ("3", 0.1))], '[detections]\nids = {"buoy" = 42}',
        {"detections.candidate_ids": [[42, 3]]}, {}),
    "an identity far below zero": (
        [arrays([detection((i, 0, 0), (name, 0.9)) for i, name in enumerate((f"-{DIGITS}", "3"), start=1)])], "",
        {"detections.range_m": [2], "detections.candidate_ids": [[3]]}, {}),
    "position of the box": (
        [arrays([detection((1, 0, 0), ("1", 1.0))])], '[detections]\nposition = "bbox"',
        {"detections.range_m": [11]}, {}),
    "own detections beside an array": (
        [rows_of("/own", "sonar_graph_msgs/msg/LandmarkDetections", [OWN], id_probability=[1.0]), one(("1", 1.0))], "",
        {"detections.range_m": [2.5]}, {}),
    "a known covariance": (
        [one(("1", 1.0), variance=0.04)], "", {"detections.range_azimuth_cov": [np.diag([0.04, 0.04 / 4])]}, {}),
}
REFUSED = {
    "a name": (one(("buoy", 0.9)), "", r"""class 'buoy' is no integer identity.*ids = \{"buoy" = 1\}"""),
    "digits": (one((DIGITS, 0.9)), "", r"has an identity of 2\^56 or more"),
    "digits of a name": (one(("b", 0.9)), f'[detections]\nids = {{"b" = {DIGITS}}}', r"has an identity of 2\^56 or mo"),
    "no posterior": (one(("1", 0.9), ("2", 0.8)), "", r"/landmarks: scores of one detection add up to 1\.7"),
}
# fmt: on


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_results_of_any_recogniser_become_detections(foreign: Any, case: Case) -> None:
    foreign.check(*case)


@pytest.mark.parametrize(("entry", "toml", "message"), REFUSED.values(), ids=REFUSED)
def test_results_that_are_no_detections_are_refused(foreign: Any, entry: Entry, toml: str, message: str) -> None:
    with pytest.raises(LogError, match=message):
        foreign.read(entry, toml=toml)


@given(st.tuples(*[st.floats(-10, 10)] * 3), st.integers(0, 1000))
def test_the_covariance_is_that_of_many_samples_to_first_order(position: tuple[float, ...], seed: int) -> None:
    assume(np.hypot(*position[:2]) > 0.5)
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 1e-4
    covariance = root @ root.T
    _, _, spread = range_and_azimuth(np.array([position]), covariance[None])
    # central differences along the columns of the root give the same matrix
    columns = []
    for column in root.T:
        ranges, azimuths, _ = range_and_azimuth(np.array([position + column, position - column]), np.zeros((2, 3, 3)))
        turned = np.angle(np.exp(1j * (azimuths[0] - azimuths[1])))
        columns.append([(ranges[0] - ranges[1]) / 2, turned / 2])
    expected = np.array(columns).T @ np.array(columns)
    np.testing.assert_allclose(spread[0], expected, rtol=1e-4, atol=1e-13)
