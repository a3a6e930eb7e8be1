import numpy as np
import pytest

from sonar_graph.devices import aris_azimuths, didson_azimuths


@pytest.mark.parametrize(
    ("beams", "telephoto", "published_deg"),
    [
        (48, False, {1: -13.1419, 14: -6.2897, 30: 4.3823, 47: 13.5735}),
        (96, False, {3: -13.0975, 28: -6.4652, 61: 4.5722, 94: 13.6586}),
        (64, False, {2: -13.827, 15: -7.812, 40: 4.074, 62: 14.265}),
        (128, False, {5: -13.619, 30: -7.870, 70: 1.6, 126: 14.488}),
        (48, True, {3: -5.934, 12: -3.403, 20: -1.069, 40: 4.839}),
        (96, True, {4: -6.824, 36: -1.836, 60: 1.995, 90: 6.674}),
    ],
)
def test_aris_beams_are_those_of_the_published_tables(
    beams: int, telephoto: bool, published_deg: dict
) -> None:
    """Rows of the manufacturer's that the package does not hold: beam from the left, degrees to the right."""
    azimuths_rad = aris_azimuths(beams, telephoto=telephoto)
    assert azimuths_rad is not None
    from_left_deg = -np.degrees(azimuths_rad)[::-1]
    assert {beam: from_left_deg[beam] for beam in published_deg} == pytest.approx(
        published_deg, abs=0.005
    )
    assert aris_azimuths(128, telephoto=True) is None


@pytest.mark.parametrize(
    ("beams", "polynomial"),
    [
        (
            96,
            lambda x: 1.012 * (0.0030 * x**3 - 0.0055 * x**2 + 2.6829 * x + 48.04) + 1,
        ),
        (48, lambda x: 0.0015 * x**3 - 0.0036 * x**2 + 1.3351 * x + 24.0976 + 1),
    ],
)
def test_didson_beams_solve_the_published_polynomial(beams, polynomial) -> None:
    """The polynomial counts from the left from 1, with angles to the right in degrees."""
    to_right_deg = -np.degrees(didson_azimuths(beams))
    np.testing.assert_allclose(
        polynomial(to_right_deg), beams - np.arange(beams), atol=1e-4
    )
