"""Poses between keyframes, and sonar frames predicted from there: range and azimuth of landmarks, with covariances.

With the motion M from a keyframe X to an instant, its noise covariance Q and its derivative D by the biases b, the body
is at ``X M`` then. Since ``X Exp(e_X) M Exp(D e_b) = X M Exp(Ad(M^-1) e_X + D e_b)``, its covariance is::

    J P J' + Q,    J = [Ad(M^-1), D]                                                                           (1)

P is the joint covariance of (X, b). With the sonar mounted at T, a landmark p is expected at ``h(X M T, p)``, h of
`sonar_graph.models.sonar`, with the covariance::

    S_0 = H P H' + H_M Q H_M',    H = [H_M J, H_p]                                                             (2)

Here P is the joint covariance of (X, b, p), H_M the derivative by the body's pose at the instant.

The tie of an instant to its keyframe is kept while the keyframe may still change. Once it leaves a bounded window, only
the pose is kept: 232 bytes for each instant.
"""

import math
from array import array
from bisect import bisect_left
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.models import Mount, sight_of, view_points, wrap_angle
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.numerics import (
    Vec3,
    Vec6,
    compiled,
    cross,
    mat,
    mat6,
    store_row,
    vec,
)
from sonar_graph.slam.smoother import JointCovariance, Known, Marginals
from sonar_graph.states import Estimate, Trajectory

TRIANGLE = np.tril_indices(6)


class Tie(NamedTuple):
    """Instant that is tied to a keyframe by odometry."""

    pose_key: int
    bias_key: int | None
    """Biases since the keyframe; None where the motion does not depend on them."""
    motion: PreintegratedMotion
    """M, from the keyframe to the instant."""

    @property
    def keys(self) -> list[int]:
        """Variables on which the pose at the instant depends."""
        return (
            [self.pose_key] if self.bias_key is None else [self.pose_key, self.bias_key]
        )

    def by_state(self, i_T_j: gtsam.Pose3, covariance: JointCovariance) -> Floats:
        """J of (1), by all variables of a joint covariance, shape (6, N), for the motion as corrected for biases."""
        J = np.zeros((6, len(covariance.matrix)))
        row = covariance.rows[self.pose_key]
        J[:, row : row + 6] = i_T_j.inverse().AdjointMap()
        if self.bias_key is not None:
            row = covariance.rows[self.bias_key]
            J[:, row : row + len(self.motion.bias)] = self.motion.D_bias
        return J


@dataclass(frozen=True, eq=False)
class AnchoredPose:
    """Instant of a call of the estimator, tied to the newest keyframe of its time."""

    stamp_ns: int
    tie: Tie

    def carried_on(self, values: Known, joint: JointCovariance) -> Estimate:
        """Pose at this instant from the keyframe and the biases, whose errors the motion inherits; (1)."""
        pose_key, bias_key, motion = self.tie
        # the biases may have moved since the motion was integrated
        i_T_j = (
            motion.i_T_j
            if bias_key is None
            else motion.corrected(values.atVector(bias_key))
        )
        J = self.tie.by_state(i_T_j, joint)
        cov = J @ joint.matrix @ J.T + motion.covariance
        return Estimate(
            self.stamp_ns, values.atPose3(pose_key).compose(i_T_j), 0.5 * (cov + cov.T)
        )


class PoseHistory:
    """Instants in the order of time: first those whose pose is final, in columns, then those that may still change."""

    def __init__(self) -> None:
        self._open: list[AnchoredPose] = []
        self._stamps_ns = array("q")
        self._poses = array("d")
        """Position and quaternion, seven numbers for each instant."""
        self._triangles = array("d")
        """Lower triangle of the covariance, 21 numbers for each instant."""

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
        """Make the poses final whose keyframes leave a bounded window."""
        count = 0
        while count < len(self._open) and self._open[count].tie.pose_key in pose_keys:
            count += 1
        if count:
            part = Trajectory.from_estimates(
                _estimates(self._open[:count], values, marginals)
            )
            i, j = TRIANGLE
            self._stamps_ns.extend(part.stamps_ns.tolist())
            self._poses.extend(
                np.hstack([part.positions, part.quaternions_xyzw]).ravel().tolist()
            )
            self._triangles.extend(part.covariances[:, i, j].ravel().tolist())
        del self._open[:count]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop older final poses."""
        count = bisect_left(self._stamps_ns, stamp_ns)
        del self._stamps_ns[:count]
        del self._poses[: 7 * count]
        del self._triangles[: 21 * count]

    def trajectory(self, values: Known, marginals: Marginals) -> Trajectory:
        """Poses at all instants."""
        rest = Trajectory.from_estimates(_estimates(self._open, values, marginals))
        n = len(self._stamps_ns)
        if n == 0:  # the usual case of a whole history
            return rest
        poses = np.array(self._poses).reshape(n, 7)
        covariances = np.empty((n, 6, 6))
        i, j = TRIANGLE
        triangles = np.array(self._triangles).reshape(n, -1)  # (n, 21)
        covariances[:, i, j] = triangles
        covariances[:, j, i] = triangles
        return Trajectory(
            np.concatenate([np.array(self._stamps_ns), rest.stamps_ns]),
            np.concatenate([poses[:, :3], rest.positions]),
            np.concatenate([poses[:, 3:], rest.quaternions_xyzw]),
            np.concatenate([covariances, rest.covariances]),
        )


def _estimates(
    instants: list[AnchoredPose], values: Known, marginals: Marginals | gtsam.ISAM2
) -> list[Estimate]:
    estimates = []
    # instants of one keyframe share its covariance, which is most of the work
    for _, on_one in groupby(instants, key=lambda instant: instant.tie.pose_key):
        together = list(on_one)
        joint = JointCovariance.of(marginals, together[0].tie.keys)
        estimates += [instant.carried_on(values, joint) for instant in together]
    return estimates


class Compared(NamedTuple):
    """Innovations of m detections."""

    innovation: Floats
    """Measured minus expected range (m) and azimuth (rad, wrapped), shape (m, 2)."""
    S: Floats
    """Covariance of the innovation, shape (m, 2, 2)."""
    distance: Floats
    """Squared Mahalanobis distance of the innovation, shape (m,)."""
    gain: Floats
    """Larger ratio of expected variance to noise variance, shape (m,): the information that a detection adds."""


class Source(NamedTuple):
    """A point that is not in the graph, as located from a keyframe that is."""

    pose_key: int
    point: Floats
    """Point in the world, shape (3,), m."""
    by_pose: Floats
    """Its derivative by the keyframe, shape (3, 6)."""
    cov: Floats
    """Covariance of the point as seen from the keyframe, shape (3, 3), m²."""


class PredictedView:
    """Prediction of a frame from a keyframe whose estimate and covariance are known.

    Parameters
    ----------
    tie
        The frame, tied to the keyframe.
    world_T_keyframe
        X as estimated.
    covariance
        Joint covariance of the keyframe, its biases and the landmarks.
    """

    def __init__(
        self,
        tie: Tie,
        world_T_keyframe: gtsam.Pose3,
        body_T_sonar: gtsam.Pose3,
        covariance: JointCovariance,
    ) -> None:
        motion = tie.motion
        world_T_body = world_T_keyframe.compose(motion.i_T_j)
        self.world_T_sonar = world_T_body.compose(body_T_sonar)
        """Pose of the sonar at the frame."""
        self._keyframe = as_arrays(world_T_keyframe)
        self._body = as_arrays(world_T_body)
        self._sonar = as_arrays(self.world_T_sonar)
        self._mount = Mount(*as_arrays(body_T_sonar))
        self._covariance = covariance
        self._motion = motion
        self._pose_row = covariance.rows[tie.pose_key]
        self._by_body = body_T_sonar.inverse().AdjointMap()
        """Derivative of the sonar's pose by the body's, both at the frame, shape (6, 6)."""
        self._by_state = self._by_body @ tie.by_state(motion.i_T_j, covariance)
        """Derivative of the sonar's pose by all variables of the covariance, shape (6, N)."""

    def height_variances(self, points: Floats) -> Floats:
        """Variance of the world z of points fixed to the body at the frame, shape (m,), m².

        Keyframe and motion count. The gyro bias is left out: it turns mostly about the vertical.

        Parameters
        ----------
        points
            In the world, shape (m, 3).
        """
        row = self._pose_row
        P = self._covariance.matrix[row : row + 6, row : row + 6]
        P = np.ascontiguousarray(P)
        from_keyframe = height_variances(*self._keyframe, P, points)
        from_motion = height_variances(*self._body, self._motion.covariance, points)
        return np.asarray(from_keyframe + from_motion)

    def beam_points(self, z: Floats) -> Floats:
        """Points of the world at range and azimuth, (m, 2), and elevation 0, shape (m, 3), m."""
        return beam_points(*self._sonar, z)

    def world_z_by_elevation(self) -> float:
        """Height by which a point at elevation 0 rises for each radian of elevation and metre of range."""
        return float(self._sonar[0][2, 2])

    def expect(self, keys: list[int], points: Floats) -> tuple[Floats, Floats]:
        """Expected range and azimuth of landmarks at points of the world, shape (m, 3).

        Returns
        -------
        Range (m) and azimuth (rad), shape (m, 2), and their covariances, shape (m, 2, 2).
        """
        predicted, joint = self.expect_jointly(keys, points, [])
        m = len(keys)
        place = np.arange(m)
        # blocks on the diagonal
        return predicted, joint.reshape(m, 2, m, 2)[place, :, place]

    def expect_jointly(
        self, keys: list[int], points: Floats, sources: list[Source]
    ) -> tuple[Floats, Floats]:
        """Joint expectation of landmarks of the graph, shape (m, 3), and of points that are not in it.

        Returns
        -------
        Range (m) and azimuth (rad), shape (m + s, 2), and their joint covariance, shape (2 (m + s), 2 (m + s)).
        """
        if sources:
            points = np.array([*points, *(source.point for source in sources)])
        predicted, by_sonar, by_point = view_points(self.world_T_sonar, points)
        rows = self._covariance.rows
        P = self._covariance.matrix
        Q = self._motion.covariance
        n = len(points)
        H = by_sonar @ self._by_state  # (n, 2, N)
        for k, key in enumerate(keys):
            H[k, :, rows[key] : rows[key] + 3] = by_point[k]
        for k, source in enumerate(sources, start=len(keys)):
            # += : the point may have been seen from the keyframe itself
            H[k, :, rows[source.pose_key] : rows[source.pose_key] + 6] += (
                by_point[k] @ source.by_pose
            )
        H = H.reshape(2 * n, len(P))
        H_M = (by_sonar @ self._by_body).reshape(2 * n, 6)
        joint = H @ P @ H.T + H_M @ Q @ H_M.T  # (2)
        for k, source in enumerate(sources, start=len(keys)):
            # own noise of the point, independent of all variables of the graph
            joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += (
                by_point[k] @ source.cov @ by_point[k].T
            )
        return predicted, np.asarray(0.5 * (joint + joint.T))

    def compare(
        self, keys: list[int], points: Floats, z: Floats, cov: Floats
    ) -> Compared:
        """Detections z, shape (m, 2), with noise (m, 2, 2), of landmarks at points of the world, shape (m, 3)."""
        predicted, prior_cov = self.expect(keys, points)
        return weigh(z, predicted, prior_cov, cov)

    def blurred(
        self, cov: Floats, motion: PreintegratedMotion, points: Floats
    ) -> Floats:
        """Noise of range and azimuth of points of the world, (m, 2, 2), with that of a motion that ends at the frame.

        Only the variances grow. The motion also correlates range and azimuth a little, which is left out.
        """
        noise = cov.copy()
        blur(*self._body, self._mount, motion.covariance, points, noise)
        return noise


def weigh(z: Floats, expected: Floats, prior_cov: Floats, cov: Floats) -> Compared:
    """Compare m detections and their noise with the expectation and its covariance."""
    return Compared(*compared_columns(z, expected, prior_cov, cov))


@compiled
def compared_columns(
    z: Floats, expected: Floats, prior_cov: Floats, cov: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Columns of `Compared`."""
    innovation = np.empty(z.shape)
    S = np.empty(cov.shape)
    distance = np.empty(len(z))
    gain = np.empty(len(z))
    for k in range(len(z)):
        r = z[k, 0] - expected[k, 0]
        alpha = wrap_angle(z[k, 1] - expected[k, 1])
        innovation[k, 0] = r
        innovation[k, 1] = alpha
        for i in range(2):
            for j in range(2):
                S[k, i, j] = prior_cov[k, i, j] + cov[k, i, j]
        a = S[k, 0, 0]
        b = S[k, 0, 1]
        c = S[k, 1, 1]
        # e' S^-1 e with the closed inverse of a 2 x 2 matrix
        squares = c * r**2 - 2.0 * b * r * alpha + a * alpha**2
        distance[k] = squares / (a * c - b**2)
        gain[k] = max(
            prior_cov[k, 0, 0] / cov[k, 0, 0], prior_cov[k, 1, 1] / cov[k, 1, 1]
        )
    return innovation, S, distance, gain


@compiled
def height_variances(R: Floats, X: Floats, C: Floats, points: Floats) -> Floats:
    """Variances of the world z of points fixed to a body, shape (m,), m², by the covariance C of the body's pose.

    ``(R, X)``: pose of the body; C: of its right perturbation, shape (6, 6); points in the world, shape (m, 3).
    """
    found = np.empty(len(points))
    world_R_body = mat(R)
    up = world_R_body.z  # in the body
    for k in range(len(points)):
        off = Vec3(points[k, 0] - X[0], points[k, 1] - X[1], points[k, 2] - X[2])
        h = Vec6(cross(world_R_body.T @ off, up), up)
        found[k] = h @ (mat6(C) @ h)
    return found


@compiled
def blur(
    R: Floats, X: Floats, mount: Mount, C: Floats, points: Floats, noise: Floats
) -> None:
    """Add to the noise of range and azimuth of points, (m, 2, 2), their variances by the covariance C of the body."""
    for k in range(len(points)):
        point = Vec3(points[k, 0], points[k, 1], points[k, 2])
        sight = sight_of(mat(R), vec(X), mount, point)
        noise[k, 0, 0] += sight.range_by_body @ (mat6(C) @ sight.range_by_body)
        noise[k, 1, 1] += sight.azimuth_by_body @ (mat6(C) @ sight.azimuth_by_body)


@compiled
def beam_points(R: Floats, t: Floats, z: Floats) -> Floats:
    """Points of the world at range and azimuth of a sonar at ``(R, t)`` and elevation 0, shape (m, 3), m."""
    found = np.empty((len(z), 3))
    for k in range(len(z)):
        on_beam = Vec3(z[k, 0] * math.cos(z[k, 1]), z[k, 0] * math.sin(z[k, 1]), 0.0)
        store_row(vec(t) + mat(R) @ on_beam, found, k, 0)
    return found


def as_arrays(pose: gtsam.Pose3) -> tuple[Floats, Floats]:
    """Rotation and position, in the layout for which compiled code exists."""
    return np.ascontiguousarray(pose.rotation().matrix()), pose.translation()
