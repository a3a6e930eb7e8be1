"""Sightings: detections tied to keyframes, the factors that they become, and those that are in the graph by landmark.

A sighting holds only what was measured. Its factors are the same whenever they are made, and for whichever landmark.
The earliest sighting of a landmark carries what is said of it once (`SightingFactors`): whatever is put in and taken
out, in whatever order, the graph depends only on which sightings are of which landmark (docs/theory/identities.md).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.slam.models import (
    Source,
    elevation_on_floor,
    factors,
    locate,
    locate_jacobians,
    range_azimuth_jacobians,
    wrap_angle,
)
from sonar_graph.slam.smoother import Changed, FactorGroup, Factors, Sightline, Smoother
from sonar_graph.states import DetectionJournal, Outcome


@dataclass(eq=False, slots=True)
class Sighting:
    """Range and azimuth of an object, seen from a keyframe."""

    stamp_ns: int
    row: int
    """Row in the journal."""
    line: Sightline
    noise: Floats
    """Covariance of range and azimuth, with that of the motion since the keyframe, shape (2, 2)."""
    floor: FloorPrior | None
    """Floor on which it may stand, judged from where it was seen."""
    elevation_rad: float = 0.0
    """Elevation of its direction when a landmark begins with it."""
    landmark_id: int | None = None
    """Landmark of which it is a sighting, or None."""
    handle: int | None = None
    """Handle of its factors in the smoother."""
    outcome: Outcome = Outcome.WAITING
    """Present outcome."""


class SightingFactors:
    """Makes the factors of sightings, with noise models that a kernel wraps."""

    def __init__(self, sonar: SonarCalibration, robust: factors.Robust) -> None:
        self.elevation_sigma_rad = sonar.elevation_aperture_rad / math.sqrt(12.0)
        """Standard deviation of an elevation that is uniform over the aperture."""
        self._aperture_rad = sonar.elevation_aperture_rad
        self._robust = robust

    def without_kernel(self) -> SightingFactors:
        """Maker of the same factors with Gaussian noise."""
        plain = copy(self)
        plain._robust = lambda noise: noise
        return plain

    def make(self, sighting: Sighting, key: int, *, is_first: bool) -> Factors:
        """Range and azimuth; the first sighting of a landmark also says what is known of its height and direction."""
        elevation = None if sighting.floor or not is_first else self.elevation_sigma_rad
        made = self.measured(sighting, key, elevation)
        return {**made, **(self._placed(sighting, key) if is_first else {})}

    def measured(
        self, sighting: Sighting, key: int, elevation_sigma_rad: float | None = None
    ) -> dict[str, gtsam.NoiseModelFactor]:
        """Range and azimuth, and elevation where it has a sigma."""
        line = sighting.line
        return factors.landmark_sighting(
            line.pose_key, key, line.body_T_sonar, line.z, sighting.noise, self._robust, elevation_sigma_rad
        )

    def beginning(self, sighting: Sighting, key: int) -> Factors:
        """Factors of a landmark's first sighting besides range and azimuth, with the same kernel."""
        line = sighting.line
        if sighting.floor:
            return self._placed(sighting, key)
        elevation = factors.elevation(
            line.pose_key, key, line.body_T_sonar, float(line.z[1]), self.elevation_sigma_rad, self._robust
        )
        return {"elevation": elevation, **self._placed(sighting, key)}

    def _placed(self, sighting: Sighting, key: int) -> Factors:
        """Factors on the place and the floor of a landmark, added once."""
        line = sighting.line
        range_m, azimuth_rad = line.z.tolist()
        on_beam = locate(line.body_T_sonar, range_m, azimuth_rad, sighting.elevation_rad)
        made = {"first direction": factors.first_direction(line.pose_key, key, on_beam)}
        if sighting.floor:
            made["floor prior"] = factors.floor_prior(key, sighting.floor.z_m, sighting.floor.sigma_m)
        return made

    def place(self, sighting: Sighting, values: gtsam.Values) -> Floats:
        """First estimate of a landmark that begins with this sighting: on its floor, else on the centre beam."""
        line = sighting.line
        range_m, azimuth_rad = line.z.tolist()
        world_T_sonar = values.atPose3(line.pose_key).compose(line.body_T_sonar)
        elevation = self.elevation_on(sighting.floor, world_T_sonar, range_m, azimuth_rad)
        return locate(world_T_sonar, range_m, azimuth_rad, elevation)

    def elevation_on(
        self, floor: FloorPrior | None, world_T_sonar: gtsam.Pose3, range_m: float, azimuth_rad: float
    ) -> float:
        """Elevation (rad) of a floor at a range and azimuth; 0 where there is none, or not in the aperture."""
        if floor is None:
            return 0.0
        return elevation_on_floor(world_T_sonar, range_m, azimuth_rad, floor.z_m, self._aperture_rad) or 0.0


class LandmarkSightings:
    """Sightings that are in the graph, by landmark."""

    def __init__(self, smoother: Smoother, maker: SightingFactors, journal: DetectionJournal) -> None:
        self.smoother, self.maker, self._journal = smoother, maker, journal
        self._of: dict[int, dict[Sighting, None]] = defaultdict(dict)
        self._rooted: dict[int, Sighting] = {}

    @property
    def ids(self) -> set[int]:
        """Identities of the landmarks in the graph."""
        return set(self._of)

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._of

    def sightings(self, landmark_id: int) -> list[Sighting]:
        """Sightings of a landmark."""
        return list(self._of.get(landmark_id, {}))

    def any_sighting(self, landmark_id: int) -> Sighting:
        """Any sighting of a landmark of the graph."""
        return next(iter(self._of[landmark_id]), None) or self._rooted[landmark_id]

    def is_rooted(self, landmark_id: int) -> bool:
        """True when sightings of it have left a bounded window, so that it stays."""
        return landmark_id in self._rooted

    def sizes(self) -> dict[int, int]:
        """Number of sightings of each landmark; those that are in the graph for good count as one."""
        return {i: len(sightings) + (i in self._rooted) for i, sightings in self._of.items()}

    def stamps_ns(self, landmark_id: int) -> set[int]:
        """Stamps of the frames that show a landmark."""
        return {sighting.stamp_ns for sighting in self._of.get(landmark_id, {})}

    def add(self, sighting: Sighting, landmark_id: int, *, is_first: bool, gain: float = 0.0) -> None:
        """Add a sighting with its factors at the next update."""
        made = self.maker.make(sighting, L(landmark_id), is_first=is_first)
        handle = self.smoother.add(made, (L(landmark_id), sighting.line), gain=gain)
        self._enter(sighting, landmark_id, handle)

    def follow(self, changed: Changed) -> None:
        """Take out sightings that the smoother could not use, and let go of those from poses that left.

        What was seen from poses that left a bounded window is part of the graph for good: its landmark stays, whatever
        becomes of its other sightings, and none of those becomes its first.
        """
        for sighting in [s for sightings in self._of.values() for s in sightings if s.handle in changed.withheld]:
            self._take(sighting)
            sighting.outcome = Outcome.WITHHELD
            if sighting.row >= 0:
                self._journal.amend(sighting.row, Outcome.WITHHELD)
        for landmark, sightings in self._of.items() if changed.left else ():
            gone = [sighting for sighting in sightings if sighting.line.pose_key in changed.left]
            for sighting in gone:
                self._rooted.setdefault(landmark, sighting)
                del sightings[sighting]

    def exchange(self, leaving: Iterable[Sighting], coming: Iterable[tuple[Sighting, int]], time_s: float) -> None:
        """Take sightings out of the graph, and put others in, each for a landmark, in one update of the smoother.

        Where the earliest sighting of a landmark changes, the factors of the old and of the new one are made anew. A
        landmark that loses its last sighting leaves the graph.
        """
        self.follow(self.smoother.flush(time_s))
        out, new = [s for s in leaving if s.landmark_id is not None], list(coming)
        touched = {s.landmark_id for s in out if s.landmark_id is not None} | {landmark for _, landmark in new}
        before = {landmark: self._first(landmark) for landmark in touched}
        removed = [sighting.handle for sighting in out]
        for sighting in out:
            self._take(sighting)
        for sighting, landmark in new:
            self._enter(sighting, landmark, None)
        firsts = {landmark: self._first(landmark) for landmark in before}
        fresh = {sighting for sighting, _ in new}
        again = [  # they stay in, but no longer are, or now are, the first of their landmark
            s
            for landmark, old in before.items()
            if firsts[landmark] is not old
            for s in (old, firsts[landmark])
            if s is not None and s.landmark_id == landmark and s not in fresh
        ]
        removed += [sighting.handle for sighting in again]
        begun = {
            L(landmark): self.maker.place(first, self.smoother.values)
            for landmark, first in firsts.items()
            if first is not None and before[landmark] is None
        }
        lost = [L(landmark) for landmark, first in firsts.items() if first is None and before[landmark] is not None]
        sightings = [sighting for sighting, _ in new] + again
        made = [
            FactorGroup(
                self.maker.make(s, L(s.landmark_id), is_first=s is firsts[s.landmark_id]), (L(s.landmark_id), s.line)
            )
            for s in sightings
            if s.landmark_id is not None
        ]
        changed = self.smoother.exchange(
            time_s, [handle for handle in removed if handle is not None], made, begun, lost
        )
        for sighting, handle in zip(sightings, changed.added, strict=True):
            sighting.handle = handle
        self.follow(changed)

    def _enter(self, sighting: Sighting, landmark_id: int, handle: int | None) -> None:
        sighting.landmark_id, sighting.handle = landmark_id, handle
        self._of[landmark_id][sighting] = None

    def _first(self, landmark_id: int) -> Sighting | None:
        if landmark_id in self._rooted:
            return self._rooted[landmark_id]
        return min(self._of.get(landmark_id, {}), key=lambda s: (s.stamp_ns, s.row), default=None)

    def _take(self, sighting: Sighting) -> None:
        landmark = sighting.landmark_id
        if landmark is None:
            return
        del self._of[landmark][sighting]
        if not self._of[landmark] and landmark not in self._rooted:
            del self._of[landmark]
        sighting.landmark_id = sighting.handle = None


def source(sighting: Sighting, values: gtsam.Values, maker: SightingFactors) -> Source:
    """The point as located by one sighting.

    With ``p = g(X, range, azimuth, elevation)``: ``cov = g_z diag(R, sigma_e²) g_z'``, sigma_e that of an elevation
    anywhere in the aperture; on a floor narrowed by its height, ``p_z ~ N(floor z, sigma²)``.
    """
    line = sighting.line
    range_m, azimuth_rad = line.z.tolist()
    X = values.atPose3(line.pose_key)
    elevation = maker.elevation_on(sighting.floor, X.compose(line.body_T_sonar), range_m, azimuth_rad)
    point, by_pose, by_polar = locate_jacobians(X, line.body_T_sonar, range_m, azimuth_rad, elevation)
    polar_cov = np.zeros((3, 3))
    polar_cov[:2, :2], polar_cov[2, 2] = sighting.noise, maker.elevation_sigma_rad**2
    cov = by_polar @ polar_cov @ by_polar.T
    if sighting.floor is not None:
        cov = cov - np.outer(cov[:, 2], cov[2]) / (cov[2, 2] + sighting.floor.sigma_m**2)
    return Source(line.pose_key, point, by_pose, cov)


def place(sightings: list[Sighting], values: gtsam.Values, maker: SightingFactors) -> tuple[Floats, Floats]:
    """Point of several sightings, shape (3,), m, and its covariance, shape (3, 3), m².

    The first sighting, corrected by the others one after the other::

        K = P H' (H P H' + R)^-1,    p <- p + K (z - h(p)),    P <- (I - K H) P
    """
    first = source(sightings[0], values, maker)
    point, P = first.point, first.cov
    for sighting in sightings[1:]:
        line = sighting.line
        predicted, _, H = range_azimuth_jacobians(values.atPose3(line.pose_key), line.body_T_sonar, point)
        K = np.linalg.solve(H @ P @ H.T + sighting.noise, H @ P).T
        innovation = np.array([line.z[0] - predicted[0], wrap_angle(line.z[1] - predicted[1])])
        point, P = point + K @ innovation, P - K @ H @ P
    return point, P
