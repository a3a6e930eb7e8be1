"""Frames of an imaging sonar over a floor with objects on it.

One frame is the coherent sum of echoes from scatterers that stay in the world, seen through the beams' pattern, with
receiver noise, time-varied gain and a logarithmic 8-bit scale::

    Y[b, r]  = sum over scatterers (echoes.py), through the two-way pattern of beam b and cross-talk, times
               (2 m / r)² 10^(-2 alpha (r - 2 m) / 20)
    dB[b, r] = 10 log10 |Y + noise|² + 30 log10 (r / 2 m) + 2 alpha (r - 2 m) + what the gain gets wrong
    sample   = round(255 dB / 80), from 0 to 255

Documentation: docs/theory/sonar_image.md.

Images along a true path, with what is where in each of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Mounting
from sonar_graph.measurements import Floats, Ints, SonarFrames
from sonar_graph.sequence import NS_PER_S
from sonar_graph.simulation.detections import FieldOfView, inside, range_azimuth_elevation
from sonar_graph.simulation.sensors import body_R_sensor, seconds_since_start
from sonar_graph.simulation.sonar_image import echoes
from sonar_graph.simulation.sonar_image.echoes import ELEVATION_STEPS, TAPS, Horizon, SonarPlacement, Surface, Tables
from sonar_graph.simulation.sonar_image.imaging_sonar import (
    ARIS_3000,
    DIDSON,
    OCULUS_M1200D,
    ImageOptions,
    ImagingSonar,
    SonarName,
)
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

SONARS: dict[SonarName, ImagingSonar] = {"didson": DIDSON, "aris3000": ARIS_3000, "oculus1200": OCULUS_M1200D}
REFERENCE_M = 2.0
REFERENCE_GRAZING = 0.475
"""Sine of the grazing angle at 2 m from 0.95 m above the floor, where `ImageOptions.floor_db` holds."""
GAIN_SLOPE_DB = 30.0
"""Decibels of gain for ten times the range, beside absorption."""
COLUMNS_PER_BEAM = 5
HALF_LIFT_RAD = np.radians(15)
"""Elevations beyond are left out: two-way, they are 50 dB down."""
LEAST_AMPLITUDE = 3e-4
"""Where a beam's pattern stays below, 70 dB down, it is taken for zero."""
RAISED_M = 0.003
"""What stands higher casts a shadow."""
BEARINGS, DISTANCE_STEP_M = 256, 0.006


class FrameSimulator:
    """Makes frames of one basin floor; each depends only on where the sonar is and on the frame's number.

    Parameters
    ----------
    options
        Effects and their values.
    objects
        What lies on the floor.
    floor_z_m
        Its height.
    seed
        Of the floor, gain error, noise and drop-outs.
    sonar
        None: the one that the options name.
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
        self.sonar = sonar or SONARS[options.sonar]
        self.objects = list(objects)
        self._floor_z_m = floor_z_m
        self._seed = seed
        floor_rng = np.random.default_rng([seed, 0])
        self._floor = scatterers(options.texture_shape, options.joints, floor_rng)

    def azimuths_rad(self) -> Floats:
        """What a log says about the beams: where they point, or equally spaced."""
        return self.sonar.azimuths_rad() if self.options.measured_lens else self.sonar.linear_azimuths_rad()

    def ranges_m(self) -> Floats:
        """What a log says about the middles of the bins: true ones scaled by the error of the sound speed."""
        return self.sonar.ranges_m() * (1 + self.options.sound_speed_error)

    def is_dropped(self, number: int) -> bool:
        """Whether a frame is never recorded."""
        return bool(self._rng(number, 1).random() < self.options.drop_probability)

    def frame(
        self, position_m: Floats, world_R_sonar: Rotation, number: int, surface_z_m: float | None = None
    ) -> NDArray[np.uint8]:
        """The recorded image, shape (beams, bins).

        Parameters
        ----------
        position_m, world_R_sonar
            The sonar in the world: x along its axis, y to its left.
        number
            Of the frame: draws its noise.
        surface_z_m
            Height of the water's surface; None: too far away to matter.
        """
        counts = self.level_db(position_m, world_R_sonar, number, surface_z_m) * (255 / self.sonar.decibel_span)
        return np.clip(np.rint(counts), 0, 255).astype(np.uint8)

    def level_db(
        self, position_m: Floats, world_R_sonar: Rotation, number: int, surface_z_m: float | None = None
    ) -> Floats32:
        """Level of each sample before it is rounded and clipped, shape (beams, bins)."""
        signal = self._through_beams(self._echoes(np.asarray(position_m, float), world_R_sonar, number))
        if self.options.multipath and surface_z_m is not None:
            signal = self._with_surface_path(signal, position_m[2] - self._floor_z_m, surface_z_m - position_m[2])
        if self.options.noise_db is not None:
            sigma = np.float32(10 ** (self.options.noise_db / 20) * np.sqrt(0.5))
            signal = signal + sigma * self._rng(number, 0).standard_normal(signal.shape, np.float32)
        intensity = signal[..., 0] ** 2 + signal[..., 1] ** 2
        return 10 * np.log10(np.maximum(intensity, np.float32(1e-12))) + self._gain_db

    def _rng(self, number: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, 2, number, purpose])

    def _echoes(self, position_m: Floats, world_R_sonar: Rotation, number: int) -> Floats32:
        """Sum of the scatterers by column of azimuth, shape (columns, bins, 2)."""
        tables = self._tables
        total = np.zeros((tables.columns, tables.bins + 2 * TAPS, 2), np.float32)
        height_m = position_m[2] - self._floor_z_m
        window = self.sonar.range_start_m, self.sonar.range_start_m + self.sonar.range_length_m
        half_azimuth_rad = 0.5 * tables.columns * self._column_rad
        sector = lit_sector(world_R_sonar, height_m, window, half_azimuth_rad, HALF_LIFT_RAD)
        if sector is not None:
            cells = cells_of(sector, position_m)
            view = SonarPlacement(
                position_m,
                np.ascontiguousarray(world_R_sonar.inv().as_matrix()),
                sector.heading,
                self._floor_z_m,
                cells.first_row,
                cells.spans,
                self._shift(number),
            )
            surface, horizon = self._surroundings(view, cells, sector.half_bearing_rad, sector.farthest_m)
            reflection = self.options.floor_reflection if self.options.multipath else 0.0
            floor = self._floor
            echoes.sum_echoes(view, floor.points, floor.texture, surface, horizon, tables, reflection, total)
        return total[:, TAPS:-TAPS]

    def _shift(self, number: int) -> NDArray[np.int64]:
        if self.options.speckle == "world":
            return np.zeros(2, np.int64)
        return self._rng(number, 2).integers(0, CELLS, 2)

    def _surroundings(
        self, view: SonarPlacement, cells: Cells, half_bearing_rad: float, farthest_m: float
    ) -> tuple[Surface, Horizon]:
        """Objects near the sonar as cells, and what they hide."""
        near = within(self.objects, view.position_m, farthest_m / np.cos(half_bearing_rad / 2))
        if not near:
            return echoes.no_surface(), echoes.no_horizon()
        surface = _laid_out(near, cells)
        if not surface.relief_m.any() and np.isnan(surface.amplitude).all():
            return echoes.no_surface(), echoes.no_horizon()
        if not self.options.shadows:
            return surface, echoes.no_horizon()
        steps = int(np.ceil(farthest_m * 1.1 / DISTANCE_STEP_M)) + 1
        blocked = np.full((BEARINGS, steps), -np.inf, np.float32)
        horizon = Horizon(blocked, float(np.tan(half_bearing_rad + 0.02)), DISTANCE_STEP_M)
        echoes.block_rays(view, surface, horizon, RAISED_M, CELL_M)
        return surface, horizon

    def _through_beams(self, total: Floats32) -> Floats32:
        """Beams' patterns and what depends on range alone, shape (beams, bins, 2)."""
        columns, bins, _ = total.shape
        seen = np.zeros((self.sonar.beams, bins * 2), np.float32)
        matrix, bands = self._beam_matrix
        echoes.through_beams(matrix, bands, np.ascontiguousarray(total).reshape(columns, -1), seen)
        return self._with_cross_talk(seen).reshape(-1, bins, 2) * self._spreading[:, None]

    def _with_cross_talk(self, seen: Floats32) -> Floats32:
        """Adds to each beam a share of all others that are fired together with it."""
        groups = self.sonar.firing_groups
        others = self.sonar.beams // groups - 1
        if self.options.cross_talk_db is None or groups == 1 or others < 1:
            return seen
        leak = float(10 ** (self.options.cross_talk_db / 20) / np.sqrt(others))
        number = np.arange(self.sonar.beams) % groups
        together = np.stack([seen[number == group].sum(axis=0) for group in range(groups)])
        return ((1 - leak) * seen + leak * together[number]).astype(np.float32, copy=False)

    def _with_surface_path(self, signal: Floats32, height_m: float, depth_m: float) -> Floats32:
        """Adds what went one way by the surface: echoes of the floor that arrive later than their own."""
        ranges_m = self.sonar.ranges_m()
        run2 = np.maximum(ranges_m**2 - height_m**2, 0.0)
        late_m = 0.5 * (ranges_m + np.sqrt(run2 + (height_m + 2 * depth_m) ** 2))
        source = np.rint(np.interp(ranges_m, late_m, np.arange(len(ranges_m)), left=-1)).astype(int)
        arrives = source >= 0
        of = source[arrives]
        turn = 2 * np.pi * self._tables.waves_per_m * (late_m - ranges_m)[of]
        level = 10 ** (self.options.surface_path_db / 20) * (ranges_m / late_m)[of] ** 2
        cos, sin = (level * np.cos(turn)).astype(np.float32), (level * np.sin(turn)).astype(np.float32)
        real, imaginary = signal[:, of, 0], signal[:, of, 1]
        result = signal.copy()
        result[:, arrives, 0] += real * cos - imaginary * sin
        result[:, arrives, 1] += real * sin + imaginary * cos
        return result

    @cached_property
    def _gain_db(self) -> Floats32:
        ranges_m = self.sonar.ranges_m()
        exact = GAIN_SLOPE_DB * np.log10(ranges_m / REFERENCE_M)
        absorbed = 2 * self.options.absorption_db_m * (ranges_m - REFERENCE_M)
        return (exact + absorbed + drawn_gain_error_db(self.options.tvg_error_db, len(ranges_m), self._seed)).astype(
            np.float32
        )

    @cached_property
    def _spreading(self) -> Floats32:
        """Amplitude over range, with the floor's strength: shape (bins,)."""
        ranges_m = self.sonar.ranges_m()
        absorbed_db = 2 * self.options.absorption_db_m * (ranges_m - REFERENCE_M)
        strength = 10 ** (self.options.floor_db / 20) / np.sqrt(self._reference_intensity())
        return (strength * (REFERENCE_M / ranges_m) ** 2 * 10 ** (-absorbed_db / 20)).astype(np.float32)

    def _reference_intensity(self) -> float:
        """Mean square of the sum over a floor of unit strength at the reference: cells in a resolution cell."""
        across_m = REFERENCE_M * (2 / 3) * self.sonar.wavelength_m / self.sonar.aperture_m
        along_m = self._pulse_sigma_m * np.sqrt(np.pi) / np.sqrt(1 - REFERENCE_GRAZING**2)
        return float(across_m * along_m / CELL_M**2 * REFERENCE_GRAZING**2)

    @property
    def _pulse_sigma_m(self) -> float:
        """Of the Gaussian amplitude whose square has the resolution as its width at half."""
        return self.sonar.range_resolution_m / (2 * np.sqrt(np.log(2)))

    @property
    def _column_rad(self) -> float:
        return self.sonar.beam_width_rad / COLUMNS_PER_BEAM

    @cached_property
    def _tables(self) -> Tables:
        sonar = self.sonar
        bin_m = sonar.range_length_m / sonar.bins
        half_rad = np.abs(sonar.azimuths_rad()).max() + 4 * sonar.beam_width_rad
        column_rad = self._column_rad
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
            phasor=echoes.phasors(),
            pulse=echoes.pulses(self._pulse_sigma_m / bin_m),
            elevation=sonar.elevation_pattern(np.arcsin(lift)).astype(np.float32),
        )

    @cached_property
    def _beam_matrix(self) -> tuple[Floats32, NDArray[np.int64]]:
        """Amplitude of each column in each beam, shape (beams, columns), and the columns that matter to it."""
        columns = self._tables.columns
        middles = (np.arange(columns) + 0.5 - 0.5 * columns) * self._column_rad
        offset = middles[None, :] - self.sonar.azimuths_rad()[:, None]
        pattern = self.sonar.two_way_pattern(offset, self.options.side_lobes)
        matters = pattern > LEAST_AMPLITUDE
        first, last = matters.argmax(axis=1), columns - matters[:, ::-1].argmax(axis=1)
        bands = np.column_stack([first // 4 * 4, -(-last // 4) * 4])
        return pattern.astype(np.float32), bands


def drawn_gain_error_db(sigma_db: float, bins: int, seed: int) -> Floats:
    """What time-varied gain leaves: a tilt over the window and a slow wave of a third of it, shape (bins,)."""
    rng = np.random.default_rng([seed, 1])
    along = np.linspace(-0.5, 0.5, bins)
    tilt, wave, phase = rng.standard_normal(), rng.standard_normal(), rng.uniform(0, 2 * np.pi)
    return sigma_db * (tilt * along + wave / 3 * np.sin(3 * np.pi * along + phase))


def _laid_out(objects: Sequence[SeabedObject], cells: Cells) -> Surface:
    """Objects on the cells in view; where two overlap, the later covers the earlier."""
    first_column, end_column = int(cells.spans[:, 0].min()), int(cells.spans[:, 1].max())
    shape = len(cells.spans), end_column - first_column
    amplitude, relief_m = np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32)
    for item in objects:
        rows, own_rows = _overlap(item.first_row - cells.first_row, len(item.amplitude), shape[0])
        columns, own_columns = _overlap(item.first_column - first_column, item.amplitude.shape[1], shape[1])
        patch = item.amplitude[own_rows, own_columns]
        amplitude[rows, columns] = np.where(np.isnan(patch), amplitude[rows, columns], patch)
        relief_m[rows, columns] += item.relief_m[own_rows, own_columns]
    return Surface(first_column, amplitude, relief_m)


def _overlap(first: int, length: int, size: int) -> tuple[slice, slice]:
    """Where a patch of a length from ``first`` on lies on an axis of a size, and which part of it."""
    begin, end = min(max(first, 0), size), max(min(first + length, size), 0)
    end = max(begin, end)
    return slice(begin, end), slice(begin - first, end - first)


_RING = np.linspace(0, 2 * np.pi, 12, endpoint=False)
_SPREAD = np.concatenate(
    [np.zeros((1, 3)), *(s * np.column_stack([np.cos(_RING), np.sin(_RING), 0 * _RING]) for s in (0.5, 1.0))]
)
"""Points of a unit disc on the floor: its centre and two rings."""
SURFACE_Z_M = 0.0


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """What is where in n frames; m objects on the floor."""

    positions: Floats
    """True position of the sonar in the world, shape (n, 3)."""
    quaternions_xyzw: Floats
    """world_R_sonar, shape (n, 4)."""
    ids: Ints
    """Landmarks by identity; what is no landmark is negative. Shape (m,)."""
    points_m: Floats
    """Centre of each object in the sonar's frame, shape (n, m, 3)."""
    share_in_view: Floats
    """How much of each object's disc the fan between half powers and the window hold, shape (n, m)."""

    def range_m(self) -> Floats:
        """Slant range of each object, shape (n, m)."""
        return range_azimuth_elevation(self.points_m)[0]

    def azimuth_rad(self) -> Floats:
        """``atan2(q_y, q_x)`` of each object, shape (n, m)."""
        return range_azimuth_elevation(self.points_m)[1]


@dataclass(frozen=True, eq=False)
class ImagedFrames:
    """Some frames and the truth about them."""

    frames: SonarFrames
    truth: FrameTruth


def image_along(
    path: VehiclePath, mounting: Mounting, pings_ns: Ints, simulator: FrameSimulator, frames_per_block: int = 32
) -> Iterator[ImagedFrames]:
    """Record a frame at every ping but those that are dropped, a block at a time.

    Parameters
    ----------
    path
        The truth.
    mounting
        Of the sonar.
    pings_ns
        When it sends, shape (n,). Frames are stamped later by the options' time offset.
    simulator
        Makes the frames.
    frames_per_block
        How many are held at once.
    """
    numbers = np.array([n for n in range(len(pings_ns)) if not simulator.is_dropped(n)], dtype=np.int64)
    for first in range(0, len(numbers), frames_per_block):
        block = numbers[first : first + frames_per_block]
        yield _block(path, mounting, pings_ns[block], block, simulator)


def _block(
    path: VehiclePath, mounting: Mounting, pings_ns: Ints, numbers: Ints, simulator: FrameSimulator
) -> ImagedFrames:
    motion = path.at(seconds_since_start(pings_ns))
    positions = motion.position + motion.world_R_body.apply(np.array(mounting.translation_m))
    world_R_sonar = motion.world_R_body * body_R_sensor(mounting)
    images = [
        simulator.frame(position, rotation, number, SURFACE_Z_M)
        for position, rotation, number in zip(positions, world_R_sonar, numbers.tolist(), strict=True)
    ]
    offset_ns = round(simulator.options.time_offset_s * NS_PER_S)
    frames = SonarFrames(pings_ns + offset_ns, np.stack(images), simulator.ranges_m(), simulator.azimuths_rad())
    return ImagedFrames(frames, frame_truth(positions, world_R_sonar, simulator))


def frame_truth(positions: Floats, world_R_sonar: Rotation, simulator: FrameSimulator) -> FrameTruth:
    """Where every object lies as the sonar sees it.

    Parameters
    ----------
    positions
        Of the sonar, shape (n, 3).
    world_R_sonar
        n rotations.
    simulator
        Knows the objects and the sonar.
    """
    sonar, objects = simulator.sonar, simulator.objects
    far_m = sonar.range_start_m + sonar.range_length_m
    half_azimuth_rad = float(np.abs(sonar.azimuths_rad()).max())
    fan = FieldOfView(sonar.range_start_m, far_m, half_azimuth_rad, sonar.elevation_span_rad / 2)
    sonar_R_world = world_R_sonar.inv().as_matrix()
    centres = np.reshape([o.position_m for o in objects], (-1, 3))
    discs = centres[:, None] + np.reshape([o.extent_m for o in objects], (-1, 1, 1)) * _SPREAD
    points_m = np.einsum("nij,nmj->nmi", sonar_R_world, centres - positions[:, None])
    spread_m = np.einsum("nij,nmkj->nmki", sonar_R_world, discs - positions[:, None, None])
    return FrameTruth(
        positions=positions,
        quaternions_xyzw=world_R_sonar.as_quat(),
        ids=np.array([o.id for o in objects], dtype=np.int64),
        points_m=points_m,
        share_in_view=inside(fan, spread_m).mean(axis=2),
    )
