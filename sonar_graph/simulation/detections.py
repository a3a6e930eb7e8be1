"""Where the simulated vehicle drives: a flat floor with landmarks on it.

World z points up with z = 0 at the water's surface, so depths are negative heights.

A recogniser that watches each landmark over frames, and believes one thing of it at a time.

A track is an uninterrupted watch of one landmark: it ends when the landmark was not detected for `LONGEST_GAP_S`.
Until it is ``id_delay_s`` old nothing is believed of it. Of some tracks another landmark is believed then, for a share
of what is left of the track, and the right one after that.

What an imaging sonar with a landmark recogniser reports about true landmarks.

A landmark is seen when it lies inside the sonar's fan; exact three-dimensional geometry decides. Of those seen a share
is missed, of those detected a share gets another's identity, and some detections are of nothing at all. Misses, wrong
identities and false detections are independent from frame to frame, which real speckle is not.

A recogniser that tracks is of one mind about a landmark while it sees it: wrong for a while and about whole tracks, and
it may need time to make up its mind (`sonar_graph.simulation.detections`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import SonarCalibration
from sonar_graph.measurements import NO_TRACK, Floats, Ints, LandmarkDetections
from sonar_graph.simulation.sensors import body_R_sensor, seconds_since_start
from sonar_graph.simulation.vehicle import VehiclePath
from sonar_graph.states import LandmarkMap


@dataclass(frozen=True, eq=False)
class World:
    """A flat floor and what lies on it."""

    landmark_ids: Ints
    """Shape (m,), each once, ascending."""
    landmark_positions: Floats
    """Shape (m, 3), metres."""
    floor_z_m: float
    """Height of the floor."""

    def landmark_map(self) -> LandmarkMap:
        """The true landmarks; their covariances are unknown (NaN), because truth has none."""
        return LandmarkMap(self.landmark_ids, self.landmark_positions, np.full((len(self.landmark_ids), 3, 3), np.nan))


def world_on_floor(xy_m: Floats, floor_z_m: float, height_sigma_m: float, rng: np.random.Generator) -> World:
    """Landmarks with IDs 1, 2, ... whose heights are drawn around that of the floor.

    The heights are drawn so that the floor prior N(floor_z_m, height_sigma_m²) which estimators are given is true:
    landmarks exactly on the floor would make every estimator look too cautious.

    Parameters
    ----------
    xy_m
        Horizontal positions, shape (m, 2).
    floor_z_m
        Height of the floor.
    height_sigma_m
        Standard deviation of a landmark's height about the floor.
    rng
        Source of the heights.
    """
    heights = floor_z_m + height_sigma_m * rng.standard_normal(len(xy_m))
    return World(np.arange(1, len(xy_m) + 1), np.column_stack([xy_m, heights]), floor_z_m)


LONGEST_GAP_S = 1.0
"""Longer without a detection ends a track."""


@dataclass(frozen=True)
class Tracking:
    """How long a recogniser needs for an identity, and for correcting a wrong one."""

    id_delay_s: float = 0.0
    """Age of a track from which on it has an identity."""
    wrong_id_share: float = 0.5
    """Share of a track, after that, in which an identity that is wrong is believed; 1: to its end."""


@dataclass(frozen=True, eq=False)
class Watched:
    """Detections, each of a landmark, as parts of tracks."""

    landmark: Ints
    """Index of the true landmark of each track, shape (t,)."""
    track: Ints
    """Of each detection, shape (n,), from 0 in the order in which tracks begin."""
    age_s: Floats
    """Of its track at each detection, shape (n,)."""
    lifetime_s: Floats
    """Of each track, shape (t,)."""
    tracking: Tracking

    @classmethod
    def of(cls, landmark: Ints, stamps_ns: Ints, tracking: Tracking) -> Watched:
        """Detections in time order, shapes (n,) and (n,)."""
        track = np.empty(len(landmark), dtype=np.int64)
        newest: dict[int, tuple[int, int]] = {}
        landmarks: list[int] = []
        first_ns: list[int] = []
        for row, (index, stamp_ns) in enumerate(zip(landmark.tolist(), stamps_ns.tolist(), strict=True)):
            number, last_ns = newest.get(index, (-1, 0))
            if number < 0 or stamp_ns - last_ns > LONGEST_GAP_S * 1e9:
                number = len(landmarks)
                landmarks.append(index)
                first_ns.append(stamp_ns)
            newest[index] = number, stamp_ns
            track[row] = number
        age_s = np.asarray((stamps_ns - np.array(first_ns, dtype=np.int64)[track]) * 1e-9, dtype=np.float64)
        lifetime_s = np.zeros(len(landmarks))
        np.maximum.at(lifetime_s, track, age_s)
        return cls(np.array(landmarks, dtype=np.int64), track, age_s, lifetime_s, tracking)

    def is_undecided(self) -> NDArray[np.bool_]:
        """Detections of tracks too young for an identity, shape (n,)."""
        return np.asarray(self.age_s < self.tracking.id_delay_s)

    def believed(self, first_taken_for: Ints) -> Ints:
        """Index of the landmark believed at each detection, shape (n,).

        Parameters
        ----------
        first_taken_for
            Index of the landmark for which each track is taken at first, shape (t,).
        """
        delay_s, share = self.tracking.id_delay_s, self.tracking.wrong_id_share
        corrected_s = delay_s + share * np.maximum(self.lifetime_s - delay_s, 0.0)
        is_corrected = (self.age_s >= corrected_s[self.track]) & (share < 1)
        return np.where(is_corrected, self.landmark[self.track], first_taken_for[self.track])


RECOGNISED_PROBABILITY = 0.97
OTHERS_PROBABILITY = 0.02
UNRECOGNISED_PROBABILITY = 0.20
NO_IDENTITY = -1


@dataclass(frozen=True)
class FieldOfView:
    """The volume which a sonar sees: ranges, and angles either side of the centre beam."""

    range_min_m: float
    range_max_m: float
    azimuth_half_rad: float
    elevation_half_rad: float


@dataclass(frozen=True)
class SimulatedRecogniser:
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
class _DetectionRows:
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


def inside(fan: FieldOfView, points: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
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
    fan: FieldOfView,
    recogniser: SimulatedRecogniser,
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
    points: Floats,
    stamps_ns: Ints,
    fan: FieldOfView,
    recogniser: SimulatedRecogniser,
    sigmas: Floats,
    rng: np.random.Generator,
) -> _DetectionRows:
    """Detections of landmarks that are there."""
    detected = inside(fan, points) & (rng.random(points.shape[:2]) < recogniser.detection_probability)
    frame, landmark = np.nonzero(detected)
    distance, azimuth, _ = range_azimuth_elevation(points[detected])
    range_azimuth = np.column_stack([distance, azimuth]) + sigmas * rng.standard_normal((len(frame), 2))
    count, rate = points.shape[1], recogniser.wrong_id_rate
    if recogniser.tracking is None:
        taken_for = _mistaken(landmark, count, rate, rng)
        return _DetectionRows(frame, range_azimuth, _confident(taken_for, count), np.full(len(frame), NO_TRACK))
    watched = Watched.of(landmark, stamps_ns[frame], recogniser.tracking)
    first_taken_for = _mistaken(watched.landmark, count, rate, rng)
    posterior = _confident(watched.believed(first_taken_for), count)
    posterior[watched.is_undecided()] = 1 / (count + 1)
    return _DetectionRows(frame, range_azimuth, posterior, watched.track)


def _false_rows(
    frames: int, landmarks: int, fan: FieldOfView, recogniser: SimulatedRecogniser, rng: np.random.Generator
) -> _DetectionRows:
    """Detections of nothing."""
    frame = np.repeat(np.arange(frames), rng.poisson(recogniser.false_detections_per_frame, frames))
    count = len(frame)
    distance = rng.uniform(fan.range_min_m, fan.range_max_m, count)
    azimuth = rng.uniform(-fan.azimuth_half_rad, fan.azimuth_half_rad, count)
    confident = rng.random(count) < recogniser.confident_false_fraction
    doubtful = UNRECOGNISED_PROBABILITY * rng.dirichlet(np.ones(landmarks), count)
    certain = _confident(rng.integers(landmarks, size=count), landmarks)
    posterior = np.where(confident[:, None], certain, doubtful)
    return _DetectionRows(frame, np.column_stack([distance, azimuth]), posterior, np.full(count, NO_TRACK))


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
