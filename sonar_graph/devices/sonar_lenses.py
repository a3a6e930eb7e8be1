"""Azimuths of the beams of lens sonars, as measured by their makers.

An acoustic lens does not space beams evenly: 0.37° a beam in the middle and 0.22° at the edge for a DIDSON. Even
spacing instead errs by up to 1.2°, which is 4 cm at 2 m.
"""

import numpy as np
from scipy.interpolate import make_interp_spline

from sonar_graph.measurements import Floats

_DIDSON_POLYNOMIALS = {
    96: 1.012 * np.array([48.04, 2.6829, -0.0055, 0.0030]),
    48: np.array([24.0976, 1.3351, -0.0036, 0.0015]),
}
"""Beam number from 1 minus 1, as a polynomial of the angle to the right in degrees, constant first."""
DIDSON_BEAMS = tuple(_DIDSON_POLYNOMIALS)
"""Numbers of beams that a DIDSON has."""
_Table = tuple[int, tuple[int, ...], tuple[float, ...]]
_ARIS_TABLES: dict[tuple[int, bool], _Table] = {
    (48, False): (
        3,
        (*range(0, 24, 4), 23),
        (13.5735, 11.7721, 9.7597, 7.5026, 5.0291, 2.3931, 0.3461),
    ),
    (96, False): (
        3,
        (*range(0, 96, 8), 95),
        (
            13.749,
            11.9476,
            9.9352,
            7.6781,
            5.2046,
            2.5686,
            -0.1706,
            -2.9098,
            -5.5458,
            -8.0193,
            -10.2764,
            -12.2888,
            -13.8759,
        ),
    ),
    (64, False): (1, (0, 4, 28, 31), (14.703, 12.951, 1.738, 0.249)),
    (128, False): (1, (0, 8, 56, 63), (14.705, 12.967, 1.846, 0.123)),
    (48, True): (1, (0, 6, 18, 23), (6.742, 5.126, 1.680, 0.154)),
    (96, True): (
        3,
        (*range(0, 48, 8), 47),
        (7.419, 6.220, 4.993, 3.739, 2.471, 1.199, 0.080),
    ),
}
"""By number of beams and whether the telephoto lens is fitted: degree of the spline, beams from the left, and their angles
to the left in degrees; a table that ends in the middle is continued antisymmetrically."""


def even_azimuths(beams: int, half_angle_deg: float) -> Floats:
    """Middles of equal parts of the sector, the first beam right-most, radians to the left, shape (beams,).

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.devices import even_azimuths
    >>> np.degrees(even_azimuths(4, 15.0)).round(2)
    array([-11.25,  -3.75,   3.75,  11.25])
    """
    return np.radians(half_angle_deg * (2 * np.arange(beams) + 1 - beams) / beams)


def didson_azimuths(beams: int) -> Floats:
    """Azimuths of a DIDSON's 48 or 96 beams, the first right-most, radians to the left, shape (beams,).

    The manufacturer's polynomial gives the beam for an angle; here it is inverted. It is monotonic in the sector.

    Source: ``lens_distortion.m`` of the manufacturer's MATLAB tools ("empirical work at the barge").

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.devices import didson_azimuths
    >>> np.degrees(didson_azimuths(96)[[0, -1]]).round(2)
    array([-14.26,  14.25])
    """
    angles_deg = np.linspace(-16.0, 16.0, 32_001)
    # tabulated to a thousandth of a degree, and read the other way
    numbers = np.polynomial.polynomial.polyval(angles_deg, _DIDSON_POLYNOMIALS[beams])
    from_left_deg = np.interp(np.arange(beams), numbers, angles_deg)
    return np.radians(-from_left_deg[::-1])


def aris_azimuths(beams: int, *, telephoto: bool) -> Floats | None:
    """Azimuths of an ARIS' beams, the first right-most, radians to the left, shape (beams,); None where no table is.

    The manufacturer's tables (composite lenses, averages of several) between some of their rows, to 0.005°.

    Source: ``beam-width-metrics`` of SoundMetrics/aris-file-sdk (MIT).

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.devices import aris_azimuths
    >>> np.degrees(aris_azimuths(48, telephoto=False)[[0, -1]]).round(2)
    array([-13.57,  13.57])
    >>> aris_azimuths(50, telephoto=False) is None
    True
    """
    if (beams, telephoto) not in _ARIS_TABLES:
        return None
    degree, *rows = _ARIS_TABLES[beams, telephoto]
    number, angle_deg = np.array(rows)
    if number[-1] < beams - 1:
        # the lens is symmetric about its middle
        number = np.concatenate([number, beams - 1 - number[::-1]])
        angle_deg = np.concatenate([angle_deg, -angle_deg[::-1]])
    from_left_deg = make_interp_spline(number, angle_deg, k=degree)(np.arange(beams))
    return np.radians(from_left_deg[::-1])
