"""Landmark detections of an imaging sonar with a recogniser, over a flat floor with landmarks.

World z points up with z = 0 at the water's surface. A landmark is seen when it lies inside the sonar's fan, by exact
three-dimensional geometry. Of those seen a share is missed, of those detected a share gets another's identity, and some
detections are false, independently from frame to frame.

A recogniser that tracks has one opinion about a track, uninterrupted detections of one landmark, which ends when the
landmark was not detected for `LONGEST_GAP_S`. Until a track is ``id_delay_s`` old it has no identity. Some tracks then
have a wrong one for a share of the rest of the track, and the right one after that. docs/theory/simulation.md
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sonar_graph.calibration import Section, SonarCalibration
from sonar_graph.measurements import NO_TRACK, Floats, Ints, LandmarkDetections
from sonar_graph.simulation.sensors import body_R_sensor, seconds_since_start
from sonar_graph.simulation.vehicle import VehiclePath
from sonar_graph.states import LandmarkMap


@dataclass(frozen=True, eq=False)
class World:
    """A flat floor and its landmarks."""

    landmark_ids: Ints
    """Shape (m,), each once, ascending."""
    landmark_positions: Floats
    """Shape (m, 3), metres."""
    floor_z_m: float
    """Height of the floor."""

    def landmark_map(self) -> LandmarkMap:
        """The true landmarks; truth has no covariances (NaN)."""
        return LandmarkMap(
            self.landmark_ids,
            self.landmark_positions,
            np.full((len(self.landmark_ids), 3, 3), np.nan),
        )


def world_on_floor(
    xy_m: Floats, floor_z_m: float, height_sigma_m: float, rng: np.random.Generator
) -> World:
    """Landmarks with IDs 1, 2, ... whose heights are drawn around that of the floor.

    Estimators are given the floor prior N(floor_z_m, height_sigma_m²), from which the heights are drawn: landmarks
    exactly on the floor would make every estimator look too cautious. Horizontal positions have the shape (m, 2).
    """
    # drawn even where the sigma is 0, so that other draws stay as they were
    heights = floor_z_m + height_sigma_m * rng.standard_normal(len(xy_m))
    return World(
        np.arange(1, len(xy_m) + 1), np.column_stack([xy_m, heights]), floor_z_m
    )


LONGEST_GAP_S = 1.0
"""Longer without a detection ends a track."""


@dataclass(frozen=True, eq=False)
class Watched:
    """Detections of landmarks, divided into tracks."""

    landmark: Ints
    """Index of the true landmark of each track, shape (t,)."""
    track: Ints
    """Track of each detection, shape (n,), from 0 in the order in which tracks begin."""
    age_s: Floats
    """Age of its track at each detection, shape (n,)."""
    lifetime_s: Floats
    """Duration of each track, shape (t,)."""

    @classmethod
    def of(cls, landmark: Ints, stamps_ns: Ints) -> Watched:
        """Divide detections in time order, landmark index and stamp each (n,), into tracks."""
        track = np.empty(len(landmark), dtype=np.int64)
        newest: dict[int, tuple[int, int]] = {}
        landmarks: list[int] = []
        first_ns: list[int] = []
        for row, (index, stamp_ns) in enumerate(
            zip(landmark.tolist(), stamps_ns.tolist(), strict=True)
        ):
            number, last_ns = newest.get(index, (-1, 0))
            # first seen, or seen again after too long: a new track
            if number < 0 or stamp_ns - last_ns > LONGEST_GAP_S * 1e9:
                number = len(landmarks)
                landmarks.append(index)
                first_ns.append(stamp_ns)
            newest[index] = number, stamp_ns
            track[row] = number
        age_s = np.asarray(
            (stamps_ns - np.array(first_ns, dtype=np.int64)[track]) * 1e-9,
            dtype=np.float64,
        )
        lifetime_s = np.zeros(len(landmarks))
        np.maximum.at(lifetime_s, track, age_s)
        return cls(np.array(landmarks, dtype=np.int64), track, age_s, lifetime_s)


RECOGNISED_PROBABILITY = 0.97
OTHERS_PROBABILITY = 0.02
UNRECOGNISED_PROBABILITY = 0.20
NO_IDENTITY = -1


@dataclass(frozen=True)
class FieldOfView:
    """Fan of a sonar: ranges, and angles either side of the centre beam."""

    range_min_m: float
    range_max_m: float
    azimuth_half_rad: float
    elevation_half_rad: float


@dataclass(frozen=True)
class SimulatedRecogniser:
    """Rates of the detector's and recogniser's errors."""

    detection_probability: float = 1.0
    """Of a landmark inside the fan, in each frame."""
    wrong_id_rate: float = 0.0
    """Share of the detected landmarks taken for another one, with the confidence of a right one."""
    false_detections_per_frame: float = 0.0
    """Mean number (Poisson), uniform over range and azimuth."""
    confident_false_fraction: float = 0.0
    """Share of the false detections taken for a landmark, with the confidence of a right one."""
    anonymous_share: float = 0.0
    """Share of all detections without any identity."""
    tracks: bool = False
    """Landmarks are watched over frames; off: each frame stands for itself."""
    id_delay_s: float = 0.0
    """Age of a track at which it gets an identity."""
    wrong_id_share: float = 0.5
    """Share of the rest of a track for which a wrong identity is kept; 1: to its end."""

    @classmethod
    def of(cls, options: Section) -> SimulatedRecogniser:
        """The rates that some options have."""
        return cls(**options.model_dump(include={field.name for field in fields(cls)}))


def landmarks_in_sonar(
    path: VehiclePath, stamps_ns: Ints, sonar: SonarCalibration, world: World
) -> Floats:
    """Position of every landmark in the sonar's frame at every instant, shape (n, m, 3), m."""
    motion = path.at(seconds_since_start(stamps_ns))
    world_R_sonar = motion.world_R_body * body_R_sensor(sonar.mounting)
    sonar_origin = motion.position + motion.world_R_body.apply(
        np.array(sonar.mounting.translation_m)
    )
    from_sonar = world.landmark_positions[None] - sonar_origin[:, None]
    return np.einsum("nji,nmj->nmi", world_R_sonar.as_matrix(), from_sonar)


def range_azimuth_elevation(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Polar coordinates of points in the sonar's frame (last axis 3): |q|, atan2(q_y, q_x), asin(q_z / |q|)."""
    distance = np.linalg.norm(points, axis=-1)
    return (
        distance,
        np.arctan2(points[..., 1], points[..., 0]),
        np.arcsin(points[..., 2] / distance),
    )


def inside(
    fan: FieldOfView, points: Floats
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """True for points of the sonar's frame (last axis 3) inside the fan."""
    distance, azimuth, elevation = range_azimuth_elevation(points)
    return (
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
    (0.01 is "none of them"); that of a false one is 0.20 spread at random over all landmarks (0.80 is "none").
    False detections belong to no track. Path and world are the truth; there is one stamp a frame, shape (n,).
    """
    # false detections leave those of landmarks as they were
    true_rng, false_rng = rng.spawn(2)
    frames = len(stamps_ns)
    landmarks = len(world.landmark_ids)
    sigmas = np.array([sonar.range_sigma_m, sonar.azimuth_sigma_rad])

    points = landmarks_in_sonar(path, stamps_ns, sonar, world)
    detected = inside(fan, points) & (
        true_rng.random(points.shape[:2]) < recogniser.detection_probability
    )
    true_frame, landmark = np.nonzero(detected)
    true_distance, true_azimuth, _ = range_azimuth_elevation(points[detected])
    true_views = np.column_stack([true_distance, true_azimuth])
    true_views = true_views + sigmas * true_rng.standard_normal((len(true_frame), 2))
    if recogniser.tracks:
        watched = Watched.of(landmark, stamps_ns[true_frame])
        true_track = watched.track
        delay_s = recogniser.id_delay_s
        share = recogniser.wrong_id_share
        first_taken_for = _mistaken(
            watched.landmark, landmarks, recogniser.wrong_id_rate, true_rng
        )
        # a wrong identity is revised after its share of the rest of the track
        corrected_s = delay_s + share * np.maximum(watched.lifetime_s - delay_s, 0.0)
        is_corrected = (watched.age_s >= corrected_s[true_track]) & (share < 1)
        believed = np.where(
            is_corrected, watched.landmark[true_track], first_taken_for[true_track]
        )
        true_posterior = _confident(believed, landmarks)
        # no identity yet: all landmarks and "none of them" are alike
        true_posterior[watched.age_s < delay_s] = 1 / (landmarks + 1)
    else:
        taken_for = _mistaken(landmark, landmarks, recogniser.wrong_id_rate, true_rng)
        true_posterior = _confident(taken_for, landmarks)
        true_track = np.full(len(true_frame), NO_TRACK)

    false_frame = np.repeat(
        np.arange(frames),
        false_rng.poisson(recogniser.false_detections_per_frame, frames),
    )
    count = len(false_frame)
    false_distance = false_rng.uniform(fan.range_min_m, fan.range_max_m, count)
    false_azimuth = false_rng.uniform(
        -fan.azimuth_half_rad, fan.azimuth_half_rad, count
    )
    is_confident = false_rng.random(count) < recogniser.confident_false_fraction
    doubtful = UNRECOGNISED_PROBABILITY * false_rng.dirichlet(np.ones(landmarks), count)
    certain = _confident(false_rng.integers(landmarks, size=count), landmarks)
    false_posterior = np.where(is_confident[:, None], certain, doubtful)

    frame = np.concatenate([true_frame, false_frame])
    if not len(frame):
        return None
    # rows of a frame keep their order: landmarks before false ones
    order = np.argsort(frame, kind="stable")
    views = np.concatenate(
        [true_views, np.column_stack([false_distance, false_azimuth])]
    )[order]
    is_anonymous = rng.spawn(1)[0].random((len(frame), 1)) < recogniser.anonymous_share
    id_probability = np.concatenate([true_posterior, false_posterior])[order]
    return LandmarkDetections(
        stamps_ns=stamps_ns[frame[order]],
        range_m=views[:, 0],
        azimuth_rad=views[:, 1],
        range_azimuth_cov=np.tile(np.diag(sigmas**2), (len(frame), 1, 1)),
        candidate_ids=np.where(is_anonymous, NO_IDENTITY, world.landmark_ids),
        id_probability=np.where(is_anonymous, 0.0, id_probability),
        track=np.concatenate([true_track, np.full(count, NO_TRACK)])[order],
    )


def _mistaken(
    landmark: Ints, landmarks: int, rate: float, rng: np.random.Generator
) -> Ints:
    """Index of the landmark that each is taken for: at the given rate another one, all equally likely."""
    others = landmarks - 1
    if not others:
        return landmark
    wrong = rng.random(len(landmark)) < rate
    # a shift by 1 or more never ends at the landmark itself
    shift = rng.integers(1, others + 1, size=len(landmark))
    return np.where(wrong, (landmark + shift) % landmarks, landmark)


def _confident(landmark: Ints, landmarks: int) -> Floats:
    """Posterior of a recogniser that is sure of a landmark's index, shape (n, landmarks)."""
    others = OTHERS_PROBABILITY / max(landmarks - 1, 1)
    posterior = np.full((len(landmark), landmarks), others)
    posterior[np.arange(len(landmark)), landmark] = RECOGNISED_PROBABILITY
    return posterior
