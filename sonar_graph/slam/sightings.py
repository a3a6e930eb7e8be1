"""From detections to factors: identity, prediction, gate, and the landmark's first appearance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import Calibration, FloorPrior
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.slam import factors
from sonar_graph.slam.association import DetectionJournal, Identities, gate_threshold, identify
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.models import FLOOR_GATE, elevation_on_floor, locate
from sonar_graph.slam.sightlines import Sightline
from sonar_graph.slam.smoother import Smoother
from sonar_graph.slam.view import View
from sonar_graph.states import Outcome

Verdict = tuple[Outcome, Floats | None, Floats | None]
"""What became of a detection, its innovation (2,) and that one's covariance (2, 2); None: nothing was expected."""


@dataclass(frozen=True)
class SightingPolicy:
    """Which detections become factors, and how much an outlier may pull."""

    identity_probability: float
    gate_probability: float
    kernel: Literal["none", "huber", "cauchy"]
    kernel_width: float

    def estimator(self) -> gtsam.noiseModel.mEstimator.Base | None:
        """The robust kernel; None for none."""
        if self.kernel == "huber":
            return gtsam.noiseModel.mEstimator.Huber.Create(self.kernel_width)
        if self.kernel == "cauchy":
            return gtsam.noiseModel.mEstimator.Cauchy.Create(self.kernel_width)
        return None


@dataclass
class Sightings:
    """Adds the factors of detected landmarks to a smoother and records what became of each detection."""

    calibration: Calibration
    policy: SightingPolicy
    smoother: Smoother
    keyframes: Keyframes
    journal: DetectionJournal = field(default_factory=DetectionJournal)
    ids: set[int] = field(default_factory=set)
    """Landmarks in the graph."""

    def __post_init__(self) -> None:
        sonar = self.calibration.sonar
        self._body_T_sonar = sonar.mounting.pose()
        self._default_cov = np.diag([sonar.range_sigma_m**2, sonar.azimuth_sigma_rad**2])
        self._kernel = self.policy.estimator()
        probability = self.policy.gate_probability
        self._gate = gate_threshold(probability, 2) if probability < 1 else np.inf
        self._elevation_sigma_rad = sonar.elevation_aperture_rad / np.sqrt(12.0)

    def add(self, frame: LandmarkDetections) -> None:
        """Take in the detections of one frame."""
        stamp_ns = int(frame.stamps_ns[0])
        unlocated = self.keyframes.newest_ns is None
        if unlocated or stamp_ns < self.keyframes.advanced_ns:
            late = Outcome.UNLOCATED if unlocated else Outcome.LATE
            for landmark_id in frame.most_probable()[0].tolist():
                self.journal.record(stamp_ns, landmark_id, late)
            return
        identities = identify(frame, self.policy.identity_probability)
        verdicts: dict[int, Verdict] = {row: (why, None, None) for row, why in enumerate(identities.refusals) if why}
        if len(verdicts) < len(frame):
            verdicts |= self._use(stamp_ns, self._with_identity(frame, identities))
        for row, landmark_id in enumerate(identities.ids.tolist()):
            self.journal.record(stamp_ns, landmark_id, *verdicts[row])

    def _with_identity(self, frame: LandmarkDetections, identities: Identities) -> Seen:
        rows = [row for row, refusal in enumerate(identities.refusals) if not refusal]
        z = np.column_stack((frame.range_m[rows], frame.azimuth_rad[rows]))
        cov = frame.range_azimuth_cov[rows]
        is_unknown = np.isnan(cov).any(axis=(1, 2))
        if is_unknown.any():
            cov[is_unknown] = self._default_cov
        ids: list[int] = identities.ids[rows].tolist()
        return Seen(rows, ids, [L(i) for i in ids], z, cov)

    def _use(self, stamp_ns: int, seen: Seen) -> dict[int, Verdict]:
        """Add the factors of a frame's landmarks; what became of each, by row."""
        self.keyframes.update_if_due()
        motion = self.keyframes.motion_since_newest(stamp_ns)
        is_known = [i in self.ids for i in seen.ids]
        known, new = seen.where(is_known), seen.where([not known for known in is_known])
        view = self._view(motion, known.keys)
        motion = self.keyframes.set_for_frame(stamp_ns, motion)
        tie = Tie.between(motion, self.keyframes.newest_key, self._body_T_sonar)
        verdicts = self._sight_again(view, tie, known) | self._sight_first(view, tie, new)
        self.keyframes.update_if_due()
        return verdicts

    def _view(self, motion: PreintegratedMotion, landmark_keys: list[int]) -> View:
        key, bias_key = self.keyframes.newest_key, self.keyframes.newest_bias_key
        keys = [key, *landmark_keys] if bias_key is None else [key, bias_key, *landmark_keys]
        return View(
            pose_key=key,
            bias_key=bias_key,
            world_T_keyframe=self.smoother.values.atPose3(key),
            motion=motion,
            body_T_sonar=self._body_T_sonar,
            covariance=self.smoother.joint_covariance(keys),
        )

    def _sight_again(self, view: View, tie: Tie, seen: Seen) -> dict[int, Verdict]:
        """Compare landmarks of the graph with what is expected of them; add what is inside the gate."""
        if not seen.ids:
            return {}
        points = np.array([self.smoother.values.atPoint3(key) for key in seen.keys])
        found = view.compare(seen.keys, points, seen.z, seen.cov)
        inside: list[bool] = (found.distance <= self._gate).tolist()
        self.smoother.waiting_gain += float(found.gain[inside].sum())
        self._add_factors(view, tie, seen.where(inside), points[inside], None)
        outcomes = [Outcome.USED if is_inside else Outcome.GATED for is_inside in inside]
        return dict(zip(seen.rows, zip(outcomes, found.innovation, found.S, strict=True), strict=True))

    def _sight_first(self, view: View, tie: Tie, seen: Seen) -> dict[int, Verdict]:
        """Add landmarks to the graph."""
        for k, (key, landmark_id) in enumerate(zip(seen.keys, seen.ids, strict=True)):
            self.ids.add(landmark_id)
            self._place(view, tie, seen.where([row == k for row in range(len(seen.ids))]), key)
        return dict.fromkeys(seen.rows, (Outcome.NEW, None, None))

    def _place(self, view: View, tie: Tie, seen: Seen, key: int) -> None:
        """Add one landmark where it was seen: on the floor, where it can stand there, else on the centre beam."""
        range_m, azimuth_rad = seen.z[0].tolist()
        floor = self._floor_under(view, range_m, azimuth_rad)
        elevation = self._elevation_on(floor, view, range_m, azimuth_rad)
        point = locate(view.world_T_sonar, range_m, azimuth_rad, elevation)
        self.smoother.add_landmark(key, point)
        self._add_factors(view, tie, seen, point[None], None if floor else self._elevation_sigma_rad)
        on_beam = locate(tie.keyframe_T_sonar, range_m, azimuth_rad, elevation)
        self.smoother.add([factors.first_direction(tie.pose_key, key, on_beam)])
        if floor:
            self.smoother.add([factors.floor_prior(key, floor.z_m, floor.sigma_m)])

    def _floor_under(self, view: View, range_m: float, azimuth_rad: float) -> FloorPrior | None:
        """The known floor, unless it is implausibly far from the point on the centre beam (`FLOOR_GATE`)."""
        floor = self.calibration.floor
        if floor is None:
            return None
        point = locate(view.world_T_sonar, range_m, azimuth_rad, 0.0)
        by_elevation = range_m * view.world_T_sonar.rotation().matrix()[2, 2] * self._elevation_sigma_rad
        variance = by_elevation**2 + view.height_variance(point) + floor.sigma_m**2
        return floor if (point[2] - floor.z_m) ** 2 <= FLOOR_GATE * variance else None

    def _elevation_on(self, floor: FloorPrior | None, view: View, range_m: float, azimuth_rad: float) -> float:
        if floor is None:
            return 0.0
        aperture = self.calibration.sonar.elevation_aperture_rad
        return elevation_on_floor(view.world_T_sonar, range_m, azimuth_rad, floor.z_m, aperture) or 0.0

    def _add_factors(self, view: View, tie: Tie, seen: Seen, points: Floats, elevation_sigma_rad: float | None) -> None:
        added: list[gtsam.NonlinearFactor] = []
        noise = view.blurred(seen.cov, tie.motion, points)
        for key, z, R in zip(seen.keys, seen.z, noise, strict=True):
            self.smoother.sightlines.add(key, Sightline(tie.pose_key, tie.keyframe_T_sonar, z))
            added += factors.landmark_sighting(
                tie.pose_key, key, tie.keyframe_T_sonar, z, R, self._robust, elevation_sigma_rad
            )
        self.smoother.add(added)

    def _robust(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """The noise model inside the chosen robust kernel."""
        return gtsam.noiseModel.Robust.Create(self._kernel, noise) if self._kernel else noise


@dataclass(frozen=True, eq=False)
class Seen:
    """Detections of one frame that have an identity, each its own."""

    rows: list[int]
    """In the frame, length m."""
    ids: list[int]
    keys: list[int]
    """Of the landmarks in the graph."""
    z: Floats
    """Range (m) and azimuth (rad), shape (m, 2)."""
    cov: Floats
    """Their noise, shape (m, 2, 2)."""

    def where(self, chosen: list[bool]) -> Seen:
        """Those that are chosen."""
        if all(chosen):
            return self
        at = [k for k, is_chosen in enumerate(chosen) if is_chosen]
        rows, ids, keys = ([column[k] for k in at] for column in (self.rows, self.ids, self.keys))
        return Seen(rows, ids, keys, self.z[at], self.cov[at])


@dataclass(frozen=True, eq=False)
class Tie:
    """How a frame hangs on the keyframe that gets its factors."""

    pose_key: int
    motion: PreintegratedMotion
    """From that keyframe to the frame; its noise blurs the sightings."""
    keyframe_T_sonar: gtsam.Pose3
    """The sonar at the frame, in the keyframe's body frame."""

    @classmethod
    def between(cls, motion: PreintegratedMotion, pose_key: int, body_T_sonar: gtsam.Pose3) -> Tie:
        """Tie by a motion and the sonar's mounting."""
        return cls(pose_key, motion, motion.i_T_j.compose(body_T_sonar))
