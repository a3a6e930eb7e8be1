from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.landmark_messages import range_and_azimuth

KIND = "vision_msgs/msg/Detection3DArray"
Results = list[tuple[str, float]]


def detection(foreign: Any, position: tuple[float, ...], results: Results, variance: float = 0.0) -> dict[str, Any]:
    covariance = (np.eye(6) * variance).ravel().tolist()
    pose = {"pose": {"position": foreign.vector(*position)}, "covariance": covariance}
    centre = {"position": foreign.vector(position[0] + 10, *position[1:])}
    return {
        "results": [{"hypothesis": {"class_id": name, "score": score}, "pose": pose} for name, score in results],
        "bbox": {"center": centre},
        "id": "track",
    }


def arrays(foreign: Any, frames: list[list[dict[str, Any]]]) -> tuple[str, str, list[dict[str, Any]]]:
    messages = [{"header": foreign.header(i, "sonar"), "detections": frame} for i, frame in enumerate(frames)]
    return "/landmarks", KIND, messages


def test_positions_become_range_and_azimuth_and_results_the_posterior(foreign: Any, read: Any) -> None:
    frames = [
        [],
        [detection(foreign, (3, 4, 0), [("7", 0.6), ("8", 0.3)]), detection(foreign, (0, -2, 0), [("1", 1.0)])],
        [detection(foreign, (1, 0, 0), [("12", 0.5)])],
        [detection(foreign, (1, 1, 0), [("1", 0.1), ("2", 0.2), ("3", 0.3)])],
    ]
    found = read(foreign.imu(), foreign.dvl(), arrays(foreign, frames)).detections
    assert ((found.stamps_ns - foreign.t0_ns) // foreign.step_ns).tolist() == [1, 1, 2, 3]
    np.testing.assert_allclose(found.range_m, [5, 2, 1, 2**0.5])
    np.testing.assert_allclose(found.azimuth_rad, [np.arctan2(4, 3), -np.pi / 2, 0, np.pi / 4])
    assert found.candidate_ids.tolist() == [[7, 8, -1], [1, -1, -1], [12, -1, -1], [1, 2, 3]]
    assert found.id_probability.tolist() == [[0.6, 0.3, 0], [1, 0, 0], [0.5, 0, 0], [0.1, 0.2, 0.3]]
    assert np.isnan(found.range_azimuth_cov).all()


def test_results_stay_with_their_detection_however_many_each_has(foreign: Any, read: Any) -> None:
    counts = [2, 0, 1, 3]
    frame = [
        detection(foreign, (i + 1, 0, 0), [(str(10 * i + k), 0.1) for k in range(count)])
        for i, count in enumerate(counts)
    ]
    sequence = read(foreign.imu(), foreign.dvl(), arrays(foreign, [frame, frame]))
    assert sequence.detections.range_m.tolist() == [1, 3, 4] * 2
    assert sequence.detections.candidate_ids.tolist() == [[0, 1, -1], [20, -1, -1], [30, 31, 32]] * 2
    assert "detections: 2 without a result" in sequence.notes["log.dropped"]


def test_classes_with_names_need_identities(foreign: Any, read: Any) -> None:
    entry = arrays(foreign, [[detection(foreign, (1, 0, 0), [("buoy", 0.9), ("3", 0.1)])]])
    with pytest.raises(LogError, match=r"""class 'buoy' is no integer identity.*ids = \{"buoy" = 1\}"""):
        read(foreign.imu(), foreign.dvl(), entry)
    found = read(foreign.imu(), foreign.dvl(), entry, toml='[detections]\nids = {"buoy" = 42}').detections
    assert found.candidate_ids.tolist() == [[42, 3]]


def test_identities_of_more_digits_than_integers_have_are_refused_as_too_large_or_none(foreign: Any, read: Any) -> None:
    digits = "9" * 30
    frame = [detection(foreign, (i, 0, 0), [(name, 0.9)]) for i, name in enumerate((f"-{digits}", "3"), start=1)]
    found = read(foreign.imu(), foreign.dvl(), arrays(foreign, [frame])).detections
    assert (found.range_m.tolist(), found.candidate_ids.tolist()) == ([2.0], [[3]])
    for name, toml in ((digits, ""), ("buoy", f'[detections]\nids = {{"buoy" = {digits}}}')):
        entry = arrays(foreign, [[detection(foreign, (1, 0, 0), [(name, 0.9)])]])
        with pytest.raises(LogError, match=r"has an identity of 2\^56 or more"):
            read(foreign.imu(), foreign.dvl(), entry, toml=toml)


def test_scores_that_are_no_posterior_are_refused(foreign: Any, read: Any) -> None:
    entry = arrays(foreign, [[detection(foreign, (1, 0, 0), [("1", 0.9), ("2", 0.8)])]])
    with pytest.raises(LogError, match=r"/landmarks: scores of one detection add up to 1\.7"):
        read(foreign.imu(), foreign.dvl(), entry)


def test_a_box_gives_the_position_where_the_results_do_not(foreign: Any, read: Any) -> None:
    entry = arrays(foreign, [[detection(foreign, (1, 0, 0), [("1", 1.0)])]])
    assert read(foreign.imu(), foreign.dvl(), entry).detections.range_m.tolist() == [1]
    boxes = read(foreign.imu(), foreign.dvl(), entry, toml='[detections]\nposition = "bbox"')
    assert boxes.detections.range_m.tolist() == [11]


def test_own_detections_go_before_an_array(foreign: Any, read: Any) -> None:
    own = {"header": foreign.header(0), "range_m": [2.5], "azimuth_rad": [0.1], "covariance": [1.0, 0, 0, 1.0]}
    flat = ("/own", "sonar_graph_msgs/msg/LandmarkDetections", [own | {"candidate_ids": [1], "id_probability": [1.0]}])
    array = arrays(foreign, [[detection(foreign, (1, 0, 0), [("1", 1.0)])]])
    assert read(foreign.imu(), foreign.dvl(), flat, array).detections.range_m.tolist() == [2.5]


COORDINATE = st.floats(-10, 10)


@given(st.tuples(COORDINATE, COORDINATE, COORDINATE), st.integers(0, 1000))
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


def test_a_known_covariance_arrives(foreign: Any, read: Any) -> None:
    entry = arrays(foreign, [[detection(foreign, (0, 2, 0), [("1", 1.0)], variance=0.04)]])
    found = read(foreign.imu(), foreign.dvl(), entry).detections
    np.testing.assert_allclose(found.range_azimuth_cov, [np.diag([0.04, 0.04 / 4])], atol=1e-15)
