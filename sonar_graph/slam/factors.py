"""Factors of the graph, each from a measurement and its noise (docs/theory/factors.md).

::

    start prior ── X0 ──odometry── X1 ──odometry── X2 ── ...        X  world_T_body at a keyframe
                   │ ╲            ╱ │                                B  biases, one a stretch of time
                   │   B0 ──walk── B1                                L  landmark in the world
                   └── range, azimuth ── L7 ── floor prior
    depth, gravity direction and the planar constraint: one keyframe each

Equations and derivatives are those of `sonar_graph.models`, or of GTSAM's compiled factors. Odometry with biases
(`odometry_factor`) and correlated noise (`CorrelatedSighting`) have factors of their own; gravity, headings and fixes
whose motion depends on biases have callbacks.

Range and azimuth are two factors, so that elevation stays unknown: ``RangeFactorWithTransform3D``, and a camera whose
optical axis lies in the sonar's fan plane along the measured azimuth. The camera has the equidistant projection
(Kannala and Brandt, IEEE PAMI 28(8), 2006): a direction at angle t from the axis has an image point at distance t from
the centre. At a small elevation e its coordinates are::

    horizontal    (azimuth - measured) e / tan(e)        e / tan(e) = 0.995 at 7 degrees
    vertical      e                                      near the axis
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration, PlanarMotion
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats
from sonar_graph.models import (
    ACCEL,
    BIASES,
    COMPASS,
    HUBER_WIDTHS,
    GaussianKernel,
    Robust,
    body_point_jacobian,
    polar_difference,
    project_points,
    up_and_derivative,
    view_points,
    wrap_angle,
    yaw_and_derivative,
)
from sonar_graph.motion import PreintegratedMotion

UNIT = gtsam.noiseModel.Unit.Create(2)
UNINFORMATIVE_M = 1e5
UNINFORMATIVE_RAD = 1e3
"""Sigmas that leave a direction to the other factors."""
EXACT = 1e-9
"""Sigma of a bias (rad/s, m/s²) that is zero."""
STEADY = 1e-3
"""Share of its sigma by which a bias without a walk may walk in a stretch."""
CORRELATION_LIMIT = 1e-6
"""Above it, range and azimuth noise are taken together."""
EQUIDISTANT = gtsam.Cal3Fisheye(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Unit focal lengths; no skew, offset or distortion."""
BEAM_R_CAMERA = gtsam.Rot3(
    np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
)
"""Columns: image x to the left, image y up, optical axis along the beam."""
ORIGIN = np.zeros(3)
IMAGE_CENTRE = np.zeros(2)
UP = np.array([0.0, 0.0, 1.0])


class SightingError:
    """Error of one factor, called by GTSAM."""

    __slots__ = ("body_T_sonar", "by_body", "keys", "z")

    def __init__(
        self, keys: tuple[int, int], body_T_sonar: gtsam.Pose3, z: Floats
    ) -> None:
        self.keys = keys
        self.z = z
        self.body_T_sonar = body_T_sonar
        # constant: GTSAM calls thousands of times
        self.by_body = body_T_sonar.inverse().AdjointMap()

    def __call__(
        self,
        _: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[Floats] | None,
    ) -> Floats:
        """Error, shape (2,), m and rad."""
        pose_key, landmark_key = self.keys
        world_T_sonar = values.atPose3(pose_key).compose(self.body_T_sonar)
        view = view_points(world_T_sonar, values.atPoint3(landmark_key)[None])
        if jacobians is not None:
            jacobians[0] = view.by_pose[0] @ self.by_body  # (2, 6)
            jacobians[1] = view.by_point[0]  # (2, 3)
        return polar_difference(view.z[0], self.z)


class CorrelatedSighting(gtsam.CustomFactor):
    """Range (m) and azimuth (rad) of a landmark, whose noises are correlated: ``h(X, L) - z``, azimuth wrapped.

    ``z``: as measured, shape (2,); ``noise``: with a kernel or without.
    """

    __slots__ = ("law",)
    Stack: ClassVar[type[SightingStack]]

    def __init__(
        self,
        pose_key: int,
        landmark_key: int,
        body_T_sonar: gtsam.Pose3,
        z: Floats,
        noise: gtsam.noiseModel.Base,
    ) -> None:
        self.law = SightingError((pose_key, landmark_key), body_T_sonar, z)
        super().__init__(noise, [pose_key, landmark_key], self.law)


class SightingViews(NamedTuple):
    """Landmarks as n sonars see them."""

    world_R_sonar: Floats
    """Shape (n, 3, 3)."""
    q: Floats
    """The landmarks in the sonars' axes, shape (n, 3), m."""
    D_q: Floats
    """Derivative of range and azimuth by q, shape (n, 2, 3)."""
    e: Floats
    """Whitened errors, shape (n, 2)."""
    lengths: list[float]
    """Lengths of those that have a kernel."""


class SightingStack:
    """Many `CorrelatedSighting` as arrays (`batch_solution.Stack`); the same numbers to rounding."""

    def __init__(self, factors: Sequence[CorrelatedSighting]) -> None:
        laws = [factor.law for factor in factors]
        sonars = np.array([law.body_T_sonar.matrix() for law in laws])
        self._keys = [law.keys for law in laws]
        self._pose_keys = np.array([law.keys[0] for law in laws], np.uint64)
        self._landmark_keys = sorted({law.keys[1] for law in laws})
        self._landmark_of = np.searchsorted(
            self._landmark_keys, [law.keys[1] for law in laws]
        )
        self._body_R_sonar = sonars[:, :3, :3]
        self._body_p_sonar = sonars[:, :3, 3]
        self._by_body = np.array([law.by_body for law in laws])
        self._z = np.array([law.z for law in laws])
        # a kernel wraps the noise whose square root whitens
        noises: list[Any] = [factor.noiseModel() for factor in factors]
        is_robust = [isinstance(noise, gtsam.noiseModel.Robust) for noise in noises]
        self._robust = np.flatnonzero(is_robust)
        self._kernels = [noises[k].robust() for k in self._robust]
        plain = [
            noise.noise() if robust else noise
            for noise, robust in zip(noises, is_robust, strict=True)
        ]
        self._whitening = np.array([noise.R() for noise in plain])

    def error(self, values: gtsam.Values) -> float:
        """Sum of the kernels' losses."""
        view = self._views(values)
        losses = 0.5 * np.vecdot(view.e, view.e)
        losses[self._robust] = [
            kernel.loss(d)
            for kernel, d in zip(self._kernels, view.lengths, strict=True)
        ]
        return losses.sum()

    def linear_factors(self, values: gtsam.Values) -> list[gtsam.JacobianFactor]:
        """Each factor, linearised, with the weight of its kernel."""
        view = self._views(values)
        # a robust kernel multiplies rows and residuals by the root of its weight
        root = np.ones((len(view.e), 1))
        weights = [
            kernel.weight(d)
            for kernel, d in zip(self._kernels, view.lengths, strict=True)
        ]
        root[self._robust, 0] = np.sqrt(weights)
        D_q = root[..., None] * self._whitening @ view.D_q  # (n, 2, 3)
        q_x = -np.cross(view.q[:, None, :], np.eye(3))  # [q]x
        by_pose = np.concatenate((D_q @ q_x, -D_q), axis=2) @ self._by_body  # (n, 2, 6)
        by_landmark = D_q @ view.world_R_sonar.transpose(0, 2, 1)  # (n, 2, 3)
        return [
            gtsam.JacobianFactor(pose, A_pose, landmark, A_landmark, rhs, UNIT)
            for (pose, landmark), A_pose, A_landmark, rhs in zip(
                self._keys, by_pose, by_landmark, -root * view.e, strict=True
            )
        ]

    def _views(self, values: gtsam.Values) -> SightingViews:
        """Every sighting at these values."""
        poses = poses_of(values, self._pose_keys)
        R = poses[:, :9].reshape(-1, 3, 3)
        world_R_sonar = R @ self._body_R_sonar
        world_p_sonar = poses[:, 9:] + times(R, self._body_p_sonar)
        # each landmark is read once, however many sightings it has
        points = np.array([values.atPoint3(key) for key in self._landmark_keys])[
            self._landmark_of
        ]
        q = times(world_R_sonar.transpose(0, 2, 1), points - world_p_sonar)
        # the same model, for all sonars at once
        predicted, D_q = project_points(np.ascontiguousarray(q))
        e = times(self._whitening, polar_difference(predicted, self._z))
        return SightingViews(
            world_R_sonar, q, D_q, e, np.linalg.norm(e[self._robust], axis=1).tolist()
        )


CorrelatedSighting.Stack = SightingStack


def times(matrices: Floats, vectors: Floats) -> Floats:
    """Product of each matrix with its vector."""
    return (matrices @ vectors[..., None])[..., 0]


def poses_of(values: gtsam.Values, keys: NDArray[np.uint64]) -> Floats:
    """Poses of a graph by the keys of keyframes, shape (...): rows of R, and p, shape (..., 12)."""
    known = np.fromiter(values.keys(), np.uint64)
    poses = gtsam.utilities.extractPose3(values)  # by ascending key
    # the highest byte of a key is its letter
    return poses[np.searchsorted(known[known >> np.uint64(56) == ord("x")], keys)]


def gaussian(cov: Floats) -> gtsam.noiseModel.Base:
    """Noise with this covariance, correlations included.

    By default GTSAM takes a matrix for diagonal when no other entry exceeds 1e-9, whatever its unit and scale: motion
    over a short time would lose all its correlations. It also accepts NaN and indefinite matrices.

    Raises
    ------
    MeasurementError
        When the matrix is not positive definite.
    """
    try:
        np.linalg.cholesky(cov)
        is_positive = bool(np.isfinite(cov).all())
    except np.linalg.LinAlgError:  # raised for an indefinite matrix, not for NaN
        is_positive = False
    if not is_positive:
        least = np.linalg.eigvalsh(np.nan_to_num(cov))[0]
        raise MeasurementError(
            f"noise of a factor: expected a positive definite covariance, not one with an eigenvalue of {least:.3g};"
            " give every component a variance above zero"
        )
    return gtsam.noiseModel.Gaussian.Covariance(cov, False)


def start_prior(pose_key: int, calibration: Calibration) -> gtsam.NonlinearFactor:
    """Prior of the first keyframe."""
    start = calibration.start
    # GTSAM's perturbation of a pose is in its own axes, too
    return gtsam.PriorFactorPose3(pose_key, start.pose(), gaussian(start.covariance()))


def map_prior(
    keys: list[int], positions_m: Floats, covariance_m2: Floats
) -> gtsam.NonlinearFactor:
    """Joint prior of m landmarks: their coordinates are ``N(positions_m, covariance_m2)``, shapes (m, 3), (3 m, 3 m)."""
    by_coordinates = np.eye(3 * len(keys))

    def error(
        _: gtsam.CustomFactor,
        values: gtsam.Values,
        jacobians: list[Floats] | None,
    ) -> Floats:
        places = np.array([values.atPoint3(key) for key in keys])
        if jacobians is not None:
            for k in range(len(jacobians)):
                jacobians[k] = by_coordinates[:, 3 * k : 3 * k + 3]
        return (places - positions_m).ravel()

    # a coordinate that is known exactly still needs a variance
    noise = gaussian(covariance_m2 + EXACT**2 * by_coordinates)
    return gtsam.CustomFactor(noise, keys, error)


def bias_prior(bias_key: int, sigmas: Floats) -> gtsam.NonlinearFactor:
    """Biases are N(0, sigma²), one sigma each; where it is zero, `EXACT`."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, EXACT), False)
    return gtsam.PriorFactorVector(bias_key, np.zeros(len(sigmas)), noise)


def bias_walk(key_i: int, key_j: int, sigmas: Floats) -> gtsam.NonlinearFactor:
    """Biases of the next stretch differ from those of the last by N(0, sigma²), one sigma each."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, STEADY * EXACT), False)
    return gtsam.BetweenFactorVector(key_i, key_j, np.zeros(len(sigmas)), noise)


def odometry(
    key_i: int, key_j: int, motion: PreintegratedMotion
) -> gtsam.NonlinearFactor:
    """Relative pose from preintegrated gyro and DVL where the gyro has no bias to estimate."""
    return gtsam.BetweenFactorPose3(
        key_i, key_j, motion.i_T_j, gaussian(motion.covariance)
    )


def landmark_sighting(
    pose_key: int,
    landmark_key: int,
    body_T_sonar: gtsam.Pose3,
    z: Floats,
    cov: Floats,
    robust: Robust | None = None,
    elevation_sigma_rad: float | None = None,
) -> dict[str, gtsam.NoiseModelFactor]:
    """Range and azimuth of a landmark, by their labels in messages; all of them belong in the graph.

    Parameters
    ----------
    body_T_sonar
        Sonar in the keyframe's body frame when the frame was taken.
    z, cov
        Range (m) and azimuth (rad), shape (2,), and their covariance, shape (2, 2).
    robust
        Kernel as ``RobustKernel().robust()`` gives it; None: Gaussian noise.
    elevation_sigma_rad
        Elevation is N(0, sigma²); None: unknown. Give it once a landmark. Its elevation does not vary between frames as
        noise would, so that repeating it would invent information.
    """
    robust = robust or GaussianKernel().robust()
    range_m = z[0]
    range_sigma_m = math.sqrt(cov[0, 0])
    azimuth_sigma_rad = math.sqrt(cov[1, 1])
    # apart, an outlier in one of them leaves the other its weight
    is_correlated = (
        abs(cov[0, 1]) >= CORRELATION_LIMIT * range_sigma_m * azimuth_sigma_rad
    )
    sigmas = np.array([azimuth_sigma_rad, elevation_sigma_rad or UNINFORMATIVE_RAD])
    if is_correlated:
        sigmas[0] = UNINFORMATIVE_RAD  # the azimuth is in the factor with the range
    sonar_R_camera = gtsam.Rot3.Rz(z[1]).compose(BEAM_R_CAMERA)
    body_T_camera = body_T_sonar.compose(gtsam.Pose3(sonar_R_camera, ORIGIN))
    noise = robust(gtsam.noiseModel.Diagonal.Sigmas(sigmas))
    camera = gtsam.GenericProjectionFactorCal3Fisheye(
        IMAGE_CENTRE,
        noise,
        pose_key,
        landmark_key,
        EQUIDISTANT,
        False,
        False,
        body_T_camera,
    )
    if not is_correlated:
        noise = robust(gtsam.noiseModel.Isotropic.Sigma(1, range_sigma_m))
        distance = gtsam.RangeFactorWithTransform3D(
            pose_key, landmark_key, range_m, noise, body_T_sonar
        )
        return {"azimuth": camera, "range": distance}
    both = CorrelatedSighting(
        pose_key, landmark_key, body_T_sonar, z, robust(gaussian(cov))
    )
    return (
        {"elevation": camera, "range and azimuth": both}
        if elevation_sigma_rad
        else {"range and azimuth": both}
    )


def first_direction(
    pose_key: int, landmark_key: int, body_p_landmark: Floats
) -> gtsam.NonlinearFactor:
    """A landmark is roughly where it was first seen: direction to a radian, range to its whole length.

    Beside a sonar's noise that is no information. But the azimuth factor has no gradient behind the sonar. Where a
    wrong identity contradicts a right one, a solution may lie behind both: without this factor only two ranges would
    then constrain the landmark, and the system would be singular.

    Parameters
    ----------
    body_p_landmark
        In the keyframe's body frame, shape (3,), m.
    """
    range_m = np.linalg.norm(body_p_landmark)
    # both components of the direction, then the range
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 1.0, range_m]))
    return gtsam.BearingRangeFactor3D(
        pose_key, landmark_key, gtsam.Unit3(body_p_landmark), range_m, noise
    )


def floor_prior(landmark_key: int, z_m: float, sigma_m: float) -> gtsam.NonlinearFactor:
    """Landmark z is N(z_m, sigma_m²); x and y are left to the other factors."""
    sigmas = np.array([UNINFORMATIVE_M, UNINFORMATIVE_M, sigma_m])
    return gtsam.PriorFactorPoint3(
        landmark_key,
        np.array([0.0, 0.0, z_m]),
        gtsam.noiseModel.Diagonal.Sigmas(sigmas),
    )


def depth(
    pose_key: int, z_m: float, body_p_port: Floats, sigma_m: float
) -> gtsam.NonlinearFactor:
    """World z of a point of the body, shape (3,) in the body frame, is N(z_m, sigma_m²)."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(
        np.array([UNINFORMATIVE_M, UNINFORMATIVE_M, sigma_m])
    )
    return gtsam.GPSFactorArm(pose_key, np.array([0.0, 0.0, z_m]), body_p_port, noise)


def gravity_direction(
    pose_key: int, up_in_body: Floats, sigma_rad: float
) -> gtsam.NonlinearFactor:
    """World's up, measured in the body as ``up_in_body`` (any length), to sigma_rad about each horizontal axis.

    ``R^T e_z - up``, GTSAM's factor for a magnetometer without bias. GTSAM's attitude factor compares the two
    directions in the world, where a turn about the vertical turns the residual. Its linearisation adds false yaw
    information, which grows with the residual.
    """
    measured = up_in_body / np.linalg.norm(up_in_body)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma_rad)
    return gtsam.MagPoseFactorPose3(pose_key, measured, 1.0, UP, ORIGIN, noise)


def gravity_with_bias(
    pose_key: int, bias_key: int, up_in_body: Floats, by_accel: Floats, sigma_rad: float
) -> gtsam.NonlinearFactor:
    """As `gravity_direction`, where the accelerometers' bias tilts the direction: error ``R^T e_z + A b_accel - up``.

    ``by_accel``: A, derivative of the unit vector measured by the bias, shape (3, 3), s²/m.
    """
    measured = up_in_body / np.linalg.norm(up_in_body)
    # a unit vector only changes across itself
    A = by_accel - np.outer(measured, measured @ by_accel)
    by_pose = np.zeros((3, 6))
    by_bias = np.zeros((3, BIASES))
    by_bias[:, ACCEL] = A

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None
    ) -> Floats:
        up, by_turn = up_and_derivative(values.atPose3(pose_key).rotation().matrix())
        if jacobians is not None:
            by_pose[:, :3] = by_turn
            jacobians[0] = by_pose
            jacobians[1] = by_bias
        return up + A @ values.atVector(bias_key)[ACCEL] - measured

    return gtsam.CustomFactor(
        gtsam.noiseModel.Isotropic.Sigma(3, sigma_rad), [pose_key, bias_key], error
    )


def huber(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """Noise of headings and position fixes, with Huber's kernel against outliers."""
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(HUBER_WIDTHS[noise.dim()]), noise
    )


def heading(
    pose_key: int,
    bias_key: int,
    yaw_rad: float,
    sigma_rad: float,
    robust: Robust = huber,
) -> gtsam.NoiseModelFactor:
    """Measured yaw is that of the body plus the bias of the compass: ``atan2(R_yx, R_xx) + b_compass - yaw``."""

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None
    ) -> Floats:
        b = values.atVector(bias_key)
        predicted, by_turn = yaw_and_derivative(
            values.atPose3(pose_key).rotation().matrix()
        )
        if jacobians is not None:
            jacobians[0] = np.concatenate((by_turn, np.zeros(3)))[None]
            jacobians[1] = np.zeros((1, len(b)))
            jacobians[1][0, COMPASS] = 1.0
        return np.array([wrap_angle(predicted + b[COMPASS] - yaw_rad)])

    noise = robust(gtsam.noiseModel.Isotropic.Sigma(1, sigma_rad))
    return gtsam.CustomFactor(noise, [pose_key, bias_key], error)


def position(
    pose_key: int,
    position_m: Floats,
    keyframe_p_antenna: Floats,
    cov_m2: Floats,
    robust: Robust = huber,
) -> gtsam.NoiseModelFactor:
    """World position of a point l, shape (3,) in the keyframe's body frame: ``p + R l - z``."""
    return gtsam.GPSFactorArm(
        pose_key, position_m, keyframe_p_antenna, robust(gaussian(cov_m2))
    )


def position_with_biases(
    keys: tuple[int, int],
    position_m: Floats,
    motion: PreintegratedMotion,
    body_p_antenna: Floats,
    cov_m2: Floats,
    robust: Robust = huber,
) -> gtsam.NoiseModelFactor:
    """World position of a point of the body, a motion after a keyframe: ``p_i + R_i M(b) a - z``.

    ``M(b) = M Exp(D (b - b_0))`` is the motion from the keyframe to the fix. Over a gap of the Doppler log its error
    comes mostly from the biases b, so that the fix constrains keyframe and biases together.

    Parameters
    ----------
    keys
        Keyframe and biases.
    position_m
        z, shape (3,).
    motion
        M with D and b_0.
    body_p_antenna
        a, shape (3,), m.
    cov_m2
        Covariance of the fix and of the noise of the motion, without the biases' part, shape (3, 3).
    """
    pose_key, bias_key = keys

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None
    ) -> Floats:
        world_T_i = values.atPose3(pose_key)
        change = motion.D_bias @ (values.atVector(bias_key) - motion.bias)  # (6,)
        i_T_j = motion.i_T_j.compose(gtsam.Pose3.Expmap(change))
        arm = i_T_j.transformFrom(body_p_antenna)
        if jacobians is not None:
            R_i = world_T_i.rotation().matrix()
            R_j = R_i @ i_T_j.rotation().matrix()
            jacobians[0] = body_point_jacobian(R_i, arm)
            by_motion = body_point_jacobian(R_j, body_p_antenna)  # (3, 6)
            jacobians[1] = (
                by_motion @ gtsam.Pose3.ExpmapDerivative(change) @ motion.D_bias
            )
        return world_T_i.transformFrom(arm) - position_m

    return gtsam.CustomFactor(robust(gaussian(cov_m2)), [pose_key, bias_key], error)


def planar(pose_key: int, motion: PlanarMotion) -> dict[str, gtsam.NonlinearFactor]:
    """The keyframe is level and at the plane's height; factors by their labels in messages."""
    return {
        "level": gravity_direction(pose_key, UP, motion.tilt_sigma_rad),
        "height": depth(pose_key, motion.z_m, np.zeros(3), motion.z_sigma_m),
    }
