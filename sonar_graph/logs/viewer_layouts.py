"""Layouts with which viewers show a result at once: one for Foxglove and Lichtblick, one for RViz 2.

Without a layout these viewers open with every topic switched off. A layout names the topics that the result has, in
their colours, with a camera, a grid and lines that fit its size. ``templates/`` has what is the same for all results;
a new kind of topic needs an entry in `_drawing_settings` and in ``templates/rviz.jinja``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from sonar_graph.errors import LogError
from sonar_graph.logs.landmark_cloud import POINT_CLOUD
from sonar_graph.logs.markers import MARKER_ARRAY, Colour
from sonar_graph.logs.pictures import COMPRESSED_IMAGE
from sonar_graph.logs.roles import ODOMETRY, POSE_WITH_COVARIANCE
from sonar_graph.measurements import Floats

PATH = "nav_msgs/msg/Path"
FOXGLOVE_SUFFIX, RVIZ_SUFFIX = ".foxglove.json", ".rviz"
_PLOTS = {
    "Plot!height": ("pose.pose.position.z", ("/pose", "/ground_truth/odometry")),
    "Plot!variance": ("pose.covariance[0]", ("/pose",)),
}
"""For each plot a field, and how the topics end of which it is shown."""


@dataclass(frozen=True)
class Scene:
    """How large what is drawn is, and where."""

    centre_m: tuple[float, float, float]
    size_m: float
    """The longest side of the box around everything."""

    @classmethod
    def around(cls, positions: Iterable[Floats]) -> Scene:
        """The scene that holds all positions, each of shape (n, 3); what is not finite does not count."""
        points = np.concatenate([np.zeros((0, 3)), *positions])
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return cls((0.0, 0.0, 0.0), 1.0)
        low, high = points.min(axis=0), points.max(axis=0)
        x, y, z = np.round((low + high) / 2, 3).tolist()
        return cls((x, y, z), max(float((high - low).max()), 1.0))

    @property
    def line_m(self) -> float:
        """Width of a line."""
        return round(self.size_m / 400, 4)

    @property
    def axis_m(self) -> float:
        """Length of a frame's axes."""
        return round(self.size_m / 25, 3)

    @property
    def text_height_m(self) -> float:
        """Height of a landmark's identity."""
        return self.size_m / 40

    @property
    def camera_m(self) -> float:
        """Distance of the camera from the centre."""
        return round(1.5 * self.size_m, 2)

    @property
    def cell_m(self) -> float:
        """Side of a cell of the grid: a power of ten."""
        return float(10.0 ** np.floor(np.log10(self.size_m)))

    @property
    def cells(self) -> int:
        """Cells along a side of the grid."""
        return int(np.ceil(1.2 * self.size_m / self.cell_m))


@dataclass(frozen=True)
class Layer:
    """A topic that can be drawn."""

    topic: str
    type_name: str
    colour: Colour
    is_latched: bool = False

    @property
    def is_shown(self) -> bool:
        """Whether it is on from the start: not what another layer shows already."""
        return not self.topic.endswith(("/odometry", "/smoothed"))

    @property
    def rgb(self) -> str:
        """The colour as RViz writes it."""
        return "; ".join(str(round(255 * part)) for part in self.colour[:3])

    def css(self, opacity: float) -> str:
        """The colour as Foxglove writes it."""
        return "#" + "".join(f"{round(255 * part):02x}" for part in (*self.colour[:3], opacity))


def write_layouts(result: Path, layers: Sequence[Layer], scene: Scene) -> None:
    """Write ``NAME.foxglove.json`` and ``NAME.rviz`` beside ``NAME.mcap``.

    Raises
    ------
    LogError
        When one cannot be written.
    """
    layout = json.dumps(foxglove_layout(layers, scene), indent=2, ensure_ascii=False) + "\n"
    for suffix, text in ((FOXGLOVE_SUFFIX, layout), (RVIZ_SUFFIX, rviz_config(layers, scene))):
        path = result.with_suffix(suffix)
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise LogError(f"{path} cannot be written: {error.strerror}") from error


def foxglove_layout(layers: Sequence[Layer], scene: Scene) -> dict[str, Any]:
    """What Foxglove and Lichtblick import: a 3D view, and plots over time beside it."""
    template = files("sonar_graph.logs").joinpath("templates", "foxglove.json")
    layout: dict[str, Any] = json.loads(template.read_text(encoding="utf-8"))
    panels = layout["configById"]
    view = panels["3D!result"]
    settings = _drawing_settings(scene)
    view["topics"] = {
        layer.topic: {"visible": layer.is_shown} | settings[layer.type_name](layer)
        for layer in layers
        if layer.type_name in settings
    }
    view["cameraState"] |= {"distance": scene.camera_m, "targetOffset": scene.centre_m}
    view["cameraState"] |= {"near": round(scene.size_m / 1000, 4), "far": 100 * scene.size_m}
    view["scene"]["transforms"] |= {"axisScale": scene.axis_m, "labelSize": round(scene.text_height_m / 2, 3)}
    x_m, y_m, _ = scene.centre_m
    grid = {"size": scene.cells * scene.cell_m, "divisions": scene.cells, "position": [x_m, y_m, 0]}
    view["layers"]["grid"] |= grid
    for panel, (field, endings) in _PLOTS.items():
        panels[panel]["paths"] = [_plotted(layer, field) for layer in layers if layer.topic.endswith(endings)]
    _show_pictures(layout, [layer.topic for layer in layers if layer.type_name == COMPRESSED_IMAGE])
    return layout


def _show_pictures(layout: dict[str, Any], topics: list[str]) -> None:
    """A panel for the first topic with pictures, over the plots; nothing where there is none."""
    if not topics:
        return
    panel = "Image!pictures"
    layout["configById"][panel] = {"imageMode": {"imageTopic": topics[0]}}
    beside = layout["layout"]
    plots = beside["second"]
    beside["second"] = {"direction": "column", "splitPercentage": 40, "first": panel, "second": plots}


def _drawing_settings(scene: Scene) -> dict[str, Callable[[Layer], dict[str, Any]]]:
    """Settings of Foxglove's 3D panel for the types that it draws; Odometry is not among them."""
    return {
        PATH: lambda layer: {"type": "line", "lineWidth": scene.line_m, "gradient": [layer.css(1), layer.css(1)]},
        MARKER_ARRAY: lambda _: {},
        POSE_WITH_COVARIANCE: lambda _: {"type": "axis", "axisScale": scene.axis_m, "showCovariance": False},
        POINT_CLOUD: lambda layer: {"pointSize": 6, "colorMode": "flat", "flatColor": layer.css(1)},
    }


def _plotted(layer: Layer, field: str) -> dict[str, Any]:
    return {
        "value": f"{layer.topic}.{field}",
        "enabled": True,
        "timestampMethod": "headerStamp",
        "label": layer.topic.split("/")[1],
        "color": layer.css(1),
        "showLine": True,
        "lineSize": 1,
    }


def rviz_config(layers: Sequence[Layer], scene: Scene) -> str:
    """What ``rviz2 -d`` opens: a display for each topic."""
    environment = Environment(
        loader=PackageLoader("sonar_graph.logs", "templates"),
        undefined=StrictUndefined,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    types = {
        "PATH": PATH,
        "MARKER_ARRAY": MARKER_ARRAY,
        "POSE_WITH_COVARIANCE": POSE_WITH_COVARIANCE,
        "ODOMETRY": ODOMETRY,
        "POINT_CLOUD": POINT_CLOUD,
        "COMPRESSED_IMAGE": COMPRESSED_IMAGE,
    }
    return environment.get_template("rviz.jinja").render(layers=layers, scene=scene, **types)
