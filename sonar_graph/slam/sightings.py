"""From detections to factors: identity, prediction, gate, and the landmark's first appearance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Floats, LandmarkDetections
from sonar_graph.slam import factors
from sonar_graph.slam.association import DetectionJournal, gate_threshold, identify
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.models import elevation_on_floor, locate, wrap_angle
from sonar_graph.slam.smoother import Smoother
from sonar_graph.slam.view import View
from sonar_graph.states import Outcome


@dataclass(frozen=True)
class SightingPolicy:
    """Which detections become factors, and how much an outlier may pull."""

    identity_probability: float
    gate_probability: float
    kernel: Literal["none", "huber", "cauchy"]
    kernel_width: float

    def robust(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """The noise model inside the chosen robust kernel."""
        if self.kernel == "none":
            return noise
        kernels: dict[str, Callable[[float], gtsam.noiseModel.mEstimator.Base]] = {
            "huber": gtsam.noiseModel.mEstimator.Huber.Create,
            "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
        }
        return gtsam.noiseModel.Robust.Create(kernels[self.kernel](self.kernel_width), noise)


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
        self._elevation_sigma_rad = sonar.elevation_aperture_rad / np.sqrt(12.0)

    def add(self, frame: LandmarkDetections) -> None:
        """Take in the detections of one frame."""
        stamp_ns = int(frame.stamps_ns[0])
        newest_ns = self.keyframes.newest_ns
        if newest_ns is None or stamp_ns < newest_ns:
            late = Outcome.UNLOCATED if newest_ns is None else Outcome.LATE
            for landmark_id in frame.most_probable()[0].tolist():
                self.journal.record(stamp_ns, landmark_id, late)
            return
        identities = identify(frame, self.policy.identity_probability)
        accepted = {i for i, r in zip(identities.ids.tolist(), identities.refusals, strict=True) if r is None}
        view = self._view(stamp_ns, accepted & self.ids) if accepted else None
        for row, (landmark_id, refusal) in enumerate(zip(identities.ids.tolist(), identities.refusals, strict=True)):
            if refusal is not None or view is None:
                self.journal.record(stamp_ns, landmark_id, refusal or Outcome.NO_IDENTITY)
                continue
            if landmark_id in self.ids and landmark_id not in view.landmarks:
                view = self._view(stamp_ns, accepted & self.ids)  # the frame shows a new landmark twice
            z = np.array([frame.range_m[row], frame.azimuth_rad[row]])
            cov = frame.range_azimuth_cov[row]
            sight = self._sight_again if landmark_id in self.ids else self._sight_first
            sight(view, landmark_id, z, self._default_cov if np.isnan(cov).any() else cov)

    def _view(self, stamp_ns: int, landmark_ids: set[int]) -> View:
        """What the graph expects at a frame; sets a keyframe if one is due and brings the smoother up to date."""
        motion = self.keyframes.motion_to_frame(stamp_ns)
        if self.smoother.has_news:
            self.smoother.update(self.keyframes.newest_s)
        ids = sorted(landmark_ids)
        pose_key = self.keyframes.newest_key
        return View(
            stamp_ns=stamp_ns,
            pose_key=pose_key,
            world_T_keyframe=self.smoother.values.atPose3(pose_key),
            motion=motion,
            body_T_sonar=self._body_T_sonar,
            landmarks={i: self.smoother.values.atPoint3(L(i)) for i in ids},
            covariance=self.smoother.joint_covariance([pose_key, *map(L, ids)]),
        )

    def _sight_again(self, view: View, landmark_id: int, z: Floats, cov: Floats) -> None:
        predicted, S, R = view.expect(landmark_id, cov)
        innovation = np.array([z[0] - predicted[0], wrap_angle(z[1] - predicted[1])])
        distance = innovation @ np.linalg.solve(S, innovation)
        inside = self.policy.gate_probability == 1 or distance <= gate_threshold(self.policy.gate_probability, 2)
        outcome = Outcome.USED if inside else Outcome.GATED
        self.journal.record(view.stamp_ns, landmark_id, outcome, innovation, S)
        if inside:
            self.smoother.add(
                factors.landmark_sighting(
                    view.pose_key, L(landmark_id), view.keyframe_T_sonar, z, R, self.policy.robust
                )
            )

    def _sight_first(self, view: View, landmark_id: int, z: Floats, cov: Floats) -> None:
        floor, sonar = self.calibration.floor, self.calibration.sonar
        elevation = (
            elevation_on_floor(view.world_T_sonar, z[0], z[1], floor.z_m, sonar.elevation_aperture_rad)
            if floor
            else None
        )
        point = locate(view.world_T_sonar, z[0], z[1], elevation or 0.0)
        _, _, R = view.expect_at(point, cov)
        self.ids.add(landmark_id)
        self.journal.record(view.stamp_ns, landmark_id, Outcome.NEW)
        self.smoother.add_lasting(L(landmark_id), point)
        self.smoother.add(
            factors.landmark_sighting(
                view.pose_key,
                L(landmark_id),
                view.keyframe_T_sonar,
                z,
                R,
                self.policy.robust,
                None if floor else self._elevation_sigma_rad,
            )
        )
        if floor:
            self.smoother.add([factors.floor_prior(L(landmark_id), floor.z_m, floor.sigma_m)])
