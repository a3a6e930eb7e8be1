"""Sightings: detections tied to keyframes, the points that they place and the factors that they become.

A sighting holds only what was measured. Its factors are the same whenever they are made, and for whichever landmark;
what is said of a landmark once is said by its earliest sighting (docs/theory/identities.md).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.models import (
    FLOOR_GATE,
    Robust,
    elevation_on_floor,
    locate,
    locate_jacobians,
    range_azimuth_jacobians,
    wrap_angle,
)
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.slam import factors
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.prediction import PredictedView, Source
from sonar_graph.slam.smoother import Factors, JointCovariance, Sightline
from sonar_graph.states import Outcome

STILL = PreintegratedMotion(
    gtsam.Pose3(), np.zeros((6, 6)), np.zeros((6, 3)), np.zeros(3), 0.0, mean_specific_force=np.full(3, np.nan)
)
"""No motion: a sighting contains that between keyframe and sonar already."""


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
    outcome: Outcome | None = None
    """Present state, of which `LandmarkGraph` is the only writer; None: not judged yet."""
    landmark_id: int | None = None
    """Landmark of which it is a sighting; None where it is not in the graph."""
    handle: int | None = None
    """Handle of its factors in the smoother."""


def beam_point(world_T_sonar: gtsam.Pose3, z: Floats, elevation_rad: float = 0.0) -> Floats:
    """Point of the world at a range (m), an azimuth and an elevation (rad), shape (3,), m."""
    return locate(world_T_sonar, float(z[0]), float(z[1]), elevation_rad)


class SightingFactors:
    """Makes the factors of sightings, with noise models that a kernel wraps."""

    def __init__(self, sonar: SonarCalibration, robust: Robust) -> None:
        self.elevation_sigma_rad = sonar.elevation_aperture_rad / math.sqrt(12.0)
        """Standard deviation of an elevation that is uniform over the aperture."""
        self._aperture_rad = sonar.elevation_aperture_rad
        self.body_T_sonar = sonar.mounting.pose()
        """Sonar on the body."""
        self._robust = robust

    def make(self, sighting: Sighting, key: int, *, is_first: bool) -> Factors:
        """Range and azimuth; the first sighting of a landmark also says what is known of its height and direction."""
        line, floor = sighting.line, sighting.floor
        elevation = None if floor or not is_first else self.elevation_sigma_rad
        made: Factors = {
            **factors.landmark_sighting(
                line.pose_key, key, line.body_T_sonar, line.z, sighting.noise, self._robust, elevation
            )
        }
        if is_first:
            on_beam = beam_point(line.body_T_sonar, line.z, sighting.elevation_rad)
            made["first direction"] = factors.first_direction(line.pose_key, key, on_beam)
            if floor:
                made["floor prior"] = factors.floor_prior(key, floor.z_m, floor.sigma_m)
        return made

    def place(self, sighting: Sighting, values: gtsam.Values) -> Floats:
        """First estimate of a landmark that begins with this sighting: on its floor, else on the centre beam."""
        world_T_sonar, z = values.atPose3(sighting.line.pose_key).compose(sighting.line.body_T_sonar), sighting.line.z
        return beam_point(world_T_sonar, z, self.elevation_on(sighting.floor, world_T_sonar, z))

    def elevation_on(self, floor: FloorPrior | None, world_T_sonar: gtsam.Pose3, z: Floats) -> float:
        """Elevation (rad) of a floor at a range and azimuth; 0 where there is none, or not in the aperture."""
        if floor is None:
            return 0.0
        return elevation_on_floor(world_T_sonar, float(z[0]), float(z[1]), floor.z_m, self._aperture_rad) or 0.0


class Screened(NamedTuple):
    """Rows of a frame by what is said of them alone."""

    refusals: list[Outcome | None]
    """Reason why a row has no identity; None: it has one, or the policy chooses it by place."""
    waits: list[bool]
    """True: a row without an identity is looked at all the same."""


class SeenFrame:
    """Detections of one frame, seen from the newest keyframe, or from a new one that it needs.

    Attributes
    ----------
    rows
        Rows of the detections in the journal.
    ids, refusals
        Most probable identity of each detection, and the reason why it does not count (`Screened`).
    z, noise
        Range (m) and azimuth (rad), shape (m, 2), and the sonar's covariance of them, shape (m, 2, 2).
    """

    def __init__(
        self,
        detections: LandmarkDetections,
        rows: list[int],
        ids: list[int],
        refusals: list[Outcome | None],
        keyframes: Keyframes,
        factors: SightingFactors,
    ) -> None:
        self.detections, self.rows, self.keyframes = detections, rows, keyframes
        self.ids, self.refusals = ids, refusals
        self.stamp_ns = int(detections.stamps_ns[0])
        self.z = np.array((detections.range_m, detections.azimuth_rad)).T.copy()
        self.noise = detections.range_azimuth_cov
        is_unknown = np.isnan(self.noise).any(axis=(1, 2))
        sonar = keyframes.calibration.sonar
        if is_unknown.any():
            self.noise = self.noise.copy()
            self.noise[is_unknown] = np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2])
        self._factors, self._body_T_sonar = factors, factors.body_T_sonar
        self._tie: tuple[int, PreintegratedMotion] | None = None

    def predict(self, keys: list[int]) -> PredictedView:
        """Prediction from the newest keyframe, with its joint covariance with other variables."""
        keyframes, smoother = self.keyframes, self.keyframes.smoother
        motion = keyframes.motion_since_newest(self.stamp_ns)
        pose_key, bias_key = keyframes.newest_key, keyframes.bias_keys[-1]
        joint = smoother.joint_covariance([pose_key, bias_key, *keys])
        return PredictedView(pose_key, bias_key, smoother.values.atPose3(pose_key), motion, self._body_T_sonar, joint)

    def sightings(self, view: PredictedView, rows: list[int], points: Floats | None = None) -> list[Sighting]:
        """Sightings tied to the newest keyframe, which is set now if the motion since the last one blurs the frame.

        ``points``: of the world at which noise by the motion is taken, shape (len(rows), 3); NaN, or None: at elevation
        0, and then the floor is judged.
        """
        if not rows:
            return []
        if self._tie is None:
            motion = self.keyframes.set_for_frame(self.stamp_ns, self.keyframes.motion_since_newest(self.stamp_ns))
            self._tie = self.keyframes.newest_key, motion
        pose_key, motion = self._tie
        at = np.full((len(rows), 3), np.nan) if points is None else points.copy()
        floors = [self.keyframes.calibration.floor] * len(rows)
        for k in np.flatnonzero(np.isnan(at[:, 0])).tolist():
            at[k] = beam_point(view.world_T_sonar, self.z[rows[k]])
            floors[k] = self.floor_under(view, rows[k])
        noise = view.blurred(self.noise[rows], motion, at)
        keyframe_T_sonar = motion.i_T_j.compose(self._body_T_sonar)
        return [
            Sighting(self.stamp_ns, self.rows[row], Sightline(pose_key, keyframe_T_sonar, self.z[row]), R, floor)
            for row, R, floor in zip(rows, noise, floors, strict=True)
        ]

    def floor_under(self, view: PredictedView, row: int) -> FloorPrior | None:
        """Known floor, or None where it is too far from the point on the centre beam (`FLOOR_GATE`)."""
        floor, range_m = self.keyframes.calibration.floor, float(self.z[row, 0])
        if floor is None:
            return None
        point = beam_point(view.world_T_sonar, self.z[row])
        by_elevation = range_m * view.world_T_sonar.rotation().matrix()[2, 2] * self._factors.elevation_sigma_rad
        variance = by_elevation**2 + view.height_variance(point) + floor.sigma_m**2
        return floor if (point[2] - floor.z_m) ** 2 <= FLOOR_GATE * variance else None


def late_view(sighting: Sighting, values: gtsam.Values, joint: JointCovariance) -> PredictedView:
    """Prediction of an earlier frame from the keyframe of a sighting, as it is estimated now."""
    line = sighting.line
    return PredictedView(line.pose_key, None, values.atPose3(line.pose_key), STILL, line.body_T_sonar, joint)


def source(sighting: Sighting, values: gtsam.Values, maker: SightingFactors) -> Source:
    """The point as located by one sighting.

    With ``p = g(X, range, azimuth, elevation)``: ``cov = g_z diag(R, sigma_e²) g_z'``, sigma_e that of an elevation
    anywhere in the aperture; on a floor narrowed by its height, ``p_z ~ N(floor z, sigma²)``.
    """
    line = sighting.line
    X = values.atPose3(line.pose_key)
    elevation = maker.elevation_on(sighting.floor, X.compose(line.body_T_sonar), line.z)
    point, by_pose, by_polar = locate_jacobians(X, line.body_T_sonar, float(line.z[0]), float(line.z[1]), elevation)
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
