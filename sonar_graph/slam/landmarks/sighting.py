"""Detections of a frame, the sightings that are made of them, and the factors of a sighting.

A sighting is a detection tied to a keyframe. It contains only what was measured, so that its factors are the same
whenever they are made and for whichever landmark. Factors that a landmark has only once (direction, elevation or floor)
belong to its earliest sighting (docs/theory/identities.md).
"""

import math
from dataclasses import dataclass, replace
from itertools import compress

import gtsam
import numpy as np

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import FLOOR_GATE, Robust, elevation_on_floor, locate
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.slam import factors
from sonar_graph.slam.prediction import PredictedView, Tie
from sonar_graph.slam.smoother import Factors, JointCovariance, Known, Sightline
from sonar_graph.states import Outcome

STILL = PreintegratedMotion(
    gtsam.Pose3(),
    np.zeros((6, 6)),
    np.zeros((6, 3)),
    np.zeros(3),
    0.0,
    mean_specific_force=np.full(3, np.nan),
)
"""No motion: the motion between keyframe and sonar is already part of a sighting."""


@dataclass(frozen=True, eq=False, slots=True)
class Sighting:
    """Range and azimuth of an object, seen from a keyframe."""

    stamp_ns: int
    row: int
    """Row in the journal."""
    line: Sightline
    noise: Floats
    """Covariance of range and azimuth, with that of the motion since the keyframe, shape (2, 2)."""
    floor: FloorPrior | None = None
    """Floor on which the object may stand, judged from where it was seen."""
    elevation_rad: float = 0.0
    """Elevation of its direction when a landmark begins with it."""


class SightingFactors:
    """Makes the factors of sightings, with noise models that a kernel wraps."""

    def __init__(
        self, sonar: SonarCalibration, robust: Robust, floor: FloorPrior | None = None
    ) -> None:
        self.elevation_sigma_rad = sonar.elevation_aperture_rad / math.sqrt(12.0)
        """Standard deviation of an elevation that is uniform over the aperture."""
        self.body_T_sonar = sonar.mounting.pose()
        """Sonar on the body."""
        self.floor = floor
        """Known floor."""
        self._aperture_rad = sonar.elevation_aperture_rad
        self._robust = robust

    def make(self, sighting: Sighting, key: int, *, is_first: bool) -> Factors:
        """Range and azimuth; for the first sighting of a landmark also its direction, and its elevation or floor."""
        line = sighting.line
        elevation = (
            self.elevation_sigma_rad if is_first and sighting.floor is None else None
        )
        # once for each landmark, and only where no floor gives the height
        made: Factors = {
            **factors.landmark_sighting(
                line.pose_key,
                key,
                line.body_T_sonar,
                line.z,
                sighting.noise,
                self._robust,
                elevation,
            )
        }
        if is_first:
            # in the keyframe's body frame
            body_p_landmark = locate(
                line.body_T_sonar, line.z[0], line.z[1], sighting.elevation_rad
            )
            made["first direction"] = factors.first_direction(
                line.pose_key, key, body_p_landmark
            )
        if is_first and sighting.floor is not None:
            made["floor prior"] = factors.floor_prior(
                key, sighting.floor.z_m, sighting.floor.sigma_m
            )
        return made

    def start(self, sighting: Sighting, values: Known) -> Floats:
        """First estimate of a landmark that begins with this sighting: on its floor, else on the centre beam."""
        line = sighting.line
        world_T_sonar = values.atPose3(line.pose_key).compose(line.body_T_sonar)
        elevation_rad = self.elevation_on(sighting.floor, world_T_sonar, line.z)
        return locate(world_T_sonar, line.z[0], line.z[1], elevation_rad)

    def elevation_on(
        self, floor: FloorPrior | None, world_T_sonar: gtsam.Pose3, z: Floats
    ) -> float:
        """Elevation (rad) of a floor at a range and azimuth; 0 without a floor in the aperture."""
        if floor is None:
            return 0.0
        return (
            elevation_on_floor(world_T_sonar, z[0], z[1], floor.z_m, self._aperture_rad)
            or 0.0
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """Detections of one frame that may become sightings."""

    detections: LandmarkDetections
    stamp_ns: int
    rows: list[int]
    """Rows of the detections in the journal."""
    ids: list[int]
    """Most probable identity of each detection."""
    tracks: list[int]
    """Track of each detection, or `NO_TRACK`."""
    refusals: list[Outcome | None]
    """Reason why that identity is not accepted; None: it is."""
    z: Floats
    """Range (m) and azimuth (rad), shape (m, 2)."""
    noise: Floats
    """Covariance of range and azimuth, shape (m, 2, 2)."""

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, is_in: list[bool]) -> "Frame | None":
        """Some of the detections; None for an empty selection."""
        if all(is_in):
            return self
        if not any(is_in):
            return None
        mask = np.array(is_in)
        return replace(
            self,
            detections=self.detections.rows(mask),
            rows=list(compress(self.rows, is_in)),
            ids=list(compress(self.ids, is_in)),
            tracks=list(compress(self.tracks, is_in)),
            refusals=list(compress(self.refusals, is_in)),
            z=self.z[mask],
            noise=self.noise[mask],
        )


@dataclass(eq=False)
class SeenFrame:
    """Detections of a frame, with their prediction and the keyframe to which their sightings are tied."""

    frame: Frame
    view: PredictedView
    """Prediction from the newest keyframe of the window."""
    keys: list[int]
    """Variables whose joint covariance with that keyframe the prediction has."""
    tie: Tie
    """Keyframe of the sightings; newer than that of the prediction where the frame needed one."""
    taken: frozenset[int]
    """Landmarks that other detections of the frame show."""
    factors: SightingFactors

    def __post_init__(self) -> None:
        self._points, height_variance = self.view.beams(self.frame.z)
        self.floors = self._floors_under(height_variance)
        """Known floor of each detection; None where it is too far from the point on the centre beam (`FLOOR_GATE`)."""

    def beam_points(self, rows: list[int]) -> Floats:
        """Points of the world at the measured range and azimuth and elevation 0, shape (len(rows), 3), m."""
        return self._points[rows]

    def sightings(
        self, rows: list[int], points: Floats, elevation_rad: float = 0.0
    ) -> list[Sighting]:
        """Sightings of some detections.

        Parameters
        ----------
        points
            Of the world, shape (len(rows), 3): the motion's noise is taken there.
        elevation_rad
            See `Sighting`.
        """
        if not rows:
            return []
        frame = self.frame
        keyframe_T_sonar = self.tie.motion.i_T_j.compose(self.factors.body_T_sonar)
        # from here on the sonar hangs on the keyframe without error: the motion's error becomes noise
        noise = self.view.blurred(frame.noise[rows], self.tie.motion, points)
        return [
            Sighting(
                stamp_ns=frame.stamp_ns,
                row=frame.rows[row],
                line=Sightline(self.tie.pose_key, keyframe_T_sonar, frame.z[row]),
                noise=R,
                floor=self.floors[row],
                elevation_rad=elevation_rad,
            )
            for row, R in zip(rows, noise, strict=True)
        ]

    def _floors_under(self, height_variance: Floats) -> list[FloorPrior | None]:
        floor = self.factors.floor
        if floor is None:
            return [None] * len(self.frame)
        # an elevation of e raises the point by e times the range along the sonar's z axis
        slope_m = self.frame.z[:, 0] * self.view.world_T_sonar.rotation().matrix()[2, 2]
        by_elevation = np.square(slope_m * self.factors.elevation_sigma_rad)
        variance = by_elevation + height_variance + floor.sigma_m**2
        # an object on a wall or a wreck must not be pulled to the floor
        is_on_floor = np.square(self._points[:, 2] - floor.z_m) <= FLOOR_GATE * variance
        return [floor if is_on else None for is_on in is_on_floor.tolist()]


def late_view(
    sighting: Sighting, values: Known, joint: JointCovariance
) -> PredictedView:
    """Prediction of an earlier frame from the keyframe of a sighting, as it is estimated now."""
    line = sighting.line
    return PredictedView(
        Tie(line.pose_key, None, STILL),
        values.atPose3(line.pose_key),
        line.body_T_sonar,
        joint,
    )
