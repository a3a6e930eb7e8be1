"""Results, their messages and layouts for viewers, as other libraries decode them."""

import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.logs import (
    PICTURES,
    Picture,
    landmark_markers,
    write_result,
)
from sonar_graph.logs.mcap import write_recording
from sonar_graph.logs.result_log import source_names
from sonar_graph.logs.viewer_messages import (
    GREY,
    Layer,
    Scene,
    foxglove_layout,
    picture_messages,
)
from sonar_graph.states import LandmarkMap, Trajectory

from .conftest import decode

T0_NS = 1_700_000_000_000_000_000
EMPTY = Trajectory.without_covariances(
    np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 4))
)
NO_LANDMARKS = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))


def stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec


def straight(offset_m: float, n: int = 100) -> Trajectory:
    """A pose a second along x, heading to +y, with a covariance that differs between axes."""
    positions = np.column_stack([np.arange(n) + offset_m, np.zeros(n), np.zeros(n)])
    quaternions = np.tile([0, 0, np.sqrt(0.5), np.sqrt(0.5)], (n, 1))
    covariances = np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (n, 1, 1))
    return Trajectory(T0_NS + np.arange(n) * 10**9, positions, quaternions, covariances)


@pytest.fixture(scope="module")
def result(
    make_sequence: Any, tmp_path_factory: pytest.TempPathFactory
) -> SimpleNamespace:
    """A result, what was written, and its messages as another library decodes them."""
    landmarks = LandmarkMap(np.array([6, 20]), np.eye(2, 3), np.array([np.eye(3)] * 2))
    known = straight(0)
    unsure = Trajectory.without_covariances(
        known.stamps_ns, known.positions, known.quaternions_xyzw
    )
    estimates = {
        "ekf-slam": (turning(1), turning(2), landmarks),
        "isam2": (straight(10), straight(20), landmarks),
        "unsure": (unsure, unsure, NO_LANDMARKS),
        "failed": (EMPTY, EMPTY, NO_LANDMARKS),
    }
    sequence = make_sequence()
    folder = tmp_path_factory.mktemp("result")
    write_result(folder / "r.mcap", sequence, estimates)
    return SimpleNamespace(
        folder=folder,
        truth=sequence.truth,
        estimates=estimates,
        messages=decode(folder / "r.mcap"),
    )


def test_every_estimator_and_the_truth_are_in_the_result(result):
    each = ["odometry", "pose", "smoothed", "path"]
    more = [*each, "pose_ellipsoid", "landmarks"]
    kinds = {"ekf_slam": more, "isam2": more, "unsure": each}
    kinds["ground_truth"] = ["odometry", "path", "landmarks"]
    expected = {f"/{name}/{kind}" for name in kinds for kind in kinds[name]}
    assert set(result.messages) == expected | {"/tf", "/tf_static"}
    assert not np.any([m.pose.covariance for m in result.messages["/unsure/pose"]])
    for layout in ("r.foxglove.json", "r.rviz"):
        text = (result.folder / layout).read_text("utf-8")
        assert "/isam2/pose_ellipsoid" in text
        assert "/unsure/pose_ellipsoid" not in text


def test_tf_is_one_tree_below_the_map(result):
    """The sensors follow the first estimator."""
    parents: dict[str, set[str]] = {}
    xs: dict[str, list[float]] = {}
    for message in result.messages["/tf"] + result.messages["/tf_static"]:
        for transform in message.transforms:
            child = transform.child_frame_id
            parents.setdefault(child, set()).add(transform.header.frame_id)
            xs.setdefault(child, []).append(transform.transform.translation.x)
    sensors = "imu", "dvl", "depth", "sonar", "positions"
    expected = {name: {"base_link"} for name in sensors} | {"base_link": {"map"}}
    for name in ("ekf_slam", "isam2", "unsure", "ground_truth"):
        expected[f"{name}/base_link"] = {"map"}
    assert parents == expected
    of_first = result.estimates["ekf-slam"][0].positions[:, 0].tolist()
    assert xs["base_link"] == xs["ekf_slam/base_link"] == of_first
    assert xs["isam2/base_link"] == list(np.arange(100.0) + 10)
    instants = [set(map(stamp_ns, m.transforms)) for m in result.messages["/tf"]]
    assert {len(stamps) for stamps in instants} == {1}
    assert len(set.union(*instants)) == len(instants)


def test_paths_stay_small_on_long_runs(make_sequence, tmp_path):
    long = straight(0, 7_000)
    path = tmp_path / "r.mcap"
    write_result(path, make_sequence(), {"isam2": (long, long, NO_LANDMARKS)})
    *so_far, last = (len(m.poses) for m in decode(path, "/isam2/path")["/isam2/path"])
    assert sum(so_far) < 12_000
    assert 4_000 < last <= 5_001


def turning(seed: int, n: int = 60) -> Trajectory:
    """Poses with every number different, at odd instants."""
    rng = np.random.default_rng(seed)
    stamps_ns = T0_NS + np.cumsum(rng.integers(1, 10**9, n))
    root = rng.normal(size=(n, 6, 6))
    covariances = root @ root.transpose(0, 2, 1)
    return Trajectory(
        stamps_ns,
        rng.normal(size=(n, 3)),
        Rotation.random(n, rng).as_quat(),
        covariances,
    )


def test_poses_survive_to_the_bit_in_a_result(result):
    causal, smoothed, _ = result.estimates["ekf-slam"]
    for topic, expected in (
        ("/ekf_slam/odometry", causal),
        ("/ekf_slam/pose", causal),
        ("/ekf_slam/smoothed", smoothed),
        ("/ground_truth/odometry", result.truth),
    ):
        messages = result.messages[topic]
        poses = [m.pose.pose for m in messages]
        assert [*map(stamp_ns, messages)] == expected.stamps_ns.tolist(), topic
        positions = [xyz(p.position) for p in poses]
        np.testing.assert_array_equal(positions, expected.positions, topic)
        quaternions = [[*xyz(q), q.w] for q in (p.orientation for p in poses)]
        np.testing.assert_array_equal(quaternions, expected.quaternions_xyzw, topic)
    ellipsoids = [
        m.markers[0].pose for m in result.messages["/ekf_slam/pose_ellipsoid"]
    ]
    centres = [xyz(pose.position) for pose in ellipsoids]
    np.testing.assert_array_equal(centres, causal.positions)
    last_ns = max(causal.stamps_ns[-1], smoothed.stamps_ns[-1])
    assert stamp_ns(result.messages["/ekf_slam/path"][-1]) == last_ns


def test_a_path_grows_and_is_smoothed_at_the_end(result):
    *so_far, last = result.messages["/isam2/path"]
    assert [len(path.poses) for path in so_far] == [31, 61, 91]
    assert [p.poses[0].pose.position.x for p in so_far] == [10, 10, 10]
    assert [p.pose.position.x for p in last.poses] == list(np.arange(100) + 20.0)
    assert [*map(stamp_ns, last.poses)] == straight(0).stamps_ns.tolist()
    # body axes turned by 90 degrees: what lies along the body's x lies along the world's y
    expected = pytest.approx([5, 4, 6, 2, 1, 3])
    for kind in ("pose", "odometry"):
        message = result.messages[f"/isam2/{kind}"][0]
        assert np.diag(np.reshape(message.pose.covariance, (6, 6))) == expected
        assert message.header.frame_id == "map"
    assert message.child_frame_id == "isam2/base_link"


@given(st.lists(st.text(max_size=6), max_size=6))
@example(["ekf-slam", "ekf_slam", "isam2", "2d", "ground-truth"])
def test_source_names_are_unique_ros_names(estimators):
    names = source_names(estimators)
    assert len(names) == len(set(names)) == len(estimators)
    assert not {"ground_truth", "tf", "tf_static"} & set(names)
    form = r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*"
    assert all(re.fullmatch(form, name) for name in names)


# --- ellipsoids -----------------------------------------------------------------------------------------------------


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def test_landmarks_are_drawn_as_ellipsoids_of_their_covariance(tmp_path):
    """A stick of 1 m standard deviation along (1, 1, 0), thin across; by hand, its longest axis lies there."""
    turn = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    stick = turn @ np.diag([1.0, 0.04, 0.01]) @ turn.T
    positions = np.array([[1.0, 2, 3], [4, 5, 6]])
    covariances = np.array([stick, np.full((3, 3), np.nan)])
    landmarks = LandmarkMap(np.array([7, 2**40]), positions, covariances)
    drawn = landmark_markers("/landmarks", landmarks, 1, GREY, 0.5)
    write_recording(tmp_path / "a.mcap", [drawn], {})
    ((array,),) = decode(tmp_path / "a.mcap").values()
    assert [(m.ns, m.id, m.text) for m in array.markers] == [
        ("ellipsoid_95_percent", 0, ""),
        ("covariance_unknown", 1, ""),
        ("identity", 0, "7"),
        ("identity", 1, "1099511627776"),
    ]
    assert {m.header.frame_id for m in array.markers} == {"map"}
    ellipsoid, unknown, *letters = array.markers
    assert [xyz(m.pose.position) for m in (ellipsoid, unknown)] == positions.tolist()
    assert [(m.pose.position.z, m.scale.z) for m in letters] == [(3.5, 0.5), (6.5, 0.5)]
    diameters = xyz(ellipsoid.scale)
    q = ellipsoid.pose.orientation
    axes = Rotation.from_quat([*xyz(q), q.w]).as_matrix()
    longest = axes[:, np.argmax(diameters)]
    np.testing.assert_allclose(np.abs(longest @ turn[:, 0]), 1)
    expected = 2 * 2.7954834829151074 * np.array([0.1, 0.2, 1.0])
    np.testing.assert_allclose(np.sort(diameters), expected)


# --- pictures ----------------------------------------------------------------------------------------------


def test_another_library_sees_each_picture_whole_with_its_stamp(tmp_path):
    """Of different sizes, as JPEG files are."""
    pictures = [Picture(T0_NS + k, bytes(range(20 + 40 * k))) for k in range(3)]
    write_recording(tmp_path / "log.mcap", picture_messages(PICTURES, pictures), {})
    messages = decode(tmp_path / "log.mcap")["/sonar/recognised"]
    assert [Picture(stamp_ns(m), bytes(m.data)) for m in messages] == pictures
    assert {(m.header.frame_id, m.format) for m in messages} == {("sonar", "jpeg")}
    assert picture_messages(PICTURES, []) == []


# --- layouts --------------------------------------------------------------------------------------------------------


def test_an_empty_scene_can_be_drawn(make_sequence, tmp_path):
    layer = Layer("/a/path", "nav_msgs/msg/Path", (1, 0, 0, 1))
    layout = foxglove_layout([layer], Scene.around([np.empty((0, 3))]))
    assert json.dumps(layout, allow_nan=False)
    write_result(tmp_path / "result.mcap", make_sequence(), {})
    layout = json.loads((tmp_path / "result.foxglove.json").read_text("utf-8"))
    topics = layout["configById"]["3D!result"]["topics"]
    assert set(topics) == {"/ground_truth/path", "/ground_truth/landmarks"}
    messages = decode(tmp_path / "result.mcap")["/tf"]
    children = {t.child_frame_id for m in messages for t in m.transforms}
    assert children == {"base_link", "ground_truth/base_link"}
