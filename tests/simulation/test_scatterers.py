from __future__ import annotations

import numpy as np
import pytest

from sonar_graph.simulation.sonar_image.scene import CELL_M, CELLS, scatterers


def correlation(field: np.ndarray) -> np.ndarray:
    """Of a periodic field with itself over the distance along x, in cells."""
    off = field - field.mean()
    power = np.mean(np.abs(np.fft.fft(off, axis=1)) ** 2, axis=0)
    found = np.fft.ifft(power).real
    return found / found[0]


def test_strength_of_the_floor_is_smooth_over_three_centimetres():
    """A Gaussian field whose correlation falls to 1/e at 3 cm; a Gamma of shape 50 is nearly one."""
    strength = scatterers(50.0, False, np.random.default_rng(3)).texture.astype(float) ** 2
    found, distance_m = correlation(strength), np.arange(CELLS) * CELL_M
    near = distance_m < 0.08
    np.testing.assert_allclose(found[near], np.exp(-((distance_m[near] / 0.03) ** 2)), atol=0.05)
    assert strength.mean() == pytest.approx(1, rel=0.02)
    assert strength.var() == pytest.approx(1 / 50, rel=0.1)


def test_a_floor_without_texture_is_even_and_joints_stand_out_of_it_by_six_decibels():
    even, jointed = (scatterers(None, joints, np.random.default_rng(3)).texture for joints in (False, True))
    np.testing.assert_array_equal(even, 1.0)
    on = jointed > 1
    np.testing.assert_allclose(20 * np.log10(jointed[on]), 6.0, atol=1e-5)
    assert on.mean() == pytest.approx(2 * 0.008 / 0.5, rel=0.1)


def test_amplitudes_are_of_a_complex_normal_law():
    points = scatterers(None, False, np.random.default_rng(3)).points
    intensity = points[..., 0].astype(float) ** 2 + points[..., 1].astype(float) ** 2
    assert intensity.mean() == pytest.approx(1, rel=0.01)
    assert np.mean(intensity**2) == pytest.approx(2, rel=0.02)
    assert ((points[..., 2:] >= 0) & (points[..., 2:] < 1)).all()
