"""Scatterers that stay where they are: what makes speckle belong to the world.

The floor is a square grid with one scatterer a cell, at a random place in it, with a complex amplitude drawn from
CN(0, 1). Both repeat every 4 m, beyond what a sonar sees at once, so that a basin of any size needs the same memory.
Many such echoes in one resolution cell give an exponentially distributed intensity; a floor of varying strength
multiplies it, and Gamma(shape) strength makes it K-distributed.

Source: Abraham and Lyons, "Novel physical interpretations of K-distributed reverberation", IEEE JOE 27(4), 2002.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Floats32 = NDArray[np.float32]

CELL_M = 0.0032
CELLS = 1250
TEXTURE_M = 0.03
"""Correlation length of the floor's strength."""
JOINT_SPACING_M, JOINT_WIDTH_M, JOINT_DB = 0.5, 0.008, 6.0


@dataclass(frozen=True, eq=False)
class Scatterers:
    """One period of the floor: cell (row i, column j) covers y from 3.2 mm · i and x from 3.2 mm · j on."""

    points: Floats32
    """Real and imaginary part of the amplitude, then x and y within the cell as shares of it; (1250, 1250, 4)."""
    texture: Floats32
    """Amplitude of the bare floor, mean square 1 but for joints, shape (1250, 1250)."""


def scatterers(texture_shape: float | None, joints: bool, rng: np.random.Generator) -> Scatterers:
    """Draw a floor.

    Parameters
    ----------
    texture_shape
        Shape of the Gamma distribution of its strength; None: even.
    joints
        Whether there are bright lines every half metre.
    rng
        Source of everything random.
    """
    points_rng, texture_rng = rng.spawn(2)
    points = np.empty((CELLS, CELLS, 4), np.float32)
    points[..., :2] = points_rng.standard_normal((CELLS, CELLS, 2), np.float32) * np.float32(np.sqrt(0.5))
    points[..., 2:] = points_rng.random((CELLS, CELLS, 2), np.float32)
    strength = np.ones((CELLS, CELLS)) if texture_shape is None else _gamma_field(texture_shape, texture_rng)
    if joints:
        strength = np.where(_on_joint(), strength * 10 ** (JOINT_DB / 10), strength)
    return Scatterers(points, np.sqrt(strength).astype(np.float32))


def _gamma_field(shape: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Strength with mean 1, Gamma-distributed at each point, smooth over `TEXTURE_M` and periodic."""
    frequency = np.fft.fftfreq(CELLS, CELL_M), np.fft.rfftfreq(CELLS, CELL_M)
    smoothing = np.exp(-((np.pi * TEXTURE_M) ** 2) * np.add.outer(frequency[0] ** 2, frequency[1] ** 2) / 2)
    field = np.fft.irfft2(smoothing * np.fft.rfft2(rng.standard_normal((CELLS, CELLS))), (CELLS, CELLS))
    quantiles = np.linspace(-6, 6, 2001)
    levels = stats.gamma.ppf(stats.norm.cdf(quantiles), shape, scale=1 / shape)
    return np.interp(field / field.std(), quantiles, levels)


def _on_joint() -> NDArray[np.bool_]:
    """Cells on the grid of joints."""
    middle_m = (np.arange(CELLS) + 0.5) * CELL_M
    on_line = (middle_m + JOINT_WIDTH_M / 2) % JOINT_SPACING_M < JOINT_WIDTH_M
    return np.asarray(on_line[:, None] | on_line[None, :])
