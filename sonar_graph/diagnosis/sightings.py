"""Changes of range and azimuth between two sightings of a landmark, measured and by the motion of the body."""

from dataclasses import dataclass

import numpy as np

from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.signals import SignalStretch
from sonar_graph.measurements import Floats, Ints, LandmarkDetections
from sonar_graph.models import wrap_angle
from sonar_graph.sequence import Sequence

PAIR_S = 1.0
"""Time between two sightings of a landmark that are compared: long enough to move."""
LONGEST_PAIR_S = 3.0
"""And short enough to turn little."""
FEWEST_PAIRS = 20
FEWEST_LANDMARKS = 2
"""Landmarks that tell a current, or a turn of the sonar."""
PASSAGE_S = 10.0
"""Time in which a landmark stays above or below the sonar."""


def sighting_pairs(seen: LandmarkDetections, t: Floats, last_s: float) -> Ints | None:
    """Rows of the first and the next sighting of a landmark, shape (k, 2), by the time of the next; None: too few.

    ``t``: times of the detections; those before 0 or after ``last_s`` are left out.
    """
    ids = seen.most_probable()[0]
    is_usable = seen.are_sound() & (t >= 0) & (t <= last_s) & (ids >= 0)
    pairs = [np.zeros((0, 2), int)]
    for landmark_id in np.unique(ids[is_usable]).tolist():
        rows = np.flatnonzero(is_usable & (ids == landmark_id))
        next_row = np.searchsorted(t[rows], t[rows] + PAIR_S)
        later = rows[np.minimum(next_row, len(rows) - 1)]
        apart_s = t[later] - t[rows]
        is_pair = (apart_s >= PAIR_S) & (apart_s <= LONGEST_PAIR_S)
        pairs.append(np.column_stack([rows, later])[is_pair])
    found = np.concatenate(pairs)
    if len(found) < FEWEST_PAIRS:
        return None
    return found[np.argsort(t[found[:, 1]], kind="stable")]


@dataclass(frozen=True, eq=False)
class SightingChanges:
    """Changes between two sightings with those by the motion as reference."""

    range: SignalStretch
    azimuth: SignalStretch
    error_by_elevation: float
    """Error of the gain of ranges for each radian of the landmarks' elevation."""


def sighting_changes(
    sequence: Sequence, motion: BodyMotion, sign: float = 1.0
) -> SightingChanges | None:
    """Changes of all pairs; None: too few.

    With p = l + r u the landmark in the body, u the direction, l the sonar's place, and the body moved by d and turned
    by R: ``p_j = R' (p_i - d)``. Elevations are taken as zero; azimuths count with a ``sign``.
    """
    seen = sequence.detections
    if seen is None:
        return None
    t = motion.since_origin(seen.stamps_ns)
    pairs = sighting_pairs(seen, t, motion.seconds[-1])
    if pairs is None:
        return None
    i, j = pairs.T
    ids = seen.most_probable()[0]
    # the height of a single one bends its ranges as a current or a turn of the sonar does
    are_enough = len(np.unique(ids[i])) >= FEWEST_LANDMARKS
    mounting = sequence.calibration.sonar.mounting.pose()
    R = mounting.rotation().matrix()  # body_R_sonar
    lever = mounting.translation()
    # a sonar's image has no elevation: landmarks are taken as level with it
    azimuth = sign * seen.azimuth_rad[i]

    def place_of(azimuth: Floats) -> Floats:
        """Landmarks in the body at the first sighting, shape (k, 3)."""
        ahead = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
        return lever + (seen.range_m[i, None] * ahead) @ R.T

    as_seen = place_of(azimuth)
    to_the_left = place_of(azimuth + np.pi / 2)
    path = motion.reference(motion.path_m)
    yaw = motion.turned
    height = motion.reference(motion.height_m)

    def after(at: Floats, place: Floats = as_seen) -> Floats:
        """Landmarks in the sonar at the second sighting, at times of any shape (..., k); NaN: unknown."""
        t_j = np.asarray(at)
        t_i = t_j - (t[j] - t[i])
        # level, in axes of the body at the first sighting
        moved = (path(t_j) - path(t_i)) * np.exp(-1j * yaw(t_i))
        turned = np.exp(-1j * (yaw(t_j) - yaw(t_i)))
        level = (place[:, 0] + 1j * place[:, 1] - moved) * turned
        z = place[:, 2] - (height(t_j) - height(t_i))
        found = (np.stack([level.real, level.imag, z], axis=-1) - lever) @ R
        # a hole between the two sightings makes the motion unknown
        found[motion.part_at(t_i) != motion.part_at(t_j)] = np.nan
        return np.asarray(found)

    def by_range(at: Floats, place: Floats = as_seen) -> Floats:
        found = after(at, place)
        return np.linalg.norm(found, axis=-1) - seen.range_m[i]

    def by_azimuth(at: Floats) -> Floats:
        found = after(at)
        turned = np.arctan2(found[..., 1], found[..., 0]) - azimuth
        return wrap_angle(turned)

    def by_others(at: Floats) -> Floats:
        """What a current of 1 m/s along each axis of the path, and a height of sqrt(2) m, take off a range, shape (k, 4).

        The last column is the change of a range whose landmark is 90 degrees to the left.

        A landmark at a height h over the sonar comes nearer by cos(e) times as much, ``1 - h^2 / (2 r^2)``.
        """
        level = as_seen[:, 0] + 1j * as_seen[:, 1]
        towards = level * np.exp(1j * yaw(at - (t[j] - t[i]))) / np.abs(level)
        apart_s = (t[j] - t[i])[:, None]
        of_height = by_range(at) / seen.range_m[i] ** 2
        by_current = apart_s * np.column_stack([towards.real, towards.imag])
        turned = by_range(at, to_the_left)
        if not are_enough:
            by_current = np.zeros_like(by_current)
            turned = np.zeros_like(turned)
        return np.column_stack([-by_current, -of_height, turned])

    changed = wrap_angle(sign * seen.azimuth_rad[j] - azimuth)
    longer = seen.range_m[j] - seen.range_m[i]
    climbed = np.asarray(height(t[j]) - height(t[i]), np.float64)
    passage_of = np.stack([ids[i], t[j] // PASSAGE_S])
    passage = np.unique(passage_of, axis=1, return_inverse=True)[1].ravel()
    return SightingChanges(
        SignalStretch(t[j], longer, by_range, has_offset=False, beside=by_others),
        SignalStretch(t[j], changed, by_azimuth, has_offset=False),
        by_climb(by_range(t[j]), climbed, passage),
    )


def by_climb(longer: Floats, climbed: Floats, passage: Ints) -> float:
    """Error of the gain of ranges for each radian of elevation e, of k pairs: changes of range, height, and a number.

    A vehicle that climbs by dz comes nearer by ``sin(e) dz``, which least squares take for ``sum e dz dr / sum dr^2``.
    During one passage of a landmark e has one sign; a vehicle that dives along its way has the same one at all of them.
    """
    is_known = np.isfinite(longer) & np.isfinite(climbed)
    dr = np.where(is_known, longer, 0.0)
    dz = np.where(is_known, climbed, 0.0)
    of_passages = np.bincount(passage, weights=dz * dr)
    return float(np.abs(of_passages).sum() / max(dr @ dr, 1e-12))
