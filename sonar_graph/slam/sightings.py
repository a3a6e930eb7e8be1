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
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.slam import factors
from sonar_graph.slam.association import DetectionJournal, gate_threshold, identify
from sonar_graph.slam.keyframes import Keyframes
from sonar_graph.slam.models import elevation_on_floor, locate, range_azimuth_jacobians, wrap_angle
from sonar_graph.slam.smoother import Smoother
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
        if any(refusal is None for refusal in identities.refusals):
            self.keyframes.set_for_frame(stamp_ns)
        view: View | None = None
        for row, (landmark_id, refusal) in enumerate(zip(identities.ids.tolist(), identities.refusals, strict=True)):
            if refusal is not None:
                self.journal.record(stamp_ns, landmark_id, refusal)
                continue
            z = np.array([frame.range_m[row], frame.azimuth_rad[row]])
            cov = frame.range_azimuth_cov[row]
            cov = self._default_cov if np.isnan(cov).any() else cov
            if landmark_id in self.ids:
                if view is None or landmark_id not in view.landmarks:
                    view = self._view(stamp_ns, set(identities.ids.tolist()) & self.ids)
                self._sight_again(view, landmark_id, z, cov)
            else:
                self._sight_first(self._view(stamp_ns, set()), landmark_id, z, cov)

    def _view(self, stamp_ns: int, landmark_ids: set[int]) -> View:
        """What the graph expects at a frame; brings the smoother up to date first."""
        if self.smoother.has_news:
            self.smoother.update(self.keyframes.newest_s)
        motion = self.keyframes.motion_since_newest(stamp_ns)
        ids = sorted(landmark_ids)
        pose_key = self.keyframes.newest_key
        return View(
            stamp_ns=stamp_ns,
            pose_key=pose_key,
            world_T_keyframe=self.smoother.values.atPose3(pose_key),
            motion=motion,
            keyframe_T_sonar=motion.i_T_j.compose(self._body_T_sonar),
            landmarks={i: self.smoother.values.atPoint3(L(i)) for i in ids},
            covariance=self.smoother.joint_covariance([pose_key, *map(L, ids)]),
        )

    def _sight_again(self, view: View, landmark_id: int, z: Floats, cov: Floats) -> None:
        predicted, S, R = view.expect(landmark_id, cov, self._body_T_sonar)
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
        world_T_sonar = view.world_T_keyframe.compose(view.keyframe_T_sonar)
        elevation = (
            elevation_on_floor(world_T_sonar, z[0], z[1], floor.z_m, sonar.elevation_aperture_rad) if floor else None
        )
        point = locate(world_T_sonar, z[0], z[1], elevation or 0.0)
        _, _, R = view.expect_at(point, cov, self._body_T_sonar)
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


@dataclass(frozen=True, eq=False)
class View:
    """What the graph expects a frame to show."""

    stamp_ns: int
    pose_key: int
    world_T_keyframe: gtsam.Pose3
    motion: PreintegratedMotion
    """From the keyframe to the frame."""
    keyframe_T_sonar: gtsam.Pose3
    """The sonar at the frame, in the keyframe's body frame."""
    landmarks: dict[int, Floats]
    """Positions of the landmarks expected, shape (3,)."""
    covariance: gtsam.JointMarginal
    """Of the keyframe and those landmarks."""

    def expect(self, landmark_id: int, cov: Floats, body_T_sonar: gtsam.Pose3) -> tuple[Floats, Floats, Floats]:
        """Expected range and azimuth (2,), the innovation's covariance (2, 2), and the noise in it (2, 2)."""
        predicted, H, R = self.expect_at(self.landmarks[landmark_id], cov, body_T_sonar)
        X, p = self.pose_key, L(landmark_id)
        P = np.block(
            [
                [self.covariance.at(X, X), self.covariance.at(X, p)],
                [self.covariance.at(p, X), self.covariance.at(p, p)],
            ]
        )
        return predicted, H @ P @ H.T + R, R

    def expect_at(self, point: Floats, cov: Floats, body_T_sonar: gtsam.Pose3) -> tuple[Floats, Floats, Floats]:
        """The same for any point: expected measurement (2,), derivative by keyframe and point (2, 9), noise (2, 2).

        The noise is the sonar's and that of the motion between keyframe and frame.
        """
        predicted, by_keyframe, by_point = range_azimuth_jacobians(
            self.world_T_keyframe, self.keyframe_T_sonar, point
        )
        world_T_body = self.world_T_keyframe.compose(self.motion.i_T_j)
        _, by_motion, _ = range_azimuth_jacobians(world_T_body, body_T_sonar, point)
        R = cov + np.diag(np.diag(by_motion @ self.motion.covariance @ by_motion.T))
        return predicted, np.hstack([by_keyframe, by_point]), R
