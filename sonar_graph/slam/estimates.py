"""Results of the estimator: poses at the instants of its calls, and the batch solution of the graph.

An instant is tied to the newest keyframe of its time by odometry. The tie is kept while that keyframe may still change.
Once it leaves a bounded window, only the pose is kept: 232 bytes for each instant.
"""

from array import array
from bisect import bisect_left
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.slam.smoother import JointCovariance, Known, Marginals
from sonar_graph.states import Estimate, Trajectory

TRIANGLE = np.tril_indices(6)


@dataclass(frozen=True, eq=False)
class AnchoredPose:
    """Instant tied to the newest keyframe of its time by odometry."""

    stamp_ns: int
    keyframe: int
    bias_key: int | None
    """Gyro bias since that keyframe; None when none is estimated."""
    motion: PreintegratedMotion

    def keys(self) -> list[int]:
        """Variables on which the pose depends."""
        return [X(self.keyframe)] if self.bias_key is None else [X(self.keyframe), self.bias_key]

    def carried_on(self, values: Known, joint: JointCovariance) -> Estimate:
        """Pose at this instant from the keyframe and the gyro bias, whose error the motion inherits.

        ``X Exp(e_X) M Exp(D e_b) = X M Exp(Ad(M^-1) e_X + D e_b)``, so the covariance is ``J P J^T`` with
        ``J = [Ad(M^-1) D]`` and P that of keyframe and bias, plus that of the motion.
        """
        key = X(self.keyframe)
        row = joint.rows[key]
        i_T_j = self.motion.i_T_j
        J = np.zeros((6, len(joint.matrix)))
        if self.bias_key is not None:
            i_T_j = self.motion.corrected(values.atVector(self.bias_key))
            bias_row = joint.rows[self.bias_key]
            J[:, bias_row : bias_row + len(self.motion.bias)] = self.motion.D_bias
        J[:, row : row + 6] = i_T_j.inverse().AdjointMap()
        cov = J @ joint.matrix @ J.T + self.motion.covariance
        return Estimate(self.stamp_ns, values.atPose3(key).compose(i_T_j), 0.5 * (cov + cov.T))


class PoseHistory:
    """Instants in the order of time: first those whose pose is final, in columns, then those that may still change."""

    def __init__(self) -> None:
        self._open: list[AnchoredPose] = []
        self._stamps_ns = array("q")
        self._poses = array("d")
        self._triangles = array("d")

    @property
    def newest_ns(self) -> int | None:
        """Last instant; None before the first."""
        return self._open[-1].stamp_ns if self._open else None

    def add(self, instant: AnchoredPose) -> None:
        """Append an instant, in place of the last one when the stamp is the same."""
        if self.newest_ns == instant.stamp_ns:
            self._open.pop()
        self._open.append(instant)

    def leave(self, pose_keys: set[int], values: Known, marginals: gtsam.ISAM2) -> None:
        """Make poses final whose keyframes leave a bounded window: position, quaternion, half of the covariance."""
        count = 0
        while count < len(self._open) and X(self._open[count].keyframe) in pose_keys:
            count += 1
        if count:
            part = Trajectory.from_estimates(_estimates(self._open[:count], values, marginals))
            i, j = TRIANGLE
            self._stamps_ns.extend(part.stamps_ns.tolist())
            self._poses.extend(np.hstack([part.positions, part.quaternions_xyzw]).ravel().tolist())
            self._triangles.extend(part.covariances[:, i, j].ravel().tolist())
        del self._open[:count]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop older final poses."""
        count = bisect_left(self._stamps_ns, stamp_ns)
        del self._stamps_ns[:count], self._poses[: 7 * count], self._triangles[: 21 * count]

    def trajectory(self, values: Known, marginals: Marginals) -> Trajectory:
        """Poses at all instants."""
        rest = Trajectory.from_estimates(_estimates(self._open, values, marginals))
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


def _estimates(instants: list[AnchoredPose], values: Known, marginals: Marginals | gtsam.ISAM2) -> list[Estimate]:
    estimates = []
    for _, on_one in groupby(instants, key=lambda instant: instant.keyframe):
        together = list(on_one)
        joint = JointCovariance.of(marginals, together[0].keys())
        estimates += [instant.carried_on(values, joint) for instant in together]
    return estimates


class Solution(NamedTuple):
    """Solution of the whole graph."""

    values: Known
    marginals: Marginals
    ids: list[int]
    """Landmarks in it, ascending."""
