import gtsam
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.devices.dvl_beams import UNMEASURED_M_S
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.preintegration.joint_preintegration import DISPLACEMENT, JointMotion, JointPreintegrator
from sonar_graph.navigation.preintegration.joint_recursion import RULES
from sonar_graph.navigation.preintegration.motion import Preintegrator

from .joint_rows import ACCEL, GYRO, random_rows, step_by_step
from .rows import NS, T0_NS, derivative, dvl, imu, stamps, waves

BIAS = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.05])
ARM = np.array([0.3, -0.1, 0.2])
seeds = st.integers(0, 2**32 - 9)
ours = pytest.mark.parametrize("rule", ["inertial", "linear"])
every_rule = pytest.mark.parametrize("rule", sorted(RULES))


def made(rows: tuple[Imu, Dvl], rule: str, bias=BIAS, **options) -> JointMotion:
    samples = rows[1].stamps_ns
    preintegrator = JointPreintegrator(GYRO, ACCEL, rule=rule, longest_s=2.0, **options)
    return preintegrator.integrate(*rows, int(samples[0]), int(samples[-1]), bias)


def difference(of: JointMotion, to: JointMotion) -> np.ndarray:
    """[theta (frame j), v, p, s]."""
    theta = gtsam.Rot3.Logmap(of.i_R_j.between(to.i_R_j))
    return np.r_[theta, to.velocity - of.velocity, to.position - of.position, to.displacement - of.displacement]


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    sigmas = np.sqrt(np.diag(expected))
    return float(np.abs((actual - expected) / np.outer(sigmas, sigmas)).max())


@every_rule
@given(seeds)
@settings(max_examples=5, deadline=None)
def test_preintegration_equals_dead_reckoning(rule, seed):
    rows = random_rows(seed)
    motion, truth = made(rows, rule), step_by_step(*rows, rule, BIAS)
    assert np.allclose(motion.i_R_j.matrix(), truth.R, atol=1e-12)
    assert np.allclose(motion.velocity, truth.v, atol=1e-11)
    assert np.allclose(motion.position, truth.p, atol=1e-11)
    assert np.allclose(motion.displacement, truth.s, atol=1e-11)
    assert relative(motion.covariance, truth.covariance()) < 1e-9


@every_rule
@given(seeds)
@settings(max_examples=5, deadline=None)
def test_derivatives_equal_differences(rule, seed):
    """By both biases, scale and mounting; of every rule."""
    rows = random_rows(seed)
    motion = made(rows, rule)

    def moved(change):
        z = (1 + change[6]) * rows[1].velocity @ gtsam.SO3.Expmap(change[7:]).matrix().T
        other = Dvl(rows[1].stamps_ns, z, rows[1].velocity_cov)
        return difference(motion, made((rows[0], other), rule, BIAS + change[:6]))

    numerical = derivative(moved, 10, 1e-5)
    for column in range(10):
        scale = max(np.abs(numerical[:, column]).max(), 0.1)
        assert np.abs(motion.D_parameters[:, column] - numerical[:, column]).max() < 5e-4 * scale


@ours
def test_corrected_equals_integrating_again(rule):
    """To first order; uncorrected, or with the opposite sign, it is far off."""
    rows, change = random_rows(4), np.r_[2e-3, -1e-3, 3e-3, 0.02, -0.01, 0.03]
    motion, again = made(rows, rule), made(rows, rule, BIAS + change)
    corrected = motion.corrected(np.r_[change, np.zeros(4)])
    wrong = [
        np.abs(difference(m, again)).max() for m in (corrected, motion, motion.corrected(np.r_[-change, np.zeros(4)]))
    ]
    assert wrong[0] < 0.01 * wrong[1] < 0.01 * wrong[2]
    assert np.array_equal(corrected.bias, again.bias)


@every_rule
@given(seeds, st.integers(1, 7))
@settings(max_examples=5, deadline=None)
def test_a_chain_has_the_displacement_of_the_whole(rule, seed, cut):
    """Mean and covariance: whatever is cut, the shared sample counts as it acts. Taken as independent, less."""
    rows = random_rows(seed)
    at = rows[1].stamps_ns
    preintegrator = JointPreintegrator(0.0, 0.0, rule=rule, longest_s=2.0)
    whole, first, second = (
        preintegrator.integrate(*rows, int(a), int(b), BIAS)
        for a, b in ((at[0], at[-1]), (at[0], at[cut]), (at[cut], at[-1]))
    )
    R = first.i_R_j.matrix()
    assert whole.i_R_j.equals(first.i_R_j.compose(second.i_R_j), 1e-12)
    assert np.allclose(first.displacement + R @ second.displacement, whole.displacement, atol=1e-10)
    expected = whole.covariance[DISPLACEMENT, DISPLACEMENT]
    block = [m.covariance[DISPLACEMENT, DISPLACEMENT] for m in (first, second, second.after(first))]
    assert np.allclose(block[0] + R @ block[2] @ R.T, expected, rtol=1e-9, atol=1e-15)
    independent = np.trace(block[0]) + np.trace(block[1])
    shares = rule not in ("hold-previous", "zoh-previous", "zoh-current")
    assert (independent < (1 - 1e-6) * np.trace(expected)) == shares


def both_ways(rows: tuple[Imu, Dvl], gyro_density: float, sigma_m_s: float):
    """Linear rule and `Preintegrator`, with lever arm and mountings."""
    calibration = Calibration(
        dvl=DvlCalibration(
            velocity_sigma_m_s=(sigma_m_s, 2 * sigma_m_s, 3 * sigma_m_s),
            mounting=Mounting(translation_m=tuple(ARM), rpy_rad=(3.1, 0.1, 0.8)),
        ),
        imu=ImuCalibration(gyro_noise_density=gyro_density, mounting=Mounting(rpy_rad=(0.2, -0.1, 2.0))),
    )
    odometry, samples = Odometry(calibration), rows[1].stamps_ns
    odometry.add(*rows)
    steps = odometry.steps_between_nodes(int(samples[0]), int(samples[-1]))
    joint = JointPreintegrator.from_calibration(calibration, "linear")
    actual = joint.integrate(*rows, int(samples[0]), int(samples[-1]), np.r_[BIAS[:3], 0, 0, 0]).relative_pose()
    return actual, Preintegrator.from_calibration(calibration).integrate(steps, BIAS[:3])


def test_linear_rule_is_the_motion_of_the_gyro_and_doppler_preintegrator():
    """Mean, bias derivative and what gyro noise does, lever arm and mountings included."""
    inertial, doppler = random_rows(8)
    actual, expected = both_ways((inertial, dvl(doppler.stamps_ns, doppler.velocity)), GYRO, 1e-9)
    assert actual.i_T_j.equals(expected.i_T_j, 1e-10)
    assert np.allclose(actual.D_bias, expected.D_bias, atol=1e-4)
    assert np.allclose(actual.mean_specific_force, expected.mean_specific_force, atol=1e-9)
    assert relative(actual.covariance, expected.covariance) < 1e-3


def test_doppler_noise_of_the_linear_rule_is_half_a_sample_less_than_spread_over_time():
    """Ten intervals: weights of one, and a half at either end, have 9.5 squares where the other has 10."""
    at = stamps(5, 2.0)
    rows = random_rows(8)[0], dvl(at, np.array([0.5, 0.1, 0.0]) + waves(at, 9, 0.3))
    actual, expected = both_ways(rows, 1e-12, 0.01)
    assert relative(actual.covariance[3:, 3:], 0.95 * expected.covariance[3:, 3:]) < 0.01


def test_inertial_part_is_that_of_gtsam():
    """Its tangent preintegration turns a step by the attitude at its start: first order in small steps."""
    quick = stamps(1000, 2.0)
    rows = imu(quick, waves(quick, 1, 0.5), np.array([0.3, -0.2, 9.8]) + waves(quick, 2, 1.0)), dvl(quick[::200], 0.1)
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(GYRO**2 * np.eye(3))
    params.setAccelerometerCovariance(ACCEL**2 * np.eye(3))
    params.setIntegrationCovariance(np.zeros((3, 3)))
    theirs = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3]))
    for k in range(len(quick) - 1):
        mean = [(column[k] + column[k + 1]) / 2 for column in (rows[0].specific_force, rows[0].angular_velocity)]
        theirs.integrateMeasurement(*mean, 1e-3)
    motion = made(rows, "inertial")
    assert motion.i_R_j.equals(theirs.deltaRij(), 2e-5)
    assert np.allclose(motion.velocity, theirs.deltaVij(), atol=3e-3)
    assert np.allclose(motion.position, theirs.deltaPij(), atol=3e-3)
    order = np.r_[0:3, 6:9, 3:6]
    sigmas = np.sqrt(np.diag(motion.covariance)[order])
    assert np.sqrt(np.diag(theirs.preintMeasCov())) == pytest.approx(sigmas, rel=0.03)


def test_a_vehicle_at_rest_stays_there():
    """Whatever its tilt: the Doppler samples level the accelerometer."""
    at, slow = stamps(100, 60.0), stamps(5, 60.0)
    up = gtsam.Rot3.RzRyRx(0.4, -0.3, 1.0).unrotate(np.array([0, 0, 9.81]))
    motion = made((imu(at, np.zeros(3), up), dvl(slow, np.zeros(3))), "inertial", np.zeros(6))
    assert np.abs(motion.displacement).max() < 1e-9
    assert motion.velocity == pytest.approx(60 * up)


def test_the_accelerometer_draws_what_lies_between_two_samples():
    """One swing of 0.5 m/s amplitude, unseen by samples that meet it at its zeros: also over a gap of two seconds."""
    at, slow = stamps(500, 4.0), stamps(0.5, 4.0)
    t = (at - T0_NS) * 1e-9
    surge = 0.25 * np.sin(np.pi * t / 2) ** 2
    force = np.column_stack([np.gradient(surge, t, edge_order=2), 0 * t, 9.81 + 0 * t])
    rows = imu(at, np.zeros(3), force), dvl(slow, np.zeros(3))
    truth = np.trapezoid(surge, t)
    assert made(rows, "inertial", np.zeros(6)).displacement[0] == pytest.approx(truth, abs=1e-4)
    assert made(rows, "linear", np.zeros(6)).displacement[0] == pytest.approx(0.0, abs=1e-12)
    assert truth > 0.4


def test_without_an_accelerometer_the_displacement_is_the_same():
    rows = random_rows(5)
    unfelt = Imu(rows[0].stamps_ns, rows[0].angular_velocity, np.full((len(rows[0]), 3), np.nan))
    with_it, without = made(rows, "linear").relative_pose(), made((unfelt, rows[1]), "linear").relative_pose()
    assert with_it.i_T_j.equals(without.i_T_j, 1e-15)
    assert np.array_equal(with_it.covariance, without.covariance)
    assert np.isnan(without.mean_specific_force).all()
    with pytest.raises(MeasurementError, match='rule "linear"'):
        made((unfelt, rows[1]), "inertial")


def test_ends_that_are_not_covered_are_refused():
    rows = random_rows(6)
    at = rows[1].stamps_ns
    preintegrator = JointPreintegrator(GYRO, ACCEL)
    for ends, message in (
        ((at[0] + 1, at[-1]), rf"start_ns: {at[0] + 1} is none of the 9 Doppler stamps .* nearest is {at[0]}$"),
        ((at[0], at[-1] + 1), rf"end_ns: {at[-1] + 1} is none of the 9 Doppler stamps .* nearest is {at[-1]}$"),
        ((at[0], at[-1] + 900 * NS), rf"from {at[0]} to {at[-1]} ns"),
        ((at[3], at[3]), "the earlier first"),
        ((at[4], at[2]), "the earlier first"),
    ):
        with pytest.raises(MeasurementError, match=message):
            preintegrator.integrate(*rows, int(ends[0]), int(ends[1]))
    late, early = rows[0].between(int(at[0]) + 1, int(at[-1]) + NS), rows[0].between(0, int(at[-1]) - 1)
    for part in (late, early):
        with pytest.raises(MeasurementError, match="do not reach"):
            preintegrator.integrate(part, rows[1], int(at[0]), int(at[-1]))


def steady(unit_ns: int = 1) -> tuple[Imu, Dvl]:
    """Ten seconds, 200 Hz and 5 Hz from zero, stamps in a unit of so many nanoseconds."""
    quick, slow = np.arange(-1, 2002) * (NS // 200), np.arange(51) * (NS // 5)
    return imu(quick // unit_ns, [0, 0, 0.1]), dvl(slow // unit_ns, [0.5, 0, 0])


@pytest.mark.parametrize(
    ("unit_ns", "ends", "message"),
    [
        (1, (0.0, 1.0), "start_ns: expected integer nanoseconds, not 0.0"),
        (1, (0, 1), "it seems to be in seconds: times 1000000000"),
        (1, (0, 1500), "it seems to be in milliseconds: times 1000000 "),
        (1, (0, 2_100_000), "it seems to be in microseconds: times 1000 "),
        (1000, (0, NS), "they seem to be in a larger unit than nanoseconds"),
        (1000, (0, NS // 1000), r"Imu.stamps_ns: 2003 rows are 5e\+03 ns apart"),
        (NS // 1000, (0, 1000), r"Imu.stamps_ns: 2003 rows are 5 ns apart"),
    ],
)
def test_another_unit_of_time_is_named(unit_ns, ends, message):
    with pytest.raises(MeasurementError, match=message):
        JointPreintegrator(GYRO, ACCEL).integrate(*steady(unit_ns), *ends)


@pytest.mark.parametrize("row", [0, 3, 5])
@pytest.mark.parametrize("other", [0.0, 1.0])
def test_repeated_doppler_stamps_are_refused_at_the_ends_too(row, other):
    """Whether or not they say the same; beyond the motion they do no harm."""
    inertial, doppler = steady()
    velocity = np.insert(doppler.velocity, row, doppler.velocity[row] + other, axis=0)
    at = np.insert(doppler.stamps_ns, row, doppler.stamps_ns[row])
    twice, preintegrator = dvl(at, velocity), JointPreintegrator(GYRO, ACCEL)
    with pytest.raises(MeasurementError, match=rf"Dvl.stamps_ns: rows {row} and {row + 1} .* {row * NS // 5} ns"):
        preintegrator.integrate(inertial, twice, 0, NS)
    preintegrator.integrate(inertial, twice, 2 * NS, 3 * NS)
    preintegrator.integrate(inertial, twice.rows(np.unique(at, return_index=True)[1]), 0, NS)


@pytest.mark.parametrize("row", [1, 50, 201])
def test_repeated_inertial_stamps_are_refused_at_the_ends_too(row):
    inertial, doppler = steady()
    twice, preintegrator = inertial.rows(np.sort(np.r_[np.arange(len(inertial)), row])), JointPreintegrator(GYRO, ACCEL)
    with pytest.raises(MeasurementError, match=rf"Imu.stamps_ns: rows {row} and {row + 1} are both stamped"):
        preintegrator.integrate(twice, doppler, 0, NS)
    preintegrator.integrate(twice, doppler, 2 * NS, 3 * NS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gyro_noise_density": -1e-4}, "gyro_noise_density: expected finite numbers of zero or more"),
        ({"gyro_noise_density": np.nan}, "gyro_noise_density: expected finite"),
        ({"gyro_noise_density": "1e-4"}, "gyro_noise_density: expected 1 number, not '1e-4'"),
        ({"accel_noise_density": np.inf}, "accel_noise_density: expected finite"),
        ({"velocity_sigma_m_s": (0.01, -0.01, 0.01)}, "velocity_sigma_m_s: expected finite"),
        ({"velocity_sigma_m_s": 0.01}, "velocity_sigma_m_s: expected 3 numbers, not 0.01"),
        ({"rule": "zoh"}, "rule: there is no 'zoh'; there are inertial, linear"),
        ({"body_T_dvl": np.eye(4)}, "body_T_dvl: expected a gtsam.Pose3, not ndarray"),
        ({"body_T_imu": (0.1, 0.0, 0.0)}, "body_T_imu: expected a gtsam.Pose3, not tuple"),
    ],
)
def test_impossible_sensors_are_refused(options, message):
    with pytest.raises(CalibrationError, match=message):
        JointPreintegrator(**{"gyro_noise_density": GYRO, "accel_noise_density": ACCEL} | options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bias": np.zeros(3)}, r"bias: expected shape \(6,\), not \(3,\)"),
        ({"bias": [0, 0, np.nan, 0, 0, 0]}, "bias: expected finite"),
        ({"earth_rate": np.zeros(2)}, r"earth_rate: expected shape \(3,\)"),
    ],
)
def test_vectors_of_another_shape_are_refused(options, message):
    with pytest.raises(MeasurementError, match=message):
        JointPreintegrator(GYRO, ACCEL).integrate(*steady(), 0, NS, **options)


def test_swapped_blocks_are_refused():
    with pytest.raises(MeasurementError, match="expected Imu and Dvl, not Dvl and Imu"):
        JointPreintegrator(GYRO, ACCEL).integrate(*steady()[::-1], 0, NS)


@given(arrays.arrays(np.float64, (3, 3), elements=st.floats(-1, 1)), st.integers(1, 3))
@settings(max_examples=60)
def test_covariances_are_refused_exactly_where_an_eigenvalue_is_negative(A, rank):
    """Of what is far enough from zero to be told; singular ones are possible."""
    inertial, doppler = steady()
    indefinite = A + A.T
    lowest, size = np.linalg.eigvalsh(indefinite)[0], np.abs(indefinite).max()
    assume(size > 1e-3)
    cases = [(A[:, :rank] @ A[:, :rank].T, False)]
    if lowest < -1e-3 * size or lowest > 0:
        cases.append((indefinite, bool(lowest < 0)))
    for cov, is_refused in cases:
        every = np.tile(np.eye(3) * 1e-4, (51, 1, 1))
        every[2] = cov
        rows = inertial, Dvl(doppler.stamps_ns, doppler.velocity, every)
        if is_refused:
            with pytest.raises(MeasurementError, match=f"row at {2 * NS // 5} ns is no covariance"):
                JointPreintegrator(GYRO, ACCEL).integrate(*rows, 0, NS)
        else:
            JointPreintegrator(GYRO, ACCEL).integrate(*rows, 0, NS)


@pytest.mark.parametrize("cov", [-np.eye(3), [[1, 5, 0], [0, 1, 0], [0, 0, 1]], [[1, 0, 0], [0, 1, 2], [0, 2, 1]]])
def test_what_is_no_covariance_is_refused(cov):
    inertial, doppler = steady()
    with pytest.raises(MeasurementError, match=r"Dvl\.velocity_cov: the row at 0 ns is no covariance"):
        JointPreintegrator(GYRO, ACCEL).integrate(inertial, dvl(doppler.stamps_ns, 0.0, cov), 0, NS)


def test_a_chain_takes_only_the_motion_that_ends_where_the_next_begins():
    rows, preintegrator = steady(), JointPreintegrator(GYRO, ACCEL)
    first, second, third = (preintegrator.integrate(*rows, k * NS, (k + 1) * NS) for k in range(3))
    for later, before in ((first, second), (third, first), (first, first)):
        with pytest.raises(MeasurementError, match=rf"ends at {before.end_ns} ns, this motion begins at"):
            later.after(before)
    assert np.array_equal(second.after(first).after(first).covariance, second.after(first).covariance)


def test_motion_beyond_all_bounds_is_refused():
    inertial, doppler = steady()
    for rows in (
        (imu(inertial.stamps_ns, 1e200), doppler),
        (inertial, dvl(doppler.stamps_ns, 1e308)),
    ):
        with pytest.raises(MeasurementError, match="the motion is not finite"):
            JointPreintegrator(GYRO, ACCEL).integrate(*rows, 0, NS)


def test_longer_blocks_change_nothing():
    rows = random_rows(7)
    at = rows[1].stamps_ns
    preintegrator = JointPreintegrator(GYRO, ACCEL)
    part = rows[0].between(int(at[2]) - NS // 20, int(at[5]) + NS // 20), rows[1].rows(slice(2, 6))
    a, b = (preintegrator.integrate(*r, int(at[2]), int(at[5]), BIAS) for r in (rows, part))
    assert np.array_equal(a.displacement, b.displacement)
    assert np.array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("unmeasured", [UNMEASURED_M_S**2, np.inf])
def test_rows_of_few_beams_are_refused_within_the_motion_only(unmeasured):
    """Their velocity is 0 where nothing was measured: it must not be taken for one."""
    inertial, doppler = random_rows(8)
    at, cov = doppler.stamps_ns, np.tile(np.eye(3) * 1e-4, (len(doppler), 1, 1))
    cov[3] = np.diag([1e-4, unmeasured, unmeasured])
    partial = Dvl(at, doppler.velocity, cov)
    preintegrator = JointPreintegrator(GYRO, ACCEL)
    for ends in ((0, 3), (3, 4), (2, 5)):
        with pytest.raises(MeasurementError, match=f"row at {at[3]} ns leaves a direction unmeasured"):
            preintegrator.integrate(inertial, partial, int(at[ends[0]]), int(at[ends[1]]))
    preintegrator.integrate(inertial, partial, int(at[0]), int(at[2]))
    left_out = partial.rows(np.delete(np.arange(len(at)), 3))
    preintegrator.integrate(inertial, left_out, int(at[0]), int(at[5]))
