"""The smoothing estimator: keyframes, landmarks and biases in one incrementally solved graph (docs/theory/isam2.md).

One call of `Isam2.process`::

    odometry ──► epochs due as keyframes ──► preintegration ──► factors of each keyframe
    frames of detections ──► newest keyframe, or a new one ──► identity ──► gate ──► sighting factors
    one update of the smoother, if anything is new
    estimate of the newest keyframe, carried on by odometry ──► Estimate at end_ns
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, Self, get_args

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from pydantic import model_validator

from sonar_graph.calibration import (
    Calibration,
    KnownMap,
    Section,
    misfits,
    require_params,
)
from sonar_graph.errors import CalibrationError, EstimatorError
from sonar_graph.measurements import (
    NS_PER_S,
    Floats,
    Ints,
    LandmarkDetections,
    Measurements,
    PositionFixes,
    require_measurements,
)
from sonar_graph.models import KernelParams, RobustKernel
from sonar_graph.motion import MotionSource, require_source
from sonar_graph.slam.frontend import Frontend
from sonar_graph.slam.keyframes import KeyframeParams, Keyframes
from sonar_graph.slam.landmarks import IdentityParams, MixtureIdentity, RobustIdentity
from sonar_graph.slam.prediction import AnchoredPose, PoseHistory
from sonar_graph.slam.smoother import (
    HistoryParams,
    JointCovariance,
    Known,
    Marginals,
    Smoother,
    SmootherParams,
    WholeHistory,
)
from sonar_graph.states import (
    DetectionLog,
    Estimate,
    LandmarkMap,
    Outcome,
    Refusal,
    RefusedRow,
    Trajectory,
)

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
        if self.history.policy == "bounded" and isinstance(
            self.identity, MixtureIdentity
        ):
            reason = (
                f'history.policy = "bounded" cannot be with identity.policy = "{self.identity.policy}", which chooses'
                ' anew in the whole history; give history.policy = "whole", or identity.policy = "robust"'
            )
            raise misfits(type(self), {"history": reason})
        return self


class Event(NamedTuple):
    """A frame or a fix, and the call that takes it in."""

    stamp_ns: int
    apply: Callable[[], None]


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

    def __init__(
        self, calibration: Calibration, odometry: MotionSource, params: Any = None
    ) -> None:
        require_params(params, self.Params, "isam2")
        require_source(odometry, calibration, "Isam2(calibration, odometry, params)")
        require_noise(calibration)
        self._params: Isam2Params = params or Isam2Params()
        self._poses = PoseHistory()
        range_sigma_m = calibration.sonar.range_sigma_m
        self._smoother = Smoother(
            self._params.smoother, self._params.history, self._poses, range_sigma_m
        )
        self._keyframes = Keyframes(
            calibration, odometry, self._params.keyframes, self._smoother
        )
        self._frontend = Frontend(
            self._params.identity, self._params.kernel, self._keyframes
        )

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
        # motion first: frames and fixes of the same call are predicted with it
        self._keyframes.add(
            measurements.imu, measurements.dvl, measurements.depth, measurements.heading
        )
        events = self._fix_events(measurements.positions)
        is_late = (
            self._poses.newest_ns is not None
            and measurements.end_ns < self._poses.newest_ns
        )
        if is_late:
            # a fix may be tied to an earlier keyframe, but the motion to an earlier frame is no longer kept
            for event in events:
                event.apply()
            self._refuse_late(measurements.detections)
            return None
        # frames before fixes of the same stamp, because the sort is stable
        events = self._frame_events(measurements.detections) + events
        for event in sorted(events, key=lambda event: event.stamp_ns):
            self._frontend.advance(event.stamp_ns)
            event.apply()
        self._frontend.advance(measurements.end_ns)
        if self._keyframes.newest_ns is None:
            return None
        self._forget()
        return self._estimate(measurements.end_ns)

    def _estimate(self, stamp_ns: int) -> Estimate:
        """Estimate at an instant: the newest keyframe's pose, carried on by odometry."""
        # provisional: no keyframe is set here, so that results do not depend on when an estimate is wanted
        instant = AnchoredPose(
            stamp_ns, self._keyframes.tie(self._keyframes.motion_since_newest(stamp_ns))
        )
        self._poses.add(instant)
        joint = self._smoother.joint_covariance(instant.tie.keys)
        return instant.carried_on(self._smoother.estimates, joint)

    def _frame_events(self, detections: LandmarkDetections | None) -> list[Event]:
        """Frames of detections, each with the call that takes it in."""
        if detections is None:
            return []
        return [
            Event(int(frame.stamps_ns[0]), partial(self._frontend.add, frame))
            for frame in detections.frames()
        ]

    def _fix_events(self, positions: PositionFixes | None) -> list[Event]:
        """Valid position fixes, each with the call that adds it to the graph."""
        if positions is None:
            return []
        known = self._keyframes.calibration.positions
        is_sound = positions.are_sound()
        events = []
        for k, stamp_ns in enumerate(positions.stamps_ns.tolist()):
            if not is_sound[k]:
                self._keyframes.refuse("positions", stamp_ns, Refusal.UNSOUND)
                continue
            cov_m2 = positions.covariance_m2[k]
            # the receiver gave none: the calibration's noise holds
            if np.isnan(cov_m2).any():
                cov_m2 = np.diag(np.square(known.sigma_m))
            events.append(
                Event(
                    stamp_ns,
                    partial(
                        self._frontend.add_fix,
                        stamp_ns,
                        positions.position_m[k],
                        cov_m2,
                    ),
                )
            )
        return events

    def _refuse_late(self, detections: LandmarkDetections | None) -> None:
        """Record the detections of a call whose end is before that of an earlier call."""
        if detections is None:
            return
        ids, _ = detections.most_probable()
        for stamp_ns, landmark_id in zip(
            detections.stamps_ns.tolist(), ids.tolist(), strict=True
        ):
            self._frontend.journal.record(stamp_ns, landmark_id, Outcome.LATE)

    def _forget(self) -> None:
        """Drop old poses and outcomes of a bounded history, in batches."""
        history = self._params.history
        if history.policy != "bounded" or history.remembered_s is None:
            return
        batch_ns = round(history.remembered_s * NS_PER_S / 4)
        # by the newest keyframe, so that it does not depend on how the log is cut into calls
        oldest_ns = (self._keyframes.stamps_ns[-1] // batch_ns - 4) * batch_ns
        self._poses.forget_before(oldest_ns)
        self._frontend.journal.forget_before(oldest_ns)

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
            raise EstimatorError(
                "isam2: marginal() is of one variable; give one of keyframe, stamp_ns and landmark"
            )
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

        For poses between keyframes, `trajectory` has their covariances, one by one. Over the history the first question
        after new measurements solves the whole graph.

        Parameters
        ----------
        over
            "window": from iSAM2, as of its last update, linearised within ``relinearize_threshold`` of the estimate.
            "history": from the batch solution of the graph, linearised there. With a bounded history both know the
            variables of the window only.

        Returns
        -------
        JointCovariance
            In the order of GTSAM's keys: landmarks, then keyframes, each by their numbers; ``rows`` has their places.

        Raises
        ------
        EstimatorError
            When something is not known, or has left the window; the message lists what there is.
        """
        if over not in get_args(Over):
            raise EstimatorError(
                f'isam2: over is {over!r}; expected "window" or "history"'
            )
        numbers = whole_numbers("keyframes", keyframes)
        numbers += [
            self._keyframe_at(stamp_ns)
            for stamp_ns in whole_numbers("stamps_ns", stamps_ns)
        ]
        ids = whole_numbers("landmarks", landmarks)
        self._require_keyframes(numbers)
        self._require_landmarks(ids, over)
        keys = {*map(X, numbers), *map(L, ids)}
        if not keys:
            raise EstimatorError(
                "isam2: the covariance of nothing was asked for; give keyframes, stamps or landmarks"
            )
        self._require_in_window(numbers)
        marginals = (
            self._smoother.marginals
            if over == "window"
            else self._frontend.smoothed().marginals
        )
        return JointCovariance.of(marginals, sorted(keys))

    def _keyframe_at(self, stamp_ns: int) -> int:
        """Number of the keyframe at a stamp; an `EstimatorError` names the nearest ones where it is missing."""
        existing_ns = self._keyframes.stamps_ns
        place = bisect_left(existing_ns, stamp_ns)
        if existing_ns[place : place + 1] == [stamp_ns]:
            return place
        beside = " and ".join(
            str(stamp) for stamp in existing_ns[max(place - 1, 0) : place + 1]
        )
        nearest = f"the nearest are at {beside} ns" if beside else "there is none yet"
        raise EstimatorError(f"isam2: no keyframe at {stamp_ns} ns; {nearest}")

    def _require_keyframes(self, numbers: list[int]) -> None:
        newest = self.keyframe_count - 1
        for number in numbers:
            if not 0 <= number <= newest:
                known = f"it has 0 to {newest}" if newest >= 0 else "none was set yet"
                raise EstimatorError(f"isam2: there is no keyframe {number}; {known}")

    def _require_landmarks(self, ids: list[int], over: Over) -> None:
        known = (
            self._smoother.landmark_ids
            if over == "window"
            else self._frontend.smoothed().ids
        )
        unknown = [landmark_id for landmark_id in ids if landmark_id not in set(known)]
        if unknown:
            listed = ", ".join(map(str, known[:MOST_LISTED])) + (
                ", ..." if len(known) > MOST_LISTED else ""
            )
            raise EstimatorError(
                f"isam2: landmark {unknown[0]} is not in the graph; it holds {listed or 'none yet'}"
            )

    def _require_in_window(self, numbers: list[int]) -> None:
        """Refuse keyframes that have left a bounded window."""
        newest = self.keyframe_count - 1
        left = [
            number for number in numbers if not self._smoother.in_window([X(number)])
        ]
        if left:
            first = next(
                (k for k in range(newest) if self._smoother.in_window([X(k)])), newest
            )
            raise EstimatorError(
                f"isam2: keyframe {left[0]} has left the window, which holds {first} to {newest}; none is known any"
                ' more; history.policy = "whole" keeps all'
            )

    def trajectory(self) -> Trajectory:
        """The smoothed pose at every instant at which `process` returned an estimate.

        Solves the whole graph. Between keyframes the pose of the keyframe before is carried on by its own odometry.
        With a bounded history that is the graph of the window; poses before it are as they were when they left.
        Doubtful identities are those that fit the whole history best, chosen beside the run, which asking leaves as it
        was.
        """
        # kept by the smoother until factors are added: map and trajectory are of one solution
        values, marginals, _ = self._frontend.smoothed()
        return self._poses.trajectory(values, marginals)

    def landmarks(self) -> LandmarkMap:
        """Landmarks by identity after solving the whole graph, with marginal covariances."""
        return self._frontend.landmarks.known.with_given(
            map_of(*self._frontend.smoothed())
        )

    def newest_landmarks(self) -> LandmarkMap:
        """Landmarks by identity as of the last update of iSAM2, in milliseconds however long the run is.

        Covariances are those of `joint_covariance` over the window.
        """
        smoother = self._smoother
        # a landmark that came with the last frame may wait for the next update
        ids = [i for i in smoother.landmark_ids if smoother.in_window([L(i)])]
        return self._frontend.landmarks.known.with_given(
            map_of(smoother.estimates, smoother.marginals, ids)
        )

    def known_map(self) -> KnownMap:
        """Landmarks after solving the whole graph, with their joint covariance, for another run."""
        ids = self._smoother.landmark_ids
        found = self.landmarks()
        rows = np.searchsorted(found.ids, ids)
        joint = self.joint_covariance(landmarks=ids, over="history")
        return KnownMap.of(ids, found.positions[rows], covariance_m2=joint.matrix)

    def detections(self) -> DetectionLog:
        """Outcome of each detection; of doubtful identities in the history of `trajectory`."""
        return self._frontend.log()

    def withheld(self) -> list[str]:
        """What could not be used, a line each: headings and fixes that the estimate contradicts, then newest factors.

        Of these the variable, the factors and what was missing.
        """
        return [
            *self._keyframes.contradictions.messages(),
            *self._frontend.landmarks.known.messages(),
            *self._smoother.withheld,
        ]

    def refused_rows(self) -> list[RefusedRow]:
        """Rows of all sensors but the sonar that are not used, and why."""
        return self._keyframes.refused


def require_noise(calibration: Calibration) -> None:
    """Refuse noise of zero: a graph weighs by inverse variances."""
    sigmas = {
        "imu.gyro_noise_density": calibration.imu.gyro_noise_density,
        "dvl.velocity_sigma_m_s": min(calibration.dvl.velocity_sigma_m_s),
        "start.position_sigma_m": min(calibration.start.position_sigma_m),
        "start.rpy_sigma_rad": min(calibration.start.rpy_sigma_rad),
    }
    zero = [name for name, least in sigmas.items() if least <= 0]
    if zero:
        raise CalibrationError(
            f"isam2: {', '.join(zero)} must be above zero; give a small value for what is known well"
        )


def whole_numbers(field: str, given: Iterable[int]) -> list[int]:
    """A list of integers, or an `EstimatorError` that names the field."""
    found = np.asarray(list(given) if isinstance(given, Iterable) else given)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
        raise EstimatorError(
            f"isam2: {field}: expected a list of integers, such as [1, 2], not {given!r}"
        )
    numbers: list[int] = found.tolist()
    return numbers


def map_of(
    values: Known, marginals: Marginals | gtsam.ISAM2, ids: list[int]
) -> LandmarkMap:
    """Map of landmarks with these identities, from a solution and what gives its marginal covariances."""
    return LandmarkMap(
        np.array(ids, dtype=np.int64),
        np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3),
        np.array([marginals.marginalCovariance(L(i)) for i in ids]).reshape(-1, 3, 3),
    )
