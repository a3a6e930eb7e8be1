"""One detection, tied to a keyframe, and the factors that it becomes.

A sighting holds only what was measured, not what was believed of the landmark when it was made. Its factors are thus
the same whenever they are made, and for whichever landmark.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass

import gtsam

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats
from sonar_graph.slam import factors
from sonar_graph.slam.models import elevation_on_floor, locate
from sonar_graph.slam.sightlines import Sightline
from sonar_graph.states import Outcome


@dataclass(eq=False, slots=True)
class Sighting:
    """Range and azimuth of something, seen from a keyframe."""

    stamp_ns: int
    row: int
    """In the journal."""
    line: Sightline
    noise: Floats
    """Covariance of range and azimuth, with that of the motion since the keyframe, shape (2, 2)."""
    floor: FloorPrior | None
    """On which it may stand, judged from where it was seen."""
    elevation_rad: float = 0.0
    """Of its direction, when a landmark begins with it."""
    landmark_id: int | None = None
    """Of which it is a sighting; None: not of any."""
    handles: tuple[int, ...] = ()
    """Of its factors."""
    outcome: Outcome = Outcome.WAITING
    """What has become of it so far."""


class SightingFactors:
    """Makes the factors of sightings.

    Parameters
    ----------
    sonar
        For its vertical aperture.
    robust
        Wraps a noise model in the chosen kernel.
    """

    def __init__(self, sonar: SonarCalibration, robust: factors.Robust) -> None:
        self.elevation_sigma_rad = sonar.elevation_aperture_rad / math.sqrt(12.0)
        """Standard deviation of an elevation that is uniform over the aperture."""
        self._aperture_rad = sonar.elevation_aperture_rad
        self._robust = robust

    def without_kernel(self) -> SightingFactors:
        """One that makes the same factors with Gaussian noise."""
        plain = copy(self)
        plain._robust = lambda noise: noise
        return plain

    def make(self, sighting: Sighting, key: int, *, is_first: bool) -> list[gtsam.NonlinearFactor]:
        """Range and azimuth; the first sighting of a landmark also says what is known of its height and direction."""
        elevation = None if sighting.floor or not is_first else self.elevation_sigma_rad
        made = self._measured(sighting, key, elevation)
        return [*made, *(self._placed(sighting, key) if is_first else [])]

    def measured(self, sighting: Sighting, key: int) -> list[gtsam.NoiseModelFactor]:
        """Range and azimuth alone."""
        return self._measured(sighting, key, None)

    def beginning(self, sighting: Sighting, key: int) -> list[gtsam.NonlinearFactor]:
        """What the first sighting of a landmark says beside range and azimuth, with a kernel as they have it."""
        line = sighting.line
        if sighting.floor:
            return self._placed(sighting, key)
        elevation = factors.elevation(
            line.pose_key, key, line.body_T_sonar, float(line.z[1]), self.elevation_sigma_rad, self._robust
        )
        return [elevation, *self._placed(sighting, key)]

    def _measured(
        self, sighting: Sighting, key: int, elevation_sigma_rad: float | None
    ) -> list[gtsam.NoiseModelFactor]:
        line = sighting.line
        return factors.landmark_sighting(
            line.pose_key, key, line.body_T_sonar, line.z, sighting.noise, self._robust, elevation_sigma_rad
        )

    def _placed(self, sighting: Sighting, key: int) -> list[gtsam.NonlinearFactor]:
        """Where, and on which floor, a landmark is said to be once."""
        line = sighting.line
        range_m, azimuth_rad = line.z.tolist()
        on_beam = locate(line.body_T_sonar, range_m, azimuth_rad, sighting.elevation_rad)
        made = [factors.first_direction(line.pose_key, key, on_beam)]
        if sighting.floor:
            made.append(factors.floor_prior(key, sighting.floor.z_m, sighting.floor.sigma_m))
        return made

    def place(self, sighting: Sighting, values: gtsam.Values) -> Floats:
        """Where a landmark that begins with this sighting is to start: on its floor, else on the centre beam."""
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
