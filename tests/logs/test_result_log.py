import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from sonar_graph.logs.result_log import source_names, write_result
from sonar_graph.logs.writing import write_log
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

T0_NS = 1_700_000_000_000_000_000
EMPTY = Trajectory.without_covariances(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 4)))
NO_LANDMARKS = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))


def straight(offset_m: float, n: int = 100) -> Trajectory:
    """A pose a second along x, heading to +y, with a covariance that tells its axes apart."""
    positions = np.column_stack([np.arange(n) + offset_m, np.zeros(n), np.zeros(n)])
    quaternions = np.tile([0, 0, np.sqrt(0.5), np.sqrt(0.5)], (n, 1))
    covariances = np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (n, 1, 1))
    return Trajectory(T0_NS + np.arange(n) * 10**9, positions, quaternions, covariances)


@pytest.fixture
def result(make_sequence: Any, tmp_path: Path) -> Path:
    landmarks = LandmarkMap(
        np.array([6, 20]), np.array([[1.0, 2, 0], [3, 4, 0]]), np.tile(np.diag([1, 4, 9.0]), (2, 1, 1))
    )
    estimates = {
        "ekf-slam": (straight(0), straight(0), landmarks),
        "isam2": (straight(10), straight(20), landmarks),
        "failed": (EMPTY, EMPTY, NO_LANDMARKS),
    }
    write_result(tmp_path / "result.mcap", make_sequence(), estimates)
    return tmp_path / "result.mcap"


@pytest.fixture
def messages(result: Path, decoded: Any) -> dict[str, list[Any]]:
    return decoded(result)


def test_every_estimator_and_the_truth_are_there_with_landmarks_as_ellipsoids_and_identities(messages):
    each = ("odometry", "pose", "pose_ellipsoid", "smoothed", "path", "landmarks", "landmark_cloud")
    expected = {f"/{name}/{kind}" for name in ("ekf_slam", "isam2") for kind in each}
    expected |= {f"/ground_truth/{kind}" for kind in ("odometry", "path", "landmarks", "landmark_cloud")}
    assert set(messages) == expected | {"/tf", "/tf_static"}
    (array,) = messages["/isam2/landmarks"]
    spheres = [m for m in array.markers if m.type == 2]
    texts = [m for m in array.markers if m.type == 9]
    assert [m.text for m in texts] == ["6", "20"]
    assert [(m.pose.position.x, m.pose.position.y) for m in spheres] == [(1, 2), (3, 4)]
    scale = spheres[0].scale
    assert sorted([scale.x, scale.y, scale.z]) == pytest.approx(2 * 2.7954834829151074 * np.array([1, 2, 3]))
    assert len({(m.ns, m.id) for m in array.markers}) == 4


def test_odometry_is_causal_with_covariances_in_the_axes_of_ros_and_the_last_path_smoothed(messages):
    assert [m.pose.pose.position.x for m in messages["/isam2/odometry"]] == list(np.arange(100) + 10.0)
    *so_far, last = messages["/isam2/path"]
    assert [len(path.poses) for path in so_far] == [31, 61, 91]
    assert [p.poses[0].pose.position.x for p in so_far] == [10, 10, 10]
    assert [p.pose.position.x for p in last.poses] == list(np.arange(100) + 20.0)
    assert [p.header.stamp.sec for p in last.poses] == list(range(1_700_000_000, 1_700_000_100))
    pose = messages["/isam2/pose"][0]
    # body axes turned by 90 degrees: what lies along the body's x lies along the world's y
    assert np.diag(np.reshape(pose.pose.covariance, (6, 6))) == pytest.approx([5, 4, 6, 2, 1, 3])
    assert (pose.header.frame_id, messages["/isam2/odometry"][0].child_frame_id) == ("map", "isam2/base_link")


def test_tf_is_a_tree_below_the_map_whose_transforms_of_one_instant_share_a_message(messages):
    """The sensors follow the first estimator."""
    parents: dict[str, set[str]] = {}
    xs: dict[str, list[float]] = {}
    for transform in [t for m in messages["/tf"] + messages["/tf_static"] for t in m.transforms]:
        parents.setdefault(transform.child_frame_id, set()).add(transform.header.frame_id)
        xs.setdefault(transform.child_frame_id, []).append(transform.transform.translation.x)
    sensors = {sensor: {"base_link"} for sensor in ("imu", "dvl", "depth", "sonar")}
    bodies = ("base_link", "ekf_slam/base_link", "isam2/base_link", "ground_truth/base_link")
    assert parents == sensors | {body: {"map"} for body in bodies}
    assert {m.child_frame_id for m in messages["/isam2/odometry"]} <= parents.keys()
    assert xs["base_link"] == xs["ekf_slam/base_link"] == list(np.arange(100.0))
    assert xs["isam2/base_link"] == list(np.arange(100.0) + 10)
    instants = [{(t.header.stamp.sec, t.header.stamp.nanosec) for t in m.transforms} for m in messages["/tf"]]
    assert {len(stamps) for stamps in instants} == {1}
    assert len(set.union(*instants)) == len(instants)


def test_rosbags_re_encodes_all_messages_of_logs_and_results_to_the_same_bytes(result, make_sequence, tmp_path):
    write_log(tmp_path / "log.mcap", make_sequence())
    for path in (result, tmp_path / "log.mcap"):
        count = 0
        with AnyReader([path]) as reader:
            for connection, _, raw in reader.messages():
                message = reader.typestore.deserialize_cdr(raw, connection.msgtype)
                assert bytes(reader.typestore.serialize_cdr(message, connection.msgtype)) == raw
                count += 1
        assert count > 80


def test_paths_stay_small_on_long_runs(make_sequence, tmp_path):
    sequence: Sequence = make_sequence()
    long = straight(0, 20_000)
    write_result(tmp_path / "r.mcap", sequence, {"isam2": (long, long, NO_LANDMARKS)})
    with (tmp_path / "r.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        lengths = [len(path.poses) for _, _, _, path in reader.iter_decoded_messages(["/isam2/path"])]
    assert sum(lengths[:-1]) < 12_000
    assert 4_000 < lengths[-1] <= 5_001


def turning(seed: int, n: int = 60) -> Trajectory:
    """Poses with every number different, at odd instants."""
    rng = np.random.default_rng(seed)
    stamps_ns = T0_NS + np.cumsum(rng.integers(1, 10**9, n))
    root = rng.normal(size=(n, 6, 6))
    covariances = root @ root.transpose(0, 2, 1)
    return Trajectory(stamps_ns, rng.normal(size=(n, 3)), Rotation.random(n, rng).as_quat(), covariances)


def test_poses_survive_to_the_bit_and_without_covariances_there_are_no_ellipsoids(make_sequence, tmp_path, decoded):
    sequence, causal, smoothed, path = make_sequence(), turning(1), turning(2), straight(0)
    unsure = Trajectory.without_covariances(path.stamps_ns, path.positions, path.quaternions_xyzw)
    estimates = {"a": (causal, smoothed, NO_LANDMARKS), "unsure": (unsure, unsure, NO_LANDMARKS)}
    write_result(tmp_path / "r.mcap", sequence, estimates)
    messages = decoded(tmp_path / "r.mcap")
    topics = {"/a/odometry": causal, "/a/pose": causal, "/a/smoothed": smoothed}
    for topic, expected in (topics | {"/ground_truth/odometry": sequence.truth}).items():
        stamps = [m.header.stamp for m in messages[topic]]
        poses = [m.pose.pose for m in messages[topic]]
        assert [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps] == expected.stamps_ns.tolist(), topic
        positions = [(p.position.x, p.position.y, p.position.z) for p in poses]
        np.testing.assert_array_equal(positions, expected.positions, topic)
        quaternions = [(q.x, q.y, q.z, q.w) for q in (p.orientation for p in poses)]
        np.testing.assert_array_equal(quaternions, expected.quaternions_xyzw, topic)
    centres = [array.markers[0].pose.position for array in messages["/a/pose_ellipsoid"]]
    np.testing.assert_array_equal([(c.x, c.y, c.z) for c in centres], causal.positions)
    last = messages["/a/path"][-1].header.stamp
    assert last.sec * 10**9 + last.nanosec == max(causal.stamps_ns[-1], smoothed.stamps_ns[-1])
    assert not np.any([m.pose.covariance for m in messages["/unsure/pose"]])
    assert "/unsure/pose_ellipsoid" not in messages
    for layout in ("r.foxglove.json", "r.rviz"):
        text = (tmp_path / layout).read_text("utf-8")
        assert "/a/pose_ellipsoid" in text
        assert "/unsure/pose_ellipsoid" not in text


@given(st.lists(st.text(max_size=6), max_size=6))
def test_source_names_are_ros_names_close_to_the_estimators_and_each_its_own(estimators):
    names = source_names(estimators)
    assert len(names) == len(set(names)) == len(estimators)
    assert not {"ground_truth", "tf", "tf_static"} & set(names)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name) for name in names)
    close = source_names(["ekf-slam", "ekf_slam", "isam2", "2d", "ground-truth"])
    assert close == ["ekf_slam", "ekf_slam_2", "isam2", "estimator_2d", "ground_truth_2"]


def test_the_command_of_evo_reads_every_trajectory(result, tmp_path):
    kinds = ("odometry", "pose", "smoothed")
    topics = [f"/{name}/{kind}" for name in ("ekf_slam", "isam2") for kind in kinds]
    command = [Path(sys.executable).with_name("evo_traj"), "mcap", result.name, *topics]
    home = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=result.parent, capture_output=True, text=True, env=home, timeout=120)
    assert done.returncode == 0, done.stderr
    assert re.findall(r"name:\s+(\S+)", done.stdout) == topics
    assert re.findall(r"infos:\s+(\d+) poses, ([\d.]+)m", done.stdout) == [("100", "99.000")] * len(topics)
