"""Errors of trajectories and maps against the truth: ATE, RPE, heading, return, landmarks.

    ATE = sqrt( 1/n sum_i |T(p_i) - p_true,i|^2 )        T: identity, or the best rigid alignment (Umeyama 1991)

All equations: docs/theory/metrics.md. Functions of two trajectories take them at the same instants; `Trajectory.at`
interpolates a truth there. Maps are compared by identity. Landmarks of unknown identity (from `FIRST_ANONYMOUS_ID` on)
are first matched to the true ones by their place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.errors import EvaluationError
from sonar_graph.measurements import NS_PER_S, Floats, Ints
from sonar_graph.models import wrap_angle
from sonar_graph.sequence import Sequence
from sonar_graph.states import FIRST_ANONYMOUS_ID, LandmarkMap, Trajectory

# a pair for the relative error may be this fraction of the delta longer or shorter than it
PAIRING_TOLERANCE = 0.01
# largest horizontal distance at which a landmark of unknown identity is matched to a true one
FARTHEST_M = 1.0
# residuals above this many times their median are outliers: three sigmas of a normal distribution
OUTLYING = 3 * 1.4826
# fits to the better half
CONCENTRATIONS = 10
# with fewer landmarks an outlier cannot be identified
LEAST_OUTVOTING = 5


@dataclass(frozen=True, eq=False)
class Alignment:
    """A rigid motion of the estimate's world into the truth's: ``p_truth = rotation @ p_estimate + translation``."""

    rotation: Floats
    """Shape (3, 3)."""
    translation: Floats
    """Shape (3,), metres."""

    def apply(self, points: Floats) -> Floats:
        """Points moved into the truth's world, shape (n, 3)."""
        return points @ self.rotation.T + self.translation

    def map(self, landmarks: LandmarkMap) -> LandmarkMap:
        """Landmarks moved into the truth's world, with their covariances."""
        # covariances turn with the points
        R = self.rotation
        moved = self.apply(landmarks.positions)
        return LandmarkMap(landmarks.ids, moved, R @ landmarks.covariances @ R.T)

    def path(self, path: Trajectory) -> Trajectory:
        """Poses moved into the truth's world; their covariances are of the body's axes and stay."""
        turned = path.quaternions_xyzw
        if path.has_orientation:
            turned = (Rotation.from_matrix(self.rotation) * path.rotations()).as_quat()
        moved = self.apply(path.positions)
        return Trajectory(path.stamps_ns, moved, turned, path.covariances)

    def inverse(self) -> Alignment:
        """The motion of the truth's world into the estimate's."""
        return Alignment(self.rotation.T, -self.rotation.T @ self.translation)


def umeyama(points: Floats, targets: Floats) -> tuple[Floats, Floats]:
    """The rotation and translation that minimise ``sum |targets - (R points + t)|²``, without scale.

    Where the points leave the rotation open (all in one place, or in 3-D on one line) it is one of the best.

    Parameters
    ----------
    points, targets
        Paired, shape (n, d), n >= 1.

    Returns
    -------
    R : shape (d, d), determinant +1
    t : shape (d,)

    Raises
    ------
    EvaluationError
        When there is no pair, or the shapes differ.

    References
    ----------
    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, IEEE Transactions
    on Pattern Analysis and Machine Intelligence 13(4), 1991. Equation numbers below are his.
    """
    if points.shape != targets.shape or not len(points):
        raise EvaluationError(
            f"alignment needs paired points, at least one; got {points.shape} and {targets.shape}"
        )
    mean_x = points.mean(axis=0)  # (34)
    mean_y = targets.mean(axis=0)  # (35)
    covariance = (targets - mean_y).T @ (points - mean_x) / len(points)  # (38)
    # the covariance need not have full rank: points may lie in one place or on one line
    U, _, Vt = np.linalg.svd(covariance)
    S = np.ones(points.shape[1])
    # (43), which (39) equals at full rank
    S[-1] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = (U * S) @ Vt  # (40)
    return R, mean_y - R @ mean_x  # (41) with c = 1


def align_se3(points: Floats, targets: Floats) -> Alignment:
    """The best rotation and translation in three dimensions, from points of shape (n, 3)."""
    return Alignment(*umeyama(points, targets))


def align_yaw(points: Floats, targets: Floats) -> Alignment:
    """The best rotation about the vertical and translation, from points of shape (n, 3).

    Height and heading are separate in the sum of squares, so its horizontal part is also the best SE(2) alignment.
    """
    rotation = np.eye(3)
    translation = (targets - points).mean(axis=0)
    # height and heading are separate terms of the sum of squares
    rotation[:2, :2], translation[:2] = umeyama(points[:, :2], targets[:, :2])
    return Alignment(rotation, translation)


def rmse(errors: Floats) -> float:
    """Root of the mean squared norm of the rows: errors of shape (n,) or (n, d).

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.evaluation import rmse
    >>> round(rmse(np.array([[3.0, 4.0], [0.0, 0.0]])), 3)
    3.536
    """
    # the mean is over all elements; times the columns it is the mean of the squared norms
    return float(np.sqrt(np.mean(np.square(errors)) * errors[0].size))


def yaw_rad(matrices: Floats) -> Floats:
    """Heading of the body's x axis, ``atan2(R[1, 0], R[0, 0])``, shape (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from sonar_graph.evaluation import yaw_rad
    >>> from sonar_graph.testing import small_world
    >>> np.degrees(yaw_rad(small_world().true_poses.rotations().as_matrix())[[0, -1]]).round(1)
    array([ 0. , 57.3])
    """
    return np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])


def aligned_errors_m(points: Floats, targets: Floats) -> Floats:
    """What is left of the distances after `align_yaw`, shape (n, 3); horizontally after the best SE(2) alignment."""
    return align_yaw(points, targets).apply(points) - targets


def yaw_errors_rad(estimate: Trajectory, truth: Trajectory) -> Floats:
    """Estimated minus true heading, wrapped, shape (n,).

    Raises `EvaluationError` for trajectories that are not at the same instants, or empty.
    """
    if not len(estimate) or not np.array_equal(estimate.stamps_ns, truth.stamps_ns):
        raise EvaluationError(
            f"an error needs estimate and truth at the same instants, at least one; got {len(estimate)} and "
            f"{len(truth)} rows: bring the truth to the estimate's with Trajectory.at"
        )
    return wrap_angle(yaw_rad(estimate.matrices) - yaw_rad(truth.matrices))


def relative_errors(
    estimate: Trajectory, truth: Trajectory, delta_s: float
) -> tuple[Floats, Floats]:
    """Errors of the motion over ``delta_s`` from every instant that has a partner that much later; pairs overlap.

    The translation of a motion is the displacement in the body frame at the pair's first instant: an error of heading
    that is already there does not count again.

    Returns
    -------
    translation_m : norm of the translation of ``(true motion)⁻¹ (estimated motion)``, shape (k,)
    yaw_rad : estimated minus true change of heading, wrapped, shape (k,)
    """
    # checks that both are at the same instants
    yaw_error = yaw_errors_rad(estimate, truth)
    # overlapping pairs use every instant, not only each tenth second
    first, second = pairs_apart(estimate.stamps_ns, delta_s)

    def body_displacement(trajectory: Trajectory) -> Floats:
        step = trajectory.positions[second] - trajectory.positions[first]
        return np.einsum("kji,kj->ki", trajectory.matrices[first], step)

    error_m = body_displacement(estimate) - body_displacement(truth)
    turned = wrap_angle(yaw_error[second] - yaw_error[first])
    return np.linalg.norm(error_m, axis=1), turned


def pairs_apart(stamps_ns: Ints, delta_s: float) -> tuple[Ints, Ints]:
    """Rows i and j with ``stamp[j] - stamp[i]`` nearest to ``delta_s`` and within one per cent of it."""
    # integers, because stamps in seconds as floats lose nanoseconds
    delta_ns = round(delta_s * NS_PER_S)
    first = np.arange(len(stamps_ns))
    wanted = stamps_ns + delta_ns
    # of the samples on both sides of the wanted stamp the nearer one is the partner
    right = np.minimum(np.searchsorted(stamps_ns, wanted), len(stamps_ns) - 1)
    left = np.maximum(right - 1, 0)
    second = np.where(wanted - stamps_ns[left] < stamps_ns[right] - wanted, left, right)
    near = np.abs(stamps_ns[second] - wanted) <= PAIRING_TOLERANCE * delta_ns
    return first[near], second[near]


@dataclass(frozen=True, eq=False)
class LandmarkErrors:
    """A map against the true one: landmarks that are in both, by identity."""

    ids: Ints
    """Shape (k,)."""
    horizontal_m: Floats
    """Estimate minus truth in x and y, not aligned, shape (k, 2)."""
    horizontal_covs: Floats
    """Reported covariance of the same, shape (k, 2, 2), m²."""
    aligned_rmse_m: float
    """Horizontal rmse after the SE(2) alignment of the map itself; NaN with fewer than two landmarks."""

    def __len__(self) -> int:
        return len(self.ids)


def landmark_errors(estimated: LandmarkMap, true: LandmarkMap) -> LandmarkErrors:
    """Compare two maps; landmarks in only one of them are left out.

    Examples
    --------
    >>> from sonar_graph import run_estimator
    >>> from sonar_graph.evaluation import landmark_errors
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> errors = landmark_errors(run_estimator(world, "isam2").landmarks, world.true_landmarks)
    >>> errors.ids
    array([ 4,  9, 11])
    """
    named, targets = in_both(estimated, true)
    aligned_rmse_m = float("nan")
    if len(named) >= 2:
        aligned_rmse_m = rmse(aligned_errors_m(named.positions, targets)[:, :2])
    errors = (named.positions - targets)[:, :2]
    return LandmarkErrors(
        named.ids, errors, named.covariances[:, :2, :2], aligned_rmse_m
    )


def in_both(estimated: LandmarkMap, true: LandmarkMap) -> tuple[LandmarkMap, Floats]:
    """The landmarks that both maps have, as estimated, and their true positions in the same order, shape (k, 3)."""
    ids, rows, true_rows = np.intersect1d(estimated.ids, true.ids, return_indices=True)
    named = LandmarkMap(ids, estimated.positions[rows], estimated.covariances[rows])
    return named, true.positions[true_rows]


@dataclass(frozen=True, eq=False)
class ScoredMap:
    """A map as it is scored against the true landmarks."""

    landmarks: LandmarkMap
    """In the world of the true landmarks; unknown identities are those of the true ones within `FARTHEST_M`."""
    alignment: Alignment | None
    """By which it got there; None where the world of the start pose is that of the true landmarks."""


def scored_map(estimated: LandmarkMap, sequence: Sequence) -> ScoredMap | None:
    """The map in the world of the true landmarks; None without these, or where it cannot be brought there.

    With a true path the start pose is in its world, and so are the landmarks. Landmarks surveyed without a
    path are in a world of their own, into which the map is aligned by the landmarks that both name.
    """
    true = sequence.true_landmarks
    if true is None:
        return None
    alignment = None
    if not sequence.truth:
        alignment = align_map(estimated, true, sequence.calibration)
        if alignment is None:
            return None
        estimated = alignment.map(estimated)
    return ScoredMap(named_by_place(estimated, true, FARTHEST_M), alignment)


def align_map(
    estimated: LandmarkMap, true: LandmarkMap, calibration: Calibration
) -> Alignment | None:
    """The alignment of a map to the true one by the landmarks that both name; None for fewer than needed.

    By yaw and translation where the estimate is level (two landmarks), else by SE(3) (three). Landmarks that lie far
    outside the fit of the others, such as those of a wrong identity, are left out (least trimmed squares, Rousseeuw and
    Van Driessen 2006: fits to the better half, then to all within `OUTLYING`).
    """
    # a level estimate has no freedom in roll and pitch that alignment could take away
    is_level = calibration.planar is not None or calibration.use_gravity
    named, targets = in_both(estimated, true)
    points = named.positions
    fit = align_yaw if is_level else align_se3
    if len(points) < (2 if is_level else 3):
        return None
    alignment = fit(points, targets)
    if len(points) < LEAST_OUTVOTING:
        return alignment

    def residuals() -> Floats:
        errors = alignment.apply(points) - targets
        return np.linalg.norm(errors[:, :2], axis=1)

    half = (len(points) + 3) // 2
    for _ in range(CONCENTRATIONS):
        # stable, so that equal residuals do not let the result hang on the machine
        better = np.argsort(residuals(), kind="stable")[:half]
        alignment = fit(points[better], targets[better])
    # the last fit uses all good landmarks, not only the better half
    near = residuals() <= OUTLYING * np.median(residuals())
    return fit(points[near], targets[near])


def named_by_place(
    estimated: LandmarkMap, true: LandmarkMap, farthest_m: float
) -> LandmarkMap:
    """The estimated map, in which landmarks of unknown identity get that of the true landmark at their place.

    The assignment is one to one, between landmarks of unknown identity and true ones that the map does not name. It has
    the most pairs within ``farthest_m`` (horizontal distance, not aligned), and among such assignments the least sum of
    squared distances (Kuhn, Naval Research Logistics 2, 1955). Landmarks without a partner keep their identity.
    """
    unknown = np.flatnonzero(
        (estimated.ids >= FIRST_ANONYMOUS_ID) & ~np.isin(estimated.ids, true.ids)
    )
    if not len(unknown):
        return estimated
    from scipy.optimize import linear_sum_assignment  # takes most of a second to load

    # a landmark that the map names is not at hand for one without a name
    free = np.flatnonzero(~np.isin(true.ids, estimated.ids))
    apart = estimated.positions[unknown, None, :2] - true.positions[None, free, :2]
    squared = np.sum(apart**2, axis=-1)
    is_near = squared <= farthest_m**2
    # more than all near pairs cost together, so that one more near pair always costs less
    too_far = farthest_m**2 * (min(squared.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(is_near, squared, too_far))
    matched = is_near[rows, columns]
    ids = estimated.ids.copy()
    ids[unknown[rows[matched]]] = true.ids[free[columns[matched]]]
    # maps are sorted by identity everywhere
    order = np.argsort(ids)
    return LandmarkMap(
        ids[order], estimated.positions[order], estimated.covariances[order]
    )
