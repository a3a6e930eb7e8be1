from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from sonar_graph.logs.result_log import write_result
from sonar_graph.logs.viewer_messages import Layer, Scene, foxglove_layout
from sonar_graph.states import LandmarkMap, Trajectory

T0_NS = 1_700_000_000_000_000_000
DRAWN_BY_RVIZ = {
    "rviz_default_plugins/Path": "Path",
    "rviz_default_plugins/Odometry": "Odometry",
    "rviz_default_plugins/PoseWithCovariance": "PoseWithCovarianceStamped",
    "rviz_default_plugins/MarkerArray": "MarkerArray",
    "rviz_default_plugins/PointCloud2": "PointCloud2",
}
"""By plugins_description.xml of rviz_default_plugins."""
DRAWN_BY_FOXGLOVE = {"Path", "PoseWithCovarianceStamped", "MarkerArray", "PointCloud2"}
"""Of the types that we write; nav_msgs/Odometry is not drawn by Lichtblick 1.28."""
COLOUR = re.compile(r"#[0-9a-f]{6}([0-9a-f]{2})?")


def estimate(offset_m: float) -> tuple[Trajectory, Trajectory, LandmarkMap]:
    positions = np.column_stack([np.arange(50.0) + offset_m, np.zeros(50), np.zeros(50)])
    covariances = np.tile(np.eye(6), (50, 1, 1))
    path = Trajectory(T0_NS + np.arange(50) * 10**9, positions, np.tile([0, 0, 0, 1.0], (50, 1)), covariances)
    return path, path, LandmarkMap(np.array([3]), np.array([[100.0, 20, -5]]), np.eye(3)[None])


@pytest.fixture
def result(make_sequence: Any, tmp_path: Path) -> Path:
    estimates = {"isam2": estimate(0), "my-filter": estimate(10)}
    write_result(tmp_path / "result.mcap", make_sequence(), estimates)
    return tmp_path / "result.mcap"


@pytest.fixture
def messages(result: Path, decoded: Callable[[Path], dict[str, list[Any]]]) -> dict[str, list[Any]]:
    return decoded(result)


@pytest.fixture
def layout(result: Path) -> dict[str, Any]:
    return json.loads(result.with_suffix(".foxglove.json").read_text("utf-8"))


@pytest.fixture
def rviz(result: Path) -> dict[str, Any]:
    return YAML(typ="safe").load(result.with_suffix(".rviz"))


def types_of(messages: dict[str, list[Any]]) -> dict[str, str]:
    return {topic: type(found[0]).__name__ for topic, found in messages.items()}


def value_at(message: Any, path: str) -> Any:
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message


# --- Foxglove and Lichtblick ----------------------------------------------------------------------------------------


def test_foxglove_layout_shows_what_the_panel_can_draw_of_this_result(
    layout: dict[str, Any], messages: dict[str, list[Any]]
) -> None:
    topics = layout["configById"]["3D!result"]["topics"]
    assert set(topics) == {topic for topic, kind in types_of(messages).items() if kind in DRAWN_BY_FOXGLOVE}
    shown = {topic for topic, settings in topics.items() if settings["visible"] is True}
    assert set(topics) - shown == {"/isam2/smoothed", "/my_filter/smoothed"}


def test_every_panel_of_the_foxglove_layout_is_placed_once(layout: dict[str, Any]) -> None:
    def panels(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            assert node["direction"] in ("row", "column")
            assert 0 < node["splitPercentage"] < 100
            yield from panels(node["first"])
            yield from panels(node["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    assert {name.split("!")[0] for name in layout["configById"]} == {"3D", "Plot"}
    assert {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"} == set(layout)


def test_every_plotted_path_leads_to_a_number(layout: dict[str, Any], messages: dict[str, list[Any]]) -> None:
    plotted = [path for name, panel in layout["configById"].items() if name[:4] == "Plot" for path in panel["paths"]]
    assert [path["label"] for path in plotted] == ["ground_truth", "isam2", "my_filter", "isam2", "my_filter"]
    for path in plotted:
        topic, field = re.fullmatch(r"(/[\w/]+)\.(.*)", path["value"]).groups()  # type: ignore[union-attr]
        assert isinstance(value_at(messages[topic][0], field), float)


def test_frames_named_in_the_foxglove_layout_are_in_the_result(
    layout: dict[str, Any], messages: dict[str, list[Any]]
) -> None:
    view = layout["configById"]["3D!result"]
    transforms = [t for m in messages["/tf"] + messages["/tf_static"] for t in m.transforms]
    frames = {t.child_frame_id for t in transforms} | {t.header.frame_id for t in transforms}
    named = {view["followTf"], view["layers"]["grid"]["frameId"]}
    named |= {name.removeprefix("frame:") for name in view["transforms"]}
    assert named <= frames


def test_an_estimator_has_one_colour_everywhere(layout: dict[str, Any], messages: dict[str, list[Any]]) -> None:
    topics = layout["configById"]["3D!result"]["topics"]
    seen = set()
    for name in ("isam2", "my_filter", "ground_truth"):
        marker = messages[f"/{name}/landmarks"][0].markers[0].color
        colour = "#" + "".join(f"{round(255 * part):02x}" for part in (marker.r, marker.g, marker.b))
        of_layers = [topics[f"/{name}/path"]["gradient"][0], topics[f"/{name}/landmark_cloud"]["flatColor"]]
        assert all(COLOUR.fullmatch(layer) and layer[:7] == colour for layer in of_layers)
        seen.add(colour)
    assert len(seen) == 3


# --- RViz -----------------------------------------------------------------------------------------------------------


def test_rviz_has_one_display_of_the_right_kind_for_each_topic(
    rviz: dict[str, Any], messages: dict[str, list[Any]]
) -> None:
    displays = rviz["Visualization Manager"]["Displays"]
    drawn = {d["Topic"]["Value"]: DRAWN_BY_RVIZ[d["Class"]] for d in displays if "Topic" in d}
    kinds = types_of(messages)
    assert drawn == {topic: kind for topic, kind in kinds.items() if kind != "TFMessage"}
    assert {d["Class"] for d in displays if "Topic" not in d} == {
        "rviz_default_plugins/Grid",
        "rviz_default_plugins/TF",
    }
    assert all(d["Enabled"] is d["Value"] for d in displays)
    assert len({d["Name"] for d in displays}) == len(displays)


def test_rviz_shows_in_the_frame_that_the_messages_are_in(rviz: dict[str, Any], messages: dict[str, list[Any]]) -> None:
    fixed = rviz["Visualization Manager"]["Global Options"]["Fixed Frame"]
    headers = {m.header.frame_id for topic, found in messages.items() if topic.endswith("/path") for m in found}
    assert headers == {fixed}


def test_rviz_asks_late_only_for_what_the_file_offers_late(rviz: dict[str, Any], result: Path) -> None:
    """A subscriber that asks for more than is offered gets nothing at all."""
    from rosbags.highlevel import AnyReader

    with AnyReader([result]) as reader:
        offered = {c.topic: [q.durability.name for q in c.ext.offered_qos_profiles] for c in reader.connections}
    displays = [d["Topic"] for d in rviz["Visualization Manager"]["Displays"] if "Topic" in d]
    asked = {topic["Value"]: topic["Durability Policy"] for topic in displays}
    assert set(asked.values()) == {"Volatile", "Transient Local"}
    for topic, durability in asked.items():
        assert offered[topic] == (["TRANSIENT_LOCAL"] if durability == "Transient Local" else [])
    assert offered["/tf_static"] == ["TRANSIENT_LOCAL"]
    assert offered["/tf"] == []


# --- size -----------------------------------------------------------------------------------------------------------


def test_the_scene_holds_everything_and_the_camera_sees_it(layout: dict[str, Any], rviz: dict[str, Any]) -> None:
    """The landmark at (100, 20, -5) is farthest from the noise of the truth around the origin."""
    scene = Scene.around([np.array([[100.0, 20, -5], [-3, 0, 0]]), np.array([[np.nan, 1e9, 0]])])
    assert scene.centre_m == (48.5, 10.0, -2.5)
    assert scene.size_m == 103
    camera = layout["configById"]["3D!result"]["cameraState"]
    assert 45 < camera["targetOffset"][0] < 50
    assert camera["near"] < camera["distance"] < camera["far"]
    half_view_m = camera["distance"] * np.tan(np.deg2rad(camera["fovy"] / 2))
    assert half_view_m > 0.5 * 103
    view = rviz["Visualization Manager"]["Views"]["Current"]
    assert view["Focal Point"]["X"] == camera["targetOffset"][0]
    assert view["Distance"] == camera["distance"]


def test_identities_can_be_read_from_the_camera(messages: dict[str, list[Any]], layout: dict[str, Any]) -> None:
    distance_m = layout["configById"]["3D!result"]["cameraState"]["distance"]
    heights = {m.scale.z for m in messages["/isam2/landmarks"][0].markers if m.text}
    assert heights
    assert all(0.01 < height_m / distance_m < 0.05 for height_m in heights)


def test_a_grid_has_few_cells_and_reaches_over_the_scene() -> None:
    for size_m in (1.0, 9.9, 10.0, 320.0, 4000.0):
        scene = Scene((0, 0, 0), size_m)
        assert 2 <= scene.cells <= 12
        assert scene.cells * scene.cell_m >= size_m


def test_a_scene_without_anything_can_be_drawn() -> None:
    layer = Layer("/a/path", "nav_msgs/msg/Path", (1, 0, 0, 1))
    layout = foxglove_layout([layer], Scene.around([np.empty((0, 3))]))
    assert json.loads(json.dumps(layout, allow_nan=False))["configById"]["3D!result"]["topics"]["/a/path"]["visible"]


def test_without_any_estimate_the_truth_is_left(
    make_sequence: Any, tmp_path: Path, decoded: Callable[[Path], dict[str, list[Any]]]
) -> None:
    write_result(tmp_path / "result.mcap", make_sequence(), {})
    layout = json.loads((tmp_path / "result.foxglove.json").read_text("utf-8"))
    topics = {"/ground_truth/path", "/ground_truth/landmarks", "/ground_truth/landmark_cloud"}
    assert set(layout["configById"]["3D!result"]["topics"]) == topics
    children = {t.child_frame_id for m in decoded(tmp_path / "result.mcap")["/tf"] for t in m.transforms}
    assert children == {"base_link", "ground_truth/base_link"}
