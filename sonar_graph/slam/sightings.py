"""From detections to factors: identity, prediction, gate, and the landmark's first appearance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.slam import factors
from sonar_graph.slam.association import DetectionJournal, gate_threshold, identify
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.models import elevation_on_floor, locate
from sonar_graph.slam.smoother import Smoother
from sonar_graph.slam.view import View, weigh
from sonar_graph.states import Outcome


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
        rows = list(zip(range(len(frame)), identities.ids.tolist(), identities.refusals, strict=True))
        if all(refusal for _, _, refusal in rows):
            for _, landmark_id, refusal in rows:
                if refusal:
                    self.journal.record(stamp_ns, landmark_id, refusal)
            return
        self.keyframes.update_if_due()
        seen = self.keyframes.motion_since_newest(stamp_ns)
        view = self._view(seen, {landmark_id for _, landmark_id, refusal in rows if not refusal} & self.ids)
        tie = Tie.between(self.keyframes.set_for_frame(stamp_ns, seen), self.keyframes.newest_key, self._body_T_sonar)
        for row, landmark_id, refusal in rows:
            if refusal:
                self.journal.record(stamp_ns, landmark_id, refusal)
            else:
                self._sight(view, tie, self._sighting(frame, stamp_ns, row, landmark_id))
        self.keyframes.update_if_due()

    def _sighting(self, frame: LandmarkDetections, stamp_ns: int, row: int, landmark_id: int) -> Sighting:
        cov = frame.range_azimuth_cov[row]
        z = np.array([frame.range_m[row], frame.azimuth_rad[row]])
        return Sighting(stamp_ns, landmark_id, z, self._default_cov if np.isnan(cov).any() else cov)

    def _sight(self, view: View, tie: Tie, sighting: Sighting) -> None:
        if sighting.landmark_id in view.landmarks:
            self._sight_again(view, tie, sighting)
        else:
            self._sight_first(view, tie, sighting)

    def _view(self, motion: PreintegratedMotion, landmark_ids: set[int]) -> View:
        key, bias_key = self.keyframes.newest_key, self.keyframes.newest_bias_key
        keys = [key, *map(L, sorted(landmark_ids))]
        return View(
            pose_key=key,
            bias_key=bias_key,
            world_T_keyframe=self.smoother.values.atPose3(key),
            motion=motion,
            body_T_sonar=self._body_T_sonar,
            landmarks={i: self.smoother.values.atPoint3(L(i)) for i in landmark_ids},
            covariance=self.smoother.joint_covariance(keys if bias_key is None else [*keys, bias_key]),
        )

    def _sight_again(self, view: View, tie: Tie, sighting: Sighting) -> None:
        innovation, S, distance, gain = weigh(sighting.z, *view.expect(sighting.landmark_id), sighting.cov)
        inside = distance <= self._gate
        outcome = Outcome.USED if inside else Outcome.GATED
        self.journal.record(sighting.stamp_ns, sighting.landmark_id, outcome, innovation, S)
        if inside:
            self.smoother.waiting_gain += gain
            self._add_factors(view, tie, sighting, view.landmarks[sighting.landmark_id], None)

    def _sight_first(self, view: View, tie: Tie, sighting: Sighting) -> None:
        floor, sonar, (range_m, azimuth_rad) = self.calibration.floor, self.calibration.sonar, sighting.z
        elevation = None
        if floor:
            elevation = elevation_on_floor(
                view.world_T_sonar, range_m, azimuth_rad, floor.z_m, sonar.elevation_aperture_rad
            )
        point = locate(view.world_T_sonar, range_m, azimuth_rad, elevation or 0.0)
        self.ids.add(sighting.landmark_id)
        self.journal.record(sighting.stamp_ns, sighting.landmark_id, Outcome.NEW)
        self.smoother.add_landmark(L(sighting.landmark_id), point)
        self._add_factors(view, tie, sighting, point, None if floor else self._elevation_sigma_rad)
        if floor:
            self.smoother.add([factors.floor_prior(L(sighting.landmark_id), floor.z_m, floor.sigma_m)])

    def _add_factors(
        self, view: View, tie: Tie, sighting: Sighting, point: Floats, elevation_sigma_rad: float | None
    ) -> None:
        R, key = view.blurred(sighting.cov, tie.motion, point), L(sighting.landmark_id)
        self.smoother.sightlines.add(key, tie.pose_key, tie.keyframe_T_sonar, sighting.z)
        self.smoother.add(
            factors.landmark_sighting(
                tie.pose_key, key, tie.keyframe_T_sonar, sighting.z, R, self._robust, elevation_sigma_rad
            )
        )

    def _robust(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """The noise model inside the chosen robust kernel."""
        return gtsam.noiseModel.Robust.Create(self._kernel, noise) if self._kernel else noise


@dataclass(frozen=True, eq=False)
class Sighting:
    """A detection with an identity."""

    stamp_ns: int
    landmark_id: int
    z: Floats
    """Range (m) and azimuth (rad), shape (2,)."""
    cov: Floats
    """Their noise, shape (2, 2)."""


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
