"""A lane with all four landmarks, a stone and a rough patch, driven along once with an imaging sonar.

It holds in half a minute what a lap of the basin holds in two: for tests that need images.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np

from sonar_graph.devices import DEFAULT_DESIGNS
from sonar_graph.images import SonarFrames
from sonar_graph.logs import sonar_image_messages, write_log
from sonar_graph.logs.mcap import Outgoing
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.basin import BODY_Z_M, FLOOR_Z_M, YSHARK
from sonar_graph.simulation.detections import world_on_floor
from sonar_graph.simulation.options import SimulationOptions
from sonar_graph.simulation.recording import Streams, frame_stamps, record
from sonar_graph.simulation.sonar_image import (
    FrameSimulator,
    ImageOptions,
    image_along,
    place_landmark,
    scattered_objects,
)
from sonar_graph.simulation.sonar_image.frames import FrameTruth
from sonar_graph.simulation.vehicle import VehiclePath, drive, follow, smooth_noise

LANDMARKS_XY_M = np.array([[2.4, 0.05], [4.0, -0.12], [5.6, 0.1], [6.4, -0.08]])
OTHERS_M = np.array([[3.2, 0.1, FLOOR_Z_M], [4.8, -0.1, FLOOR_Z_M]])
"""A stone and a rough patch as large and as bright as a landmark."""
LENGTH_M = 5.2
SPEED_M_S = 0.17
RAMP_S = 2.0
TOPIC = "/sonar/image"


@dataclass(frozen=True, eq=False)
class Lane:
    """The sensors of the run (without detections), its images, and what is in each of them."""

    sequence: Sequence
    frames: SonarFrames
    truth: list[FrameTruth]
    path: VehiclePath

    def write(self, log: Path, frames: Iterable[SonarFrames] | None = None) -> Path:
        """As a log, with images in the order given, whatever their stamps."""
        blocks = (
            [self.one(row) for row in range(len(self.frames))]
            if frames is None
            else frames
        )
        write_log(log, self.sequence, _in_this_order(blocks))
        return log

    def true_steps(self, rows: slice = slice(None)) -> list[gtsam.Pose3]:
        """True motion of the sonar between frames, while there is truth."""
        truth = self.sequence.truth
        stamps = self.frames.stamps_ns[rows]
        poses = truth.at(stamps[stamps <= truth.stamps_ns[-1]])
        body_T_sonar = self.sequence.calibration.sonar.mounting.pose()
        sonar = [
            gtsam.Pose3(gtsam.Rot3(R), t) * body_T_sonar
            for R, t in zip(poses.matrices, poses.positions, strict=True)
        ]
        return [before.inverse() * now for before, now in pairwise(sonar)]

    def one(self, row: int) -> SonarFrames:
        """A block of one frame."""
        frames = self.frames
        only = slice(row, row + 1)
        return replace(
            frames, stamps_ns=frames.stamps_ns[only], intensity=frames.intensity[only]
        )


def _in_this_order(blocks: Iterable[SonarFrames]) -> Iterator[Outgoing]:
    """Each block of one frame is recorded after the one before."""
    time_ns = 0
    for block in blocks:
        time_ns = max(time_ns + 1, int(block.stamps_ns[0]))
        message = sonar_image_messages(
            TOPIC, block, frequency_hz=1.8e6, sound_speed_m_s=1480
        )
        yield replace(message, log_times_ns=np.array([time_ns]))


def lane_path(rng: np.random.Generator) -> VehiclePath:
    """Straight ahead, swaying by centimetres and degrees."""
    piece = drive((0.0, 0.0, 0.0), LENGTH_M, SPEED_M_S, RAMP_S)
    seconds = np.linspace(0, piece.duration_s, round(2 * piece.duration_s) + 1)
    x, y, yaw = follow((0.0, 0.0, 0.0), [piece], seconds).T
    level = np.zeros_like(seconds)
    sway = smooth_noise(
        seconds, np.array([0.03, 0.06, 0.02, *np.radians([2.0, 2.0, 3.0])]), 4.0, 6, rng
    )
    return VehiclePath.through(
        seconds, np.column_stack([x, y, level + BODY_Z_M, level, level, yaw]) + sway
    )


def lane_run(seed: int) -> Lane:
    """The run of a seed."""
    options = SimulationOptions(seed=seed, frame_rate_hz=5.0)
    streams = Streams.of(seed)
    world = world_on_floor(
        LANDMARKS_XY_M, FLOOR_Z_M, options.floor_sigma_m, streams.world
    )
    path = lane_path(streams.path)
    sequence = replace(
        record("lane", options, YSHARK, path, world, streams, {"ours": "a lane"}),
        detections=None,
    )
    yaw_rad = streams.seabed.uniform(-np.pi, np.pi, len(DEFAULT_DESIGNS))
    placed = zip(DEFAULT_DESIGNS, world.landmark_positions, yaw_rad, strict=True)
    objects = [place_landmark(*each, FLOOR_Z_M) for each in placed] + scattered_objects(
        OTHERS_M, 1, streams.seabed
    )
    simulator = FrameSimulator(ImageOptions(), objects, FLOOR_Z_M, seed)
    blocks = list(
        image_along(
            path, YSHARK.sonar, frame_stamps(5.0, path.duration_s), simulator, 1
        )
    )
    columns = (
        np.concatenate([getattr(b.frames, name) for b in blocks])
        for name in ("stamps_ns", "intensity")
    )
    first = blocks[0].frames
    frames = SonarFrames(*columns, first.ranges_m, first.azimuths_rad)
    return Lane(sequence, frames, [block.truth for block in blocks], path)
