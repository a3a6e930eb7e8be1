"""Frames of an imaging sonar over a floor with objects, and the truth about each along a path.

One frame is the coherent sum of echoes from scatterers that stay in the world, seen through the beams' pattern, with
receiver noise, time-varied gain and a logarithmic 8-bit scale::

    Y[b, r]  = sum over scatterers (`echoes`), through the two-way pattern of beam b and cross-talk, times
               (2 m / r)² 10^(-2 alpha (r - 2 m) / 20)
    dB[b, r] = 10 log10 |Y + noise|² + 30 log10 (r / 2 m) + 2 alpha (r - 2 m) + error of the gain
    sample   = round(255 dB / 80), from 0 to 255

docs/theory/sonar_image.md
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Mounting
from sonar_graph.images import SonarFrames
from sonar_graph.measurements import NS_PER_S, Floats, Ints
from sonar_graph.simulation.detections import (
    FieldOfView,
    inside,
    range_azimuth_elevation,
)
from sonar_graph.simulation.sensors import body_R_sensor, seconds_since_start
from sonar_graph.simulation.sonar_image import echoes
from sonar_graph.simulation.sonar_image.echoes import (
    ELEVATION_STEPS,
    PHASE_STEPS,
    PULSE_STEPS,
    TAPS,
    Horizon,
    SonarPlacement,
    Surface,
    Tables,
)
from sonar_graph.simulation.sonar_image.imaging_sonar import ImageOptions, ImagingSonar
from sonar_graph.simulation.sonar_image.scene import (
    CELL_M,
    CELLS,
    Cells,
    Floats32,
    SeabedObject,
    cells_of,
    lit_sector,
    scatterers,
    within,
)
from sonar_graph.simulation.vehicle import VehiclePath

REFERENCE_M = 2.0
REFERENCE_GRAZING = 0.475
"""Sine of the grazing angle at 2 m from 0.95 m above the floor, where `ImageOptions.floor_db` holds."""
GAIN_SLOPE_DB = 30.0
"""Decibels of gain for ten times the range, beside absorption."""
COLUMNS_PER_BEAM = 5
HALF_LIFT_RAD = np.radians(15)
"""Larger elevations are left out: two-way, they are 50 dB down."""
LEAST_AMPLITUDE = 3e-4
"""A beam's pattern below this, 70 dB down, is taken for zero."""
RAISED_M = 0.003
"""Cells that are this much higher than the lowest floor cast a shadow."""
SCOUR_M = 0.05
"""Distance from an object over which ripples reach their height."""
BEARINGS = 256
DISTANCE_STEP_M = 0.006


class FrameSimulator:
    """Simulator of frames over one floor; each depends only on the sonar's pose and on the frame's number.

    The seed is that of the floor, gain error, noise and drop-outs. Without a sonar it is the one that the options name.
    """

    def __init__(
        self,
        options: ImageOptions,
        objects: Sequence[SeabedObject] = (),
        floor_z_m: float = 0.0,
        seed: int = 0,
        sonar: ImagingSonar | None = None,
    ) -> None:
        self.options = options
        self.sonar = sonar or options.imaging_sonar()
        self.objects = list(objects)
        self._floor_z_m = floor_z_m
        self._seed = seed
        sonar = self.sonar
        self._floor = scatterers(
            options.texture_shape,
            options.joints,
            np.random.default_rng([seed, 0]),
            options.texture_length_m,
            options.ripple_length_m,
            options.ripple_height_m,
        )
        # the Gaussian's square is as wide at half
        pulse_sigma_m = sonar.range_resolution_m / (2 * np.sqrt(np.log(2)))
        self._column_rad = column_rad = sonar.beam_width_rad / COLUMNS_PER_BEAM
        self._tables = tables_of(sonar, column_rad, pulse_sigma_m)

        ranges_m = sonar.ranges_m()
        # there and back, against the reference range
        absorbed_db = 2 * options.absorption_db_m * (ranges_m - REFERENCE_M)
        # the operator sees the time-varied gain of the sonar, with its error
        gain_db = GAIN_SLOPE_DB * np.log10(ranges_m / REFERENCE_M) + absorbed_db
        gain_db = gain_db + drawn_gain_error_db(
            options.tvg_error_db, len(ranges_m), seed
        )
        self._gain_db: Floats32 = gain_db.astype(np.float32)
        # mean square of the sum over a floor of unit strength at the reference: cells in a resolution cell
        across_m = REFERENCE_M * (2 / 3) * sonar.wavelength_m / sonar.aperture_m
        along_m = pulse_sigma_m * np.sqrt(np.pi) / np.sqrt(1 - REFERENCE_GRAZING**2)
        reference_intensity = float(
            across_m * along_m / CELL_M**2 * REFERENCE_GRAZING**2
        )
        # so that the mean level of the floor at the reference is `floor_db`
        strength = 10 ** (options.floor_db / 20) / np.sqrt(reference_intensity)
        spreading = strength * (REFERENCE_M / ranges_m) ** 2 * 10 ** (-absorbed_db / 20)
        self._spreading: Floats32 = spreading.astype(np.float32)

        columns = self._tables.columns
        middles = (np.arange(columns) + 0.5 - 0.5 * columns) * column_rad
        offset = middles[None, :] - sonar.azimuths_rad()[:, None]
        pattern = sonar.two_way_pattern(offset, options.side_lobes)
        matters = pattern > LEAST_AMPLITUDE
        # beams are narrow: each has a band of columns that reach it
        first = matters.argmax(axis=1)
        last = columns - matters[:, ::-1].argmax(axis=1)
        # `through_beams` takes four columns at a time
        self._bands = np.column_stack([first // 4 * 4, -(-last // 4) * 4])
        self._beam_matrix: Floats32 = pattern.astype(np.float32)

    def azimuths_rad(self) -> Floats:
        """Azimuths of the beams as a log states them: true ones, or equally spaced, shape (beams,)."""
        return (
            self.sonar.azimuths_rad()
            if self.options.measured_lens
            else self.sonar.linear_azimuths_rad()
        )

    def ranges_m(self) -> Floats:
        """Middles of the bins as a log states them: true ones scaled by the error of the sound speed, shape (bins,)."""
        return self.sonar.ranges_m() * (1 + self.options.sound_speed_error)

    def is_dropped(self, number: int) -> bool:
        """True for a frame that is never recorded."""
        return bool(self._rng(number, 1).random() < self.options.drop_probability)

    def frame(
        self,
        position_m: Floats,
        world_R_sonar: Rotation,
        number: int,
        surface_z_m: float | None = None,
    ) -> NDArray[np.uint8]:
        """Recorded image, shape (beams, bins).

        The sonar's x points along its axis, its y to the left. The frame's number is the seed of its noise.
        ``surface_z_m`` is the height of the water's surface; None: too far away to matter.
        """
        # a byte for the full span
        counts = self.level_db(position_m, world_R_sonar, number, surface_z_m) * (
            255 / self.sonar.decibel_span
        )
        return np.clip(np.rint(counts), 0, 255).astype(np.uint8)

    def level_db(
        self,
        position_m: Floats,
        world_R_sonar: Rotation,
        number: int,
        surface_z_m: float | None = None,
    ) -> Floats32:
        """Level of each sample before it is rounded and clipped, shape (beams, bins)."""
        position_m = np.asarray(position_m, float)
        total = self.scattered(position_m, world_R_sonar, number)
        columns, bins, _ = total.shape
        # real and imaginary parts are samples alike: the pattern of a beam is real
        by_column = np.ascontiguousarray(total).reshape(columns, -1)
        seen = echoes.through_beams(self._beam_matrix, self._bands, by_column)
        if self.options.cross_talk_db is not None:
            seen = with_cross_talk(seen, self.sonar, self.options.cross_talk_db)
        signal = seen.reshape(-1, bins, 2) * self._spreading[:, None]
        if self.options.multipath and surface_z_m is not None:
            heights_m = position_m[2] - self._floor_z_m, surface_z_m - position_m[2]
            signal = with_surface_path(
                signal, self.sonar, *heights_m, self.options.surface_path_db
            )
        if self.options.noise_db is not None:
            # the power of complex noise is the sum over both parts
            sigma = np.float32(10 ** (self.options.noise_db / 20) * np.sqrt(0.5))
            signal = signal + sigma * self._rng(number, 0).standard_normal(
                signal.shape, np.float32
            )
        # the detector of the sonar keeps the power and drops the phase
        intensity = signal[..., 0] ** 2 + signal[..., 1] ** 2
        return 10 * np.log10(np.maximum(intensity, np.float32(1e-12))) + self._gain_db

    def _rng(self, number: int, purpose: int) -> np.random.Generator:
        """Random generator of a frame for one purpose."""
        return np.random.default_rng([self._seed, 2, number, purpose])

    def scattered(
        self, position_m: Floats, world_R_sonar: Rotation, number: int
    ) -> Floats32:
        """Sum of the scatterers by column of azimuth, shape (columns, bins, 2)."""
        tables = self._tables
        total = np.zeros((tables.columns, tables.bins + 2 * TAPS, 2), np.float32)
        height_m = position_m[2] - self._floor_z_m
        window = (
            self.sonar.range_start_m,
            self.sonar.range_start_m + self.sonar.range_length_m,
        )
        half_azimuth_rad = 0.5 * tables.columns * self._column_rad
        sector = lit_sector(
            world_R_sonar, height_m, window, half_azimuth_rad, HALF_LIFT_RAD
        )
        if sector is not None:
            cells = cells_of(sector, position_m)
            is_fixed = self.options.speckle == "world"
            # speckle of a frame: amplitudes are taken from another place of the floor
            shift = (
                np.zeros(2, np.int64)
                if is_fixed
                else self._rng(number, 2).integers(0, CELLS, 2)
            )
            view = SonarPlacement(
                position_m,
                np.ascontiguousarray(world_R_sonar.inv().as_matrix()),
                sector.heading,
                self._floor_z_m,
                cells.first_row,
                cells.spans,
                shift,
            )
            surface = echoes.NO_SURFACE
            horizon = echoes.NO_HORIZON
            near = within(
                self.objects,
                position_m,
                sector.farthest_m / np.cos(sector.half_bearing_rad / 2),
            )
            laid = laid_out(near, cells, self._floor.relief_m)
            # an even floor without objects needs neither slopes nor shadows
            if laid.relief_m.any() or not np.isnan(laid.amplitude).all():
                surface = laid
                if self.options.shadows:
                    steps = int(np.ceil(sector.farthest_m * 1.1 / DISTANCE_STEP_M)) + 1
                    # no ray is blocked so far
                    blocked = np.full((BEARINGS, steps), -np.inf, np.float32)
                    horizon = Horizon(
                        blocked,
                        float(np.tan(sector.half_bearing_rad + 0.02)),
                        DISTANCE_STEP_M,
                    )
                    # ripples reach down from the even floor: their crests shade their troughs
                    raised_m = RAISED_M - self.options.ripple_height_m
                    echoes.block_rays(view, surface, horizon, raised_m, CELL_M)
            reflection = (
                self.options.floor_reflection if self.options.multipath else 0.0
            )
            echoes.sum_echoes(
                view,
                self._floor,
                surface,
                horizon,
                tables,
                reflection,
                total,
            )
        # pulses of scatterers just outside of the window reach into it
        return total[:, TAPS:-TAPS]


def with_cross_talk(seen: Floats32, sonar: ImagingSonar, level_db: float) -> Floats32:
    """Add to each beam a share of all others that are fired together with it."""
    groups = sonar.firing_groups
    others = sonar.beams // groups - 1
    if groups == 1 or others < 1:
        return seen
    # the power of all others together is `level_db`
    leak = float(10 ** (level_db / 20) / np.sqrt(others))
    number = np.arange(sonar.beams) % groups
    together = np.stack([seen[number == group].sum(axis=0) for group in range(groups)])
    return ((1 - leak) * seen + leak * together[number]).astype(np.float32, copy=False)


def with_surface_path(
    signal: Floats32,
    sonar: ImagingSonar,
    height_m: float,
    depth_m: float,
    level_db: float,
) -> Floats32:
    """Add echoes that went one way by the surface and arrive later than the direct ones."""
    ranges_m = sonar.ranges_m()
    # horizontal distance of the scatterer on the floor
    run2 = np.maximum(ranges_m**2 - height_m**2, 0.0)
    # one way direct, one way by the image of the sonar in the surface
    late_m = 0.5 * (ranges_m + np.sqrt(run2 + (height_m + 2 * depth_m) ** 2))
    # direct bin whose echo arrives at each bin by the surface
    source = np.rint(
        np.interp(ranges_m, late_m, np.arange(len(ranges_m)), left=-1)
    ).astype(int)
    arrives = source >= 0
    of = source[arrives]
    # the longer way turns the phase
    turn = 2 * np.pi * (2 / sonar.wavelength_m) * (late_m - ranges_m)[of]
    level = 10 ** (level_db / 20) * (ranges_m / late_m)[of] ** 2
    cos = (level * np.cos(turn)).astype(np.float32)
    sin = (level * np.sin(turn)).astype(np.float32)
    real = signal[:, of, 0]
    imaginary = signal[:, of, 1]
    result = signal.copy()
    result[:, arrives, 0] += real * cos - imaginary * sin
    result[:, arrives, 1] += real * sin + imaginary * cos
    return result


def tables_of(sonar: ImagingSonar, column_rad: float, pulse_sigma_m: float) -> Tables:
    """Tables of a sonar for columns of some width and a Gaussian pulse."""
    bin_m = sonar.range_length_m / sonar.bins
    # beyond the outermost beam its pattern is over after a few widths
    half_rad = np.abs(sonar.azimuths_rad()).max() + 4 * sonar.beam_width_rad
    # tables at the middles of their steps
    angle = 2 * np.pi * (np.arange(PHASE_STEPS) + 0.5) / PHASE_STEPS
    place = (np.arange(PULSE_STEPS) + 0.5) / PULSE_STEPS
    offset = np.arange(TAPS) + 1 - 0.5 * TAPS - place[:, None]
    lift = (np.arange(ELEVATION_STEPS) + 0.5) / ELEVATION_STEPS - 0.5
    return Tables(
        cell_m=CELL_M,
        columns_per_rad=1 / column_rad,
        columns=4 * int(np.ceil(half_rad / column_rad / 2)),
        range_start_m=sonar.range_start_m,
        bin_m=bin_m,
        bins_per_m=1 / bin_m,
        bins=sonar.bins,
        waves_per_m=2 / sonar.wavelength_m,
        phasor=np.column_stack([np.cos(angle), np.sin(angle)]).astype(np.float32),
        pulse=np.exp(-((offset / (pulse_sigma_m / bin_m)) ** 2) / 2).astype(np.float32),
        elevation=sonar.elevation_pattern(np.arcsin(lift)).astype(np.float32),
    )


def drawn_gain_error_db(sigma_db: float, bins: int, seed: int) -> Floats:
    """Error of the time-varied gain: a tilt over the window and a slow wave of a third of it, shape (bins,)."""
    rng = np.random.default_rng([seed, 1])
    along = np.linspace(-0.5, 0.5, bins)
    # whole numbers of draws: other options leave the random stream as it was
    tilt = rng.standard_normal()
    wave = rng.standard_normal()
    phase = rng.uniform(0, 2 * np.pi)
    return sigma_db * (tilt * along + wave / 3 * np.sin(3 * np.pi * along + phase))


def laid_out(
    objects: Sequence[SeabedObject], cells: Cells, ripples_m: Floats32
) -> Surface:
    """Objects and ripples on the cells in view; the later of two objects covers the earlier.

    Ripples end within `SCOUR_M` around an object.
    """
    first_column = int(cells.spans[:, 0].min())
    end_column = int(cells.spans[:, 1].max())
    shape = len(cells.spans), end_column - first_column
    amplitude = np.full(shape, np.nan, np.float32)
    relief_m = np.zeros(shape, np.float32)
    if len(ripples_m):
        rows = cells.first_row + np.arange(shape[0])
        columns = first_column + np.arange(shape[1])
        relief_m = ripples_m[np.ix_(rows % CELLS, columns % CELLS)]
        for item in objects:
            y = (rows + 0.5) * CELL_M - item.position_m[1]
            x = (columns + 0.5) * CELL_M - item.position_m[0]
            # the current scours the sand around an object
            away_m = np.hypot(x, y[:, None]) - item.extent_m
            relief_m *= np.clip(away_m / SCOUR_M, 0, 1).astype(np.float32)
    for item in objects:
        to_rows, own_rows = _overlap(
            item.first_row - cells.first_row, len(item.amplitude), shape[0]
        )
        to_columns, own_columns = _overlap(
            item.first_column - first_column, item.amplitude.shape[1], shape[1]
        )
        # cells of the patch without material stay floor
        patch = item.amplitude[own_rows, own_columns]
        amplitude[to_rows, to_columns] = np.where(
            np.isnan(patch), amplitude[to_rows, to_columns], patch
        )
        relief_m[to_rows, to_columns] += item.relief_m[own_rows, own_columns]
    return Surface(first_column, amplitude, relief_m)


def _overlap(first: int, length: int, size: int) -> tuple[slice, slice]:
    """Slice of an axis of a size that a patch of a length from ``first`` on covers, and the slice of the patch."""
    begin = min(max(first, 0), size)
    end = max(min(first + length, size), 0)
    end = max(begin, end)
    return slice(begin, end), slice(begin - first, end - first)


_RING = np.linspace(0, 2 * np.pi, 12, endpoint=False)
_SPREAD = np.concatenate(
    [
        np.zeros((1, 3)),
        *(
            s * np.column_stack([np.cos(_RING), np.sin(_RING), 0 * _RING])
            for s in (0.5, 1.0)
        ),
    ]
)
"""Points of a unit disc on the floor: its centre and two rings."""
SURFACE_Z_M = 0.0


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Positions of the sonar and of m objects in n frames."""

    positions: Floats
    """True position of the sonar in the world, shape (n, 3)."""
    quaternions_xyzw: Floats
    """world_R_sonar, shape (n, 4)."""
    ids: Ints
    """Identities of landmarks, negative for other objects, shape (m,)."""
    points_m: Floats
    """Centre of each object in the sonar's frame, shape (n, m, 3)."""
    kinds: tuple[str, ...]
    """What each object is: a landmark's design, or the name of another thing, length m."""
    share_in_view: Floats
    """Share of each object's disc inside the fan between half powers and the window, shape (n, m)."""

    def range_m(self) -> Floats:
        """Slant range of each object, shape (n, m)."""
        return range_azimuth_elevation(self.points_m)[0]

    def azimuth_rad(self) -> Floats:
        """``atan2(q_y, q_x)`` of each object, shape (n, m)."""
        return range_azimuth_elevation(self.points_m)[1]


@dataclass(frozen=True, eq=False)
class ImagedFrames:
    """Frames and the truth about them."""

    frames: SonarFrames
    truth: FrameTruth


def image_along(
    path: VehiclePath,
    mounting: Mounting,
    pings_ns: Ints,
    simulator: FrameSimulator,
    frames_per_block: int = 32,
) -> Iterator[ImagedFrames]:
    """Record a frame at every ping but those that are dropped, a block at a time.

    Frames are stamped later than their pings, shape (n,), by the options' time offset.
    """
    # a dropped frame keeps its number, so that the others look as without drops
    numbers = np.array(
        [n for n in range(len(pings_ns)) if not simulator.is_dropped(n)], dtype=np.int64
    )
    for first in range(0, len(numbers), frames_per_block):
        block = numbers[first : first + frames_per_block]
        motion = path.at(seconds_since_start(pings_ns[block]))
        positions = motion.position + motion.world_R_body.apply(
            np.array(mounting.translation_m)
        )
        world_R_sonar = motion.world_R_body * body_R_sensor(mounting)
        images = [
            simulator.frame(position, rotation, number, SURFACE_Z_M)
            for position, rotation, number in zip(
                positions, world_R_sonar, block.tolist(), strict=True
            )
        ]
        # the pose is that of the ping; only the stamp is late
        stamps_ns = pings_ns[block] + round(simulator.options.time_offset_s * NS_PER_S)
        frames = SonarFrames(
            stamps_ns, np.stack(images), simulator.ranges_m(), simulator.azimuths_rad()
        )
        yield ImagedFrames(frames, frame_truth(positions, world_R_sonar, simulator))


def frame_truth(
    positions: Floats, world_R_sonar: Rotation, simulator: FrameSimulator
) -> FrameTruth:
    """Position of every object in the sonar's frame, for positions (n, 3) and n rotations of the sonar."""
    sonar = simulator.sonar
    objects = simulator.objects
    far_m = sonar.range_start_m + sonar.range_length_m
    half_azimuth_rad = float(np.abs(sonar.azimuths_rad()).max())
    fan = FieldOfView(
        sonar.range_start_m, far_m, half_azimuth_rad, sonar.elevation_span_rad / 2
    )
    # all objects in all frames at once
    sonar_R_world = world_R_sonar.inv().as_matrix()
    centres = np.reshape([o.position_m for o in objects], (-1, 3))
    discs = (
        centres[:, None]
        + np.reshape([o.extent_m for o in objects], (-1, 1, 1)) * _SPREAD
    )
    points_m = np.einsum("nij,nmj->nmi", sonar_R_world, centres - positions[:, None])
    spread_m = np.einsum(
        "nij,nmkj->nmki", sonar_R_world, discs - positions[:, None, None]
    )
    return FrameTruth(
        positions=positions,
        quaternions_xyzw=world_R_sonar.as_quat(),
        ids=np.array([o.id for o in objects], dtype=np.int64),
        points_m=points_m,
        kinds=tuple(o.kind for o in objects),
        share_in_view=inside(fan, spread_m).mean(axis=2),
    )
