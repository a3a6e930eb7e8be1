"""Messages and layouts for viewers: ellipsoids and landmarks, pictures, and the first look of a result.

Viewers differ in how large they draw the covariance of a pose (RViz: one sigma; Lichtblick: half a sigma, without
correlations); an ellipsoid marker looks the same in all of them. A viewer can switch markers by their namespace:
``ellipsoid_95_percent``, ``covariance_unknown`` (a sphere whose size means nothing), ``identity``.

Without a layout, viewers open with every topic switched off. `write_layouts` writes one for Foxglove and Lichtblick
and one for RViz 2, with a camera, a grid and lines that fit the result. A new kind of topic needs an entry in
``templates/foxglove.jinja`` and in ``templates/rviz.jinja`` (docs/tutorials/03_viewers.md).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sonar_graph.logs.adapters import body_to_ros
from sonar_graph.logs.mcap import Outgoing
from sonar_graph.logs.roles import ODOMETRY, POSE_WITH_COVARIANCE
from sonar_graph.logs.trajectory_files import write_text
from sonar_graph.logs.writing import (
    WORLD_FRAME,
    Columns,
    fields,
    header,
    outgoing,
    stamped,
)
from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.states import LandmarkMap, Trajectory

MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
SPHERE = 2
TEXT_VIEW_FACING = 9
UNKNOWN_DIAMETER_M = 0.2
"""Diameter of the sphere that is drawn for an unknown covariance."""
_SMALLEST_DIAMETER_M = 1e-3
ELLIPSOID = "ellipsoid_95_percent"
UNKNOWN = "covariance_unknown"
IDENTITY = "identity"
_FAINT = 0.35
_SIGMAS = math.sqrt(chi_square_quantile(0.95, 3))
Colour = tuple[float, float, float, float]
BLUE: Colour = (0.12, 0.47, 0.71, 0.8)
ORANGE: Colour = (1.0, 0.5, 0.05, 0.8)
PURPLE: Colour = (0.58, 0.4, 0.74, 0.8)
GREEN: Colour = (0.17, 0.63, 0.17, 0.8)
GREY: Colour = (0.5, 0.5, 0.5, 0.9)


def ellipsoids(covariances: Floats) -> tuple[Floats, Floats]:
    """95 % ellipsoids of Gaussian points in space, ``x' C^-1 x = chi2_3(0.95)``.

    From covariances, shape (m, 3, 3), m², NaN where unknown, which gives a small sphere: diameters along the principal
    axes, shape (m, 3), m, and quaternions x, y, z, w from these axes to the world, shape (m, 4).
    """
    covariances = covariances.copy()
    covariances[_unknown(covariances)] = (
        np.eye(3) * (UNKNOWN_DIAMETER_M / (2 * _SIGMAS)) ** 2
    )
    # C = R diag(variances) R^T: the axes of the ellipsoid are the columns of R
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # right-handed
    # rounding may leave a variance below zero
    diameters = 2 * _SIGMAS * np.sqrt(np.maximum(variances, 0))
    return np.maximum(diameters, _SMALLEST_DIAMETER_M), Rotation.from_matrix(
        axes
    ).as_quat()


def _unknown(covariances: Floats) -> NDArray[np.bool_]:
    return np.asarray(~np.isfinite(covariances.reshape(-1, 9)).all(axis=1))


def landmark_markers(
    topic: str,
    landmarks: LandmarkMap,
    stamp_ns: int,
    colour: Colour,
    text_height_m: float,
) -> Outgoing:
    """``visualization_msgs/MarkerArray``: for each landmark an ellipsoid, with its identity as text above it."""
    count = len(landmarks)
    is_unknown = _unknown(landmarks.covariances)
    diameters, quaternions = ellipsoids(landmarks.covariances)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    # above the landmark, where a small ellipsoid does not hide it
    above = landmarks.positions + np.array([0, 0, text_height_m])
    letters = np.full((count, 3), text_height_m)
    values = _marker_columns(
        np.full(2 * count, stamp_ns),
        np.vstack([landmarks.positions, above]),
        np.vstack([quaternions, upright]),
        np.vstack([diameters, letters]),
        colour,
    )
    names = [UNKNOWN if unknown else ELLIPSOID for unknown in is_unknown]
    texts = [str(identity) for identity in landmarks.ids.tolist()]
    values |= {
        "markers.ns": names + [IDENTITY] * count,
        "markers.id": np.tile(np.arange(count), 2),
        "markers.type": np.repeat([SPHERE, TEXT_VIEW_FACING], count),
        "markers.text": [""] * count + texts,
    }
    lengths = {"markers": 2 * count}
    at_ns = np.array([stamp_ns])
    return outgoing(topic, MARKER_ARRAY, at_ns, values, lengths, is_latched=True)


def position_ellipsoids(topic: str, trajectory: Trajectory, colour: Colour) -> Outgoing:
    """``visualization_msgs/MarkerArray`` for each pose with a known covariance: the ellipsoid of its position."""
    # the translation is the second half of a covariance in body axes
    is_known = ~_unknown(trajectory.covariances[:, 3:, 3:])
    known = trajectory.rows(np.flatnonzero(is_known))
    # without a pose there is nothing to turn
    world_axes = known.covariances
    if len(known):
        world_axes = body_to_ros(known.covariances, known.matrices)
    diameters, quaternions = ellipsoids(world_axes[:, :3, :3])
    columns = _marker_columns(
        known.stamps_ns,
        known.positions,
        quaternions,
        diameters,
        (*colour[:3], _FAINT),
    )
    # one marker in each message
    values: Columns = {
        path: value[:, None] if isinstance(value, np.ndarray) else value
        for path, value in columns.items()
    }
    values |= {"markers.ns": ELLIPSOID, "markers.type": SPHERE}
    return outgoing(topic, MARKER_ARRAY, known.stamps_ns, values, {"markers": 1})


def _marker_columns(
    stamps_ns: Ints,
    positions: Floats,
    quaternions: Floats,
    sizes_m: Floats,
    colour: Colour,
) -> Columns:
    """Fields of markers, a row each, in the world."""
    values = header(stamps_ns, WORLD_FRAME, "markers.header")
    values |= fields("markers.pose.position", "xyz", positions)
    values |= fields("markers.pose.orientation", "xyzw", quaternions)
    values |= fields("markers.scale", "xyz", sizes_m)
    parts = zip("rgba", colour, strict=True)
    return values | {f"markers.color.{name}": part for name, part in parts}


COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
PICTURES = "/sonar/recognised"
"""Topic of sonar images into which recognised landmarks are drawn."""


class Picture(NamedTuple):
    """A picture in JPEG format."""

    stamp_ns: int
    jpeg: bytes


def picture_messages(topic: str, pictures: Sequence[Picture]) -> list[Outgoing]:
    """``sensor_msgs/CompressedImage``, one for each picture."""
    messages = []
    for picture in pictures:
        stamps_ns = np.array([picture.stamp_ns])
        # pictures differ in their size, so that each is an entry
        content = np.frombuffer(picture.jpeg, np.uint8)[None, :]
        values: Columns = {"format": "jpeg", "data": content}
        lengths = {"data": content.shape[1]}
        messages.append(
            stamped(topic, COMPRESSED_IMAGE, stamps_ns, "sonar", values, lengths)
        )
    return messages


PATH = "nav_msgs/msg/Path"
FOXGLOVE_SUFFIX = ".foxglove.json"
RVIZ_SUFFIX = ".rviz"


@dataclass(frozen=True)
class Scene:
    """Size and centre of everything that is drawn."""

    centre_m: tuple[float, float, float]
    size_m: float
    """Longest side of the box around everything."""

    @classmethod
    def around(cls, positions: Iterable[Floats]) -> Scene:
        """The scene around all positions, each of shape (n, 3), without those that are not finite."""
        points = np.concatenate([np.zeros((0, 3)), *positions])
        # an estimate that diverged must not move the camera away
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return cls((0.0, 0.0, 0.0), 1.0)
        # a box, not a sphere: surveys are long and flat
        low = points.min(axis=0)
        high = points.max(axis=0)
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
        # a power of ten is read off without a legend
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
        """True where it is on from the start; what another layer shows already is off."""
        return not self.topic.endswith(("/odometry", "/smoothed"))

    @property
    def rgb(self) -> str:
        """Colour in RViz's notation."""
        return "; ".join(str(round(255 * part)) for part in self.colour[:3])

    def css(self, opacity: float) -> str:
        """Colour in Foxglove's notation."""
        return "#" + "".join(
            f"{round(255 * part):02x}" for part in (*self.colour[:3], opacity)
        )


def write_layouts(result: Path, layers: Sequence[Layer], scene: Scene) -> None:
    """Write ``NAME.foxglove.json`` and ``NAME.rviz`` beside ``NAME.mcap``; a LogError where one cannot be written.

    ``rviz2 -d`` opens the latter, with a display for each topic.
    """
    layout = json.dumps(foxglove_layout(layers, scene), indent=2, ensure_ascii=False)
    write_text(result.with_suffix(FOXGLOVE_SUFFIX), f"{layout}\n")
    rviz = _filled("rviz.jinja", layers, scene)
    write_text(result.with_suffix(RVIZ_SUFFIX), rviz)


def foxglove_layout(layers: Sequence[Layer], scene: Scene) -> dict[str, Any]:
    """Layout that Foxglove and Lichtblick import: a 3D view, with plots over time and pictures beside it."""
    layout: dict[str, Any] = json.loads(_filled("foxglove.jinja", layers, scene))
    return layout


def _filled(template: str, layers: Sequence[Layer], scene: Scene) -> str:
    """Text of a template, to which the types of topics are known by the names of the constants here."""
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
        "COMPRESSED_IMAGE": COMPRESSED_IMAGE,
    }

    def plotted(*endings: str) -> list[Layer]:
        return [layer for layer in layers if layer.topic.endswith(endings)]

    return environment.get_template(template).render(
        layers=layers, scene=scene, plotted=plotted, **types
    )
