"""Simulated landmarks along a recorded run, and the detections of a sonar on that vehicle.

Vehicle, IMU and Doppler log are real; landmarks and detections are drawn. The log's reference trajectory is taken for
the truth, with a quintic spline through it. Errors of the reference (time, noise) are therefore in the geometry of the
detections too. Landmarks lie on either side of the track at random distances and heights; the same stretch driven twice
sees the same ones.
"""

import math
from dataclasses import replace

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Mounting, Section, SonarCalibration
from sonar_graph.errors import SimulationError
from sonar_graph.measurements import NS_PER_S
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.detections import (
    FieldOfView,
    SimulatedRecogniser,
    World,
    simulate_detections,
)
from sonar_graph.simulation.sensors import EPOCH_NS, regular_stamps
from sonar_graph.simulation.vehicle import VehiclePath, rpy_from_rotation

LEAST_POSES = 6
"""Number that a quintic spline needs."""
KNOT_S = 0.5


class LandmarkOptions(Section):
    """Options of landmarks and sonar on a recorded run.

    Examples
    --------
    >>> from sonar_graph.simulation import LandmarkOptions
    >>> LandmarkOptions(spacing_m=10.0).seed
    0
    """

    seed: int = Field(0, ge=0)
    """Of everything random; equal options give equal bits."""
    spacing_m: float = Field(25.0, gt=0)
    """Along the track, between one landmark and the next."""
    side_min_m: float = Field(4.0, gt=0)
    """Horizontal distance of a landmark from the track, at least."""
    side_max_m: float = Field(15.0, gt=0)
    """At most."""
    height_sigma_m: float = Field(1.0, ge=0)
    """Of a landmark's height about that of the vehicle when it passes."""
    frame_rate_hz: float = Field(2.0, gt=0, le=30)
    """Sonar frames a second."""
    range_min_m: float = Field(1.0, gt=0)
    """The nearest that the sonar sees."""
    range_max_m: float = Field(40.0, gt=0)
    """The farthest."""
    azimuth_aperture_rad: float = Field(math.radians(130), gt=0, lt=math.pi)
    """Full horizontal opening of the sonar, which looks ahead."""
    elevation_aperture_rad: float = Field(math.radians(20), gt=0, lt=math.pi)
    """Full vertical opening."""
    range_sigma_m: float = Field(0.05, gt=0)
    """White noise of a detection's range."""
    azimuth_sigma_rad: float = Field(0.009, gt=0)
    """White noise of a detection's azimuth (half a degree)."""
    detection_probability: float = Field(0.8, ge=0, le=1)
    """Of a landmark inside the fan, in each frame."""
    wrong_id_rate: float = Field(0.01, ge=0, le=1)
    """Share of the detected landmarks taken confidently for another one."""
    false_detections_per_frame: float = Field(0.05, ge=0)
    """Mean number of detections of nothing."""
    confident_false_fraction: float = Field(0.0, ge=0, le=1)
    """Share of the false detections taken confidently for a landmark."""


def add_landmarks(
    recorded: Sequence, options: LandmarkOptions | None = None
) -> Sequence:
    """Add landmarks, detections and the sonar's calibration to a recorded run; all else stays as recorded.

    Parameters
    ----------
    recorded
        Run with a reference trajectory; its detections and landmarks are replaced.
    options
        None: a landmark every 25 m, seen from up to 40 m.

    Raises
    ------
    SimulationError
        When the log has no reference trajectory, too short a one, or ranges are the wrong way round.

    Examples
    --------
    >>> from sonar_graph.simulation import LandmarkOptions, add_landmarks
    >>> from sonar_graph.testing import aided_world
    >>> seen = add_landmarks(aided_world(), LandmarkOptions(spacing_m=5.0, side_min_m=2.0))
    >>> len(seen.true_landmarks) > 0
    True
    """
    options = options or LandmarkOptions()
    for low, high in (("range_min_m", "range_max_m"), ("side_min_m", "side_max_m")):
        least = getattr(options, low)
        most = getattr(options, high)
        if least >= most:
            raise SimulationError(
                f"simulate landmarks: {low} = {least:g} must be less than {high} = {most:g}"
            )
    first_ns, path = reference_path(recorded)
    children = np.random.SeedSequence(options.seed).spawn(2)
    world_rng, sonar_rng = map(np.random.default_rng, children)
    world = landmarks_beside(path, options, world_rng)
    sonar = SonarCalibration(
        mounting=Mounting(),
        range_sigma_m=options.range_sigma_m,
        azimuth_sigma_rad=options.azimuth_sigma_rad,
        elevation_aperture_rad=options.elevation_aperture_rad,
    )
    azimuth_half_rad = options.azimuth_aperture_rad / 2
    elevation_half_rad = options.elevation_aperture_rad / 2
    fan = FieldOfView(
        options.range_min_m, options.range_max_m, azimuth_half_rad, elevation_half_rad
    )
    frames_ns = regular_stamps(options.frame_rate_hz, path.duration_s)
    detections = simulate_detections(
        path, frames_ns, sonar, fan, SimulatedRecogniser.of(options), world, sonar_rng
    )
    if detections is None:
        raise SimulationError(
            f"{recorded.name}: not one landmark is seen; lower spacing_m = {options.spacing_m:g} or raise range_max_m"
        )
    return replace(
        recorded,
        calibration=recorded.calibration.model_copy(
            update={"sonar": sonar, "floor": None}
        ),
        detections=replace(
            detections, stamps_ns=detections.stamps_ns - EPOCH_NS + first_ns
        ),  # on the log's clock
        true_landmarks=world.landmark_map(),
        notes=recorded.notes
        | {
            "simulated": "landmarks and detections, on the recorded reference trajectory; all else is recorded",
            "landmark options": options.model_dump_json(),
        },
    )


def reference_path(recorded: Sequence) -> tuple[int, VehiclePath]:
    """Stamp of the path's beginning (ns), and the spline through the reference while IMU and DVL run.

    Its poses are thinned to one in `KNOT_S`: the noise of a quick reference is no motion.
    """
    reference = recorded.true_poses
    if reference is None or not len(reference):
        raise SimulationError(
            f"{recorded.name}: no reference trajectory with orientations, along which landmarks could lie; "
            "name its topic with --topic truth=TOPIC"
        )
    stamps_ns = reference.stamps_ns
    inside = np.flatnonzero(
        (stamps_ns >= recorded.start_ns) & (stamps_ns <= recorded.end_ns)
    )
    if len(inside) < LEAST_POSES:
        raise SimulationError(
            f"{recorded.name}: {len(inside)} poses of the reference lie within the time of IMU and DVL; "
            f"expected {LEAST_POSES} or more"
        )
    stamps_ns = stamps_ns[inside]
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    # a spline through every pose would follow the noise of the reference
    knots = [0.0]
    for instant in seconds[1:].tolist():
        if instant - knots[-1] >= KNOT_S - 1e-6:
            knots.append(instant)
    seconds = np.array(knots) if len(knots) >= LEAST_POSES else seconds
    poses = reference.at(stamps_ns[0] + np.rint(seconds * NS_PER_S).astype(np.int64))
    # a jump by 2 pi would be a turn
    angles = np.unwrap(rpy_from_rotation(poses.rotations()), axis=0)
    return int(stamps_ns[0]), VehiclePath.through(
        seconds, np.column_stack([poses.positions, angles])
    )


def landmarks_beside(
    path: VehiclePath, options: LandmarkOptions, rng: np.random.Generator
) -> World:
    """Landmarks beside the track."""
    seconds = np.arange(0.0, path.duration_s, 0.1)
    motion = path.at(seconds)
    along_m = np.concatenate(
        [
            [0.0],
            np.cumsum(np.linalg.norm(np.diff(motion.position[:, :2], axis=0), axis=1)),
        ]
    )
    # by the distance travelled, so that a hovering vehicle gets no heap
    places_m = np.arange(
        0.5 * options.spacing_m, max(along_m[-1], options.spacing_m), options.spacing_m
    )
    # first instant at each place
    row = np.minimum(np.searchsorted(along_m, places_m), len(seconds) - 1)
    course = np.arctan2(motion.velocity[row, 1], motion.velocity[row, 0])
    # to the left or to the right
    side_m = rng.choice([-1.0, 1.0], len(row)) * rng.uniform(
        options.side_min_m, options.side_max_m, len(row)
    )
    offset = np.column_stack([-np.sin(course) * side_m, np.cos(course) * side_m])
    height = motion.position[row, 2] + options.height_sigma_m * rng.standard_normal(
        len(row)
    )
    positions = np.column_stack([motion.position[row, :2] + offset, height])
    return World(np.arange(1, len(row) + 1), positions, float(height.min()))
