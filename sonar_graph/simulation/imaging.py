"""Images along a true path, with what is where in each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Mounting
from sonar_graph.measurements import Floats, Ints, SonarFrames
from sonar_graph.sequence import NS_PER_S
from sonar_graph.simulation.detections import Fan, inside, range_azimuth_elevation
from sonar_graph.simulation.sensors import body_R_sensor, seconds_since_start
from sonar_graph.simulation.sonar_image import FrameSimulator
from sonar_graph.simulation.vehicle import VehiclePath

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
    fan = Fan(sonar.range_start_m, far_m, half_azimuth_rad, sonar.elevation_span_rad / 2)
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
