"""The picture of sonar_image.md: ``python docs/theory/sonar_image.py PICTURE.png``."""

import sys

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.simulation.sonar_image import (
    SCENES,
    FrameSimulator,
    ImageOptions,
    SeabedObject,
    place_landmark,
    strangers_at,
    weathered,
)
from sonar_graph.simulation.sonar_image.strangers import KINDS

SONAR_M, TILT = (
    np.array([0.0, 0.0, 0.95]),
    Rotation.from_euler("ZYX", [0, 30, 0], degrees=True),
)
SURFACE_Z_M = 1.7
TRIANGLE = DEFAULT_DESIGNS[2]


def worn_landmark(options: ImageOptions) -> SeabedObject:
    """The triangle, straight ahead."""
    landmark = place_landmark(
        TRIANGLE,
        np.array([1.75, 0.0, TRIANGLE.height_m]),
        0.4,
        0.0,
        options.foam_height_m,
    )
    return weathered(landmark, options, np.random.default_rng(5))


def show(
    panel: Axes, options: ImageOptions, objects: list[SeabedObject], title: str
) -> None:
    """One frame as the sonar sees it: range upward, left to the left."""
    simulator = FrameSimulator(options, objects, 0.0, 1)
    image = simulator.frame(SONAR_M, TILT, 3, SURFACE_Z_M)
    azimuth, r = simulator.azimuths_rad()[:, None], simulator.ranges_m()
    across_m, ahead_m = -r * np.sin(azimuth), r * np.cos(azimuth)
    panel.pcolormesh(
        across_m, ahead_m, image[1:, 1:], vmin=50, vmax=200, cmap="inferno"
    )
    panel.set_title(title, fontsize=9)


def draw(path: str) -> None:
    """The presets above, strangers in the easy scene below."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(2, 1))
    for panel, scene in zip(above.subplots(1, len(SCENES)), SCENES, strict=True):
        options = ImageOptions(scene=scene)
        show(panel, options, [worn_landmark(options)], f'scene = "{scene}"')
    for panel, kind in zip(below.subplots(1, len(KINDS)), KINDS, strict=True):
        show(
            panel,
            ImageOptions(),
            strangers_at(
                np.array([[1.75, 0.0, 0.0]]), (kind,), -1, np.random.default_rng(2)
            ),
            kind,
        )
        panel.set(xlim=(-0.25, 0.25), ylim=(1.72, 2.3))
    for panel in figure.axes:
        panel.set_aspect("equal")
        panel.axis("off")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    for picture in sys.argv[1:]:
        draw(picture)
