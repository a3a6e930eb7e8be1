"""Messages and layouts for viewers, as other libraries decode them."""

import json
import re
import struct
from collections.abc import Iterator
from itertools import pairwise
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

from sonar_graph.logs.mcap.writer import Outgoing, write_recording
from sonar_graph.logs.result_log import write_result
from sonar_graph.logs.viewer_messages import (
    GREY,
    PICTURES,
    UNKNOWN_DIAMETER_M,
    Layer,
    Picture,
    Scene,
    ellipsoids,
    foxglove_layout,
    landmark_cloud,
    landmark_markers,
    picture_messages,
    position_ellipsoids,
)
from sonar_graph.states import LandmarkMap, Trajectory

from .conftest import decode

# --- ellipsoids -----------------------------------------------------------------------------------------------------


@given(st.integers(0, 10_000))
def test_points_on_the_drawn_ellipsoid_have_the_same_mahalanobis_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(1, 3, 3)) + 2 * np.eye(3)
    covariances = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    diameters, quaternions = ellipsoids(covariances)
    sphere = rng.normal(size=(50, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = Rotation.from_quat(quaternions[0]).apply(sphere * diameters[0] / 2)
    squared = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariances[0]), points)
    np.testing.assert_allclose(squared, 7.814727903251179)  # chi-square table: 3 degrees of freedom, 0.95


def test_unknown_covariances_are_small_spheres_and_landmarks_known_exactly_can_still_be_seen() -> None:
    diameters, _ = ellipsoids(np.array([np.full((3, 3), np.nan), np.eye(3), np.zeros((3, 3))]))
    np.testing.assert_allclose(diameters[0], UNKNOWN_DIAMETER_M)
    np.testing.assert_allclose(diameters[1], 2 * np.sqrt(7.814727903251179))
    assert (diameters[2] > 0).all()


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


def test_namespaces_tell_ellipsoids_that_mean_something_from_those_that_do_not(tmp_path: Path) -> None:
    covariances = np.array([np.diag([0.01, 0.04, 0.09]), np.full((3, 3), np.nan)])
    landmarks = LandmarkMap(np.array([7, 2**40]), np.array([[1.0, 2, 3], [4, 5, 6]]), covariances)
    (array,) = drawn(tmp_path, landmark_markers("/landmarks", landmarks, 1, GREY, 0.5))
    spaces, texts = [m.ns for m in array.markers], [m.text for m in array.markers]
    assert spaces == ["ellipsoid_95_percent", "covariance_unknown", "identity", "identity"]
    assert texts == ["", "", "7", "1099511627776"]
    assert [(m.pose.position.z, m.scale.z) for m in array.markers[2:]] == [(3.5, 0.5), (6.5, 0.5)]
    assert {(m.header.frame_id, m.action, m.lifetime.sec) for m in array.markers} == {("map", 0, 0)}


def test_a_drawn_ellipsoid_lies_as_its_covariance_does(tmp_path: Path) -> None:
    """A stick of 1 m standard deviation along (1, 1, 0), thin across; by hand, its longest axis lies there."""
    along, across = np.array([1.0, 1, 0]) / np.sqrt(2), np.array([1.0, -1, 0]) / np.sqrt(2)
    covariance = np.outer(along, along) + 0.04 * np.outer(across, across) + 0.01 * np.diag([0, 0, 1.0])
    landmarks = LandmarkMap(np.array([1]), np.zeros((1, 3)), covariance[None])
    marker = drawn(tmp_path, landmark_markers("/landmarks", landmarks, 1, GREY, 0.5))[0].markers[0]
    diameters = xyz(marker.scale)
    longest = axes(marker).as_matrix()[:, np.argmax(diameters)]
    np.testing.assert_allclose(np.abs(longest @ along), 1)
    np.testing.assert_allclose(np.sort(diameters), 2 * 2.7954834829151074 * np.array([0.1, 0.2, 1.0]))


def test_the_ellipsoid_of_a_pose_holds_95_percent_of_sampled_positions(tmp_path: Path) -> None:
    """Its covariance is in the body's axes, the ellipsoid is drawn in those of the map."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 6, 6))
    covariances = root @ root.transpose(0, 2, 1)
    covariances[1] = np.nan
    rotations = Rotation.random(3, rng)
    positions = rng.normal(size=(3, 3))
    trajectory = Trajectory(np.array([10, 20, 30]), positions, rotations.as_quat(), covariances)
    markers = [array.markers[0] for array in drawn(tmp_path, position_ellipsoids("/pose", trajectory, GREY))]
    assert [marker.header.stamp.nanosec for marker in markers] == [10, 30]
    for marker, row in zip(markers, (0, 2), strict=True):
        samples = rng.multivariate_normal(np.zeros(6), covariances[row], 50_000)[:, 3:]
        sampled = rotations[row].apply(samples) + positions[row]
        within = axes(marker).inv().apply(sampled - xyz(marker.pose.position)) / (xyz(marker.scale) / 2)
        assert abs(np.mean(np.sum(within**2, axis=1) < 1) - 0.95) < 0.005


# --- cloud and pictures ----------------------------------------------------------------------------------------------

FORMATS = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
"""By sensor_msgs/PointField."""


def test_a_reader_of_the_fields_finds_position_identity_and_covariance(tmp_path: Path) -> None:
    ids, positions = [3, 2**40 + 1], np.array([[1.5, -2.25, 0.1], [4000.0, 5.0, -6.0]])
    covariances = np.array([[[1, 0.1, 0.2], [0.1, 2, 0.3], [0.2, 0.3, 3]], np.full((3, 3), np.nan)])
    (cloud,) = drawn(tmp_path, landmark_cloud("/cloud", LandmarkMap(np.array(ids), positions, covariances), 5))
    places = {f.name: (f.offset, f.offset + struct.calcsize(FORMATS[f.datatype])) for f in cloud.fields}
    first, second = (
        {
            f.name: struct.unpack_from("<" + FORMATS[f.datatype], bytes(cloud.data), start + f.offset)[0]
            for f in cloud.fields
        }
        for start in (0, cloud.point_step)
    )
    upper = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
    assert list(first.values()) == [1.5, -2.25, np.float32(0.1), 3, 1, 0.1, 0.2, 2, 0.3, 3]
    assert list(second.values())[:4] == [4000, 5, -6, ids[1]]
    assert all(np.isnan(second[name]) for name in upper)
    assert list(first) == ["x", "y", "z", "id", *upper]
    assert {f.datatype for f in cloud.fields if f.name in "xyz"} == {7}, "RViz reads float32 only"
    # the rules of the type
    assert (cloud.height, cloud.width, cloud.is_bigendian) == (1, 2, False)
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    assert all(end <= start for (_, end), (start, _) in pairwise(places.values()))
    assert places["cov_zz"][1] <= cloud.point_step
    assert {f.count for f in cloud.fields} == {1}


def test_another_library_sees_each_picture_whole_with_its_stamp(tmp_path: Path) -> None:
    """Of different sizes, as JPEG files are."""
    images = [np.full((20, 30 + 40 * k), 90 * k, np.uint8) for k in range(3)]
    contents = [cv2.imencode(".jpg", image)[1].tobytes() for image in images]
    pictures = [Picture(1_700_000_000_000_000_001 + k * 10**9, content) for k, content in enumerate(contents)]
    write_recording(tmp_path / "log.mcap", picture_messages(PICTURES, pictures), {})
    with (tmp_path / "log.mcap").open("rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert [entry.channel.topic for entry in found] == ["/sonar/recognised"] * 3
    assert {entry.schema.name for entry in found} == {"sensor_msgs/msg/CompressedImage"}
    for entry, picture, image in zip(found, pictures, images, strict=True):
        message = entry.decoded_message
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert stamp_ns == entry.message.log_time == picture.stamp_ns
        assert (message.header.frame_id, message.format, bytes(message.data)) == ("sonar", "jpeg", picture.jpeg)
        assert cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_GRAYSCALE).shape == image.shape
    assert picture_messages(PICTURES, []) == []


# --- layouts ---------------------------------------------------------------------------------------------------------

T0_NS = 1_700_000_000_000_000_000
SAME_NAME = ("Path", "Odometry", "MarkerArray", "PointCloud2")
DRAWN_BY_RVIZ = {f"rviz_default_plugins/{kind}": kind for kind in SAME_NAME}
DRAWN_BY_RVIZ["rviz_default_plugins/PoseWithCovariance"] = "PoseWithCovarianceStamped"
"""By plugins_description.xml of rviz_default_plugins."""
DRAWN_BY_FOXGLOVE = {"Path", "PoseWithCovarianceStamped", "MarkerArray", "PointCloud2"}
"""Of the types that we write; nav_msgs/Odometry is not drawn by Lichtblick 1.28."""
COLOUR = re.compile(r"#[0-9a-f]{6}([0-9a-f]{2})?")


def estimate(offset_m: float) -> tuple[Trajectory, Trajectory, LandmarkMap]:
    positions = np.column_stack([np.arange(50.0) + offset_m, np.zeros(50), np.zeros(50)])
    covariances = np.tile(np.eye(6), (50, 1, 1))
    path = Trajectory(T0_NS + np.arange(50) * 10**9, positions, np.tile([0, 0, 0, 1.0], (50, 1)), covariances)
    return path, path, LandmarkMap(np.array([3]), np.array([[100.0, 20, -5]]), np.eye(3)[None])


@pytest.fixture(scope="module")
def result(make_sequence: Any, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A result with its layouts, and its messages as another library decodes them."""
    path = tmp_path_factory.mktemp("result") / "result.mcap"
    write_result(path, make_sequence(), {"isam2": estimate(0), "my-filter": estimate(10)})
    layout = json.loads(path.with_suffix(".foxglove.json").read_text("utf-8"))
    rviz, messages = YAML(typ="safe").load(path.with_suffix(".rviz"))["Visualization Manager"], decode(path)
    types, view = {topic: type(ms[0]).__name__ for topic, ms in messages.items()}, layout["configById"]["3D!result"]
    return SimpleNamespace(path=path, messages=messages, types=types, layout=layout, view=view, rviz=rviz)


def value_at(message: Any, path: str) -> Any:
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message


def test_foxglove_layout_shows_what_the_panel_can_draw_of_this_result_in_its_frames(result: Any) -> None:
    topics = result.view["topics"]
    assert set(topics) == {topic for topic, kind in result.types.items() if kind in DRAWN_BY_FOXGLOVE}
    shown = {topic for topic, settings in topics.items() if settings["visible"] is True}
    assert set(topics) - shown == {"/isam2/smoothed", "/my_filter/smoothed"}
    transforms = [t for m in result.messages["/tf"] + result.messages["/tf_static"] for t in m.transforms]
    frames = {t.child_frame_id for t in transforms} | {t.header.frame_id for t in transforms}
    named = {result.view["followTf"], result.view["layers"]["grid"]["frameId"]}
    named |= {name.removeprefix("frame:") for name in result.view["transforms"]}
    assert named <= frames


def test_every_panel_of_the_foxglove_layout_is_placed_once_and_every_plotted_path_leads_to_a_number(
    result: Any,
) -> None:
    def panels(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            assert node["direction"] in ("row", "column")
            assert 0 < node["splitPercentage"] < 100
            yield from panels(node["first"])
            yield from panels(node["second"])

    configs = result.layout["configById"]
    assert sorted(panels(result.layout["layout"])) == sorted(configs)
    assert {name.split("!")[0] for name in configs} == {"3D", "Plot"}
    assert {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"} == set(result.layout)
    plotted = [path for name, panel in configs.items() if name[:4] == "Plot" for path in panel["paths"]]
    assert [path["label"] for path in plotted] == ["ground_truth", "isam2", "my_filter", "isam2", "my_filter"]
    for path in plotted:
        topic, field = re.fullmatch(r"(/[\w/]+)\.(.*)", path["value"]).groups()  # type: ignore[union-attr]
        assert isinstance(value_at(result.messages[topic][0], field), float)


def test_an_estimator_has_one_colour_everywhere(result: Any) -> None:
    topics, seen = result.view["topics"], set()
    for name in ("isam2", "my_filter", "ground_truth"):
        marker = result.messages[f"/{name}/landmarks"][0].markers[0].color
        colour = "#" + "".join(f"{round(255 * part):02x}" for part in (marker.r, marker.g, marker.b))
        of_layers = [topics[f"/{name}/path"]["gradient"][0], topics[f"/{name}/landmark_cloud"]["flatColor"]]
        assert all(COLOUR.fullmatch(layer) and layer[:7] == colour for layer in of_layers)
        seen.add(colour)
    assert len(seen) == 3


def test_rviz_has_one_display_of_the_right_kind_for_each_topic_in_the_frame_of_its_messages(result: Any) -> None:
    displays = result.rviz["Displays"]
    drawn = {d["Topic"]["Value"]: DRAWN_BY_RVIZ[d["Class"]] for d in displays if "Topic" in d}
    assert drawn == {topic: kind for topic, kind in result.types.items() if kind != "TFMessage"}
    others = {d["Class"] for d in displays if "Topic" not in d}
    assert others == {"rviz_default_plugins/Grid", "rviz_default_plugins/TF"}
    assert all(d["Enabled"] is d["Value"] for d in displays)
    assert len({d["Name"] for d in displays}) == len(displays)
    headers = {m.header.frame_id for topic, ms in result.messages.items() if topic.endswith("/path") for m in ms}
    assert headers == {result.rviz["Global Options"]["Fixed Frame"]}


def test_rviz_asks_late_only_for_what_the_file_offers_late(result: Any) -> None:
    """A subscriber that asks for more than is offered gets nothing at all."""
    with AnyReader([result.path]) as reader:
        offered = {c.topic: [q.durability.name for q in c.ext.offered_qos_profiles] for c in reader.connections}
    asked = {d["Topic"]["Value"]: d["Topic"]["Durability Policy"] for d in result.rviz["Displays"] if "Topic" in d}
    assert set(asked.values()) == {"Volatile", "Transient Local"}
    for topic, durability in asked.items():
        assert offered[topic] == (["TRANSIENT_LOCAL"] if durability == "Transient Local" else [])
    assert (offered["/tf_static"], offered["/tf"]) == (["TRANSIENT_LOCAL"], [])


# --- size -----------------------------------------------------------------------------------------------------------


def test_the_scene_holds_everything_and_the_camera_sees_it_and_the_identities(result: Any) -> None:
    """The landmark at (100, 20, -5) is farthest from the noise of the truth around the origin."""
    scene = Scene.around([np.array([[100.0, 20, -5], [-3, 0, 0]]), np.array([[np.nan, 1e9, 0]])])
    assert scene.centre_m == (48.5, 10.0, -2.5)
    assert scene.size_m == 103
    camera = result.view["cameraState"]
    assert 45 < camera["targetOffset"][0] < 50
    assert camera["near"] < camera["distance"] < camera["far"]
    assert camera["distance"] * np.tan(np.deg2rad(camera["fovy"] / 2)) > 0.5 * 103
    view = result.rviz["Views"]["Current"]
    assert view["Focal Point"]["X"] == camera["targetOffset"][0]
    assert view["Distance"] == camera["distance"]
    heights = {m.scale.z for m in result.messages["/isam2/landmarks"][0].markers if m.text}
    assert heights
    assert all(0.01 < height_m / camera["distance"] < 0.05 for height_m in heights)


def test_a_grid_has_few_cells_and_reaches_over_the_scene() -> None:
    for size_m in (1.0, 9.9, 10.0, 320.0, 4000.0):
        scene = Scene((0, 0, 0), size_m)
        assert 2 <= scene.cells <= 12
        assert scene.cells * scene.cell_m >= size_m


def test_a_scene_without_anything_can_be_drawn_and_without_any_estimate_the_truth_is_left(
    make_sequence: Any, tmp_path: Path
) -> None:
    layer = Layer("/a/path", "nav_msgs/msg/Path", (1, 0, 0, 1))
    layout = foxglove_layout([layer], Scene.around([np.empty((0, 3))]))
    assert json.loads(json.dumps(layout, allow_nan=False))["configById"]["3D!result"]["topics"]["/a/path"]["visible"]
    write_result(tmp_path / "result.mcap", make_sequence(), {})
    layout = json.loads((tmp_path / "result.foxglove.json").read_text("utf-8"))
    topics = {"/ground_truth/path", "/ground_truth/landmarks", "/ground_truth/landmark_cloud"}
    assert set(layout["configById"]["3D!result"]["topics"]) == topics
    children = {t.child_frame_id for m in decode(tmp_path / "result.mcap")["/tf"] for t in m.transforms}
    assert children == {"base_link", "ground_truth/base_link"}
