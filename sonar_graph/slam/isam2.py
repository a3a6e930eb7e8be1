"""The smoothing estimator: keyframes, landmarks and gyro bias in one incrementally solved graph (docs/theory/isam2.md).

One call of `Isam2.process`::

    odometry ── epochs due as keyframes ──► preintegration ──► factors of each keyframe
    frames of detections ──► newest keyframe, or a new one ──► identity ──► gate ──► sighting factors
    one update of the smoother, if there is anything new
    newest keyframe's estimate, carried on by odometry ──► Estimate at end_ns
"""

from bisect import bisect_left
from collections.abc import Iterable
from functools import partial
from typing import Any, ClassVar, Literal, Self, get_args

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from pydantic import model_validator

from sonar_graph.calibration import Calibration, Section, require_params
from sonar_graph.errors import CalibrationError, EstimatorError
from sonar_graph.measurements import NS_PER_S, Floats, Ints, Measurements, PositionFixes, require_measurements
from sonar_graph.models import KernelParams, RobustKernel
from sonar_graph.motion import MotionSource, require_source
from sonar_graph.slam.estimates import AnchoredPose, PoseHistory
from sonar_graph.slam.frontend import Frontend
from sonar_graph.slam.keyframes import KeyframeParams, Keyframes
from sonar_graph.slam.landmarks import IdentityParams, MixtureIdentity, RobustIdentity
from sonar_graph.slam.smoother import (
    HistoryParams,
    JointCovariance,
    Marginals,
    Smoother,
    SmootherParams,
    WholeHistory,
)
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Outcome, Refusal, RefusedRow, Trajectory
from sonar_graph.tagged_sections import misfits

Over = Literal["window", "history"]
MOST_LISTED = 12
"""Most landmarks that a message lists."""


class Isam2Params(Section):
    """Settings of the smoothing estimator.

    Examples
    --------
    >>> from sonar_graph.slam import BoundedHistory, Isam2Params, MixtureIdentity
    >>> params = Isam2Params(identity=MixtureIdentity(wrong_id_probability=0.1))
    >>> params.identity.policy, params.keyframes.max_interval_s
    ('max-mixture', 5.0)
    >>> try:
    ...     Isam2Params(identity=MixtureIdentity(), history=BoundedHistory())
    ... except ValueError as error:
    ...     print("max-mixture" in str(error))
    True
    """

    keyframes: KeyframeParams = KeyframeParams()
    """Where keyframes are set."""
    smoother: SmootherParams = SmootherParams()
    """The incremental solution."""
    history: HistoryParams = WholeHistory()
    """What is kept of poses older than the lag."""
    kernel: KernelParams = RobustKernel()
    """Shape of the noise of range and of azimuth, under every identity policy."""
    identity: IdentityParams = RobustIdentity()
    """Policy for identities that may be wrong (docs/theory/doubtful_identities.md)."""

    @model_validator(mode="after")
    def _check_history(self) -> Self:
        if self.history.policy == "bounded" and isinstance(self.identity, MixtureIdentity):
            reason = (
                f'history.policy = "bounded" cannot be with identity.policy = "{self.identity.policy}", which chooses'
                ' anew in the whole history; give history.policy = "whole", or identity.policy = "robust"'
            )
            raise misfits(type(self), {"history": reason})
        return self


class Isam2:
    """Landmark SLAM by incremental smoothing (Kaess et al., iSAM2, IJRR 31(2), 2012).

    Parameters
    ----------
    calibration
        What is known before the run.
    odometry
        Source of motion, its own, such as `sonar_graph.navigation.Odometry`.
    params
        Settings; None for the defaults.

    Examples
    --------
    >>> from sonar_graph import Odometry
    >>> from sonar_graph.slam import Isam2, Isam2Params
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> isam2 = Isam2(world.calibration, Odometry(world.calibration), Isam2Params())
    >>> for step in world.replay(world.instants(rate_hz=2.0)):
    ...     estimate = isam2.process(step)
    >>> isam2.landmarks().ids
    array([ 4,  9, 11])
    >>> isam2.trajectory().positions.shape
    (40, 3)
    """

    Params: ClassVar[type[Section]] = Isam2Params

    def __init__(self, calibration: Calibration, odometry: MotionSource, params: Any = None) -> None:
        require_params(params, self.Params, "isam2")
        require_source(odometry, calibration, "Isam2(calibration, odometry, params)")
        noise = {
            "imu.gyro_noise_density": calibration.imu.gyro_noise_density,
            "dvl.velocity_sigma_m_s": min(calibration.dvl.velocity_sigma_m_s),
            "start.position_sigma_m": min(calibration.start.position_sigma_m),
            "start.rpy_sigma_rad": min(calibration.start.rpy_sigma_rad),
        }
        if zero := [name for name, least in noise.items() if least <= 0]:  # a graph weighs by inverse variances
            raise CalibrationError(
                f"isam2: {', '.join(zero)} must be above zero; give a small value for what is known well"
            )
        p: Isam2Params = params or Isam2Params()
        self._params = p
        self._asked = PoseHistory()
        self._smoother = Smoother(p.smoother, self._asked if p.history.policy == "bounded" else None)
        self._keyframes = Keyframes(calibration, odometry, p.keyframes, self._smoother)
        self._sightings = Frontend(p.identity, p.kernel, self._keyframes)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor added so far; of a bounded history what the window holds."""
        return self._smoother.graph

    @property
    def values(self) -> gtsam.Values:
        """The newest estimate of every variable: ``X(i)`` keyframes, ``L(id)`` landmarks, ``B(i)`` biases.

        Of a bounded history those in the window.
        """
        return self._smoother.values

    @property
    def keyframe_count(self) -> int:
        """Number of keyframes so far."""
        return len(self._keyframes.stamps_ns)

    def process(self, measurements: Measurements) -> Estimate | None:
        """Take in measurements and return the causal estimate at their end.

        None before IMU and DVL have begun, and for an instant before that of an earlier call.
        """
        require_measurements(measurements, "isam2")
        self._keyframes.add(measurements.imu, measurements.dvl, measurements.depth, measurements.heading)
        fixes = [] if measurements.positions is None else self._fixes(measurements.positions)
        if self._asked.newest_ns is not None and measurements.end_ns < self._asked.newest_ns:
            for _, take_in in fixes:
                take_in()
            if measurements.detections is not None:
                stamps_ns, ids = measurements.detections.stamps_ns, measurements.detections.most_probable()[0]
                for stamp_ns, landmark_id in zip(stamps_ns.tolist(), ids.tolist(), strict=True):
                    self._sightings.journal.record(stamp_ns, landmark_id, Outcome.LATE)
            return None
        frames = [] if measurements.detections is None else list(measurements.detections.frames())
        for stamp_ns, take_in in sorted(
            [(int(frame.stamps_ns[0]), partial(self._sightings.add, frame)) for frame in frames] + fixes,
            key=lambda event: event[0],
        ):
            self._sightings.advance(stamp_ns)
            take_in()
        self._sightings.advance(measurements.end_ns)
        if self._keyframes.newest_ns is None:
            return None
        self._forget()
        motion = self._keyframes.motion_since_newest(measurements.end_ns)
        newest = len(self._keyframes.stamps_ns) - 1
        instant = AnchoredPose(measurements.end_ns, newest, self._keyframes.bias_keys[newest], motion)
        self._asked.add(instant)
        return instant.carried_on(self._smoother.values, self._smoother.joint_covariance(instant.keys()))

    def _fixes(self, positions: PositionFixes) -> list[tuple[int, partial[None]]]:
        """What to do with each sound position fix, with its stamp."""
        sigma_m = self._keyframes.calibration.positions.sigma_m
        found: list[tuple[int, partial[None]]] = []
        known = zip(positions.stamps_ns.tolist(), positions.are_sound().tolist(), strict=True)
        for k, (stamp_ns, is_sound) in enumerate(known):
            if not is_sound:
                self._keyframes.refuse("positions", stamp_ns, Refusal.UNSOUND)
                continue
            cov_m2 = positions.covariance_m2[k]
            cov_m2 = np.diag(np.square(sigma_m)) if np.isnan(cov_m2).any() else cov_m2
            found.append((stamp_ns, partial(self._sightings.add_fix, stamp_ns, positions.position_m[k], cov_m2)))
        return found

    def _forget(self) -> None:
        """Drop old poses and outcomes of a bounded history, in batches."""
        history, now_ns = self._params.history, self._keyframes.stamps_ns[-1]
        if history.policy == "bounded" and history.remembered_s is not None:
            batch_ns = round(history.remembered_s * NS_PER_S / 4)
            oldest_ns = (now_ns // batch_ns - 4) * batch_ns  # by the newest keyframe, however the log is cut
            self._asked.forget_before(oldest_ns)
            self._sightings.journal.forget_before(oldest_ns)

    def keyframe_stamps(self) -> Ints:
        """Stamps of the keyframes, shape (n,), nanoseconds."""
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
        if over not in get_args(Over):
            raise EstimatorError(f'isam2: over is {over!r}; expected "window" or "history"')
        asked: list[list[int]] = []
        for field, given in (("keyframes", keyframes), ("stamps_ns", stamps_ns), ("landmarks", landmarks)):
            found = np.asarray(list(given) if isinstance(given, Iterable) else given)
            if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
                raise EstimatorError(f"isam2: {field}: expected a list of integers, such as [1, 2], not {given!r}")
            asked.append(found.tolist())
        smoother, existing_ns, poses = self._smoother, self._keyframes.stamps_ns, asked[0]
        newest = len(existing_ns) - 1
        for stamp_ns in asked[1]:
            place = bisect_left(existing_ns, stamp_ns)
            if existing_ns[place : place + 1] != [stamp_ns]:
                beside = " and ".join(str(stamp) for stamp in existing_ns[max(place - 1, 0) : place + 1])
                nearest = f"the nearest are at {beside} ns" if beside else "there is none yet"
                raise EstimatorError(f"isam2: no keyframe at {stamp_ns} ns; {nearest}")
            poses.append(place)
        for number in poses:
            if not 0 <= number <= newest:
                known = f"it has 0 to {newest}" if existing_ns else "none was set yet"
                raise EstimatorError(f"isam2: there is no keyframe {number}; {known}")
        ids = smoother.landmark_ids if over == "window" else self._sightings.smoothed().ids
        if unknown := [i for i in asked[2] if i not in set(ids)]:
            listed = ", ".join(map(str, ids[:MOST_LISTED])) + (", ..." if len(ids) > MOST_LISTED else "")
            raise EstimatorError(f"isam2: landmark {unknown[0]} is not in the graph; it holds {listed or 'none yet'}")
        keys = list(dict.fromkeys([*map(X, poses), *map(L, asked[2])]))
        if not keys:
            raise EstimatorError("isam2: the covariance of nothing was asked for; give keyframes, stamps or landmarks")
        held = set(smoother.in_window(keys))
        left = [number for number in dict.fromkeys(poses) if X(number) not in held]
        if left and (over == "window" or smoother.is_bounded):
            first = next((k for k in range(newest) if smoother.in_window([X(k)])), newest)
            instead = "none is known any more" if smoother.is_bounded else 'ask over="history" for older ones'
            raise EstimatorError(
                f"isam2: keyframe {left[0]} has left the window, which holds {first} to {newest}; {instead}"
            )
        if over == "window":
            return JointCovariance.of(smoother.marginals, sorted(keys))
        return JointCovariance.of(self._sightings.smoothed().marginals, sorted(keys))

    def trajectory(self) -> Trajectory:
        """The smoothed pose at every instant at which `process` returned an estimate.

        Solves the whole graph. Between keyframes the pose of the keyframe before is carried on by its own odometry.
        With a bounded history that is the graph of the window; poses before it are as they were when they left.
        Doubtful identities are those that fit the whole history best, chosen beside the run, which asking leaves as it
        was.
        """
        values, marginals, _ = self._sightings.smoothed()
        return self._asked.trajectory(values, marginals)

    def landmarks(self) -> LandmarkMap:
        """Landmarks by identity after solving the whole graph, with marginal covariances."""
        return map_of(*self._sightings.smoothed())

    def newest_landmarks(self) -> LandmarkMap:
        """Landmarks by identity as of the last update of iSAM2, in milliseconds however long the run is.

        Covariances are those of `joint_covariance` over the window.
        """
        smoother = self._smoother
        ids = [i for i in smoother.landmark_ids if smoother.in_window([L(i)])]
        return map_of(smoother.values, smoother.marginals, ids)

    def detections(self) -> DetectionLog:
        """Outcome of each detection; of doubtful identities in the history of `trajectory`."""
        return self._sightings.log()

    def withheld(self) -> list[str]:
        """What could not be used, a line each: headings and fixes that the estimate contradicts, then newest factors.

        Of these the variable, the factors and what was missing.
        """
        return [*self._keyframes.contradictions.messages(), *self._smoother.withheld]

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of all sensors but the sonar that are not used, and why."""
        return self._keyframes.refused


def map_of(values: gtsam.Values, marginals: Marginals | gtsam.ISAM2, ids: list[int]) -> LandmarkMap:
    """Map of landmarks with these identities, from a solution and what gives its marginal covariances."""
    return LandmarkMap(
        np.array(ids, dtype=np.int64),
        np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3),
        np.array([marginals.marginalCovariance(L(i)) for i in ids]).reshape(-1, 3, 3),
    )
