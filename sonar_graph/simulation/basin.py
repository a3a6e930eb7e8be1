"""Basin experiment of the 2014 paper, with landmark detections or with sonar images.

Four landmarks lie on the floor of a basin of 20 m × 14 m × 1.7 m, at (5, 0), (7, -5), (2, -7) and (0, -2). A vehicle
with an imaging sonar tilted 30° down drives around them three times in 2039 s at about 0.15 m/s. The route, the square
of 7 m through the landmarks with a stop before each, is this project's, for the reasons in docs/theory/simulation.md.

Source: "Experimental Results of Real-time Sonar-based Underwater Localization Using Landmarks", 2014.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Mounting, SonarImage
from sonar_graph.devices import (
    DEFAULT_DESIGNS,
    OWN_DESIGNS,
    LandmarkDesign,
    load_designs,
)
from sonar_graph.errors import SimulationError
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
    strangers_at,
    true_mounting,
    weathered,
)
from sonar_graph.simulation.vehicle import (
    PlanarPose,
    RouteLeg,
    VehiclePath,
    drive,
    follow,
    hover,
    smooth_noise,
    turn,
)

LANDMARKS_XY_M = np.array([[5.0, 0.0], [7.0, -5.0], [2.0, -7.0], [0.0, -2.0]])
FLOOR_Z_M = -1.7
SIDE_M = 7.0
LANDMARK_ALONG_SIDE_M = 5.0
SIDES = 4
BODY_Z_M = -0.70
YSHARK = Vehicle(
    sonar=Mounting(
        translation_m=(0.40, 0.0, -0.05), rpy_rad=(0.0, math.radians(30), 0.0)
    ),
    fan=FieldOfView(1.25, 2.5, math.radians(14.4), math.radians(7)),
    dvl=Mounting(
        translation_m=(-0.20, 0.0, -0.15), rpy_rad=(0.0, 0.0, math.radians(45))
    ),
    depth_port_m=(0.10, 0.05, 0.10),
)
WATCHING_M = 1.8
"""Horizontal distance from sonar to landmark while hovering: a slant range of 2.04 m."""
OBJECTS_ALONG_SIDE_M = (2.2, 3.5, 6.5)
STRANGERS_ALONG_SIDE_M = (4.35, 5.65)
"""Strangers lie beside the landmarks, before and behind them, so that a frame can show both."""
OBJECTS_ASIDE_M = 0.3
"""Stones and patches lie at about these distances along each side, up to `OBJECTS_ASIDE_M` beside it."""
RAMP_S = 3.0
TURN_S = 8.0
FASTEST_M_S = 0.45
KNOT_S = 0.5
PAPER_DURATION_S = 2039.0
PAPER_LAPS = 3
PAPER_SPEED_M_S = 0.15
UNKNOWN_OBJECTS = "unknown objects"
"""Note of a log with strangers: each thing on the floor that is no landmark, and where it lies."""
NOTES = {
    "truth": "exact: a quintic spline",
    "earth rotation": "neither simulated nor to be removed",
}


class BasinOptions(SimulationOptions):
    """Options of the basin experiment.

    Examples
    --------
    >>> from sonar_graph.simulation import BasinOptions, simulate_basin
    >>> options = BasinOptions(seed=3, duration_s=130.0, laps=1, wrong_id_rate=0.1)
    >>> simulate_basin(options).true_landmarks.ids
    array([1, 2, 3, 4])
    """

    duration_s: float = Field(PAPER_DURATION_S, gt=0)
    """Of the whole run. The time that driving and turning leave is spent watching landmarks."""
    laps: int = Field(PAPER_LAPS, ge=1)
    """Rounds of the square."""
    speed_m_s: float = Field(PAPER_SPEED_M_S, gt=0, le=FASTEST_M_S)
    """While driving straight; raised, up to 0.45 m/s, as far as the duration needs it."""
    image: ImageOptions | None = None
    """None: landmark detections; otherwise the sonar records images, in which landmarks are still to be recognised."""


def simulate_basin(options: BasinOptions | None = None) -> Sequence:
    """Simulate the basin experiment: measurements of all sensors, calibration and exact truth.

    Parameters
    ----------
    options
        None: the published run of 2039 s with the better sensors. With ``image`` there are no detections: the frames
        come from `simulate_basin_frames`.

    Returns
    -------
    Sequence
        IMU, Doppler log, depth and landmark detections; the calibration that holds for them; true trajectory in the
        ``world`` frame at 50 Hz and true landmarks (m).

    Raises
    ------
    SimulationError
        When the duration is too short for the laps, or a file of landmark designs has fewer than four.
    CalibrationError
        When ``image.designs`` is no file of landmark designs.

    Examples
    --------
    >>> from sonar_graph.simulation import BasinOptions, simulate_basin
    >>> sequence = simulate_basin(BasinOptions(seed=1, duration_s=120, laps=1))
    >>> sequence.true_landmarks.positions[:, :2].tolist()
    [[5.0, 0.0], [7.0, -5.0], [2.0, -7.0], [0.0, -2.0]]
    >>> len(sequence.imu), len(sequence.dvl), len(sequence.depth)
    (12001, 841, 1201)
    >>> sequence.notes["speed_m_s"]
    '0.438'
    """
    options = options or BasinOptions()
    streams = Streams.of(options.seed)
    world, path = _world_and_path(options, streams)
    sequence = record(
        "basin", options, YSHARK, path, world, streams, provenance(options)
    )
    if options.image is None:
        return sequence
    if options.image.strangers:
        others = [
            o
            for o in objects_on_floor(world, options.image, streams.seabed)
            if o.id < 0
        ]
        lie = ", ".join(
            f"{o.kind} at ({o.position_m[0]:.2f}, {o.position_m[1]:.2f})"
            for o in others
        )
        sequence = replace(sequence, notes={**sequence.notes, UNKNOWN_OBJECTS: lie})
    scale = SonarImage(
        scale="decibel",
        decibel_span=SONARS[options.image.sonar].decibel_span,
        full_scale=255,
    )
    sonar = sequence.calibration.sonar.model_copy(update={"image": scale})
    return replace(
        sequence,
        detections=None,
        calibration=sequence.calibration.model_copy(update={"sonar": sonar}),
    )


def simulate_basin_frames(
    options: BasinOptions, frames_per_block: int = 32
) -> Iterator[ImagedFrames]:
    """Simulate the sonar images of the run that `simulate_basin` gives for the same options, a block at a time.

    Parameters
    ----------
    options
        Without ``image`` its defaults hold.
    frames_per_block
        Number of frames in one block; memory grows with it.

    Yields
    ------
    ImagedFrames
        Frames, and the truth about each.

    Raises
    ------
    SimulationError
        When the duration is too short for the laps.

    Examples
    --------
    >>> from sonar_graph.simulation import BasinOptions, simulate_basin_frames
    >>> block = next(simulate_basin_frames(BasinOptions(duration_s=120, laps=1), frames_per_block=1))
    >>> block.frames.intensity.shape  # frames, beams, range bins
    (1, 96, 512)
    """
    streams = Streams.of(options.seed)
    world, path = _world_and_path(options, streams)
    image = options.image or ImageOptions()
    simulator = FrameSimulator(
        image, objects_on_floor(world, image, streams.seabed), FLOOR_Z_M, options.seed
    )
    stamps_ns = frame_stamps(options.frame_rate_hz, path.duration_s)
    mounting = true_mounting(YSHARK.sonar, image, options.seed)
    yield from image_along(path, mounting, stamps_ns, simulator, frames_per_block)


def _world_and_path(
    options: BasinOptions, streams: Streams
) -> tuple[World, VehiclePath]:
    """Landmarks with the identities of their designs, and the route with the wobble of a vehicle under a joystick.

    The wobble is slow wandering of a decimetre and quicker swaying of centimetres and degrees.
    """
    world = world_on_floor(
        LANDMARKS_XY_M, FLOOR_Z_M, options.floor_sigma_m, streams.world
    )
    # the identities are those of the designs that lie there
    world = replace(
        world,
        landmark_ids=np.array([design.id for design in designs_laid(options.image)]),
    )
    rng = streams.path
    seconds = np.linspace(
        0, options.duration_s, math.ceil(options.duration_s / KNOT_S) + 1
    )
    x, y, yaw = follow((0.0, 0.0, 0.0), route(options, rng), seconds).T
    # depth, roll and pitch are not steered
    level = np.zeros_like(seconds)
    intended = np.column_stack([x, y, level + BODY_Z_M, level, level, yaw])
    slow = smooth_noise(seconds, np.array([0.12, 0.12, 0.03]), 40.0, 3, rng)
    quick = smooth_noise(seconds, np.array([0.03, 0.03, 0.02]), 5.0, 3, rng)
    swaying = smooth_noise(seconds, np.radians([1.8, 1.8, 3.0]), 4.0, 3, rng)
    return world, VehiclePath.through(
        seconds, intended + np.column_stack([slow + quick, swaying])
    )


def designs_laid(image: ImageOptions | None) -> list[LandmarkDesign]:
    """Designs of the landmarks at `LANDMARKS_XY_M`, in this order: the four lowest identities.

    Raises
    ------
    CalibrationError
        When ``image.designs`` is no file of landmark designs.
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


def objects_on_floor(
    world: World, image: ImageOptions, rng: np.random.Generator
) -> list[SeabedObject]:
    """Landmarks, turned at random and worn, then stones and patches at random spots on the route, then strangers."""
    yaw_rad = rng.uniform(-np.pi, np.pi, len(world.landmark_ids))
    placed = zip(
        designs_laid(image), world.landmark_positions, yaw_rad.tolist(), strict=True
    )
    landmarks = [
        place_landmark(*each, FLOOR_Z_M, image.foam_height_m) for each in placed
    ]
    # wear and strangers leave the places of all else as they were
    wear_rng, strangers_rng = rng.spawn(2)
    landmarks = [
        weathered(one, image, own)
        for one, own in zip(landmarks, wear_rng.spawn(len(landmarks)), strict=True)
    ]
    spots = []
    beside = []
    corner = np.zeros(2)
    # the four sides of the square, clockwise
    for heading_rad in -math.pi / 2 * np.arange(SIDES):
        ahead = np.array([math.cos(heading_rad), math.sin(heading_rad)])
        left = np.array([-ahead[1], ahead[0]])
        for along_m in OBJECTS_ALONG_SIDE_M:
            aside_m = rng.uniform(-OBJECTS_ASIDE_M, OBJECTS_ASIDE_M)
            spots.append(
                [
                    *(
                        corner
                        + (along_m + rng.uniform(-0.2, 0.2)) * ahead
                        + aside_m * left
                    ),
                    FLOOR_Z_M,
                ]
            )
        for along_m in STRANGERS_ALONG_SIDE_M:
            aside_m = strangers_rng.uniform(-OBJECTS_ASIDE_M, OBJECTS_ASIDE_M)
            beside.append([*(corner + along_m * ahead + aside_m * left), FLOOR_Z_M])
        corner = corner + SIDE_M * ahead
    # all spots are drawn, whatever the number of stones
    chosen = rng.permutation(np.array(spots))[: image.stones + image.decoys]
    others = scattered_objects(chosen, image.stones, rng)
    return (
        landmarks
        + others
        + strangers_at(
            np.array(beside), image.strangers, -1 - len(others), strangers_rng
        )
    )


def provenance(options: BasinOptions) -> dict[str, str]:
    """Notes on which values are the paper's; duration, laps and speed are only where they are as published."""
    speed_m_s = cruise_speed(options)
    chosen = {
        f"{options.duration_s:g} s in all": options.duration_s == PAPER_DURATION_S,
        f"laps: {options.laps}": options.laps == PAPER_LAPS,
        f"{speed_m_s:.3f} m/s while driving": speed_m_s == PAPER_SPEED_M_S,
    }
    published = [
        "basin",
        "landmark positions",
        "tilt",
        "window",
        *(text for text, same in chosen.items() if same),
    ]
    ours = [
        "route",
        "hovering",
        "sensor models and mountings",
        "rates",
        "noise",
        "wobble",
    ]
    ours += (
        ["error rates of the recogniser"]
        if options.image is None
        else ["landmark designs", "image model"]
    )
    ours += [*(text for text, same in chosen.items() if not same)]
    notes = {"from the paper": ", ".join(published), "ours": ", ".join(ours), **NOTES}
    if options.image and options.image.scene != "easy":
        notes["scene"] = options.image.scene
    if options.image and options.image.designs is not None:
        laid = ", ".join(
            f"{design.id}: {design.name}" for design in designs_laid(options.image)
        )
        notes[OWN_DESIGNS] = f"{laid}, of {Path(options.image.designs).name}"
    return {**notes, "speed_m_s": f"{speed_m_s:.3f}"}


def cruise_speed(options: BasinOptions) -> float:
    """Speed on the straights, m/s: that of the options, or a higher one where the duration needs it.

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


def route(options: BasinOptions, rng: np.random.Generator) -> list[RouteLeg]:
    """Legs along the square: drive into sight of a landmark, watch it, drive over it to the corner, turn right.

    Driving and turning leave some time, which is spent watching, unequally.
    """
    speed = cruise_speed(options)
    sides = SIDES * options.laps
    # no time is left where the speed was raised for the duration
    spare_s = max(
        0.0, options.duration_s - sides * (SIDE_M / speed + 2 * RAMP_S + TURN_S)
    )
    share = rng.uniform(0.8, 1.2, sides)
    # where the sonar, not the body, is that far from the landmark
    stop_m = LANDMARK_ALONG_SIDE_M - WATCHING_M - YSHARK.sonar.translation_m[0]
    pose: PlanarPose = (0.0, 0.0, 0.0)
    legs: list[RouteLeg] = []
    for watch_s in (spare_s * share / share.sum()).tolist():
        legs.append(drive(pose, stop_m, speed, RAMP_S))
        legs.append(hover(legs[-1].goal, watch_s))
        legs.append(drive(legs[-1].goal, SIDE_M - stop_m, speed, RAMP_S))
        legs.append(turn(legs[-1].goal, -math.pi / 2, TURN_S))
        pose = legs[-1].goal
    return legs
