"""The instants at which estimates were asked for, and the poses there once more is known.

An instant is tied to the newest keyframe of its time. While that keyframe may still change, the tie is kept; in a
bounded window it cannot change any more once it leaves, and only the pose is kept, 232 bytes an instant.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from dataclasses import dataclass
from itertools import groupby

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion
from sonar_graph.navigation.kernels import compiled
from sonar_graph.slam.joint_covariance import JointCovariance
from sonar_graph.states import Estimate, Trajectory

NO_DERIVATIVE = np.zeros((6, 3))
TRIANGLE = np.tril_indices(6)


@dataclass(frozen=True, eq=False)
class Anchored:
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


class Asked:
    """Instants in the order of time."""

    def __init__(self) -> None:
        self._open: list[Anchored] = []
        self._final = FinalPoses()

    @property
    def newest_ns(self) -> int | None:
        """The last instant; None before the first."""
        return self._open[-1].stamp_ns if self._open else None

    def add(self, instant: Anchored) -> None:
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
    instants: list[Anchored], values: gtsam.Values, marginals: gtsam.Marginals | gtsam.ISAM2
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
