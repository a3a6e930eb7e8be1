"""Recording of all sensors along a true path, as a `Sequence`.

Each sensor draws from a random stream of its own, so that changing one (such as the sonar's frame rate) leaves the noise
of all others as it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    FloorPrior,
    Mounting,
    SonarCalibration,
    Start,
)
from sonar_graph.errors import SimulationError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.detections import (
    FieldOfView,
    SimulatedRecogniser,
    World,
    simulate_detections,
)
from sonar_graph.simulation.options import (
    DEPTH_RATE_HZ,
    DVL_PRESETS,
    IMU_PRESETS,
    IMU_RATE_HZ,
    SimulationOptions,
)
from sonar_graph.simulation.sensors import (
    regular_stamps,
    seconds_since_start,
    simulate_depth,
    simulate_dvl,
    simulate_imu,
)
from sonar_graph.simulation.vehicle import VehiclePath, rpy_from_rotation
from sonar_graph.states import Trajectory
from sonar_graph.version import __version__

TRUTH_RATE_HZ = 50.0
SONAR_OFFSET_S = 0.0371
"""First sonar frame; not a multiple of any other sensor's period."""


@dataclass(frozen=True)
class Vehicle:
    """Mountings of the sensors, and the sonar's field of view."""

    sonar: Mounting
    fan: FieldOfView
    dvl: Mounting
    depth_port_m: tuple[float, float, float]


@dataclass(frozen=True)
class Streams:
    """Independent random generators, one for each purpose, all from one seed."""

    path: np.random.Generator
    world: np.random.Generator
    start: np.random.Generator
    imu: np.random.Generator
    dvl: np.random.Generator
    depth: np.random.Generator
    sonar: np.random.Generator
    seabed: np.random.Generator

    @classmethod
    def of(cls, seed: int) -> Streams:
        """Spawn the streams of a seed."""
        children = np.random.SeedSequence(seed).spawn(8)
        return cls(*map(np.random.default_rng, children))


def record(
    name: str,
    options: SimulationOptions,
    vehicle: Vehicle,
    path: VehiclePath,
    world: World,
    streams: Streams,
    notes: dict[str, str],
) -> Sequence:
    """Simulate all measurements along a path, with the truth and the calibration that holds for them.

    Path and world are the truth; the notes name the origin of values, the generator and its options.

    Raises `SimulationError` when options of tracks are set without ``tracks``.
    """
    if options.id_delay_s > 0 and not options.tracks:
        raise SimulationError(
            f"simulate {name}: id_delay_s = {options.id_delay_s:g} is the age of a track; set tracks = true with it"
        )
    usual = type(options).model_fields["wrong_id_share"].default
    if options.wrong_id_share != usual and not options.tracks:
        raise SimulationError(
            f"simulate {name}: wrong_id_share = {options.wrong_id_share:g} is a share of a track; set tracks = true"
        )
    calibration = true_calibration(options, vehicle, path, world, streams.start)
    rates_hz = (
        IMU_RATE_HZ,
        DVL_PRESETS[options.dvl].rate_hz,
        DEPTH_RATE_HZ,
        TRUTH_RATE_HZ,
    )
    imu_ns, dvl_ns, depth_ns, truth_ns = (
        regular_stamps(rate, path.duration_s) for rate in rates_hz
    )
    # sensors run at their own rates; the sonar is not in step with any
    frames_ns = frame_stamps(options.frame_rate_hz, path.duration_s)
    truth = path.at(seconds_since_start(truth_ns))
    return Sequence(
        name=name,
        calibration=calibration,
        imu=simulate_imu(
            path, imu_ns, calibration.imu, calibration.gravity_m_s2, streams.imu
        ),
        dvl=simulate_dvl(
            path,
            dvl_ns,
            calibration.dvl,
            streams.dvl,
            scale_error=options.dvl_scale_error,
            dropouts_per_hour=options.dvl_dropouts_per_hour,
            dropout_s=options.dvl_dropout_s,
        ),
        depth=simulate_depth(path, depth_ns, calibration.depth, streams.depth),
        detections=simulate_detections(
            path,
            frames_ns,
            calibration.sonar,
            vehicle.fan,
            SimulatedRecogniser.of(options),
            world,
            streams.sonar,
        ),
        truth=Trajectory.without_covariances(
            truth_ns, truth.position, truth.world_R_body.as_quat()
        ),
        true_landmarks=world.landmark_map(),
        notes={
            "generator": f"sonar_graph {__version__}, {name}",
            "options": options.model_dump_json(),
            **notes,
        },
    )


def frame_stamps(rate_hz: float, duration_s: float) -> Ints:
    """Stamps of the sonar's pings, shape (n,), ns."""
    return regular_stamps(rate_hz, duration_s, SONAR_OFFSET_S)


def true_calibration(
    options: SimulationOptions,
    vehicle: Vehicle,
    path: VehiclePath,
    world: World,
    rng: np.random.Generator,
) -> Calibration:
    """The noise that is simulated, and a start drawn about the true one, so that its error matches its sigma."""
    preset = IMU_PRESETS[options.imu]
    sigma_m_s = DVL_PRESETS[options.dvl].velocity_sigma_m_s
    imu = preset.model_copy(
        update={
            "gyro_bias_sigma": preset.gyro_bias_sigma * options.gyro_bias_scale,
            "gyro_bias_walk_density": preset.gyro_bias_walk_density
            * options.gyro_bias_scale,
            "accel_bias_sigma": preset.accel_bias_sigma * options.accel_bias_scale,
        }
    )
    true = path.at(np.zeros(1))
    # the start in the calibration errs by what its sigmas state
    position = true.position[0] + options.start_position_sigma_m * rng.standard_normal(
        3
    )
    true_rpy = rpy_from_rotation(true.world_R_body[0])
    rpy = true_rpy + options.start_rotation_sigma_rad * rng.standard_normal(3)
    return Calibration(
        imu=imu,
        dvl=DvlCalibration(velocity_sigma_m_s=(sigma_m_s,) * 3, mounting=vehicle.dvl),
        depth=DepthCalibration(sigma_m=0.01, port_m=vehicle.depth_port_m),
        sonar=SonarCalibration(
            mounting=vehicle.sonar,
            range_sigma_m=options.range_sigma_m,
            azimuth_sigma_rad=options.azimuth_sigma_rad,
            elevation_aperture_rad=2 * vehicle.fan.elevation_half_rad,
        ),
        start=Start(
            position_m=_vector(position),
            rpy_rad=_vector(rpy),
            position_sigma_m=(options.start_position_sigma_m,) * 3,
            rpy_sigma_rad=(options.start_rotation_sigma_rad,) * 3,
        ),
        floor=FloorPrior(z_m=world.floor_z_m, sigma_m=options.floor_sigma_m),
    )


def _vector(values: Floats) -> tuple[float, float, float]:
    """Plain numbers for a calibration."""
    x, y, z = values.tolist()
    return x, y, z
