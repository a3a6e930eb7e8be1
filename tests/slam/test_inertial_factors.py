from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, M, V, X

from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.preintegration.joint_preintegration import JointMotion, JointPreintegrator
from sonar_graph.slam.models.inertial_factors import doppler_odometry, inertial_doppler_odometry

NS = 1_000_000_000
GRAVITY = np.array([0.0, 0.0, -9.81])
BODY_T_IMU = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.4), np.array([0.2, 0.1, -0.3]))
BODY_T_DVL = gtsam.Pose3(gtsam.Rot3.RzRyRx(3.0, 0.1, 0.8), np.array([-0.4, 0.2, -0.1]))
SIZES = {"X": 6, "V": 3, "B": 6, "C": 1, "M": 3}


def some_motion(seed: int, rule: str = "inertial") -> JointMotion:
    rng = np.random.default_rng(seed)
    quick, slow = np.arange(-5, 206) * (NS // 200), np.arange(6) * (NS // 5)
    rate, force = 0.3 * rng.standard_normal((211, 3)), np.array([0, 0, 9.8]) + rng.standard_normal((211, 3))
    dvl = Dvl(slow, 0.5 * rng.standard_normal((6, 3)), np.full((6, 3, 3), np.nan))
    bias = 0.01 * rng.standard_normal(6)
    sensors = JointPreintegrator(1e-3, 2e-3, (0.01,) * 3, BODY_T_IMU, BODY_T_DVL, rule)
    return sensors.integrate(Imu(quick, rate, force), dvl, 0, NS, bias)


def fitting(motion: JointMotion, seed: int, off: float, turned: bool = False) -> gtsam.Values:
    """States that obey the motion up to random errors of this size; turned: an attitude off by nearly half a turn."""
    rng = np.random.default_rng(seed)
    X_i = gtsam.Pose3.Expmap(rng.uniform(-2, 2, 6))
    R, R_i, t = motion.i_R_j.matrix(), X_i.rotation().matrix(), motion.duration_s
    v_i = rng.standard_normal(3)
    place = motion.displacement - R @ motion.body_p_dvl + motion.body_p_dvl
    X_j = X_i.compose(gtsam.Pose3(motion.i_R_j, place)).retract(off * rng.standard_normal(6))
    if turned:
        X_j = X_j.compose(gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.6, 0.0, 0.8]) * (np.pi - 0.01)), np.zeros(3)))
    values = gtsam.Values()
    values.insert(X(0), X_i)
    values.insert(X(1), X_j)
    values.insert(V(0), v_i)
    values.insert(V(1), v_i + GRAVITY * t + R_i @ motion.velocity + off * rng.standard_normal(3))
    b = motion.bias + 0.01 * off * rng.standard_normal(6)
    values.insert(B(0), gtsam.imuBias.ConstantBias(b[3:], b[:3]))
    values.insert(C(0), 0.01 * off)
    values.insert(M(0), 0.1 * off * rng.standard_normal(3))
    return values


def made(motion: JointMotion, full: bool, calibrated: bool) -> gtsam.CustomFactor:
    extra = (C(0), M(0)) if calibrated else ()
    if full:
        return inertial_doppler_odometry(X(0), V(0), X(1), V(1), B(0), motion, GRAVITY, *extra)
    return doppler_odometry(X(0), X(1), B(0), motion, *extra)


def moved(values: gtsam.Values, key: int, change: np.ndarray) -> gtsam.Values:
    kind, other = chr(gtsam.Symbol(key).chr()).upper(), gtsam.Values(values)
    if kind == "X":
        other.update(key, values.atPose3(key).retract(change))
    elif kind == "B":
        b = values.atConstantBias(key).vector() + change
        other.update(key, gtsam.imuBias.ConstantBias(b[:3], b[3:]))
    elif kind == "C":
        other.update(key, values.atDouble(key) + change[0])
    else:
        other.update(key, values.atPoint3(key) + change)
    return other


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize(("off", "turned"), [(0.3, False), (1e-9, False), (0.05, True)])
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_equal_differences(full, calibrated, off, turned, seed):
    """On random states, near zero error, and near half a turn of error."""
    motion = some_motion(seed)
    factor, values = made(motion, full, calibrated), fitting(motion, seed + 10, off, turned)
    whitener = gtsam.noiseModel.Gaussian.Covariance(
        motion.covariance if full else motion.covariance[np.ix_(np.r_[0:3, 9:12], np.r_[0:3, 9:12])]
    )
    linear = factor.linearize(values)
    A, b = linear.jacobian()
    R = whitener.R()
    assert np.allclose(np.linalg.solve(R, -b), factor.unwhitenedError(values), atol=1e-9)
    H, column = np.linalg.solve(R, A), 0
    keys = factor.keys()
    for key in keys:
        size = SIZES[chr(gtsam.Symbol(key).chr()).upper()]
        for axis in np.eye(size) * 1e-5:
            plus, minus = (factor.unwhitenedError(moved(values, key, s * axis)) for s in (1, -1))
            numerical = (plus - minus) / 2e-5
            assert np.allclose(H[:, column], numerical, rtol=1e-5, atol=1e-5), (gtsam.Symbol(key).string(), axis)
            column += 1
    assert column == H.shape[1]


def test_states_that_obey_the_motion_have_no_error():
    motion = some_motion(1)
    values = fitting(motion, 2, 0.0)
    error = made(motion, True, True).unwhitenedError(values)
    assert np.allclose(error[[0, 1, 2, 3, 4, 5, 9, 10, 11]], 0, atol=1e-9)
    assert np.allclose(made(motion, False, True).unwhitenedError(values), 0, atol=1e-9)
    # The random samples' inertial position is another than their Doppler displacement.
    X_i, X_j = values.atPose3(X(0)), values.atPose3(X(1))
    imu_i, imu_j = (pose.transformFrom(motion.body_p_imu) for pose in (X_i, X_j))
    gained = X_i.rotation().unrotate(imu_j - imu_i - values.atPoint3(V(0)) - GRAVITY / 2) - motion.position
    assert np.allclose(error[6:9], gained, atol=1e-9)
    assert np.abs(gained).max() > 0.1


def test_another_bias_is_taken_in_as_by_the_motion_itself():
    motion = some_motion(3)
    change = np.r_[1e-3, -2e-3, 1e-3, 0.02, 0.01, -0.03, 0.01, 2e-3, -1e-3, 3e-3]
    values = fitting(motion.corrected(change), 4, 0.0)
    b = motion.bias + change[:6]
    values.update(B(0), gtsam.imuBias.ConstantBias(b[3:], b[:3]))
    values.update(C(0), change[6])
    values.update(M(0), change[7:])
    assert np.allclose(made(motion, False, True).unwhitenedError(values), 0, atol=1e-9)
    values.update(C(0), -change[6])
    assert np.abs(made(motion, False, True).unwhitenedError(values)).max() > 1e-3


def test_doppler_rows_agree_with_the_compiled_between_factor():
    """Same cost near the minimum, through the relative pose and its covariance."""
    motion = some_motion(5)
    pose = motion.relative_pose()
    between = gtsam.BetweenFactorPose3(X(0), X(1), pose.i_T_j, gtsam.noiseModel.Gaussian.Covariance(pose.covariance))
    for seed in range(3):
        values = fitting(motion, seed, 1e-4)
        values.update(B(0), gtsam.imuBias.ConstantBias(motion.bias[3:], motion.bias[:3]))
        assert made(motion, False, False).error(values) == pytest.approx(between.error(values), rel=1e-2)


def test_keys_are_integers_and_differ():
    motion = some_motion(1)
    with pytest.raises(MeasurementError, match="keys: x0 is given twice"):
        doppler_odometry(X(0), X(0), B(0), motion)
    with pytest.raises(MeasurementError, match="keys: b0 is given twice"):
        inertial_doppler_odometry(X(0), V(0), X(1), V(1), B(0), motion, GRAVITY, mounting=B(0))
    with pytest.raises(MeasurementError, match=r"keys: expected integers, .* not 'x0'"):
        doppler_odometry("x0", "x1", "b0", motion)


def test_twelve_rows_need_a_measured_specific_force():
    """Rows of NaN otherwise; the six rows of the Doppler log do without."""
    motion = some_motion(1, "linear")
    unfelt = replace(motion, velocity=np.full(3, np.nan), position=np.full(3, np.nan))
    with pytest.raises(MeasurementError, match="was not measured in every row; use doppler_odometry"):
        made(unfelt, True, False)
    assert np.isfinite(made(unfelt, False, False).unwhitenedError(fitting(motion, 1, 0.1))).all()
    made(motion, True, False)
