"""The instants at which estimates were asked for, and the poses there once more is known.

An instant is tied to the newest keyframe of its time. While that keyframe may still change, the tie is kept; in a
bounded window it cannot change any more once it leaves, and only the pose is kept, 232 bytes an instant.

Joint covariances of keyframes and landmarks, asked for by their numbers or stamps.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, NamedTuple, get_args

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from sonar_graph.errors import EstimatorError
from sonar_graph.measurements import Floats
from sonar_graph.navigation.preintegration import PreintegratedMotion
from sonar_graph.numerics import compiled
from sonar_graph.slam.smoother import JointCovariance, Smoother
from sonar_graph.states import Estimate, Trajectory

NO_DERIVATIVE = np.zeros((6, 3))
TRIANGLE = np.tril_indices(6)


@dataclass(frozen=True, eq=False)
class AnchoredPose:
    """An instant, tied to the newest keyframe of its time by odometry."""

    stamp_ns: int
    keyframe: int
    bias_key: int | None
    """Of the gyro bias since that keyframe; None when there is none to estimate."""
    motion: PreintegratedMotion

    def keys(self) -> list[int]:
        """Of the variables on which the pose depends."""
        return [X(self.keyframe)] if self.bias_key is None else [X(self.keyframe), self.bias_key]

    def carried_on(self, values: gtsam.Values, joint: JointCovariance) -> Estimate:
        """The pose at this instant from that of the keyframe (and the bias, whose error the motion inherits).

        ``X Exp(e_X) M Exp(D e_b) = X M Exp(Ad(M^-1) e_X + D e_b)``, so the covariance is ``J P J^T`` with
        ``J = [Ad(M^-1) D]`` and P that of keyframe and bias, plus that of the motion.
        """
        key, motion, D_bias = X(self.keyframe), self.motion.i_T_j, NO_DERIVATIVE
        bias_row = 0
        if self.bias_key is not None:
            motion, D_bias = self.motion.corrected(values.atPoint3(self.bias_key)), self.motion.D_bias
            bias_row = joint.rows[self.bias_key]
        J_pose = motion.inverse().AdjointMap()
        cov = _carried_on(joint.matrix, joint.rows[key], bias_row, J_pose, D_bias, self.motion.covariance)
        return Estimate(self.stamp_ns, values.atPose3(key).compose(motion), cov)


class PoseHistory:
    """Instants in the order of time."""

    def __init__(self) -> None:
        self._open: list[AnchoredPose] = []
        self._final = FinalPoses()

    @property
    def newest_ns(self) -> int | None:
        """The last instant; None before the first."""
        return self._open[-1].stamp_ns if self._open else None

    def add(self, instant: AnchoredPose) -> None:
        """The next one; in place of the last when it is the same."""
        if self.newest_ns == instant.stamp_ns:
            self._open.pop()
        self._open.append(instant)

    def leave(self, pose_keys: set[int], values: gtsam.Values, marginals: gtsam.ISAM2) -> None:
        """Keyframes leave a bounded window, and what hangs on them is as it is now."""
        count = 0
        while count < len(self._open) and X(self._open[count].keyframe) in pose_keys:
            count += 1
        if count:
            self._final.add(Trajectory.from_estimates(_estimates(self._open[:count], values, marginals)))
        del self._open[:count]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that cannot change any more and are older."""
        self._final.forget_before(stamp_ns)

    def trajectory(self, values: gtsam.Values, marginals: gtsam.Marginals | gtsam.ISAM2) -> Trajectory:
        """Through all instants."""
        return self._final.then(Trajectory.from_estimates(_estimates(self._open, values, marginals)))


def _estimates(
    instants: list[AnchoredPose], values: gtsam.Values, marginals: gtsam.Marginals | gtsam.ISAM2
) -> list[Estimate]:
    estimates = []
    for _, on_one in groupby(instants, key=lambda instant: instant.keyframe):
        together = list(on_one)
        joint = JointCovariance.of(marginals, together[0].keys())
        estimates += [instant.carried_on(values, joint) for instant in together]
    return estimates


class FinalPoses:
    """Poses that stay as they are, in columns."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._poses = array("d")
        self._triangles = array("d")

    def add(self, part: Trajectory) -> None:
        """The next ones: position and quaternion, and the lower triangle of the covariance."""
        i, j = TRIANGLE
        self._stamps_ns.extend(part.stamps_ns.tolist())
        self._poses.extend(np.hstack([part.positions, part.quaternions_xyzw]).ravel().tolist())
        self._triangles.extend(part.covariances[:, i, j].ravel().tolist())

    def forget_before(self, stamp_ns: int) -> None:
        """Drop older ones."""
        count = bisect_left(self._stamps_ns, stamp_ns)
        del self._stamps_ns[:count], self._poses[: 7 * count], self._triangles[: 21 * count]

    def then(self, rest: Trajectory) -> Trajectory:
        """These, and what follows."""
        n = len(self._stamps_ns)
        if n == 0:
            return rest
        poses = np.array(self._poses).reshape(n, 7)
        covariances = np.empty((n, 6, 6))
        i, j = TRIANGLE
        covariances[:, i, j] = covariances[:, j, i] = np.array(self._triangles).reshape(n, -1)
        return Trajectory(
            np.concatenate([np.array(self._stamps_ns), rest.stamps_ns]),
            np.concatenate([poses[:, :3], rest.positions]),
            np.concatenate([poses[:, 3:], rest.quaternions_xyzw]),
            np.concatenate([covariances, rest.covariances]),
        )


@compiled
def _carried_on(
    joint: Floats, pose_row: int, bias_row: int, J_pose: Floats, D_bias: Floats, motion_cov: Floats
) -> Floats:
    pose, bias = slice(pose_row, pose_row + 6), slice(bias_row, bias_row + 3)
    P_pose, P_cross, P_bias = joint[pose, pose].copy(), joint[pose, bias].copy(), joint[bias, bias].copy()
    cross = J_pose @ P_cross @ D_bias.T
    cov = J_pose @ P_pose @ J_pose.T + cross + cross.T + D_bias @ P_bias @ D_bias.T + motion_cov
    return 0.5 * (cov + cov.T)


Over = Literal["window", "history"]
MOST_LISTED = 12
"""Landmarks that a message lists."""


class Solution(NamedTuple):
    """Of the whole graph."""

    values: gtsam.Values
    marginals: gtsam.Marginals | gtsam.ISAM2
    ids: list[int]
    """Of the landmarks in it, ascending."""


def joint_covariance(
    smoother: Smoother,
    history: Callable[[], Solution],
    stamps_ns: Sequence[int],
    over: Over,
    keyframes: Iterable[int],
    at_ns: Iterable[int],
    landmarks: Iterable[int],
) -> JointCovariance:
    """See `sonar_graph.slam.isam2.Isam2.joint_covariance`.

    Parameters
    ----------
    history
        Solves the whole graph.
    stamps_ns
        Of all keyframes of the run.
    at_ns
        Stamps of those that are asked for beside ``keyframes``.
    """
    if over not in get_args(Over):
        raise EstimatorError(f'isam2: over is {over!r}; expected "window" or "history"')
    keyframes, at_ns, landmarks = (
        _numbers(*asked) for asked in (("keyframes", keyframes), ("stamps_ns", at_ns), ("landmarks", landmarks))
    )
    poses = [*keyframes, *(_number_at(stamp_ns, stamps_ns) for stamp_ns in at_ns)]
    for number in poses:
        if not 0 <= number < len(stamps_ns):
            raise EstimatorError(f"isam2: there is no keyframe {number}; {_existing(len(stamps_ns))}")
    known_ids = smoother.landmark_ids if over == "window" else history().ids
    keys = list(dict.fromkeys([*map(X, poses), *map(L, _known(landmarks, known_ids))]))
    if not keys:
        raise EstimatorError("isam2: the covariance of nothing was asked for; give keyframes, stamps or landmarks")
    held = set(smoother.in_window(keys))
    left = [number for number in dict.fromkeys(poses) if X(number) not in held]
    if left and (over == "window" or smoother.is_bounded):
        first = next((k for k in range(len(stamps_ns)) if smoother.in_window([X(k)])), len(stamps_ns) - 1)
        instead = "none is known any more" if smoother.is_bounded else 'ask over="history" for older ones'
        raise EstimatorError(
            f"isam2: keyframe {left[0]} has left the window, which holds {first} to {len(stamps_ns) - 1}; {instead}"
        )
    if over == "window":
        return JointCovariance.of(smoother.marginals, sorted(keys))
    return JointCovariance.of(history().marginals, sorted(keys))


def _numbers(field: str, asked: object) -> list[int]:
    found = np.asarray(list(asked) if isinstance(asked, Iterable) else asked)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
        raise EstimatorError(f"isam2: {field}: expected a list of integers, such as [1, 2], not {asked!r}")
    return [int(number) for number in found.tolist()]


def _number_at(stamp_ns: int, stamps_ns: Sequence[int]) -> int:
    place = bisect_left(stamps_ns, stamp_ns)
    if place < len(stamps_ns) and stamps_ns[place] == stamp_ns:
        return place
    beside = " and ".join(str(stamp) for stamp in stamps_ns[max(place - 1, 0) : place + 1])
    nearest = f"the nearest are at {beside} ns" if beside else "there is none yet"
    raise EstimatorError(f"isam2: no keyframe at {stamp_ns} ns; {nearest}")


def _known(landmarks: Iterable[int], ids: list[int]) -> list[int]:
    asked = list(landmarks)
    unknown = [i for i in asked if i not in set(ids)]
    if unknown:
        listed = ", ".join(map(str, ids[:MOST_LISTED])) + (", ..." if len(ids) > MOST_LISTED else "")
        raise EstimatorError(f"isam2: landmark {unknown[0]} is not in the graph; it holds {listed or 'none yet'}")
    return asked


def _existing(count: int) -> str:
    return f"it has 0 to {count - 1}" if count else "none was set yet"
