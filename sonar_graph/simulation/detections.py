"""What an imaging sonar with a landmark recogniser reports about true landmarks.

A landmark is seen when it lies inside the sonar's fan; exact three-dimensional geometry decides. Of those seen a share
is missed, of those detected a share gets another's identity, and some detections are of nothing at all. Misses, wrong
identities and false detections are independent from frame to frame, which real speckle is not.

A recogniser that tracks is of one mind about a landmark while it sees it: wrong for a while and about whole tracks, and
it may need time to make up its mind (`sonar_graph.simulation.tracking`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_graph.calibration import SonarCalibration
from sonar_graph.measurements import NO_TRACK, Floats, Ints, LandmarkDetections
from sonar_graph.simulation.sensors import body_R_sensor, seconds_since_start
from sonar_graph.simulation.tracking import Tracking, Watched
from sonar_graph.simulation.vehicle import VehiclePath
from sonar_graph.simulation.world import World

RECOGNISED_PROBABILITY = 0.97
OTHERS_PROBABILITY = 0.02
UNRECOGNISED_PROBABILITY = 0.20
NO_IDENTITY = -1


@dataclass(frozen=True)
class Fan:
    """The volume which a sonar sees: ranges, and angles either side of the centre beam."""

    range_min_m: float
    range_max_m: float
    azimuth_half_rad: float
    elevation_half_rad: float


@dataclass(frozen=True)
class Recogniser:
    """How often the detector and recogniser are right."""

    detection_probability: float = 1.0
    """Of a landmark inside the fan, in each frame."""
    wrong_id_rate: float = 0.0
    """Share of the detected landmarks which are taken for another one, with the confidence of a right one."""
    false_detections_per_frame: float = 0.0
    """Mean number (Poisson), uniform over range and azimuth."""
    confident_false_fraction: float = 0.0
    """Share of the false detections which are taken for a landmark with the confidence of a right one."""
    anonymous_share: float = 0.0
    """Share of all detections in which it names nothing."""
    tracking: Tracking | None = None
    """How it tracks; None: it does not, and each frame stands for itself."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Detections before they become a block: frame index, (range, azimuth), posterior over the landmarks, track."""

    frame: Ints
    range_azimuth: Floats
    id_probability: Floats
    track: Ints


def landmarks_in_sonar(path: VehiclePath, stamps_ns: Ints, sonar: SonarCalibration, world: World) -> Floats:
    """Every landmark in the sonar's frame at every instant: sonar_T_world l, shape (n, m, 3)."""
    motion = path.at(seconds_since_start(stamps_ns))
    world_R_sonar = motion.world_R_body * body_R_sensor(sonar.mounting)
    sonar_origin = motion.position + motion.world_R_body.apply(np.array(sonar.mounting.translation_m))
    from_sonar = world.landmark_positions[None] - sonar_origin[:, None]
    return np.einsum("nji,nmj->nmi", world_R_sonar.as_matrix(), from_sonar)


def range_azimuth_elevation(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Polar coordinates of points in the sonar's frame (last axis 3): |q|, atan2(q_y, q_x), asin(q_z / |q|)."""
    distance = np.linalg.norm(points, axis=-1)
    return distance, np.arctan2(points[..., 1], points[..., 0]), np.arcsin(points[..., 2] / distance)


def inside(fan: Fan, points: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which points of the sonar's frame (last axis 3) the fan holds."""
    distance, azimuth, elevation = range_azimuth_elevation(points)
    return np.asarray(
        (distance >= fan.range_min_m)
        & (distance <= fan.range_max_m)
        & (np.abs(azimuth) <= fan.azimuth_half_rad)
        & (np.abs(elevation) <= fan.elevation_half_rad)
    )


def simulate_detections(
    path: VehiclePath,
    stamps_ns: Ints,
    sonar: SonarCalibration,
    fan: Fan,
    recogniser: Recogniser,
    world: World,
    rng: np.random.Generator,
) -> LandmarkDetections | None:
    """Landmark detections in the sonar frames at ``stamps_ns``; None where there was not one.

    The posterior of a recognised detection is 0.97 for its identity and 0.02 spread evenly over the other landmarks
    (0.01 says "none of them"); that of a false one is 0.20 spread at random over all landmarks (0.80 says "none").
    False detections belong to no track.

    Parameters
    ----------
    path, world
        The truth.
    stamps_ns
        One stamp a frame, shape (n,).
    sonar
        Mounting and noise of range and azimuth.
    fan
        What it sees.
    recogniser
        How often it is right.
    rng
        Source of everything random.
    """
    true_rng, false_rng = rng.spawn(2)
    points = landmarks_in_sonar(path, stamps_ns, sonar, world)
    sigmas = np.array([sonar.range_sigma_m, sonar.azimuth_sigma_rad])
    true = _true_rows(points, stamps_ns, fan, recogniser, sigmas, true_rng)
    false = _false_rows(len(stamps_ns), len(world.landmark_ids), fan, recogniser, false_rng)
    frame = np.concatenate([true.frame, false.frame])
    if not len(frame):
        return None
    order = np.argsort(frame, kind="stable")
    range_azimuth = np.concatenate([true.range_azimuth, false.range_azimuth])[order]
    is_anonymous = rng.spawn(1)[0].random((len(frame), 1)) < recogniser.anonymous_share
    id_probability = np.concatenate([true.id_probability, false.id_probability])[order]
    return LandmarkDetections(
        stamps_ns=stamps_ns[frame[order]],
        range_m=range_azimuth[:, 0],
        azimuth_rad=range_azimuth[:, 1],
        range_azimuth_cov=np.tile(np.diag(sigmas**2), (len(frame), 1, 1)),
        candidate_ids=np.where(is_anonymous, NO_IDENTITY, world.landmark_ids),
        id_probability=np.where(is_anonymous, 0.0, id_probability),
        track=np.concatenate([true.track, false.track])[order],
    )


def _true_rows(
    points: Floats, stamps_ns: Ints, fan: Fan, recogniser: Recogniser, sigmas: Floats, rng: np.random.Generator
) -> _Rows:
    """Detections of landmarks that are there."""
    detected = inside(fan, points) & (rng.random(points.shape[:2]) < recogniser.detection_probability)
    frame, landmark = np.nonzero(detected)
    distance, azimuth, _ = range_azimuth_elevation(points[detected])
    range_azimuth = np.column_stack([distance, azimuth]) + sigmas * rng.standard_normal((len(frame), 2))
    count, rate = points.shape[1], recogniser.wrong_id_rate
    if recogniser.tracking is None:
        taken_for = _mistaken(landmark, count, rate, rng)
        return _Rows(frame, range_azimuth, _confident(taken_for, count), np.full(len(frame), NO_TRACK))
    watched = Watched.of(landmark, stamps_ns[frame], recogniser.tracking)
    first_taken_for = _mistaken(watched.landmark, count, rate, rng)
    posterior = _confident(watched.believed(first_taken_for), count)
    posterior[watched.is_undecided()] = 1 / (count + 1)
    return _Rows(frame, range_azimuth, posterior, watched.track)


def _false_rows(frames: int, landmarks: int, fan: Fan, recogniser: Recogniser, rng: np.random.Generator) -> _Rows:
    """Detections of nothing."""
    frame = np.repeat(np.arange(frames), rng.poisson(recogniser.false_detections_per_frame, frames))
    count = len(frame)
    distance = rng.uniform(fan.range_min_m, fan.range_max_m, count)
    azimuth = rng.uniform(-fan.azimuth_half_rad, fan.azimuth_half_rad, count)
    confident = rng.random(count) < recogniser.confident_false_fraction
    doubtful = UNRECOGNISED_PROBABILITY * rng.dirichlet(np.ones(landmarks), count)
    certain = _confident(rng.integers(landmarks, size=count), landmarks)
    posterior = np.where(confident[:, None], certain, doubtful)
    return _Rows(frame, np.column_stack([distance, azimuth]), posterior, np.full(count, NO_TRACK))


def _mistaken(landmark: Ints, landmarks: int, rate: float, rng: np.random.Generator) -> Ints:
    """Index of the landmark for which each is taken: at the given rate another one, all equally likely."""
    others = landmarks - 1
    if not others:
        return landmark
    wrong = rng.random(len(landmark)) < rate
    shift = rng.integers(1, others + 1, size=len(landmark))
    return np.where(wrong, (landmark + shift) % landmarks, landmark)


def _confident(landmark: Ints, landmarks: int) -> Floats:
    """Posterior of a recogniser which is sure of a landmark's index, shape (n, landmarks)."""
    others = OTHERS_PROBABILITY / max(landmarks - 1, 1)
    posterior = np.full((len(landmark), landmarks), others)
    posterior[np.arange(len(landmark)), landmark] = RECOGNISED_PROBABILITY
    return posterior
