"""Floor as scatterers that stay in the world, the objects on it, and the cells that a sonar sees.

The floor is a square grid with one scatterer a cell, at a random place in it, with a complex amplitude from CN(0, 1).
Both repeat every 4 m, beyond what a sonar sees at once, so that memory does not grow with the basin. Many such echoes
in one resolution cell give an exponentially distributed intensity; Gamma(shape) strength of the floor makes it
K-distributed. An object is a patch of the grid: how strongly each cell scatters and how high it is.

Source: Abraham and Lyons, "Novel physical interpretations of K-distributed reverberation", IEEE JOE 27(4), 2002.
docs/theory/sonar_image.md
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from sonar_graph.devices import LandmarkDesign
from sonar_graph.measurements import Floats, Ints

Floats32 = NDArray[np.float32]
CELL_M = 0.0032
CELLS = 1250
MEANDER_RAD = 0.8
MEANDER_LENGTHS = 3.0
"""Wandering of ripples' crests: standard deviation of the phase, and over how many ripples it is correlated."""
JOINT_SPACING_M = 0.5
JOINT_WIDTH_M = 0.008
JOINT_DB = 6.0


class Scatterers(NamedTuple):
    """One period of the floor: cell (row i, column j) covers y from 3.2 mm · i and x from 3.2 mm · j on."""

    points: Floats32
    """Real and imaginary part of the amplitude, then x and y within the cell as shares of it; (1250, 1250, 4)."""
    texture: Floats32
    """Amplitude of the bare floor, mean square 1 but for joints, shape (1250, 1250)."""
    relief_m: Floats32
    """Height over the even floor, at most 0, shape (1250, 1250); without a row: even."""


def smooth_field(length_m: float, rng: np.random.Generator) -> Floats:
    """Periodic Gaussian random field of unit variance with the correlation ``exp(-(d / length)²)``, (1250, 1250)."""
    # noise filtered in the frequency domain is periodic, as the floor is
    frequency = np.fft.fftfreq(CELLS, CELL_M), np.fft.rfftfreq(CELLS, CELL_M)
    smoothing = np.exp(
        -((np.pi * length_m) ** 2)
        * np.add.outer(frequency[0] ** 2, frequency[1] ** 2)
        / 2
    )
    field = np.fft.irfft2(
        smoothing * np.fft.rfft2(rng.standard_normal((CELLS, CELLS))), (CELLS, CELLS)
    )
    return field / field.std()


def ripples(length_m: float, height_m: float, rng: np.random.Generator) -> Floats:
    """Heights of sand ripples, from ``-height_m`` to 0, shape (1250, 1250).

    Sinusoidal, with crests that wander. They run in a random direction, with as many waves along x and y as fit the
    period.
    """
    heading = rng.uniform(-np.pi, np.pi)
    period_m = CELLS * CELL_M
    # whole numbers of waves in the period, or the crests would break at its border
    waves_x, waves_y = np.rint(
        period_m / length_m * np.array([np.cos(heading), np.sin(heading)])
    )
    along = 2 * np.pi * np.arange(CELLS) / CELLS
    phase = (
        waves_y * along[:, None]
        + waves_x * along
        + MEANDER_RAD * smooth_field(MEANDER_LENGTHS * length_m, rng)
    )
    return 0.5 * height_m * (np.cos(phase) - 1)


def scatterers(
    texture_shape: float | None,
    joints: bool,
    rng: np.random.Generator,
    texture_length_m: float = 0.03,
    ripple_length_m: float = 0.12,
    ripple_height_m: float = 0.0,
) -> Scatterers:
    """Draw a floor; its joints are bright lines every half metre.

    ``texture_shape`` is the shape of the Gamma distribution of its strength (mean 1, smooth over the texture's length
    and periodic); None: even.
    """
    # texture and ripples do not change the scatterers
    points_rng, texture_rng, ripple_rng = rng.spawn(3)
    points = np.empty((CELLS, CELLS, 4), np.float32)
    points[..., :2] = points_rng.standard_normal(
        (CELLS, CELLS, 2), np.float32
    ) * np.float32(np.sqrt(0.5))
    points[..., 2:] = points_rng.random((CELLS, CELLS, 2), np.float32)
    strength = np.ones((CELLS, CELLS))
    if texture_shape is not None:
        # a Gaussian field through the quantiles of the Gamma distribution
        quantiles = np.linspace(-6, 6, 2001)
        levels = stats.gamma.ppf(
            stats.norm.cdf(quantiles), texture_shape, scale=1 / texture_shape
        )
        strength = np.interp(
            smooth_field(texture_length_m, texture_rng), quantiles, levels
        )
    if joints:
        middle_m = (np.arange(CELLS) + 0.5) * CELL_M
        on_line = (middle_m + JOINT_WIDTH_M / 2) % JOINT_SPACING_M < JOINT_WIDTH_M
        on_joint = on_line[:, None] | on_line[None, :]
        strength = np.where(on_joint, strength * 10 ** (JOINT_DB / 10), strength)
    relief_m = np.empty((0, 0))
    if ripple_height_m > 0:
        relief_m = ripples(ripple_length_m, ripple_height_m, ripple_rng)
    texture = np.sqrt(strength).astype(np.float32)
    return Scatterers(points, texture, relief_m.astype(np.float32))


Shape = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Level over the floor in dB (NaN: floor) and height over it in metres, at points of the object's own frame."""
SLOPE_M = 0.4
"""Distance over which the floor rises or falls to the bottom of a landmark."""


@dataclass(frozen=True, eq=False)
class SeabedObject:
    """Landmark, stone or patch on the floor, as a patch of the scatterers' grid."""

    id: int
    """Identity of a landmark; negative for other objects."""
    kind: str
    position_m: Floats
    """World position of the centre of its face, or of its foot, shape (3,)."""
    yaw_rad: float
    extent_m: float
    """Radius of the disc that its material covers."""
    radius_m: float
    """Radius of a circle around its patch, in which the floor may slope."""
    first_row: int
    """First row of its patch on the grid."""
    first_column: int
    amplitude: Floats32
    """Over the even floor, shape (rows, columns); NaN: floor."""
    relief_m: Floats32
    """Height over the even floor, same shape."""


def place(
    id_: int,
    kind: str,
    shape: Shape,
    extent_m: float,
    position_m: Floats,
    yaw_rad: float,
    margin_m: float = 0.0,
) -> SeabedObject:
    """Put a shape on the grid, at a world position and turned by a yaw (positive to the left).

    Extent is the radius of its material, margin the width of the slope of the floor around it.
    """
    radius_m = extent_m + margin_m
    first = np.floor((position_m[:2] - radius_m) / CELL_M).astype(int) - 1
    # a cell more on each side, for the slopes at the border
    cells = int(np.ceil(2 * radius_m / CELL_M)) + 3
    x = (first[0] + np.arange(cells) + 0.5) * CELL_M - position_m[0]
    y = (first[1] + np.arange(cells) + 0.5) * CELL_M - position_m[1]
    world_x, world_y = np.meshgrid(x, y)
    cos = np.cos(yaw_rad)
    sin = np.sin(yaw_rad)
    # from the world into the axes of the object
    level_db, height_m = shape(
        cos * world_x + sin * world_y, cos * world_y - sin * world_x
    )
    amplitude = (10 ** (level_db / 20)).astype(np.float32)
    position_m = np.asarray(position_m, float)
    relief = height_m.astype(np.float32)
    row = int(first[1])
    column = int(first[0])
    return SeabedObject(
        id_,
        kind,
        position_m,
        yaw_rad,
        extent_m,
        radius_m,
        row,
        column,
        amplitude,
        relief,
    )


def place_landmark(
    design: LandmarkDesign,
    position_m: Floats,
    yaw_rad: float,
    floor_z_m: float,
    foam_height_m: float | None = None,
) -> SeabedObject:
    """Put a landmark on the floor, with its face at its true position (m, world) and a yaw in rad.

    The floor rises or falls around it by a smooth cosine as far as that needs. Parts darker than the floor lie lower
    than the others by ``foam_height_m``, or where that is None by the relief of the design, at most on the floor.
    """
    relief_m = design.standing_m if foam_height_m is None else foam_height_m
    bottom_m = float(position_m[2]) - design.height_m - floor_z_m
    pixels = len(design.mask)
    middle_m = ((np.arange(pixels) + 0.5) / pixels - 0.5) * design.size_m
    away_m = np.hypot(middle_m[:, None], middle_m[None, :]) + design.size_m / pixels
    # radius of all of its material
    plate_m = float(away_m[~np.isnan(design.mask)].max(initial=0.0))

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        level_db = design.level_db(x_m, y_m)
        # the floor meets the bottom of the landmark without a step, which would shine
        away = np.clip((np.hypot(x_m, y_m) - plate_m) / SLOPE_M, 0, 1)
        ground_m = bottom_m * 0.5 * (1 + np.cos(np.pi * away))
        height_m = np.where(
            level_db > 0, design.height_m, max(design.height_m - relief_m, 0.0)
        )
        return level_db, ground_m + np.where(np.isnan(level_db), 0.0, height_m)

    return place(design.id, design.name, shape, plate_m, position_m, yaw_rad, SLOPE_M)


def stone(radius_m: float, height_m: float, level_db: float) -> Shape:
    """Half an ellipsoid."""

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        from_top = (x_m**2 + y_m**2) / radius_m**2
        height = height_m * np.sqrt(np.clip(1 - from_top, 0, None))
        return np.where(from_top < 1, level_db, np.nan), height

    return shape


def material(
    inside: NDArray[np.bool_], level_db: Floats | float, height_m: Floats | float
) -> tuple[Floats, Floats]:
    """Level and height of what lies inside of an outline; floor around it."""
    return np.where(inside, level_db, np.nan), np.where(inside, height_m, 0.0)


def ragged_outline(
    radius_m: float,
    limits: tuple[float, float],
    harmonics: int,
    sigma: float,
    rng: np.random.Generator,
) -> Callable[[Floats, Floats], Floats]:
    """Draw an outline: its radius at points, which varies irregularly with direction, within limits over the mean."""
    # higher harmonics are weaker: a rough outline without spikes
    order = np.arange(1, harmonics + 1)
    waves = rng.normal(0, sigma / np.sqrt(order), (2, harmonics))

    def outline(x_m: Floats, y_m: Floats) -> Floats:
        angle = np.arctan2(y_m, x_m)[..., None] * order
        share = 1 + np.cos(angle) @ waves[0] + np.sin(angle) @ waves[1]
        return radius_m * np.clip(share, *limits)

    return outline


def block(length_m: float, width_m: float, height_m: float, level_db: float) -> Shape:
    """A box; its upright sides scatter as steeply as the grid can show."""

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        inside = (np.abs(x_m) < length_m / 2) & (np.abs(y_m) < width_m / 2)
        return material(inside, level_db, height_m)

    return shape


def ragged_patch(radius_m: float, level_db: float, rng: np.random.Generator) -> Shape:
    """A flat rough patch whose radius varies irregularly with direction, from about half to one and a half."""
    outline = ragged_outline(radius_m, (0.3, 1.7), 5, 0.28, rng)

    def shape(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        return material(np.hypot(x_m, y_m) < outline(x_m, y_m), level_db, 0.005)

    return shape


def scattered_objects(
    spots_m: Floats, stones: int, rng: np.random.Generator
) -> list[SeabedObject]:
    """Stones at the first of some spots (n, 3), ragged patches at the others, with identities -1, -2, ..."""
    objects = []
    for number, spot in enumerate(spots_m):
        if number < stones:
            radius_m = rng.uniform(0.08, 0.16)
            kind = "stone"
            shape = stone(radius_m, rng.uniform(0.02, 0.06), rng.uniform(4, 10))
        else:
            mean_radius_m = rng.uniform(0.10, 0.16)
            kind = "patch"
            shape = ragged_patch(mean_radius_m, rng.uniform(9, 13), rng)
            radius_m = 1.7 * mean_radius_m
        objects.append(
            place(-1 - number, kind, shape, radius_m, spot, rng.uniform(-np.pi, np.pi))
        )
    return objects


def within(
    objects: Sequence[SeabedObject], centre_m: Floats, reach_m: float
) -> list[SeabedObject]:
    """Objects that a circle on the floor touches."""
    return [
        o
        for o in objects
        if np.hypot(*(o.position_m[:2] - centre_m[:2])) < reach_m + o.radius_m
    ]


class Sector(NamedTuple):
    """Sector of the floor around the point below the sonar."""

    heading: Floats
    """Horizontal unit vector of the sonar's axis, shape (2,)."""
    half_bearing_rad: float
    nearest_m: float
    """Horizontal distances."""
    farthest_m: float


class Cells(NamedTuple):
    """Columns of the grid that are in view, row by row."""

    first_row: int
    spans: Ints
    """First and last column (not included) of each row, shape (rows, 2)."""


def lit_sector(
    world_R_sonar: Rotation,
    height_m: float,
    ranges_m: tuple[float, float],
    half_azimuth_rad: float,
    half_lift_rad: float,
) -> Sector | None:
    """Floor within the ranges and the angles either side of the axis; None without any."""
    axis = world_R_sonar.apply([1.0, 0.0, 0.0])
    azimuth, lift = np.meshgrid(
        np.linspace(-half_azimuth_rad, half_azimuth_rad, 5),
        np.linspace(-half_lift_rad, half_lift_rad, 5),
    )
    rays = world_R_sonar.apply(
        np.stack(
            [
                np.cos(lift) * np.cos(azimuth),
                np.cos(lift) * np.sin(azimuth),
                np.sin(lift),
            ],
            -1,
        ).reshape(-1, 3)
    )
    # how far along the floor each ray comes while it drops by one
    run = np.hypot(rays[:, 0], rays[:, 1])
    nearest, farthest = (np.sqrt(max(r**2 - height_m**2, 0.0)) for r in ranges_m)
    drop = -rays[:, 2] / run
    # the steepest ray limits the near side, the flattest one the far side
    nearest = max(nearest, height_m / max(drop.max(), 1e-6))
    if drop.min() > 0:
        farthest = min(farthest, height_m / drop.min())
    if nearest >= farthest or height_m <= 0:
        return None
    heading = axis[:2] / np.hypot(*axis[:2])
    # relative to the axis: tilt and roll widen the sector on the floor
    bearings = np.arctan2(
        heading[0] * rays[:, 1] - heading[1] * rays[:, 0], rays[:, :2] @ heading
    )
    return Sector(
        heading, float(np.abs(bearings).max()), float(nearest), float(farthest)
    )


def cells_of(sector: Sector, foot_m: Floats) -> Cells:
    """Cells of a quadrilateral that contains the sector; ``foot_m`` is the point below the sonar."""
    bearing = sector.half_bearing_rad * np.array([1, 1, 0, -1, -1])
    # two chords from outside touch the arc of the far side
    far_m = sector.farthest_m / np.cos(sector.half_bearing_rad / 2)
    reach_m = np.array([sector.nearest_m, far_m, far_m, far_m, sector.nearest_m])
    ahead = reach_m * np.cos(bearing)
    aside = reach_m * np.sin(bearing)
    x = (foot_m[0] + sector.heading[0] * ahead - sector.heading[1] * aside) / CELL_M
    y = (foot_m[1] + sector.heading[1] * ahead + sector.heading[0] * aside) / CELL_M
    first_row = int(np.floor(y.min()))
    end_row = int(np.ceil(y.max()))
    middle = np.arange(first_row, end_row) + 0.5
    left = np.full(len(middle), np.inf)
    right = np.full(len(middle), -np.inf)
    for x1, y1, x2, y2 in zip(x, y, np.roll(x, -1), np.roll(y, -1), strict=True):
        if abs(y2 - y1) < 1e-9:
            continue
        # rows whose middle this side of the polygon crosses
        crosses = (middle >= min(y1, y2)) & (middle <= max(y1, y2))
        at = x1 + (middle[crosses] - y1) * (x2 - x1) / (y2 - y1)
        left[crosses] = np.minimum(left[crosses], at)
        right[crosses] = np.maximum(right[crosses], at)
    # rows that no side crosses hold no cell
    empty = left > right
    left[empty] = x[0]
    right[empty] = x[0]
    return Cells(
        first_row, np.column_stack([np.floor(left), np.ceil(right)]).astype(np.int64)
    )
