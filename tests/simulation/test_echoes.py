"""How strongly a sloping face echoes, summed by hand over its cells."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.simulation.sonar_image.frames import FrameSimulator
from sonar_graph.simulation.sonar_image.imaging_sonar import ImageOptions
from sonar_graph.simulation.sonar_image.scene import place

HEIGHT_M, MIDDLE_M, FRAMES = 0.95, 1.6, 16
LENGTH_M, WIDTH_M = 0.06, 0.2
TILT = Rotation.from_euler("ZYX", [0, 30, 0], degrees=True)


def ramp(rise: float):
    """Rises away from the sonar; only its middle scatters to speak of, by 60 dB over the floor."""

    def shape(x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        is_bright = (np.abs(x_m) < LENGTH_M / 2) & (np.abs(y_m) < WIDTH_M / 2)
        rises = (np.abs(x_m) < 0.08) & (np.abs(y_m) < 0.15)
        return np.where(is_bright, 60.0, np.nan), np.where(rises, rise * (x_m + 0.08), 0.0)

    return place(-1, "ramp", shape, 0.2, np.array([MIDDLE_M, 0.0, 0.0]), 0.0)


def energy(rise: float, floor_reflection: float | None = None) -> float:
    """Mean sum over all samples; scatterers are drawn anew for each frame."""
    options = ImageOptions(
        cross_talk_db=None, tvg_error_db=0.0, texture_shape=None, joints=False, noise_db=None, shadows=False,
        absorption_db_m=0.0, speckle="frame", multipath=floor_reflection is not None,
        floor_reflection=floor_reflection or 0.0,
    )  # fmt: skip
    made, place_m = FrameSimulator(options, [ramp(rise)]), np.array([0.0, 0.0, HEIGHT_M])
    return float(np.mean([np.sum(10 ** (made.level_db(place_m, TILT, n).astype(float) / 10)) for n in range(FRAMES)]))


def by_hand(rise: float, *, is_ghost: bool = False) -> float:
    """Lambert's cos^2 i times the facet's area, elevation pattern, and range: spreading r^-4 and gain r^3."""
    x = MIDDLE_M + np.linspace(-LENGTH_M / 2, LENGTH_M / 2, 41)
    y = np.linspace(-WIDTH_M / 2, WIDTH_M / 2, 41)[:, None]
    top = rise * (x - MIDDLE_M + 0.08)
    to_face = np.stack(np.broadcast_arrays(x, y, top - HEIGHT_M), axis=-1)
    r = np.linalg.norm(to_face, axis=-1)
    area = np.hypot(1, rise)
    normal = np.array([-rise, 0.0, 1.0]) / area
    cos = -(to_face @ normal) / r
    lift = np.arcsin(TILT.inv().apply(to_face.reshape(-1, 3))[:, 2].reshape(r.shape) / r)
    pattern = np.sinc(0.886 * np.sin(lift) / np.sin(np.radians(14))) ** 4
    if is_ghost:
        r = 0.5 * (r + np.sqrt(x**2 + y**2 + (HEIGHT_M + top) ** 2))
    return float(np.mean(cos**2 * area * pattern / r))


@pytest.mark.parametrize("rise", [1.0, 1.5])
def test_a_sloping_face_echoes_by_lamberts_rule_times_its_area(rise: float):
    ratio_db = 10 * np.log10(energy(rise) / energy(0.0))
    assert ratio_db == pytest.approx(10 * np.log10(by_hand(rise) / by_hand(0.0)), abs=0.4)


def test_a_steep_face_echoes_by_way_of_the_floor_there_and_back():
    """Out by the floor and back straight, and the other way round, are equally long: twice the amplitude."""
    rise, reflection = 1.5, 0.8
    steepness = 1 - 1 / np.hypot(1, rise)
    share = energy(rise, reflection) / energy(rise) - 1
    expected = (2 * reflection * steepness) ** 2 * by_hand(rise, is_ghost=True) / by_hand(rise)
    assert share == pytest.approx(expected, rel=0.2)
