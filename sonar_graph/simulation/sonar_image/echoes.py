"""Coherent sum of all echoes from the floor and the objects on it.

A scatterer with complex amplitude a, at distance r in direction (azimuth, elevation e), seen under the angle i from its
facet's normal N = (-dz/dx, -dz/dy, 1), adds to the column of its azimuth at range bin b::

    a gain (u · N) / sqrt(|N|) pattern(e) pulse(r_b - r) exp(4 pi j r / wavelength)

with u the unit vector to the sonar: the intensity of Lambert's rule, cos² i times the facet's area |N|. The module
`frames` applies the beams' pattern in azimuth and the factors of range alone to the sum. docs/theory/sonar_image.md
"""

from typing import NamedTuple

import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.numerics import compiled, inlined
from sonar_graph.simulation.sonar_image.scene import Floats32, Scatterers

TAPS = 6
"""Bins that one echo reaches."""
PULSE_STEPS = 32
PHASE_STEPS = 1024
ELEVATION_STEPS = 512
STEEP = 0.25
"""Facets with ``1 - 1/|N|`` above it see the floor in front of them."""


class Tables(NamedTuple):
    """Constants of a sonar, and functions as tables."""

    cell_m: float
    """Of the scatterers' grid."""
    columns_per_rad: float
    """Resolution of the columns of azimuth."""
    columns: int
    """Centred on azimuth 0."""
    range_start_m: float
    """Edge of the first bin."""
    bin_m: float
    bins_per_m: float
    bins: int
    waves_per_m: float
    """Of the way there and back: 2 / wavelength."""
    phasor: Floats32
    """Cosine and sine, shape (PHASE_STEPS, 2)."""
    pulse: Floats32
    """Amplitude at TAPS bins for positions within a bin, shape (PULSE_STEPS, TAPS)."""
    elevation: Floats32
    """Two-way amplitude over the sine of elevation from -0.5 to 0.5, shape (ELEVATION_STEPS,)."""


class SonarPlacement(NamedTuple):
    """Pose of the sonar, and the cells that it can see."""

    position_m: Floats
    """In the world, shape (3,)."""
    sonar_R_world: Floats
    """Shape (3, 3)."""
    heading: Floats
    """Horizontal unit vector of its axis, shape (2,)."""
    floor_z_m: float
    first_row: int
    spans: Ints
    """First and last column (not included) of each row, shape (rows, 2)."""
    shift: Ints
    """Added to row and column of the amplitudes: (0, 0) where speckle belongs to the world."""


class Surface(NamedTuple):
    """Objects in view, cell by cell; arrays without a row where there is only floor."""

    first_column: int
    amplitude: Floats32
    """NaN: floor."""
    relief_m: Floats32


class Horizon(NamedTuple):
    """Highest blocked line of sight over bearing and horizontal distance."""

    tangent: Floats32
    """Rise over run of the highest blocked ray, shape (bearings, distances); without a row: no shadows."""
    half_tangent: float
    """Tangents of bearings from minus to plus this one."""
    distance_m: float
    """Size of a step."""


@inlined
def sight(
    view: SonarPlacement, horizon: Horizon, x: float, y: float
) -> tuple[float, float, int]:
    """Distance ahead of the sonar and from it along the floor, and number of the bearing, of a place."""
    ahead = view.heading[0] * x + view.heading[1] * y
    aside = view.heading[0] * y - view.heading[1] * x
    share = (aside / ahead / horizon.half_tangent + 1.0) * 0.5
    return ahead, np.sqrt(x * x + y * y), int(share * len(horizon.tangent))


@compiled
def block_rays(
    view: SonarPlacement,
    surface: Surface,
    horizon: Horizon,
    raised_m: float,
    cell_m: float,
) -> None:
    """Fill the horizon: everything behind a raised cell is blocked below the ray over its top."""
    bearings, distances = horizon.tangent.shape
    for row in range(surface.relief_m.shape[0]):
        y = (view.first_row + row + 0.5) * cell_m - view.position_m[1]
        for column in range(surface.relief_m.shape[1]):
            relief = surface.relief_m[row, column]
            # the even floor shades nothing
            if relief < raised_m:
                continue
            x = (surface.first_column + column + 0.5) * cell_m - view.position_m[0]
            ahead, run, bearing = sight(view, horizon, x, y)
            distance = int(run / horizon.distance_m)
            if ahead > 0 and 0 <= bearing < bearings and distance < distances:
                rise = (view.floor_z_m + relief - view.position_m[2]) / run
                if rise > horizon.tangent[bearing, distance]:
                    horizon.tangent[bearing, distance] = rise
    for bearing in range(bearings):
        for distance in range(1, distances):
            # what blocks a ray blocks it for all that lies behind
            before = horizon.tangent[bearing, distance - 1]
            if before > horizon.tangent[bearing, distance]:
                horizon.tangent[bearing, distance] = before


@compiled
def add_echo(
    tables: Tables,
    echoes: Floats32,
    column: int,
    range_m: float,
    amplitude: float,
    re: float,
    im: float,
) -> None:
    """One echo with its phase, spread over the bins that the pulse reaches."""
    waves = range_m * tables.waves_per_m
    # only the fraction of a wave turns the phase
    step = int((waves - np.floor(waves)) * PHASE_STEPS)
    cos = tables.phasor[step, 0] * amplitude
    sin = tables.phasor[step, 1] * amplitude
    real = re * cos - im * sin
    imaginary = re * sin + im * cos
    # first of the bins that the pulse reaches, its middle between the third and fourth
    place = (range_m - tables.range_start_m) * tables.bins_per_m - 0.5 * TAPS + 0.5
    first = int(np.floor(place))
    within = int((place - first) * PULSE_STEPS)
    if first < -TAPS or first >= tables.bins:
        return
    for tap in range(TAPS):
        at = first + tap + TAPS
        echoes[column, at, 0] += real * tables.pulse[within, tap]
        echoes[column, at, 1] += imaginary * tables.pulse[within, tap]


@compiled
def is_blocked(
    view: SonarPlacement, horizon: Horizon, x: float, y: float, z: float
) -> bool:
    """True where something nearer hides a point from the sonar."""
    bearings, distances = horizon.tangent.shape
    _, run, bearing = sight(view, horizon, x, y)
    # one step nearer: a cell must not shade itself
    distance = int(run / horizon.distance_m) - 1
    if not 0 <= bearing < bearings or distance < 0:
        return False
    return z < run * horizon.tangent[bearing, min(distance, distances - 1)]


@compiled
def slopes(
    relief_m: Floats32, row: int, column: int, cell_m: float
) -> tuple[float, float]:
    """Rise per metre along x and y; 0 at the border of the view."""
    rows, columns = relief_m.shape
    if not (0 < row < rows - 1 and 0 < column < columns - 1):
        return 0.0, 0.0
    along_x = relief_m[row, column + 1] - relief_m[row, column - 1]
    along_y = relief_m[row + 1, column] - relief_m[row - 1, column]
    return along_x / (2 * cell_m), along_y / (2 * cell_m)


@compiled
def table_places(
    R: Floats, x: float, y: float, z: float, per_range: float, tables: Tables
) -> tuple[int, int]:
    """Column of azimuth and step of elevation of a point at distance 1 / per_range, (-1, -1) outside of the tables."""
    forward = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
    left = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
    up = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    if forward <= 0:
        return -1, -1
    t = left / forward
    t2 = t * t
    # arctangent by its series: most points lie near the axis
    azimuth = (
        t * (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9))))
        if t2 < 0.1
        else np.arctan(t)
    )
    column = int(np.floor(azimuth * tables.columns_per_rad + 0.5 * tables.columns))
    # the table is over the sine, which needs no arcsine here
    lift = int((up * per_range + 0.5) * ELEVATION_STEPS)
    if not 0 <= column < tables.columns or not 0 <= lift < ELEVATION_STEPS:
        return -1, -1
    return column, lift


@compiled
def sum_echoes(
    view: SonarPlacement,
    floor: Scatterers,
    surface: Surface,
    horizon: Horizon,
    tables: Tables,
    floor_reflection: float,
    echoes: Floats32,
) -> None:
    """Add every echo in view to ``echoes``, shape (columns, TAPS + bins + TAPS, 2), real and imaginary part."""
    cell_m = tables.cell_m
    points = floor.points
    texture = floor.texture
    cells = points.shape[0]
    has_objects = surface.amplitude.shape[0] > 0
    has_shadows = horizon.tangent.shape[0] > 0
    # a pulse reaches into the window from as far as its taps
    least_m2 = (tables.range_start_m - TAPS * tables.bin_m) ** 2
    most_m2 = (tables.range_start_m + (tables.bins + TAPS) * tables.bin_m) ** 2
    height_m = view.position_m[2] - view.floor_z_m
    for row in range(view.spans.shape[0]):
        i = (view.first_row + row) % cells
        point_row = (i + view.shift[0]) % cells
        y_row = (view.first_row + row) * cell_m - view.position_m[1]
        j = (view.spans[row, 0] - 1) % cells
        point_column = (j + view.shift[1]) % cells
        for column in range(view.spans[row, 0], view.spans[row, 1]):
            # a remainder costs as much as all else here
            j = j + 1 if j + 1 < cells else 0
            point_column = point_column + 1 if point_column + 1 < cells else 0
            point = points[point_row, point_column]
            x = column * cell_m - view.position_m[0] + cell_m * point[2]
            y = y_row + cell_m * point[3]
            gain = texture[i, j]
            relief = 0.0
            slope_x = 0.0
            slope_y = 0.0
            area = 1.0
            if has_objects:
                at = column - surface.first_column
                relief = surface.relief_m[row, at]
                slope_x, slope_y = slopes(surface.relief_m, row, at, cell_m)
                if not np.isnan(surface.amplitude[row, at]):
                    gain = surface.amplitude[row, at]
                area = np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
            z = relief - height_m
            range_m2 = x * x + y * y + z * z
            # u . N times the range; not positive: the facet faces away
            toward = x * slope_x + y * slope_y - z
            if range_m2 < least_m2 or range_m2 > most_m2 or toward <= 0:
                continue
            if has_shadows and is_blocked(view, horizon, x, y, z):
                continue
            range_m = np.sqrt(range_m2)
            beam_column, lift = table_places(
                view.sonar_R_world, x, y, z, 1 / range_m, tables
            )
            if beam_column < 0:
                continue
            amplitude = (
                gain * toward / (range_m * np.sqrt(area)) * tables.elevation[lift]
            )
            add_echo(
                tables, echoes, beam_column, range_m, amplitude, point[0], point[1]
            )
            # of upright sides the floor in front of them is a mirror
            steepness = 1 - 1 / area
            if steepness > STEEP and relief > 0 and floor_reflection > 0:
                # distance of the image of the facet below the floor
                image_m = np.sqrt(x * x + y * y + (height_m + relief) ** 2)
                # there by the floor and back direct, and the other way round
                ghost = 2 * floor_reflection * steepness * amplitude
                add_echo(
                    tables,
                    echoes,
                    beam_column,
                    0.5 * (range_m + image_m),
                    ghost,
                    point[0],
                    point[1],
                )


@compiled
def through_beams(beam_matrix: Floats32, bands: Ints, echoes: Floats32) -> Floats32:
    """Matrix product ``beam_matrix @ echoes``, on one core and always in the same order.

    Shapes (beams, columns), (columns, samples), gives (beams, samples). Of each beam only the columns of its band count,
    from the first to the last (not included), whose number is divisible by 4. A BLAS would use all cores for a product
    this small, and its bytes would depend on their number.
    """
    samples = echoes.shape[1]
    seen = np.zeros((len(beam_matrix), samples), np.float32)
    for beam in range(len(beam_matrix)):
        for column in range(bands[beam, 0], bands[beam, 1], 4):
            a = beam_matrix[beam, column]
            b = beam_matrix[beam, column + 1]
            c = beam_matrix[beam, column + 2]
            d = beam_matrix[beam, column + 3]
            for k in range(samples):
                seen[beam, k] += (a * echoes[column, k] + b * echoes[column + 1, k]) + (
                    c * echoes[column + 2, k] + d * echoes[column + 3, k]
                )
    return seen


NONE = np.empty((0, 0), np.float32)
NO_SURFACE = Surface(0, NONE, NONE)
"""Without objects."""
NO_HORIZON = Horizon(NONE, 1.0, 1.0)
"""Without shadows."""
