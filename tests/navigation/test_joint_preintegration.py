"""Joint preintegration: laws of every rule, against dead reckoning in dense matrices, GTSAM and formulas."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.devices.dvl_beams import UNMEASURED_M_S
from sonar_graph.errors import CalibrationError, MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.joint_preintegration import (
    DISPLACEMENT,
    RULES,
    JointMotion,
    JointPreintegrator,
)

from .rows import ACCEL, GYRO, NS, StepByStep, at, derivative, dvl, imu, random_rows, stamps, step_by_step, waves
from .ways import DVL, QUIET, Vehicle

BIAS = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.05])
EARTH = np.array([0.04, -0.07, 0.05])
"""A thousand times as fast, for its sign and axes to be seen."""
SIGMAS = (0.01, 0.02, 0.04)
seeds = st.integers(0, 2**32 - 9)
ours = pytest.mark.parametrize("rule", ["inertial", "linear"])
every_rule = pytest.mark.parametrize("rule", sorted(RULES))
others = pytest.mark.parametrize("rule", sorted(set(RULES) - {"inertial"}))


def made(rows: tuple[Imu, Dvl], rule: str, bias=BIAS, **options) -> JointMotion:
    return JointPreintegrator(GYRO, ACCEL, rule=rule, longest_s=2.0, **options).integrate(*rows, *ends(rows), bias)


def difference(of: JointMotion, to: JointMotion) -> np.ndarray:
    """[theta (frame j), v, p, s]."""
    theta = gtsam.Rot3.Logmap(of.i_R_j.between(to.i_R_j))
    return np.r_[theta, to.velocity - of.velocity, to.position - of.position, to.displacement - of.displacement]


def ends(rows: tuple[Imu, Dvl]) -> tuple[int, int]:
    return int(rows[1].stamps_ns[0]), int(rows[1].stamps_ns[-1])


def with_doppler(rows: tuple[Imu, Dvl], velocity: np.ndarray, cov: np.ndarray) -> tuple[Imu, Dvl]:
    return rows[0], Dvl(rows[1].stamps_ns, velocity, np.broadcast_to(cov, (len(rows[1]), 3, 3)))


def plain(
    rule: str, seed: int, earth=(0.0, 0.0, 0.0), accel=ACCEL, cov=None, **rows_of
) -> tuple[JointMotion, StepByStep]:
    rows = random_rows(seed, **rows_of)
    rows = rows if cov is None else with_doppler(rows, rows[1].velocity, cov)
    motion = JointPreintegrator(GYRO, accel, rule=rule, longest_s=2.0).integrate(*rows, *ends(rows), BIAS, earth)
    return motion, step_by_step(*rows, rule, BIAS, earth, accel_density=accel)


def mounted(rule: str) -> tuple[JointMotion, StepByStep]:
    """Readings along a sensor's own axes, covariances of the calibration or the log in turn; no long interval."""
    rows = random_rows(109)
    imu_at = Mounting(translation_m=(0.3, -0.1, 0.2), rpy_rad=(0.2, -0.4, 2.0))
    dvl_at = Mounting(translation_m=(-0.2, 0.1, 0.4), rpy_rad=(3.0, 0.3, 0.8))
    A, B = gtsam.Rot3.RzRyRx(0.2, -0.4, 2.0).matrix(), gtsam.Rot3.RzRyRx(3.0, 0.3, 0.8).matrix()
    own, cov = Imu(rows[0].stamps_ns, rows[0].angular_velocity @ A, rows[0].specific_force @ A), np.diag(SIGMAS) ** 2
    said = np.where(np.arange(len(rows[1]))[:, None, None] % 2, cov, np.nan)
    log = with_doppler(rows, rows[1].velocity @ B, said)[1]
    known = Calibration(
        imu=ImuCalibration(gyro_noise_density=GYRO, accel_noise_density=ACCEL, mounting=imu_at),
        dvl=DvlCalibration(velocity_sigma_m_s=SIGMAS, mounting=dvl_at),
    )
    motion = JointPreintegrator.from_calibration(known, rule).integrate(own, log, *ends(rows), BIAS, EARTH)
    assert motion.body_p_imu == pytest.approx((0.3, -0.1, 0.2))
    assert motion.body_p_dvl == pytest.approx((-0.2, 0.1, 0.4))
    return motion, step_by_step(*with_doppler(rows, rows[1].velocity, B @ cov @ B.T), rule, BIAS, EARTH)


CASES = {
    "slow": lambda rule: plain(rule, 4),
    "slow, other rows": lambda rule: plain(rule, 2**31),
    "eastward Earth": lambda rule: plain(rule, 11, EARTH),
    "westward Earth": lambda rule: plain(rule, 11, -EARTH),
    "steps of up to 0.4 rad": lambda rule: plain(rule, 12, turn_rad_s=20.0),
    "gyros whose noise no other hides": lambda rule: plain(rule, 13, accel=0.0, cov=np.eye(3) * 1e-20),
    "sensors at an angle": mounted,
}


@every_rule
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_joint_motion_is_dead_reckoning_in_dense_matrices(rule, case):
    motion, truth = case(rule)
    expected = truth.covariance()
    sigmas = np.sqrt(np.diag(expected))
    assert np.allclose(motion.i_R_j.matrix(), truth.R, atol=1e-12)
    for found, true in ((motion.velocity, truth.v), (motion.position, truth.p), (motion.displacement, truth.s)):
        assert np.allclose(found, true, atol=2e-6)
    assert np.allclose(motion.covariance / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=3e-3)


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


def test_the_inertial_rule_needs_an_accelerometer():
    rows = random_rows(5)
    unfelt = replace(rows[0], specific_force=np.full((len(rows[0]), 3), np.nan))
    with pytest.raises(MeasurementError, match='rule "linear"'):
        made((unfelt, rows[1]), "inertial")


def steady(unit_ns: int = 1) -> tuple[Imu, Dvl]:
    """Ten seconds, 200 Hz and 5 Hz from zero, stamps in a unit of so many nanoseconds."""
    quick, slow = np.arange(-1, 2002) * (NS // 200), np.arange(51) * (NS // 5)
    return imu(quick // unit_ns, [0, 0, 0.1]), dvl(slow // unit_ns, [0.5, 0, 0])


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ({"ends": (150_000_000, NS)}, "start_ns: 150000000 is none of the 51 Doppler stamps .* nearest is 200000000$"),
        ({"ends": (0, NS + 1)}, f"end_ns: {NS + 1} is none of the 51 Doppler stamps .* nearest is {NS}$"),
        ({"ends": (0, 900 * NS)}, f"from 0 to {10 * NS} ns"),
        ({"ends": (NS, NS)}, "the earlier first"),
        ({"ends": (NS, NS // 5)}, "the earlier first"),
        ({"imu_rows": slice(2, None)}, "do not reach"),
        ({"imu_rows": slice(0, 201)}, "do not reach"),
        ({"ends": (0.0, 1.0)}, "start_ns: expected integer nanoseconds, not 0.0"),
        ({"ends": (0, 1)}, "it seems to be in seconds: times 1000000000"),
        ({"ends": (0, 1500)}, "it seems to be in milliseconds: times 1000000 "),
        ({"ends": (0, 2_100_000)}, "it seems to be in microseconds: times 1000 "),
        ({"unit_ns": 1000}, "they seem to be in a larger unit than nanoseconds"),
        ({"unit_ns": 1000, "ends": (0, NS // 1000)}, r"Imu.stamps_ns: 2003 rows are 5e\+03 ns apart"),
        ({"unit_ns": NS // 1000, "ends": (0, 1000)}, r"Imu.stamps_ns: 2003 rows are 5 ns apart"),
        ({"bias": np.zeros(3)}, r"bias: expected shape \(6,\), not \(3,\)"),
        ({"bias": [0, 0, np.nan, 0, 0, 0]}, "bias: expected finite"),
        ({"earth_rate": np.zeros(2)}, r"earth_rate: expected shape \(3,\)"),
        ({"swapped": True}, "expected Imu and Dvl, not Dvl and Imu"),
        ({"rate": 1e200}, "the motion is not finite"),
        ({"velocity": 1e308}, "the motion is not finite"),
        ({"cov": -np.eye(3)}, r"Dvl\.velocity_cov: the row at 0 ns is no covariance"),
        ({"cov": [[1, 5, 0], [0, 1, 0], [0, 0, 1]]}, r"Dvl\.velocity_cov: the row at 0 ns is no covariance"),
    ],
)
def test_mistakes_in_a_motion_are_named(mistake, message):
    mistake = dict(mistake)
    ends = mistake.pop("ends", (0, NS))
    inertial, doppler = steady(mistake.pop("unit_ns", 1))
    inertial = imu(inertial.stamps_ns, mistake.pop("rate", [0, 0, 0.1])).rows(mistake.pop("imu_rows", slice(None)))
    doppler = dvl(doppler.stamps_ns, mistake.pop("velocity", [0.5, 0, 0]), mistake.pop("cov", np.nan))
    blocks = (doppler, inertial) if mistake.pop("swapped", False) else (inertial, doppler)
    with pytest.raises(MeasurementError, match=message):
        JointPreintegrator(GYRO, ACCEL).integrate(*blocks, *ends, **mistake)


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


@pytest.mark.parametrize(("sensor", "row"), [("Dvl", 0), ("Dvl", 3), ("Dvl", 5), ("Imu", 1), ("Imu", 50), ("Imu", 201)])
def test_repeated_stamps_are_refused_at_the_ends_too(sensor, row):
    """Beyond the motion they do no harm."""
    rows, preintegrator = steady(), JointPreintegrator(GYRO, ACCEL)
    twice = [r.rows(np.sort(np.r_[np.arange(len(r)), row])) if type(r).__name__ == sensor else r for r in rows]
    with pytest.raises(MeasurementError, match=rf"{sensor}.stamps_ns: rows {row} and {row + 1} are both stamped"):
        preintegrator.integrate(*twice, 0, NS)
    preintegrator.integrate(*twice, 2 * NS, 3 * NS)


def test_a_chain_takes_only_the_motion_that_ends_where_the_next_begins():
    rows, preintegrator = steady(), JointPreintegrator(GYRO, ACCEL)
    first, second, third = (preintegrator.integrate(*rows, k * NS, (k + 1) * NS) for k in range(3))
    for later, before in ((first, second), (third, first), (first, first)):
        with pytest.raises(MeasurementError, match=rf"ends at {before.end_ns} ns, this motion begins at"):
            later.after(before)
    assert np.array_equal(second.after(first).after(first).covariance, second.after(first).covariance)


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


QUICK_HZ, LONG_SIGMA = 100.0, 0.003
BODY_T_IMU, BODY_T_DVL = QUIET.mounting.pose(), DVL.mounting.pose()
SENSORS = JointPreintegrator(2e-4, 1e-4, (LONG_SIGMA,) * 3, BODY_T_IMU, BODY_T_DVL)


def apart(*doppler_s: float) -> tuple[Imu, Dvl]:
    vehicle, dvl_ns = Vehicle(), np.array([at(second) for second in doppler_s])
    return vehicle.imu(stamps(QUICK_HZ, doppler_s[-1] + 0.1)), vehicle.dvl(dvl_ns)


def whole(samples: tuple[Imu, Dvl], sensors: JointPreintegrator = SENSORS) -> JointMotion:
    return sensors.integrate(*samples, *ends(samples))


@pytest.mark.parametrize("doppler_s", [(6.0, 11.0), (6.0, 36.0), (5.8, 6.0, 16.0, 16.2, 36.0), (6.0, 16.0, 26.0, 26.5)])
def test_a_vehicle_that_turns_is_where_it_is_however_far_the_samples_are_apart(doppler_s):
    """The log swings about the IMU; as if it did not, the way is wrong by a centimetre to a metre."""
    motion = whole(apart(*doppler_s))
    truth = Vehicle().displacement(doppler_s[0], doppler_s[-1])
    assert motion.relative_pose().i_T_j.translation() == pytest.approx(truth, abs=1e-3)
    at_one_point = JointPreintegrator(0.0, 0.0, body_T_dvl=gtsam.Pose3(BODY_T_DVL.rotation(), np.zeros(3)))
    swung = BODY_T_DVL.translation() - motion.i_R_j.matrix() @ BODY_T_DVL.translation()
    wrong = whole(apart(*doppler_s), at_one_point).displacement + swung - truth
    assert np.linalg.norm(wrong) > 0.01


def test_a_chain_over_long_intervals_has_the_displacement_of_the_whole():
    samples = apart(6.0, 7.0, 9.0, 9.2, 12.0)
    first, second = (SENSORS.integrate(*samples, at(a), at(b)) for a, b in ((6.0, 9.0), (9.0, 12.0)))
    chained = first.displacement + first.i_R_j.matrix() @ second.displacement
    assert chained == pytest.approx(whole(samples).displacement, abs=1e-9)


@others
def test_rules_that_know_nothing_of_a_gap_refuse_it(rule):
    samples = apart(6.0, 6.2, 8.0, 8.2)
    sensors = JointPreintegrator(2e-4, 1e-4, rule=rule)
    with pytest.raises(MeasurementError, match=rf"no row for 1.8 s after {at(6.2)} ns.*longest_s \(1.5 s\).*inertial"):
        whole(samples, sensors)
    sensors.integrate(*samples, at(6.0), at(6.2))
    whole(samples, replace(sensors, longest_s=1.9))
    whole(samples)
