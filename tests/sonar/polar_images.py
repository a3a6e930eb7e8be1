"""Small polar images of designs on a flat floor: a stand-in for a sonar, of exponential speckle without memory."""

from __future__ import annotations

from functools import cache

import numpy as np

from sonar_graph.devices.landmark_designs import LandmarkDesign

RANGES_M = 1.26 + 1.25 / 512 * (np.arange(512) + 0.5)
AZIMUTHS_RAD = np.radians(np.linspace(-14.25, 14.25, 96))
HEIGHT_M = 0.95
FLOOR_DB = 35.0


def level_R_sonar(pitch_rad: float = np.radians(30), roll_rad: float = 0.0) -> np.ndarray:
    """Down by the pitch, then rolled; written out."""
    cp, sp, cr, sr = np.cos(pitch_rad), np.sin(pitch_rad), np.cos(roll_rad), np.sin(roll_rad)
    return np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


def floor_points(rotation: np.ndarray, height_m: float = HEIGHT_M) -> tuple[np.ndarray, np.ndarray]:
    """Level floor point (beams, bins, 2) of every pixel, by a search over elevation, and where there is one."""
    return _searched(tuple(rotation.ravel().tolist()), height_m)


@cache
def _searched(numbers: tuple[float, ...], height_m: float) -> tuple[np.ndarray, np.ndarray]:
    rotation = np.reshape(numbers, (3, 3))
    elevation = np.radians(np.linspace(-9, 9, 721))
    xy = np.full((96, 512, 2), np.nan)
    for beam, azimuth in enumerate(AZIMUTHS_RAD):
        rays = np.column_stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        level = rays @ rotation.T
        distance = np.where(level[:, 2] < -1e-6, -height_m / np.minimum(level[:, 2], -1e-6), np.inf)
        order = np.argsort(distance)
        for axis in range(2):
            xy[beam, :, axis] = np.interp(
                RANGES_M, distance[order], (distance[:, None] * level[:, :2])[order, axis], np.nan, np.nan
            )
    return xy, np.isfinite(xy[..., 0])


def image_db(
    design: LandmarkDesign | None,
    xy_m: tuple[float, float],
    heading_rad: float,
    rotation: np.ndarray,
    rng: np.random.Generator | None,
) -> np.ndarray:
    """Decibels, shape (96, 512); without a generator the mean level itself."""
    xy, lit = floor_points(rotation)
    level = np.where(lit, FLOOR_DB, 0.0)
    if design is not None:
        u, v = xy[..., 0] - xy_m[0], xy[..., 1] - xy_m[1]
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        on_floor = np.nan_to_num(
            design.level_db(np.nan_to_num(cos * u + sin * v, nan=9.0), np.nan_to_num(cos * v - sin * u, nan=9.0))
        )
        level = level + np.where(lit, on_floor, 0.0)
    if rng is not None:
        level = level + 10 * np.log10(rng.exponential(size=level.shape))
    return level.astype(np.float32)
