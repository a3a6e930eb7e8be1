"""The basin experiment of the seed paper, with landmark detections or with sonar images.

Four landmarks lie on the floor of a basin of 20 m × 14 m × 1.7 m, at (5, 0), (7, -5), (2, -7) and (0, -2). A vehicle
with an imaging sonar tilted 30° down is driven around them three times in 2039 s at about 0.15 m/s.

The published landmarks lie on the sides of a square of 7 m, each 5 m along its side when it is driven clockwise from
the origin along x. That square is taken for the "rectangle path" of the paper; on each side the vehicle stops where it
sees the landmark from 1.8 m (horizontally), watches it, drives on over it to the corner, and turns right by 90°.
Three laps (84 m) at 0.15 m/s take 728 s with stops and turns; watching fills the rest. 2039 s at 0.15 m/s would be
306 m, more than ten laps of that square: the published mean speed cannot be meant over the whole run.

Source: "Experimental Results of Real-time Sonar-based Underwater Localization Using Landmarks", 2014.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Calibration, Mounting, SonarImage
from sonar_graph.devices import DEFAULT_DESIGNS, OWN_DESIGNS, LandmarkDesign, load_designs
from sonar_graph.errors import SimulationError
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.detections import FieldOfView, World, world_on_floor
from sonar_graph.simulation.options import SimulationOptions
from sonar_graph.simulation.recording import Streams, Vehicle, frame_stamps, record
from sonar_graph.simulation.sonar_image import (
    SONARS,
    FrameSimulator,
    ImagedFrames,
    ImageOptions,
    SeabedObject,
    image_along,
    place_landmark,
    scattered_objects,
)
from sonar_graph.simulation.vehicle import PlanarPose, RouteLeg, VehiclePath, drive, follow, hover, smooth_noise, turn

LANDMARKS_XY_M = np.array([[5.0, 0.0], [7.0, -5.0], [2.0, -7.0], [0.0, -2.0]])
FLOOR_Z_M = -1.7
SIDE_M = 7.0
LANDMARK_ALONG_SIDE_M = 5.0
SIDES = 4
BODY_Z_M = -0.70
YSHARK = Vehicle(
    sonar=Mounting(translation_m=(0.40, 0.0, -0.05), rpy_rad=(0.0, math.radians(30), 0.0)),
    fan=FieldOfView(1.25, 2.5, math.radians(14.4), math.radians(7)),
    dvl=Mounting(translation_m=(-0.20, 0.0, -0.15), rpy_rad=(0.0, 0.0, math.radians(45))),
    depth_port_m=(0.10, 0.05, 0.10),
)
WATCHING_M = 1.8
"""Horizontal distance from sonar to landmark while hovering: a slant range of 2.04 m."""
OBJECTS_ALONG_SIDE_M = (2.2, 3.5, 6.5)
OBJECTS_ASIDE_M = 0.3
"""Stones and patches that are no landmarks lie about there along each side, up to so far to either side of it."""
RAMP_S = 3.0
TURN_S = 8.0
FASTEST_M_S = 0.45
KNOT_S = 0.5
PAPER_DURATION_S, PAPER_LAPS, PAPER_SPEED_M_S = 2039.0, 3, 0.15
NOTES = {
    "truth": "exact: a quintic spline",
    "earth rotation": "neither simulated nor to be removed",
}


class BasinOptions(SimulationOptions):
    """What can be chosen about the basin experiment."""

    duration_s: float = Field(PAPER_DURATION_S, gt=0)
    """Of the whole run. What driving and turning leave is spent watching landmarks."""
    laps: int = Field(PAPER_LAPS, ge=1)
    """Rounds of the square."""
    speed_m_s: float = Field(PAPER_SPEED_M_S, gt=0, le=FASTEST_M_S)
    """While driving straight; raised, up to 0.45 m/s, as far as the duration needs it."""
    image: ImageOptions | None = None
    """None: landmark detections; otherwise the sonar records images, in which landmarks are still to be recognised."""


def simulate_basin(options: BasinOptions | None = None) -> Sequence:
    """The basin experiment with exact truth.

    Parameters
    ----------
    options
        None: the published run with the better sensors. With ``image`` there are no detections: the frames come from
        `simulate_basin_frames`.

    Raises
    ------
    SimulationError
        When the duration is too short for the laps.
    """
    options = options or BasinOptions()
    streams = Streams.of(options.seed)
    world = _world(options, streams.world)
    path = _path(options, streams.path)
    sequence = record("basin", options, YSHARK, path, world, streams, _notes(options))
    if options.image is None:
        return sequence
    return replace(sequence, detections=None, calibration=_imaging(sequence.calibration, options.image))


def _imaging(calibration: Calibration, image: ImageOptions) -> Calibration:
    """The calibration with what the counts of the images mean."""
    scale = SonarImage(scale="decibel", decibel_span=SONARS[image.sonar].decibel_span, full_scale=255)
    return calibration.model_copy(update={"sonar": calibration.sonar.model_copy(update={"image": scale})})


def simulate_basin_frames(options: BasinOptions, frames_per_block: int = 32) -> Iterator[ImagedFrames]:
    """The images of the very run that `simulate_basin` gives for the same options, a block at a time.

    Parameters
    ----------
    options
        Without ``image`` its defaults hold.
    frames_per_block
        How many frames are held at once.

    Raises
    ------
    SimulationError
        When the duration is too short for the laps.
    """
    streams = Streams.of(options.seed)
    world = _world(options, streams.world)
    path = _path(options, streams.path)
    image = options.image or ImageOptions()
    simulator = FrameSimulator(image, _seabed(world, image, streams.seabed), FLOOR_Z_M, options.seed)
    stamps_ns = frame_stamps(options.frame_rate_hz, path.duration_s)
    yield from image_along(path, YSHARK.sonar, stamps_ns, simulator, frames_per_block)


def _world(options: BasinOptions, rng: np.random.Generator) -> World:
    """The landmarks on the floor, with the identities of their designs."""
    world = world_on_floor(LANDMARKS_XY_M, FLOOR_Z_M, options.floor_sigma_m, rng)
    return replace(world, landmark_ids=np.array([design.id for design in designs_laid(options.image)]))


def designs_laid(image: ImageOptions | None) -> list[LandmarkDesign]:
    """The four that lie at `LANDMARKS_XY_M`, in this order: those of the lowest identities, by identity.

    Raises
    ------
    CalibrationError
        When the file of one's own designs is none.
    SimulationError
        When there are fewer than four.
    """
    named = None if image is None else image.designs
    designs = DEFAULT_DESIGNS if named is None else load_designs(Path(named))
    if (missing := len(LANDMARKS_XY_M) - len(designs)) > 0:
        raise SimulationError(
            f"image.designs: {named} has {len(designs)} landmark designs, the basin needs {len(LANDMARKS_XY_M)}; "
            f"add {missing}"
        )
    return sorted(designs, key=lambda design: design.id)[: len(LANDMARKS_XY_M)]


def _seabed(world: World, image: ImageOptions, rng: np.random.Generator) -> list[SeabedObject]:
    """Landmarks, turned at random, and what is no landmark."""
    yaw_rad = rng.uniform(-np.pi, np.pi, len(world.landmark_ids))
    placed = zip(designs_laid(image), world.landmark_positions, yaw_rad.tolist(), strict=True)
    landmarks = [place_landmark(design, position, yaw, FLOOR_Z_M) for design, position, yaw in placed]
    spots = rng.permutation(_spots(rng))[: image.stones + image.decoys]
    return landmarks + scattered_objects(spots, image.stones, rng)


def _spots(rng: np.random.Generator) -> Floats:
    """Places on the route where something may lie that is no landmark, shape (12, 3)."""
    spots, corner = [], np.zeros(2)
    for heading_rad in -math.pi / 2 * np.arange(SIDES):
        ahead = np.array([math.cos(heading_rad), math.sin(heading_rad)])
        left = np.array([-ahead[1], ahead[0]])
        for along_m in OBJECTS_ALONG_SIDE_M:
            aside_m = rng.uniform(-OBJECTS_ASIDE_M, OBJECTS_ASIDE_M)
            spots.append([*(corner + (along_m + rng.uniform(-0.2, 0.2)) * ahead + aside_m * left), FLOOR_Z_M])
        corner = corner + SIDE_M * ahead
    return np.array(spots)


def _notes(options: BasinOptions) -> dict[str, str]:
    """Provenance: what is the paper's, which of duration, laps and speed only where they are as published."""
    speed_m_s = cruise_speed(options)
    chosen = {
        f"{options.duration_s:g} s in all": options.duration_s == PAPER_DURATION_S,
        f"laps: {options.laps}": options.laps == PAPER_LAPS,
        f"{speed_m_s:.3f} m/s while driving": speed_m_s == PAPER_SPEED_M_S,
    }
    published = ["basin", "landmark positions", "tilt", "window", *(text for text, same in chosen.items() if same)]
    ours = ["route", "hovering", "sensor models and mountings", "rates", "noise", "wobble"]
    ours += ["error rates of the recogniser"] if options.image is None else ["landmark designs", "image model"]
    ours += [*(text for text, same in chosen.items() if not same)]
    return {
        "from the paper": ", ".join(published),
        "ours": ", ".join(ours),
        **NOTES,
        **_own_designs(options.image),
        "speed_m_s": f"{speed_m_s:.3f}",
    }


def _own_designs(image: ImageOptions | None) -> dict[str, str]:
    if image is None or image.designs is None:
        return {}
    laid = ", ".join(f"{design.id}: {design.name}" for design in designs_laid(image))
    return {OWN_DESIGNS: f"{laid}, of {Path(image.designs).name}"}


def cruise_speed(options: BasinOptions) -> float:
    """Speed on the straights: the one asked for, or what the duration needs.

    Raises
    ------
    SimulationError
        When even the greatest speed is not enough.
    """
    sides = SIDES * options.laps
    overhead_s = sides * (2 * RAMP_S + TURN_S)
    shortest_s = overhead_s + sides * SIDE_M / FASTEST_M_S
    if options.duration_s < shortest_s:
        raise SimulationError(
            f"simulate basin: duration_s = {options.duration_s:g} is too short for laps = {options.laps}; "
            f"give at least {math.ceil(shortest_s)} s, or fewer laps"
        )
    return max(options.speed_m_s, sides * SIDE_M / (options.duration_s - overhead_s))


def _path(options: BasinOptions, rng: np.random.Generator) -> VehiclePath:
    """The route with the wobble of a vehicle under a joystick."""
    seconds = np.linspace(0, options.duration_s, math.ceil(options.duration_s / KNOT_S) + 1)
    start, pieces = (0.0, 0.0, 0.0), _route(options, rng)
    x, y, yaw = follow(start, pieces, seconds).T
    level = np.zeros_like(seconds)
    intended = np.column_stack([x, y, level + BODY_Z_M, level, level, yaw])
    return VehiclePath.through(seconds, intended + _wobble(seconds, rng))


def _route(options: BasinOptions, rng: np.random.Generator) -> list[RouteLeg]:
    """Sides of the square: drive into sight of the landmark, watch, drive over it to the corner, turn right."""
    speed = cruise_speed(options)
    stop_m = LANDMARK_ALONG_SIDE_M - WATCHING_M - YSHARK.sonar.translation_m[0]
    pose: PlanarPose = (0.0, 0.0, 0.0)
    pieces: list[RouteLeg] = []
    for watch_s in _watching_s(options, speed, rng).tolist():
        pieces.append(drive(pose, stop_m, speed, RAMP_S))
        pieces.append(hover(pieces[-1].goal, watch_s))
        pieces.append(drive(pieces[-1].goal, SIDE_M - stop_m, speed, RAMP_S))
        pieces.append(turn(pieces[-1].goal, -math.pi / 2, TURN_S))
        pose = pieces[-1].goal
    return pieces


def _watching_s(options: BasinOptions, speed_m_s: float, rng: np.random.Generator) -> Floats:
    """How long each landmark is watched, shape (sides,): unequal, in all what driving and turning leave."""
    sides = SIDES * options.laps
    spare_s = max(0.0, options.duration_s - sides * (SIDE_M / speed_m_s + 2 * RAMP_S + TURN_S))
    share = rng.uniform(0.8, 1.2, sides)
    return np.asarray(spare_s * share / share.sum())


def _wobble(seconds: Floats, rng: np.random.Generator) -> Floats:
    """What the water and the operator add to (x, y, z, roll, pitch, yaw), shape (n, 6).

    Slow wandering of a decimetre and quicker swaying of centimetres and degrees.
    """
    roll_pitch_yaw = np.radians([1.8, 1.8, 3.0])
    slow = smooth_noise(seconds, np.array([0.12, 0.12, 0.03]), 40.0, 3, rng)
    quick = smooth_noise(seconds, np.array([0.03, 0.03, 0.02]), 5.0, 3, rng)
    swaying = smooth_noise(seconds, roll_pitch_yaw, 4.0, 3, rng)
    return np.column_stack([slow + quick, swaying])
