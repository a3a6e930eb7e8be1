"""Poses between keyframes, and sonar frames predicted from there: range and azimuth of landmarks, with covariances.

With the motion M from a keyframe X to an instant, its noise covariance Q and its derivative D by the biases b, the body
is at ``X M`` then. Since ``X Exp(e_X) M Exp(D e_b) = X M Exp(Ad(M^-1) e_X + D e_b)``, its covariance is::

    J P J' + Q,    J = [Ad(M^-1), D]                                                                           (1)

P is the joint covariance of (X, b). With the sonar mounted at T, a landmark p is expected at ``h(X M T, p)``, h of
`sonar_graph.models.sonar`, with the covariance::

    S_0 = H P H' + H_M Q H_M',    H = [H_M J, H_p]                                                             (2)

Here P is the joint covariance of (X, b, p), H_M the derivative by the body's pose at the instant.

The tie of an instant to its keyframe is kept while the keyframe may still change. Once it leaves a bounded window, only
the pose is kept.
"""

import math
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import gtsam
import numpy as np

from sonar_graph.measurements import Floats, Ints
from sonar_graph.models import Mount, sight_of, wrap_angle
from sonar_graph.motion import PreintegratedMotion
from sonar_graph.numerics import (
    LOWER_LEFT,
    LOWER_RIGHT,
    UPPER_LEFT,
    Vec3,
    Vec6,
    compiled,
    cross,
    diagonal_blocks,
    inlined,
    innovation_of,
    mat,
    mat6,
    row_of,
    skew,
    store,
    store_row,
    store_row6,
)
from sonar_graph.slam.smoother import JointCovariance, Known, Marginals
from sonar_graph.states import Estimate, Trajectory

NO_BIASES = np.zeros((6, 0))
"""D of a motion that does not depend on biases."""


# numba takes longer to recognise a named tuple, or to return an array, than to evaluate a frame
Moved = tuple[Floats, Floats, Floats]
"""Motion as arrays: mean, shape (4, 4), D, shape (6, 11) or `NO_BIASES`, and Q."""
SonarOnBody = tuple[Floats, Floats]
"""Pose of the body in the world, and of the sonar in the body, shape (4, 4)."""


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

    def moved(self, i_T_j: gtsam.Pose3) -> Moved:
        """The motion as arrays, with the mean as corrected for biases."""
        D = NO_BIASES if self.bias_key is None else self.motion.D_bias
        return i_T_j.matrix(), D, self.motion.covariance


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
        rows = joint.first_rows(self.tie.keys)
        cov = carried_covariance(self.tie.moved(i_T_j), joint.matrix, rows)
        return Estimate(self.stamp_ns, values.atPose3(pose_key).compose(i_T_j), cov)


class PoseHistory:
    """Instants in the order of time: first those whose pose is final, then those that may still change."""

    def __init__(self) -> None:
        self._final: list[Trajectory] = []
        """Poses that left the window, of each time together."""
        self._open: list[AnchoredPose] = []

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
            leaving = _estimates(self._open[:count], values, marginals)
            self._final.append(Trajectory.from_estimates(leaving))
        del self._open[:count]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop older final poses."""
        while self._final and self._final[0].stamps_ns[-1] < stamp_ns:
            del self._final[0]
        if self._final:
            first = int(self._final[0].stamps_ns.searchsorted(stamp_ns))
            self._final[0] = self._final[0].rows(slice(first, None))

    def trajectory(self, values: Known, marginals: Marginals) -> Trajectory:
        """Poses at all instants."""
        rest = Trajectory.from_estimates(_estimates(self._open, values, marginals))
        parts = [*self._final, rest]
        return Trajectory(
            np.concatenate([part.stamps_ns for part in parts]),
            np.concatenate([part.positions for part in parts]),
            np.concatenate([part.quaternions_xyzw for part in parts]),
            np.concatenate([part.covariances for part in parts]),
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
        world_T_body = world_T_keyframe.compose(tie.motion.i_T_j)
        self.world_T_sonar = world_T_body.compose(body_T_sonar)
        """Pose of the sonar at the frame."""
        self._tie = tie
        self._keyframe = world_T_keyframe.matrix()
        self._sonar = world_T_body.matrix(), body_T_sonar.matrix()
        self._covariance = covariance

    def beams(self, z: Floats) -> tuple[Floats, Floats]:
        """Points of the world at range and azimuth, (m, 2), and elevation 0, and how sure their height is.

        Returns
        -------
        Points, shape (m, 3), m, and the variance of their world z by keyframe and motion, shape (m,), m². The gyro bias
        is left out: it turns mostly about the vertical.
        """
        joint = self._covariance
        row = joint.rows[self._tie.pose_key]
        P = np.ascontiguousarray(joint.matrix[row : row + 6, row : row + 6])
        points = np.empty((len(z), 3))
        variance = np.empty(len(z))
        covariances = (P, self._tie.motion.covariance)
        write_beams(self._sonar, self._keyframe, covariances, z, (points, variance))
        return points, variance

    def expect(self, keys: list[int], points: Floats) -> tuple[Floats, Floats]:
        """Expected range and azimuth of landmarks at points of the world, shape (m, 3).

        Returns
        -------
        Range (m) and azimuth (rad), shape (m, 2), and their covariances, shape (m, 2, 2).
        """
        expected, joint = self.expect_jointly(keys, points, [])
        return expected, diagonal_blocks(joint, 2)

    def expect_jointly(
        self, keys: list[int], points: Floats, sources: list[Source]
    ) -> tuple[Floats, Floats]:
        """Joint expectation of landmarks of the graph, shape (m, 3), and of points that are not in it.

        Returns
        -------
        Range (m) and azimuth (rad), shape (m + s, 2), and their joint covariance, shape (2 (m + s), 2 (m + s)).
        """
        joint = self._covariance
        P = joint.matrix
        rows = joint.first_rows([*self._tie.keys, *keys])
        if sources:
            points = np.array([*points, *(source.point for source in sources)])
            located = np.arange(len(P), len(P) + 3 * len(sources), 3)
            rows = np.concatenate((rows, located))
            P = with_sources(joint, sources)
        moved = self._tie.moved(self._tie.motion.i_T_j)
        return expected_views(self._sonar, moved, P, rows, points)

    def compare(
        self, keys: list[int], points: Floats, z: Floats, cov: Floats
    ) -> Compared:
        """Detections z, shape (m, 2), with noise (m, 2, 2), of landmarks at points of the world, shape (m, 3)."""
        return weigh(z, *self.expect_jointly(keys, points, []), cov)

    def blurred(
        self, cov: Floats, motion: PreintegratedMotion, points: Floats
    ) -> Floats:
        """Noise of range and azimuth of points of the world, (m, 2, 2), with that of a motion that ends at the frame.

        Only the variances grow. The motion also correlates range and azimuth a little, which is left out.
        """
        noise = cov.copy()
        blur(self._sonar, motion.covariance, points, noise)
        return noise


def with_sources(covariance: JointCovariance, sources: list[Source]) -> Floats:
    """Joint covariance of all variables, shape (N, N), and of s located points after them, (N + 3 s, N + 3 s)."""
    P = covariance.matrix
    by_variables = np.zeros((3 * len(sources), len(P)))
    own = np.zeros((3 * len(sources), 3 * len(sources)))
    for k, source in enumerate(sources):
        of_point = slice(3 * k, 3 * k + 3)
        row = covariance.rows[source.pose_key]
        by_variables[of_point, row : row + 6] = source.by_pose
        # independent of all variables of the graph
        own[of_point, of_point] = source.cov
    of_both = by_variables @ P
    return np.block([[P, of_both.T], [of_both, of_both @ by_variables.T + own]])


def weigh(z: Floats, expected: Floats, joint: Floats, cov: Floats) -> Compared:
    """Compare m detections and their noise with the expectation and its joint covariance, shape (2 m, 2 m)."""
    m = len(z)
    found = Compared(np.empty((m, 2)), np.empty((m, 2, 2)), np.empty(m), np.empty(m))
    write_compared(z, expected, joint, cov, (*found,))
    return found


@compiled
def write_compared(
    z: Floats,
    expected: Floats,
    joint: Floats,
    cov: Floats,
    found: tuple[Floats, Floats, Floats, Floats],
) -> None:
    """Fill the columns of `Compared`."""
    innovation, S, distance, gain = found
    for k in range(len(z)):
        r = z[k, 0] - expected[k, 0]
        alpha = wrap_angle(z[k, 1] - expected[k, 1])
        innovation[k, 0] = r
        innovation[k, 1] = alpha
        for i in range(2):
            for j in range(2):
                S[k, i, j] = joint[2 * k + i, 2 * k + j] + cov[k, i, j]
        a = S[k, 0, 0]
        b = S[k, 0, 1]
        c = S[k, 1, 1]
        # e' S^-1 e with the closed inverse of a 2 x 2 matrix
        squares = c * r**2 - 2.0 * b * r * alpha + a * alpha**2
        distance[k] = squares / (a * c - b**2)
        of_range = joint[2 * k, 2 * k] / cov[k, 0, 0]
        gain[k] = max(of_range, joint[2 * k + 1, 2 * k + 1] / cov[k, 1, 1])


@inlined
def by_state(moved: Moved) -> Floats:
    """J of (1), shape (6, n): by the keyframe, then by the biases if the motion depends on them."""
    i_T_j, D, _ = moved
    J = np.zeros((6, 6 + D.shape[1]))
    R_inverse = mat(i_T_j).T
    store(R_inverse, J, UPPER_LEFT)  # Ad(M^-1)
    store(-1.0 * (R_inverse @ skew(position(i_T_j))), J, LOWER_LEFT)
    store(R_inverse, J, LOWER_RIGHT)
    # assigning to a slice would take seconds to compile
    for i in range(6):
        for k in range(D.shape[1]):
            J[i, 6 + k] = D[i, k]
    return J


@inlined
def joint_of(P: Floats, rows: Ints, biases: int) -> Floats:
    """Joint covariance of keyframe, biases and points; P is that of more variables, where they begin at these rows."""
    places = np.empty(6 + biases + 3 * len(rows), np.int64)
    n = 0
    for k in range(len(rows)):
        size = 3
        if k == 0:
            size = 6
        elif k == 1 and biases > 0:
            size = biases
        for i in range(size):
            places[n] = rows[k] + i
            n += 1
    found = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            found[i, j] = P[places[i], places[j]]
    return found


@compiled
def carried_covariance(moved: Moved, P: Floats, rows: Ints) -> Floats:
    """(1), shape (6, 6); P and rows are those of `joint_of`."""
    J = by_state(moved)
    _, D, Q = moved
    _, JPJ_Q = innovation_of(joint_of(P, rows, D.shape[1]), J, Q)
    return JPJ_Q


@compiled
def expected_views(
    sonar: SonarOnBody, moved: Moved, P: Floats, rows: Ints, points: Floats
) -> tuple[Floats, Floats]:
    """Range and azimuth of m points, shape (m, 2), after a motion, and their joint covariance (2), shape (2 m, 2 m).

    P and rows are those of `joint_of`.
    """
    world_T_body, body_T_sonar = sonar
    _, D, Q = moved
    m = len(points)
    expected = np.empty((m, 2))
    mount = Mount(body_T_sonar, body_T_sonar[:3, 3])
    J = by_state(moved)
    n = J.shape[1]
    H = np.zeros((2 * m, n + 3 * m))
    H_M = np.empty((2 * m, 6))
    for k in range(m):
        point = row_of(points, k)
        sight = sight_of(mat(world_T_body), position(world_T_body), mount, point)
        expected[k, 0] = sight.range_m
        expected[k, 1] = sight.azimuth_rad
        store_row6(sight.range_by_body, H_M, 2 * k, 0)
        store_row6(sight.azimuth_by_body, H_M, 2 * k + 1, 0)
        store_row(sight.range_by_point, H, 2 * k, n + 3 * k)
        store_row(sight.azimuth_by_point, H, 2 * k + 1, n + 3 * k)
    for r in range(2 * m):
        for i in range(6):
            for c in range(n):
                H[r, c] += H_M[r, i] * J[i, c]  # H_M J
    _, HQH = innovation_of(Q, H_M, np.zeros((2 * m, 2 * m)))
    _, S_0 = innovation_of(joint_of(P, rows, D.shape[1]), H, HQH)
    return expected, S_0


@compiled
def blur(sonar: SonarOnBody, C: Floats, points: Floats, noise: Floats) -> None:
    """Add to the noise of range and azimuth of points, (m, 2, 2), their variances by the covariance C of the body."""
    world_T_body, body_T_sonar = sonar
    mount = Mount(body_T_sonar, body_T_sonar[:3, 3])
    for k in range(len(points)):
        point = row_of(points, k)
        sight = sight_of(mat(world_T_body), position(world_T_body), mount, point)
        noise[k, 0, 0] += sight.range_by_body @ (mat6(C) @ sight.range_by_body)
        noise[k, 1, 1] += sight.azimuth_by_body @ (mat6(C) @ sight.azimuth_by_body)


@compiled
def write_beams(
    sonar: SonarOnBody,
    world_T_keyframe: Floats,
    covariances: tuple[Floats, Floats],
    z: Floats,
    found: tuple[Floats, Floats],
) -> None:
    """Fill in points and variances of `PredictedView.beams`; covariances of the keyframe's pose and of the motion."""
    world_T_body, body_T_sonar = sonar
    P, Q = covariances
    points, variance = found
    for k in range(len(z)):
        on_beam = Vec3(z[k, 0] * math.cos(z[k, 1]), z[k, 0] * math.sin(z[k, 1]), 0.0)
        q = position(body_T_sonar) + mat(body_T_sonar) @ on_beam
        point = position(world_T_body) + mat(world_T_body) @ q
        store_row(point, points, k, 0)
        h = height_by_body(world_T_keyframe, point)
        h_M = height_by_body(world_T_body, point)
        variance[k] = h @ (mat6(P) @ h) + h_M @ (mat6(Q) @ h_M)


@inlined
def position(T: Floats) -> Vec3:
    """Position of a pose of shape (4, 4)."""
    return Vec3(T[0, 3], T[1, 3], T[2, 3])


@inlined
def height_by_body(T: Floats, point: Vec3) -> Vec6:
    """Derivative of the world z of a point that is fixed to a body, by the body's pose T, shape (4, 4)."""
    up = mat(T).z  # in the body
    return Vec6(cross(mat(T).T @ (point - position(T)), up), up)
