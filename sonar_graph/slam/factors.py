"""Factors of the graph, each from a measurement and its noise (docs/theory/factors.md).

::

    start prior ── X0 ──odometry── X1 ──odometry── X2 ── ...        X  world_T_body at a keyframe
                   │ ╲            ╱ │                                B  gyro bias, one a stretch of time
                   │   B0 ──walk── B1                                L  landmark in the world
                   └── range, azimuth ── L7 ── floor prior
    depth, gravity direction and the planar constraint: one keyframe each

All but those that depend on biases (`biased_odometry`) or whose noises are correlated (`correlated_sighting`) are
GTSAM's own (compiled). Range and azimuth are two: elevation stays unknown. ``RangeFactorWithTransform3D``, and for
azimuth a camera whose optical axis lies in the
sonar's fan plane along the measured azimuth, with the equidistant projection (Kannala and Brandt, IEEE PAMI 28(8),
2006): a direction at angle t from the axis has an image point at distance t from its centre. Its horizontal coordinate
is ``azimuth - measured`` at elevation 0, times ``e / tan(e)`` at a small elevation e (0.995 at 7 degrees); the vertical
coordinate is e near the axis. So a horizontal and a vertical sigma state what is known.
"""

import math

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration, PlanarMotion
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Floats
from sonar_graph.models import ACCEL, BIASES, COMPASS, HUBER_WIDTHS, Robust, wrap_angle, yaw_and_derivative
from sonar_graph.navigation import PreintegratedMotion
from sonar_graph.numerics import cross_matrix
from sonar_graph.slam.sighting_factor import CorrelatedSighting

UNINFORMATIVE_M = 1e5
UNINFORMATIVE_RAD = 1e3
"""Sigmas that leave a direction to the other factors."""
EXACT, STEADY = 1e-9, 1e-3
"""Sigma of a bias (rad/s, m/s²) that is zero; share of its sigma by which one without a walk may walk in a stretch."""
CORRELATION_LIMIT = 1e-6
"""Above it, range and azimuth noise are taken together."""
EQUIDISTANT = gtsam.Cal3Fisheye(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Unit focal lengths; no skew, offset or distortion."""
BEAM_R_CAMERA = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
"""Columns: image x to the left, image y up, optical axis along the beam."""
ORIGIN, IMAGE_CENTRE, UP = np.zeros(3), np.zeros(2), np.array([0.0, 0.0, 1.0])


def gaussian(cov: Floats) -> gtsam.noiseModel.Base:
    """Noise with this covariance, all of it.

    Left to itself GTSAM takes a matrix for diagonal when no other entry exceeds 1e-9, whatever its unit and scale:
    motion over a short time would lose all its correlations. A matrix that is none it takes as well, and weighs by
    numbers that are none.

    Raises
    ------
    MeasurementError
        When the matrix is not positive definite.
    """
    try:
        np.linalg.cholesky(cov)
        is_sound = bool(np.isfinite(cov).all())
    except np.linalg.LinAlgError:
        is_sound = False
    if not is_sound:
        least = np.linalg.eigvalsh(np.nan_to_num(cov))[0]
        raise MeasurementError(
            f"noise of a factor: expected a positive definite covariance, not one with an eigenvalue of {least:.3g};"
            " give every component a variance above zero"
        )
    return gtsam.noiseModel.Gaussian.Covariance(cov, False)


def start_prior(pose_key: int, calibration: Calibration) -> gtsam.NonlinearFactor:
    """Prior of the first keyframe; position sigmas are along the world's axes, rotation sigmas about the body's."""
    start = calibration.start
    body_R_world = start.pose().rotation().matrix().T
    cov = np.zeros((6, 6))
    cov[:3, :3] = np.diag(np.square(start.rpy_sigma_rad))
    cov[3:, 3:] = body_R_world @ np.diag(np.square(start.position_sigma_m)) @ body_R_world.T
    return gtsam.PriorFactorPose3(pose_key, start.pose(), gaussian(cov))


def bias_prior(bias_key: int, sigmas: Floats) -> gtsam.NonlinearFactor:
    """Biases are N(0, sigma²), one sigma each; where it is zero, `EXACT`."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, EXACT), False)
    return gtsam.PriorFactorVector(bias_key, np.zeros(len(sigmas)), noise)


def bias_walk(key_i: int, key_j: int, sigmas: Floats) -> gtsam.NonlinearFactor:
    """Biases of the next stretch are those of the last, give or take a sigma each."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, STEADY * EXACT), False)
    return gtsam.BetweenFactorVector(key_i, key_j, np.zeros(len(sigmas)), noise)


def odometry(key_i: int, key_j: int, motion: PreintegratedMotion) -> gtsam.NonlinearFactor:
    """Relative pose from preintegrated gyro and DVL where the gyro has no bias to estimate."""
    noise = gaussian(motion.covariance)
    return gtsam.BetweenFactorPose3(key_i, key_j, motion.i_T_j, noise)


def landmark_sighting(
    pose_key: int,
    landmark_key: int,
    body_T_sonar: gtsam.Pose3,
    z: Floats,
    cov: Floats,
    robust: Robust,
    elevation_sigma_rad: float | None = None,
) -> dict[str, gtsam.NoiseModelFactor]:
    """Range and azimuth of a landmark, by their labels in messages.

    Parameters
    ----------
    body_T_sonar
        Sonar in the keyframe's body frame when the frame was taken.
    z, cov
        Range (m) and azimuth (rad), shape (2,), and their covariance, shape (2, 2).
    elevation_sigma_rad
        Elevation is N(0, sigma²); None: not said here. Say it once a landmark: its elevation does not vary between
        frames as noise would, so that repeating it would invent information.
    """
    range_var, azimuth_var, covariance = float(cov[0, 0]), float(cov[1, 1]), float(cov[0, 1])
    keys = pose_key, landmark_key
    if abs(covariance) < CORRELATION_LIMIT * math.sqrt(range_var * azimuth_var):
        noise = robust(gtsam.noiseModel.Isotropic.Sigma(1, math.sqrt(range_var)))
        azimuth_sigma_rad = math.sqrt(azimuth_var)
        return {
            "azimuth": _camera(*keys, body_T_sonar, float(z[1]), azimuth_sigma_rad, elevation_sigma_rad, robust),
            "range": gtsam.RangeFactorWithTransform3D(*keys, float(z[0]), noise, body_T_sonar),
        }
    both = {"range and azimuth": correlated_sighting(*keys, body_T_sonar, z, cov, robust)}
    if not elevation_sigma_rad:
        return both
    elevation = _camera(*keys, body_T_sonar, float(z[1]), UNINFORMATIVE_RAD, elevation_sigma_rad, robust)
    return {"elevation": elevation, **both}


def _camera(
    pose_key: int,
    landmark_key: int,
    body_T_sonar: gtsam.Pose3,
    azimuth_rad: float,
    azimuth_sigma_rad: float,
    elevation_sigma_rad: float | None,
    robust: Robust,
) -> gtsam.NoiseModelFactor:
    """Azimuth and elevation of a landmark about a direction at elevation 0; without a sigma elevation is not said."""
    sonar_R_camera = gtsam.Rot3.Rz(azimuth_rad).compose(BEAM_R_CAMERA)
    body_T_camera = body_T_sonar.compose(gtsam.Pose3(sonar_R_camera, ORIGIN))
    vertical = UNINFORMATIVE_RAD if elevation_sigma_rad is None else elevation_sigma_rad
    noise = robust(gtsam.noiseModel.Diagonal.Sigmas(np.array([azimuth_sigma_rad, vertical])))
    return gtsam.GenericProjectionFactorCal3Fisheye(
        IMAGE_CENTRE, noise, pose_key, landmark_key, EQUIDISTANT, False, False, body_T_camera
    )


def correlated_sighting(
    pose_key: int, landmark_key: int, body_T_sonar: gtsam.Pose3, z: Floats, cov: Floats, robust: Robust
) -> gtsam.NoiseModelFactor:
    """Range and azimuth whose noises are correlated, as one factor: ``h(X, L) - z``, azimuth wrapped."""
    return CorrelatedSighting(pose_key, landmark_key, body_T_sonar, z, robust(gaussian(cov)))


def first_direction(pose_key: int, landmark_key: int, body_p_landmark: Floats) -> gtsam.NonlinearFactor:
    """A landmark is somewhere about where it was first seen: direction to a radian, range to its whole length.

    Beside a sonar's noise that says nothing. But the azimuth factor is blind to what lies behind it, and where a wrong
    identity contradicts a right one a solution may lie behind both: without this factor nothing but two ranges would
    then hold the landmark, and the system would have no solution.

    Parameters
    ----------
    body_p_landmark
        In the keyframe's body frame, shape (3,), m.
    """
    range_m = float(np.linalg.norm(body_p_landmark))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 1.0, range_m]))
    return gtsam.BearingRangeFactor3D(pose_key, landmark_key, gtsam.Unit3(body_p_landmark), range_m, noise)


def floor_prior(landmark_key: int, z_m: float, sigma_m: float) -> gtsam.NonlinearFactor:
    """Landmark z is N(z_m, sigma_m²); x and y are left to the other factors."""
    sigmas = np.array([UNINFORMATIVE_M, UNINFORMATIVE_M, sigma_m])
    return gtsam.PriorFactorPoint3(landmark_key, np.array([0.0, 0.0, z_m]), gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def depth(pose_key: int, z_m: float, body_p_port: Floats, sigma_m: float) -> gtsam.NonlinearFactor:
    """World z of a point of the body, shape (3,) in the body frame, is N(z_m, sigma_m²)."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([UNINFORMATIVE_M, UNINFORMATIVE_M, sigma_m]))
    return gtsam.GPSFactorArm(pose_key, np.array([0.0, 0.0, z_m]), body_p_port, noise)


def gravity_direction(pose_key: int, up_in_body: Floats, sigma_rad: float) -> gtsam.NonlinearFactor:
    """World's up, seen in the body as ``up_in_body`` (any length), to sigma_rad about each horizontal axis.

    ``R^T e_z - up``, GTSAM's factor for a magnetometer without bias, and not its attitude factor: that one compares the
    two directions in the world, where a turn about the vertical turns the residual. Linearised, it says of the yaw what
    it cannot know: the more the larger its residual is beside sigma.
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
    across, by_bias = by_accel - np.outer(measured, measured @ by_accel), np.zeros((3, BIASES))
    by_bias[:, ACCEL] = across

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        up = values.atPose3(pose_key).matrix()[2, :3]
        if jacobians is not None:
            by_pose = np.zeros((3, 6))
            by_pose[:, :3] = cross_matrix(up)
            jacobians[0], jacobians[1] = by_pose, by_bias
        return up + across @ values.atVector(bias_key)[ACCEL] - measured

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, sigma_rad), [pose_key, bias_key], error)


def huber(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    """Noise of headings and position fixes, of which some are outliers."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER_WIDTHS[noise.dim()]), noise)


def heading(
    pose_key: int, bias_key: int, yaw_rad: float, sigma_rad: float, robust: Robust = huber
) -> gtsam.NoiseModelFactor:
    """Yaw of the body and the compass' bias add up to what is measured: ``atan2(R_yx, R_xx) + b_compass - yaw``."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        b = values.atVector(bias_key)
        predicted, by_turn = yaw_and_derivative(values.atPose3(pose_key).rotation().matrix())
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.zeros((1, 6)), np.zeros((1, len(b)))
            jacobians[0][0, :3], jacobians[1][0, COMPASS] = by_turn, 1.0
        return np.array([wrap_angle(predicted + b[COMPASS] - yaw_rad)])

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma_rad)
    return gtsam.CustomFactor(robust(noise), [pose_key, bias_key], error)


def position(
    pose_key: int, position_m: Floats, keyframe_p_antenna: Floats, cov_m2: Floats, robust: Robust = huber
) -> gtsam.NoiseModelFactor:
    """World position of a point, shape (3,) in the keyframe's body frame, as measured: ``p + R l - z``."""
    return gtsam.GPSFactorArm(pose_key, position_m, keyframe_p_antenna, robust(gaussian(cov_m2)))


def planar(pose_key: int, motion: PlanarMotion) -> dict[str, gtsam.NonlinearFactor]:
    """The keyframe is level and at the plane's height; factors by their labels in messages."""
    return {
        "level": gravity_direction(pose_key, UP, motion.tilt_sigma_rad),
        "height": depth(pose_key, motion.z_m, np.zeros(3), motion.z_sigma_m),
    }
