"""The smoothing estimator: keyframes, landmarks and gyro bias in one incrementally solved graph.

Flow of one call of `Isam2.process`::

    odometry  ── nodes due as keyframes ──► preintegrate ──► factors of that keyframe
    frames of detections ──► newest keyframe, or a new one ──► identity ──► gate ──► sighting factors
    one update of the smoother, if there is anything new
    newest keyframe's estimate, carried on by odometry ──► Estimate at end_ns

A frame is tied to its keyframe through the odometry between them: the sonar's pose in the keyframe's body frame at the
time of the frame. Keyframes can then be sparser than frames at no loss but the (included) noise of that short motion.

Settings of the smoother that exclude each other, or do nothing beside another: all reasons, in one place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, ClassVar, Literal, NamedTuple, Self

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L
from pydantic import Field, model_validator

from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import CalibrationError, EstimatorError
from sonar_graph.measurements import Floats, Ints, Measurements
from sonar_graph.sequence import NS_PER_S
from sonar_graph.settings import misfits
from sonar_graph.slam.estimates import AnchoredPose, Over, PoseHistory, joint_covariance
from sonar_graph.slam.frontend import SightingPolicy, Sightings
from sonar_graph.slam.keyframes import KeyframePolicy, Keyframes
from sonar_graph.slam.landmarks import AnonymousPolicy, Kernel, Mixture, RecogniserErrors
from sonar_graph.slam.smoother import JointCovariance, Smoother
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Outcome, RefusedRow, Trajectory


class Isam2Params(Section):
    """Settings of the smoothing estimator."""

    lag_s: float = Field(15.0, gt=0)
    """Poses older than this are marginalised out of the incremental solution; a large value keeps the whole history."""
    history: Literal["whole", "bounded"] = "whole"
    """What is kept of poses older than the lag. "whole": everything, for the batch solution in `Isam2.trajectory`.
    "bounded": nothing but what they say of landmarks and bias, so that time and memory do not grow with the run;
    `Isam2.trajectory` is then what the lag allowed (docs/theory/bounded_memory.md)."""
    remembered_s: float | None = Field(None, gt=0)
    """With a bounded history: `Isam2.trajectory` and `Isam2.detections` forget what is older than this (and up to a
    quarter more); None: nothing."""
    max_keyframe_interval_s: float = Field(5.0, gt=0)
    """A keyframe is set at the latest after this time."""
    motion_noise_share: float = Field(0.1, ge=0)
    """While landmarks are seen, a keyframe is set sooner: once the variance of the motion since the last one exceeds
    this share of the sonar's variance. 0: every frame with a landmark."""
    waiting_gain: float = Field(5.0, ge=0)
    """Sightings wait for the next keyframe until what they would add, the sum of expected over measured variance,
    exceeds this. 0: none waits."""
    bias_interval_s: float = Field(60.0, gt=0)
    """The gyro bias is constant over stretches of this length."""
    relinearize_threshold: float = Field(0.001, gt=0)
    """A variable is relinearised when a component of its change exceeds this (rad or m)."""
    stale_shift_m: float = Field(0.1, gt=0)
    """The window is linearised anew, from a solution of the whole graph, when a landmark has moved farther."""
    kernel: Literal["none", "huber", "cauchy"] = "cauchy"
    """Robust kernel on range and on azimuth. It may let an outlier at a landmark's first sighting be outvoted later,
    which a gate cannot, unless it lies too far off; where noise is Gaussian it costs next to nothing (measured in
    docs/theory/isam2.md)."""
    kernel_width: float = Field(1.5, gt=0)
    """Width of the kernel, in standard deviations."""
    identity_probability: float = Field(0.7, ge=0, le=1)
    """A detection is used when its most probable identity has at least this posterior."""
    gate_probability: float = Field(0.999, gt=0, le=1)
    """With `identity_policy` "gate": a detection whose squared Mahalanobis innovation exceeds this chi-square quantile
    (2 dof) is refused; 1: none."""

    identity_policy: Literal["gate", "robust", "max-mixture", "gnc"] = "robust"
    """What is made of identities that may be wrong (docs/theory/doubtful_identities.md).

    "gate": what is probable enough is believed, if it lies where that landmark is expected (`gate_probability`).
    Assumes that the estimate and its covariance are right when a detection comes; nothing is taken back.
    "robust": what is probable enough is believed. Assumes that most sightings of every landmark are right, and that
    wrong ones disagree with each other: the kernel then lets the majority win, unless a landmark's first sighting is
    so far off that the others hardly pull.
    "max-mixture": a detection, or a track, is of the landmark that its place and its posterior together make most
    probable, or of none; chosen anew in the window as the estimate moves, in the whole history for smoothed results.
    Assumes `wrong_id_probability`, errors that are independent, and an estimate that is near when it chooses.
    "gnc": the same, and smoothed results also try what graduated non-convexity finds in the whole history, which needs
    no near estimate; assumes that most of what the recogniser says is right.
    The last two want a whole history and take no ``unknown_landmarks = "associate"``.

    `kernel` is the shape of the noise under all of them."""
    wrong_id_probability: float = Field(0.05, gt=0, lt=1)
    """Probability that what the recogniser says has nothing to do with what was seen, beside what its posterior admits.
    The mixture's other landmarks share one half of it, no landmark has the other."""
    view_range_m: float = Field(10.0, gt=0)
    """Detections of no landmark are spread evenly over so much range."""
    view_azimuth_rad: float = Field(2.0, gt=0)
    """The same of azimuth."""

    deferred_identity: bool = True
    """Detections of one track wait until its identity is known, and are moved when it turns out to be another. Has no
    effect where detections belong to no track."""
    longest_wait_s: float = Field(60.0, gt=0)
    """A detection waits at most so long for its identity. A track not seen for so long keeps the one it has."""

    unknown_landmarks: Literal["ignore", "associate"] = "ignore"
    """What becomes of detections that name no landmark: ``ignore`` refuses them; ``associate`` pairs them with
    landmarks by geometry, and begins landmarks with identities from 3000000000 on; docs/theory/unknown_landmarks.md
    says on what conditions."""
    unknown_gate_probability: float = Field(0.9999, gt=0, lt=1)
    """A true pairing of a frame's detections with landmarks is jointly compatible with this probability."""
    unknown_density_m2: float = Field(0.05, gt=0)
    """Landmarks a square metre that may be there and are not in the map: the rival of every pairing."""
    unknown_sightings: int = Field(5, ge=1)
    """So many sightings of what is paired with no landmark begin one."""
    unknown_wait_s: float = Field(10.0, gt=0)
    """So long, and no longer than ``lag_s``, a sighting waits for them."""

    @model_validator(mode="after")
    def _check_conflicts(self) -> Self:
        found = conflicts(self)
        if found:
            raise misfits(type(self), {conflict.setting: conflict.reason for conflict in found})
        return self

    def mixture(self) -> Mixture | None:
        """What detections may be of; None: the recogniser is believed, or not."""
        if self.identity_policy in ("gate", "robust"):
            return None
        errors = RecogniserErrors(self.wrong_id_probability, self.view_range_m, self.view_azimuth_rad)
        return Mixture(errors, Kernel(self.kernel, self.kernel_width))

    def anonymous(self) -> AnonymousPolicy | None:
        """What is believed of landmarks without identities; None: their detections are refused."""
        if self.unknown_landmarks == "ignore":
            return None
        return AnonymousPolicy(
            self.unknown_gate_probability,
            self.unknown_density_m2,
            self.unknown_sightings,
            min(self.unknown_wait_s, self.lag_s),
        )


class Isam2:
    """Landmark SLAM by incremental smoothing (Kaess et al., iSAM2, IJRR 31(2), 2012).

    Parameters
    ----------
    calibration
        What is known before the run.
    params
        Settings; None for the defaults.
    """

    Params: ClassVar[type[Section]] = Isam2Params

    def __init__(self, calibration: Calibration, params: Any = None) -> None:
        _check_noise(calibration)
        self._calibration = calibration
        self._params = _settings(params)
        p = self._params
        self._smoother = Smoother(
            p.lag_s, p.relinearize_threshold, p.stale_shift_m, p.waiting_gain, is_bounded=p.history == "bounded"
        )
        self._smoother.when_leaving = self._leave
        policy = KeyframePolicy(p.max_keyframe_interval_s, p.motion_noise_share, p.bias_interval_s)
        self._keyframes = Keyframes(calibration, policy, self._smoother)
        sightings = SightingPolicy(
            p.identity_probability,
            p.gate_probability if p.identity_policy == "gate" else 1.0,
            p.kernel,
            p.kernel_width,
            p.deferred_identity,
            p.longest_wait_s,
            p.mixture(),
            p.identity_policy == "gnc",
            p.anonymous(),
        )
        self._sightings = Sightings(calibration, sightings, self._smoother, self._keyframes)
        self._asked = PoseHistory()
        self._forgot_s = -math.inf

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor added so far; of a bounded history what the window holds."""
        return self._smoother.graph

    @property
    def values(self) -> gtsam.Values:
        """The newest estimate of every variable: ``X(i)`` keyframes, ``L(id)`` landmarks, ``B(i)`` gyro biases.

        Of a bounded history those in the window.
        """
        return self._smoother.values

    @property
    def keyframe_count(self) -> int:
        """Number of keyframes so far."""
        return len(self._keyframes.stamps_ns)

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in measurements; the causal estimate at their end.

        None before IMU and DVL have begun, and for an instant before that of an earlier call.
        """
        if self._asked.newest_ns is not None and measurements.end_ns < self._asked.newest_ns:
            self._refuse(measurements)
            return None
        self._keyframes.add(measurements.imu, measurements.dvl, measurements.depth)
        if measurements.detections is not None:
            for frame in measurements.detections.frames():
                self._keyframes.advance(int(frame.stamps_ns[0]))
                self._sightings.add(frame)
        self._keyframes.advance(measurements.end_ns)
        self._keyframes.update_if_due()
        if self._keyframes.newest_ns is None:
            return None
        motion = self._keyframes.motion_since_newest(measurements.end_ns)
        newest = len(self._keyframes.stamps_ns) - 1
        instant = AnchoredPose(measurements.end_ns, newest, self._keyframes.bias_key(newest), motion)
        self._asked.add(instant)
        return instant.carried_on(self._smoother.values, self._smoother.joint_covariance(instant.keys()))

    def _leave(self, keys: set[int]) -> None:
        """Variables leave a bounded window."""
        self._asked.leave(keys, self._smoother.values, self._smoother.marginals)
        self._sightings.leave(keys)
        self._forget(self._keyframes.newest_s)

    def _forget(self, now_s: float) -> None:
        """Drop what need not be remembered, a good deal at a time."""
        remembered_s = self._params.remembered_s
        if remembered_s is not None and now_s - self._forgot_s > remembered_s / 4:
            self._forgot_s, oldest_ns = now_s, round((now_s - remembered_s) * NS_PER_S)
            self._asked.forget_before(oldest_ns)
            self._sightings.journal.forget_before(oldest_ns)

    def _refuse(self, measurements: Measurements) -> None:
        """Time does not go back: take the rows that are still new, refuse the detections, estimate nothing."""
        self._keyframes.add(measurements.imu, measurements.dvl, None)
        if measurements.detections is not None:
            for stamp_ns, i in zip(
                measurements.detections.stamps_ns.tolist(),
                measurements.detections.most_probable()[0].tolist(),
                strict=True,
            ):
                self._sightings.journal.record(stamp_ns, i, Outcome.LATE)

    def keyframe_stamps(self) -> Ints:
        """Stamps of the keyframes, by their numbers, shape (n,), nanoseconds."""
        return np.array(self._keyframes.stamps_ns, dtype=np.int64)

    def marginal(
        self,
        *,
        keyframe: int | None = None,
        stamp_ns: int | None = None,
        landmark: int | None = None,
        over: Over = "window",
    ) -> Floats:
        """Covariance of one keyframe, by its number or stamp, or of one landmark, by its identity.

        Returns
        -------
        Floats
            Of the body-frame perturbation [rotation, translation], shape (6, 6), or of the position in the world,
            shape (3, 3), m². What holds of `joint_covariance` holds of it.
        """
        asked = [[] if one is None else [one] for one in (keyframe, stamp_ns, landmark)]
        if sum(map(len, asked)) != 1:
            raise EstimatorError("isam2: marginal() is of one variable; give one of keyframe, stamp_ns and landmark")
        return self.joint_covariance(*asked, over=over).matrix

    def joint_covariance(
        self,
        keyframes: Iterable[int] = (),
        stamps_ns: Iterable[int] = (),
        landmarks: Iterable[int] = (),
        *,
        over: Over = "window",
    ) -> JointCovariance:
        """Joint covariance of keyframes, by their numbers or stamps, and of landmarks, by their identities.

        Poses between keyframes: `trajectory` has their covariances, one by one. Cost, with 20 landmarks after 34
        minutes: 0.1 ms for one variable and 0.6 ms for the newest keyframe with all landmarks over the window; over the
        history 1 s for its solution, once until there are new measurements, then 3 ms for any one variable and 40 ms
        for fifty keyframes together (docs/theory/isam2.md).

        Parameters
        ----------
        over
            "window": from iSAM2, as of its last update, linearised within ``relinearize_threshold`` of the estimate;
            what marginals touch, landmarks above all, stays linearised where it was when they were made. Only of what
            is in the window. "history": from the solution of the whole graph, linearised there, of anything; with a
            bounded history from the solution of the window's graph.

        Returns
        -------
        JointCovariance
            In the order of GTSAM's keys: landmarks, then keyframes, each by their numbers; ``rows`` says where.

        Raises
        ------
        EstimatorError
            When something is not known, or has left the window; it says what there is.
        """
        history = self._sightings.history
        return joint_covariance(
            self._smoother, history, self._keyframes.stamps_ns, over, keyframes, stamps_ns, landmarks
        )

    def trajectory(self) -> Trajectory:
        """The smoothed pose at every instant at which `process` returned an estimate.

        Solves the whole graph. Between keyframes the pose of the keyframe before is carried on by its own odometry.
        With a bounded history that is the graph of the window; poses before it are as they were when they left.
        Doubtful identities are those that fit the whole history best, chosen beside the run, which asking leaves as it
        was.
        """
        values, marginals, _ = self._sightings.history()
        return self._asked.trajectory(values, marginals)

    def landmarks(self) -> LandmarkMap:
        """Landmarks by identity after solving the whole graph, with marginal covariances."""
        values, marginals, ids = self._sightings.history()
        return LandmarkMap(
            np.array(ids, dtype=np.int64),
            np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3),
            np.array([marginals.marginalCovariance(L(i)) for i in ids]).reshape(-1, 3, 3),
        )

    def detections(self) -> DetectionLog:
        """What became of each detection; of doubtful identities in the history that `trajectory` is of."""
        return self._sightings.log()

    def withheld(self) -> list[str]:
        """What of the newest detections could not be used in the graph, variable by variable, and what was missing."""
        return list(self._smoother.withheld)

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of IMU, Doppler log and depth that are not used, and why."""
        return self._keyframes.refused


def _settings(params: Any) -> Isam2Params:
    if params is None:
        return Isam2Params()
    if not isinstance(params, Isam2Params):
        raise EstimatorError(
            f"isam2: params: expected Isam2Params or None, not {type(params).__name__}; of a dict:"
            " Isam2Params(**params)"
        )
    return params


def _check_noise(calibration: Calibration) -> None:
    """A graph weighs by the inverse of variances: none may be zero."""
    start = calibration.start
    zero = [
        name
        for name, least in {
            "imu.gyro_noise_density": calibration.imu.gyro_noise_density,
            "dvl.velocity_sigma_m_s": min(calibration.dvl.velocity_sigma_m_s),
            "start.position_sigma_m": min(start.position_sigma_m),
            "start.rpy_sigma_rad": min(start.rpy_sigma_rad),
        }.items()
        if least <= 0
    ]
    if zero:
        raise CalibrationError(
            f"isam2: {', '.join(zero)} must be above zero; give a small value for what is known well"
        )


_OF_MIXTURES = ("wrong_id_probability", "view_range_m", "view_azimuth_rad")
_OF_UNKNOWN = ("unknown_gate_probability", "unknown_density_m2", "unknown_sightings", "unknown_wait_s")


class Conflict(NamedTuple):
    """A setting that cannot stand beside the others."""

    setting: str
    reason: str
    """With what it collides, and what to do: one line that names the setting."""


def conflicts(params: Isam2Params) -> list[Conflict]:
    """What excludes each other, then what was set on purpose and does nothing."""
    return [*_excluding(params), *_idle(params)]


def _excluding(params: Isam2Params) -> list[Conflict]:
    """A mixture is of landmarks that have names, in a history that is kept."""
    if params.mixture() is None:
        return []
    policy, found = f'identity_policy = "{params.identity_policy}"', []
    if params.history == "bounded":
        reason = (
            f"{policy} chooses anew in the whole history; give it"
            ' history = "whole", or history = "bounded" with identity_policy = "robust"'
        )
        found.append(Conflict("history", reason))
    if params.unknown_landmarks == "associate":
        reason = (
            f"{policy} pairs detections by place itself, and begins no landmark"
            ' without a name; give it unknown_landmarks = "ignore", or "associate" with identity_policy = "robust"'
        )
        found.append(Conflict("unknown_landmarks", reason))
    return found


def _idle(params: Isam2Params) -> list[Conflict]:
    """Settings that were given and that nothing asks for; what says the same as the others is let through."""
    given = params.model_fields_set
    idle = {name: why for name, why in _without_effect(params).items() if name in given}
    return [Conflict(name, f"{name} is of no effect with {why}") for name, why in idle.items()]


def _without_effect(params: Isam2Params) -> dict[str, str]:
    """Beside which setting each of them does nothing, and what to set for it to do something."""
    policy, idle = f'"{params.identity_policy}"', {}
    if params.identity_policy != "gate" and params.gate_probability < 1:
        idle["gate_probability"] = f'{policy}: set identity_policy = "gate"'
    if params.mixture() is None:
        idle |= dict.fromkeys(_OF_MIXTURES, f'{policy}: set identity_policy = "max-mixture" or "gnc"')
        if not params.deferred_identity:
            idle["longest_wait_s"] = "deferred_identity = false: leave one of them out"
    else:
        idle["identity_probability"] = f"{policy}, which weighs every posterior: leave it out"
        if not params.deferred_identity:
            idle["deferred_identity"] = f"{policy}, which always decides on whole tracks: leave it out"
    if params.unknown_landmarks == "ignore":
        idle |= dict.fromkeys(_OF_UNKNOWN, 'unknown_landmarks = "ignore": set unknown_landmarks = "associate"')
    if params.kernel == "none":
        idle["kernel_width"] = 'kernel = "none": set kernel = "cauchy" or "huber"'
    if params.history == "whole" and params.remembered_s is not None:
        idle["remembered_s"] = 'history = "whole": set history = "bounded"'
    return idle
