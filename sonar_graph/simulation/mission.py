"""Long mission with wide sonar views of the same landmarks: work for estimators, rather than an experiment.

The vehicle goes round a closed, three-lobed loop again and again at a constant speed, 2 m over a flat floor; its
forward-looking sonar sees up to ten landmarks at a time.
"""

import math

import numpy as np
from pydantic import Field

from sonar_graph.calibration import Mounting
from sonar_graph.measurements import Floats
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.detections import FieldOfView, world_on_floor
from sonar_graph.simulation.options import SimulationOptions
from sonar_graph.simulation.recording import Streams, Vehicle, record
from sonar_graph.simulation.vehicle import VehiclePath, smooth_noise

FLOOR_Z_M = -5.0
BODY_Z_M = -3.0
LOOP_RADIUS_M = 6.0
LOBE_M = 1.2
LOBES = 3
FIELD_RADIUS_M = 11.0
KNOT_S = 0.5
GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
NOTES = {"ours": "everything: a synthetic mission", "truth": "exact: a quintic spline"}


class MissionOptions(SimulationOptions):
    """Options of the mission.

    Examples
    --------
    >>> from sonar_graph.simulation import MissionOptions, simulate_mission
    >>> round(simulate_mission(MissionOptions(duration_s=60.0)).duration_s)
    60
    """

    duration_s: float = Field(2040.0, gt=5)
    """Of the whole run."""
    speed_m_s: float = Field(0.5, gt=0, le=1.0)
    """Along the loop of about 40 m."""
    landmarks: int = Field(12, ge=1, le=500)
    """Number on the floor, spread evenly over a disc of 22 m."""
    frame_rate_hz: float = Field(2.0, gt=0, le=30)
    """Sonar frames a second."""
    azimuth_aperture_rad: float = Field(math.radians(130), gt=0, lt=math.pi)
    """Full horizontal opening of the sonar."""
    elevation_aperture_rad: float = Field(math.radians(20), gt=0, lt=math.pi)
    """Full vertical opening."""
    range_max_m: float = Field(15.0, gt=0.5)
    """The farthest it sees; the nearest is 0.5 m."""


def simulate_mission(options: MissionOptions | None = None) -> Sequence:
    """Simulate the mission: measurements of all sensors, calibration and exact truth.

    Parameters
    ----------
    options
        None: 34 minutes with 12 landmarks.

    Examples
    --------
    >>> from sonar_graph.simulation import MissionOptions, simulate_mission
    >>> sequence = simulate_mission(MissionOptions(duration_s=20, landmarks=5))
    >>> len(sequence.true_landmarks), sequence.calibration.floor.z_m
    (5, -5.0)
    """
    options = options or MissionOptions()
    streams = Streams.of(options.seed)
    # the sunflower's spiral: evenly over a disc, without rows
    index = np.arange(options.landmarks)
    radius = FIELD_RADIUS_M * np.sqrt((index + 0.5) / options.landmarks)
    angle = GOLDEN_ANGLE_RAD * index
    landmarks_xy = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    world = world_on_floor(
        landmarks_xy, FLOOR_Z_M, options.floor_sigma_m, streams.world
    )
    vehicle = Vehicle(
        sonar=Mounting(
            translation_m=(0.40, 0.0, -0.05), rpy_rad=(0.0, math.radians(10), 0.0)
        ),
        fan=FieldOfView(
            0.5,
            options.range_max_m,
            options.azimuth_aperture_rad / 2,
            options.elevation_aperture_rad / 2,
        ),
        dvl=Mounting(translation_m=(-0.20, 0.0, -0.15)),
        depth_port_m=(0.10, 0.05, 0.10),
    )
    seconds = np.linspace(
        0, options.duration_s, math.ceil(options.duration_s / KNOT_S) + 1
    )
    xy, heading = loop(options.speed_m_s * seconds)
    level = np.zeros_like(seconds)
    intended = np.column_stack([xy, level + BODY_Z_M, level, level, heading])
    # no vehicle keeps its course exactly
    position = smooth_noise(seconds, np.array([0.05, 0.05, 0.04]), 8.0, 3, streams.path)
    attitude = smooth_noise(seconds, np.radians([1.8, 1.8, 2.0]), 4.0, 3, streams.path)
    path = VehiclePath.through(
        seconds, intended + np.column_stack([position, attitude])
    )
    return record("mission", options, vehicle, path, world, streams, NOTES)


def loop(travelled_m: Floats) -> tuple[Floats, Floats]:
    """Position (n, 2) and unwrapped heading (n,) after a distance on the loop r = 6 m + 1.2 m cos(3 angle)."""
    fine = np.linspace(0, 2 * math.pi, 20_001)
    # length of the loop by fine chords, for a constant speed
    along_m = np.concatenate(
        [[0.0], np.cumsum(np.hypot(*np.diff(_loop_xy(fine), axis=0).T))]
    )
    laps, rest_m = np.divmod(travelled_m, along_m[-1])
    angle = np.interp(rest_m, along_m, fine) + 2 * math.pi * laps
    # the heading is the tangent of the loop
    ahead = _loop_xy(angle + 1e-4) - _loop_xy(angle - 1e-4)
    return _loop_xy(angle), np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _loop_xy(angle: Floats) -> Floats:
    """The loop by its polar angle, shape (n, 2)."""
    radius = LOOP_RADIUS_M + LOBE_M * np.cos(LOBES * angle)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
