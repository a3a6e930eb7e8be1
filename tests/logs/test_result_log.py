"""Results, their messages and layouts for viewers, as other libraries decode them."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from sonar_graph.logs import (
    PICTURES,
    Picture,
    landmark_markers,
    write_log,
    write_result,
)
from sonar_graph.logs.mcap import Outgoing, write_recording
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
    """A result with its layouts, and its messages as another library decodes them."""
    covariances = np.tile(np.diag([1, 4, 9.0]), (2, 1, 1))
    landmarks = LandmarkMap(
        np.array([6, 20]), np.array([[1.0, 2, 0], [3, 4, 0]]), covariances
    )
    estimates = {
        "ekf-slam": (straight(0), straight(0), landmarks),
        "isam2": (straight(10), straight(20), landmarks),
        "failed": (EMPTY, EMPTY, NO_LANDMARKS),
    }
    path = tmp_path_factory.mktemp("result") / "result.mcap"
    write_result(path, make_sequence(), estimates)
    layout = json.loads(path.with_suffix(".foxglove.json").read_text("utf-8"))
    rviz = YAML(typ="safe").load(path.with_suffix(".rviz"))["Visualization Manager"]
    messages = decode(path)
    types = {topic: type(ms[0]).__name__ for topic, ms in messages.items()}
    view = layout["configById"]["3D!result"]
    return SimpleNamespace(
        path=path, messages=messages, types=types, layout=layout, view=view, rviz=rviz
    )


def test_every_estimator_and_the_truth_are_in_the_result(
    result,
):
    each = (
        "odometry",
        "pose",
        "pose_ellipsoid",
        "smoothed",
        "path",
        "landmarks",
    )
    expected = {f"/{name}/{kind}" for name in ("ekf_slam", "isam2") for kind in each}
    expected |= {f"/ground_truth/{kind}" for kind in ("odometry", "path", "landmarks")}
    assert set(result.messages) == expected | {"/tf", "/tf_static"}
    (array,) = result.messages["/isam2/landmarks"]
    spheres = [m for m in array.markers if m.type == 2]
    texts = [m for m in array.markers if m.type == 9]
    assert [m.text for m in texts] == ["6", "20"]
    assert [(m.pose.position.x, m.pose.position.y) for m in spheres] == [(1, 2), (3, 4)]
    scale = spheres[0].scale
    assert sorted([scale.x, scale.y, scale.z]) == pytest.approx(
        2 * 2.7954834829151074 * np.array([1, 2, 3])
    )
    assert len({(m.ns, m.id) for m in array.markers}) == 4


def test_odometry_is_causal_and_the_last_path_smoothed(
    result,
):
    assert [m.pose.pose.position.x for m in result.messages["/isam2/odometry"]] == list(
        np.arange(100) + 10.0
    )
    *so_far, last = result.messages["/isam2/path"]
    assert [len(path.poses) for path in so_far] == [31, 61, 91]
    assert [p.poses[0].pose.position.x for p in so_far] == [10, 10, 10]
    assert [p.pose.position.x for p in last.poses] == list(np.arange(100) + 20.0)
    assert [p.header.stamp.sec for p in last.poses] == list(
        range(1_700_000_000, 1_700_000_100)
    )
    pose = result.messages["/isam2/pose"][0]
    odometry = result.messages["/isam2/odometry"][0]
    for message in (pose, odometry):
        # body axes turned by 90 degrees: what lies along the body's x lies along the world's y
        assert np.diag(np.reshape(message.pose.covariance, (6, 6))) == pytest.approx(
            [5, 4, 6, 2, 1, 3]
        )
    assert (pose.header.frame_id, odometry.child_frame_id) == ("map", "isam2/base_link")


def test_tf_is_one_tree_below_the_map(
    result,
):
    """The sensors follow the first estimator."""
    parents: dict[str, set[str]] = {}
    xs: dict[str, list[float]] = {}
    for transform in [
        t
        for m in result.messages["/tf"] + result.messages["/tf_static"]
        for t in m.transforms
    ]:
        parents.setdefault(transform.child_frame_id, set()).add(
            transform.header.frame_id
        )
        xs.setdefault(transform.child_frame_id, []).append(
            transform.transform.translation.x
        )
    sensors = {
        sensor: {"base_link"}
        for sensor in ("imu", "dvl", "depth", "sonar", "positions")
    }
    bodies = (
        "base_link",
        "ekf_slam/base_link",
        "isam2/base_link",
        "ground_truth/base_link",
    )
    assert parents == sensors | {body: {"map"} for body in bodies}
    assert {
        m.child_frame_id for m in result.messages["/isam2/odometry"]
    } <= parents.keys()
    assert xs["base_link"] == xs["ekf_slam/base_link"] == list(np.arange(100.0))
    assert xs["isam2/base_link"] == list(np.arange(100.0) + 10)
    instants = [
        {(t.header.stamp.sec, t.header.stamp.nanosec) for t in m.transforms}
        for m in result.messages["/tf"]
    ]
    assert {len(stamps) for stamps in instants} == {1}
    assert len(set.union(*instants)) == len(instants)


def test_rosbags_re_encodes_every_message_to_the_same_bytes(
    result, make_sequence, tmp_path
):
    write_log(tmp_path / "log.mcap", make_sequence())
    for path in (result.path, tmp_path / "log.mcap"):
        count = 0
        with AnyReader([path]) as reader:
            for connection, _, raw in reader.messages():
                message = reader.typestore.deserialize_cdr(raw, connection.msgtype)
                assert (
                    bytes(reader.typestore.serialize_cdr(message, connection.msgtype))
                    == raw
                )
                count += 1
        assert count > 80


def test_paths_stay_small_on_long_runs(make_sequence, tmp_path):
    long = straight(0, 20_000)
    write_result(
        tmp_path / "r.mcap", make_sequence(), {"isam2": (long, long, NO_LANDMARKS)}
    )
    with (tmp_path / "r.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        lengths = [
            len(path.poses)
            for _, _, _, path in reader.iter_decoded_messages(["/isam2/path"])
        ]
    assert sum(lengths[:-1]) < 12_000
    assert 4_000 < lengths[-1] <= 5_001


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


def test_poses_survive_to_the_bit_in_a_result(make_sequence, tmp_path):
    sequence = make_sequence()
    causal = turning(1)
    smoothed = turning(2)
    path = straight(0)
    unsure = Trajectory.without_covariances(
        path.stamps_ns, path.positions, path.quaternions_xyzw
    )
    estimates = {
        "a": (causal, smoothed, NO_LANDMARKS),
        "unsure": (unsure, unsure, NO_LANDMARKS),
    }
    write_result(tmp_path / "r.mcap", sequence, estimates)
    messages = decode(tmp_path / "r.mcap")
    topics = {"/a/odometry": causal, "/a/pose": causal, "/a/smoothed": smoothed}
    for topic, expected in (
        topics | {"/ground_truth/odometry": sequence.truth}
    ).items():
        stamps = [m.header.stamp for m in messages[topic]]
        poses = [m.pose.pose for m in messages[topic]]
        assert [
            stamp.sec * 10**9 + stamp.nanosec for stamp in stamps
        ] == expected.stamps_ns.tolist(), topic
        positions = [(p.position.x, p.position.y, p.position.z) for p in poses]
        np.testing.assert_array_equal(positions, expected.positions, topic)
        quaternions = [(q.x, q.y, q.z, q.w) for q in (p.orientation for p in poses)]
        np.testing.assert_array_equal(quaternions, expected.quaternions_xyzw, topic)
    centres = [
        array.markers[0].pose.position for array in messages["/a/pose_ellipsoid"]
    ]
    np.testing.assert_array_equal([(c.x, c.y, c.z) for c in centres], causal.positions)
    last = messages["/a/path"][-1].header.stamp
    assert last.sec * 10**9 + last.nanosec == max(
        causal.stamps_ns[-1], smoothed.stamps_ns[-1]
    )
    assert not np.any([m.pose.covariance for m in messages["/unsure/pose"]])
    assert "/unsure/pose_ellipsoid" not in messages
    for layout in ("r.foxglove.json", "r.rviz"):
        text = (tmp_path / layout).read_text("utf-8")
        assert "/a/pose_ellipsoid" in text
        assert "/unsure/pose_ellipsoid" not in text


@given(st.lists(st.text(max_size=6), max_size=6))
def test_source_names_are_unique_ros_names(
    estimators,
):
    names = source_names(estimators)
    assert len(names) == len(set(names)) == len(estimators)
    assert not {"ground_truth", "tf", "tf_static"} & set(names)
    assert all(
        re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name) for name in names
    )
    close = source_names(["ekf-slam", "ekf_slam", "isam2", "2d", "ground-truth"])
    assert close == [
        "ekf_slam",
        "ekf_slam_2",
        "isam2",
        "estimator_2d",
        "ground_truth_2",
    ]


# --- ellipsoids -----------------------------------------------------------------------------------------------------


def drawn(folder: Path, messages: Outgoing) -> list[Any]:
    """Messages of one topic as another library decodes them."""
    write_recording(folder / "a.mcap", [messages], {})
    (found,) = decode(folder / "a.mcap").values()
    return found


def xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


def axes(marker: Any) -> Rotation:
    q = marker.pose.orientation
    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def test_landmarks_are_drawn_as_ellipsoids_of_their_covariance(
    tmp_path: Path,
) -> None:
    """A stick of 1 m standard deviation along (1, 1, 0), thin across; by hand, its longest axis lies there."""
    along = np.array([1.0, 1, 0]) / np.sqrt(2)
    across = np.array([1.0, -1, 0]) / np.sqrt(2)
    stick = (
        np.outer(along, along)
        + 0.04 * np.outer(across, across)
        + 0.01 * np.diag([0, 0, 1.0])
    )
    positions = np.array([[1.0, 2, 3], [4, 5, 6]])
    covariances = np.array([stick, np.full((3, 3), np.nan)])
    landmarks = LandmarkMap(np.array([7, 2**40]), positions, covariances)
    (array,) = drawn(tmp_path, landmark_markers("/landmarks", landmarks, 1, GREY, 0.5))
    spaces = [m.ns for m in array.markers]
    texts = [m.text for m in array.markers]
    assert spaces == [
        "ellipsoid_95_percent",
        "covariance_unknown",
        "identity",
        "identity",
    ]
    assert texts == ["", "", "7", "1099511627776"]
    assert [(m.pose.position.z, m.scale.z) for m in array.markers[2:]] == [
        (3.5, 0.5),
        (6.5, 0.5),
    ]
    assert {(m.header.frame_id, m.action, m.lifetime.sec) for m in array.markers} == {
        ("map", 0, 0)
    }
    diameters = xyz(array.markers[0].scale)
    longest = axes(array.markers[0]).as_matrix()[:, np.argmax(diameters)]
    np.testing.assert_allclose(np.abs(longest @ along), 1)
    np.testing.assert_allclose(
        np.sort(diameters), 2 * 2.7954834829151074 * np.array([0.1, 0.2, 1.0])
    )


# --- pictures ----------------------------------------------------------------------------------------------


def test_another_library_sees_each_picture_whole_with_its_stamp(tmp_path: Path) -> None:
    """Of different sizes, as JPEG files are."""
    images = [np.full((20, 30 + 40 * k), 90 * k, np.uint8) for k in range(3)]
    contents = [cv2.imencode(".jpg", image)[1].tobytes() for image in images]
    pictures = [
        Picture(1_700_000_000_000_000_001 + k * 10**9, content)
        for k, content in enumerate(contents)
    ]
    write_recording(tmp_path / "log.mcap", picture_messages(PICTURES, pictures), {})
    with (tmp_path / "log.mcap").open("rb") as stream:
        found = list(
            make_reader(
                stream, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        )
    assert [entry.channel.topic for entry in found] == ["/sonar/recognised"] * 3
    assert {entry.schema.name for entry in found} == {"sensor_msgs/msg/CompressedImage"}
    for entry, picture, image in zip(found, pictures, images, strict=True):
        message = entry.decoded_message
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert stamp_ns == entry.message.log_time == picture.stamp_ns
        assert (message.header.frame_id, message.format, bytes(message.data)) == (
            "sonar",
            "jpeg",
            picture.jpeg,
        )
        assert (
            cv2.imdecode(
                np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_GRAYSCALE
            ).shape
            == image.shape
        )
    assert picture_messages(PICTURES, []) == []


# --- layouts ---------------------------------------------------------------------------------------------------------

SAME_NAME = ("Path", "Odometry", "MarkerArray")
DRAWN_BY_RVIZ = {f"rviz_default_plugins/{kind}": kind for kind in SAME_NAME}
DRAWN_BY_RVIZ["rviz_default_plugins/PoseWithCovariance"] = "PoseWithCovarianceStamped"
"""By plugins_description.xml of rviz_default_plugins."""
"""Of the types that we write; nav_msgs/Odometry is not drawn by Lichtblick 1.28."""


# --- size -----------------------------------------------------------------------------------------------------------


def test_an_empty_scene_can_be_drawn(make_sequence: Any, tmp_path: Path) -> None:
    layer = Layer("/a/path", "nav_msgs/msg/Path", (1, 0, 0, 1))
    layout = foxglove_layout([layer], Scene.around([np.empty((0, 3))]))
    assert json.loads(json.dumps(layout, allow_nan=False))["configById"]["3D!result"][
        "topics"
    ]["/a/path"]["visible"]
    write_result(tmp_path / "result.mcap", make_sequence(), {})
    layout = json.loads((tmp_path / "result.foxglove.json").read_text("utf-8"))
    topics = {
        "/ground_truth/path",
        "/ground_truth/landmarks",
    }
    assert set(layout["configById"]["3D!result"]["topics"]) == topics
    children = {
        t.child_frame_id
        for m in decode(tmp_path / "result.mcap")["/tf"]
        for t in m.transforms
    }
    assert children == {"base_link", "ground_truth/base_link"}
