"""Biases of a run: what they do to a motion, by differences of motions of rows that have them; what gravity shows."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.dead_reckoning import DeadReckoning
from baselines.ekf_slam import EkfSlam
from baselines.invariant_ekf import InvariantEkf
from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
    Start,
)
from sonar_graph.measurements import Dvl, Heading, Imu, PositionFixes
from sonar_graph.models import (
    BIASES,
    COMPASS,
    HEADING,
    SCALE,
    TILT,
    by_biases,
    gyro_bias_of,
)
from sonar_graph.navigation import Odometry
from sonar_graph.numerics import Vec3
from sonar_graph.sequence import Sequence
from sonar_graph.slam import Isam2

G = 9.80665
ARM = (-0.3, 0.2, 0.1)
END_NS = 60_000_000_000


def turning(
    calibration: Calibration,
    roll_rad: float = 0.3,
    rate_rad_s: float = 0.3,
    accel_bias=(0.0, 0.0, 0.0),
    scale=0.0,
) -> Sequence:
    """A minute of exact rows of a vehicle that circles about the vertical, rolled, at 0.5 m/s."""
    imu_ns = np.arange(0, END_NS + 1, 20_000_000)
    dvl_ns = np.arange(0, END_NS + 1, 200_000_000)
    up = Rotation.from_euler("x", roll_rad).inv().apply([0.0, 0.0, 1.0])
    ahead = np.array([0.5, 0.0, 0.0])
    arm = np.array(calibration.dvl.mounting.translation_m)
    gyro = rate_rad_s * up
    force = G * up + np.cross(rate_rad_s * up, ahead) + accel_bias
    velocity = (ahead + np.cross(gyro, arm)) * (1.0 + scale)
    unknown = np.full((len(dvl_ns), 3, 3), np.nan)
    imu = Imu(imu_ns, np.tile(gyro, (len(imu_ns), 1)), np.tile(force, (len(imu_ns), 1)))
    start = calibration.start.model_copy(update={"rpy_rad": (roll_rad, 0.0, 0.0)})
    world = calibration.model_copy(update={"start": start})
    return Sequence(
        "circle", world, imu, Dvl(dvl_ns, np.tile(velocity, (len(dvl_ns), 1)), unknown)
    )


def known(**imu: float) -> Calibration:
    return Calibration(
        imu=ImuCalibration(
            **({"gyro_noise_density": 1e-4, "accel_noise_density": 1e-3} | imu)
        ),
        dvl=DvlCalibration(mounting=Mounting(translation_m=ARM)),
    )


def ran(kind: type, sequence: Sequence, rate_hz: float = 1.0):
    estimator = kind(sequence.calibration, Odometry(sequence.calibration))
    estimates = [
        estimator.process(step) for step in sequence.replay(sequence.instants(rate_hz))
    ]
    return estimator, [estimate for estimate in estimates if estimate is not None]


def biases_of(estimator) -> tuple[np.ndarray, np.ndarray]:
    """Newest b and its covariance."""
    if isinstance(estimator, InvariantEkf):
        _, state = estimator.state()
        return state.bias, state.P[3 : 3 + BIASES, 3 : 3 + BIASES]
    values = estimator.values
    marginals = gtsam.Marginals(estimator.graph, values)
    key = max(key for key in values.keys() if gtsam.Symbol(key).chr() == ord("b"))  # noqa: SIM118
    return values.atVector(key), marginals.marginalCovariance(key)


def motion_of(sequence: Sequence):
    odometry = Odometry(sequence.calibration)
    odometry.add(sequence.imu, sequence.dvl)
    return odometry.motion(0, 4_000_000_000, np.zeros(3))


def split(sequence: Sequence) -> np.ndarray:
    motion = motion_of(sequence)
    dR = motion.i_T_j.rotation().matrix()
    dp = motion.i_T_j.translation()
    up = sequence.calibration.start.pose().rotation().matrix()[2]
    return by_biases(motion.D_bias, dR, dp, up, up, np.array(ARM))


def test_both_gyro_biases_add_up_and_one_is_about_the_vertical():
    sequence = turning(known())
    D = split(sequence)
    motion = motion_of(sequence)
    np.testing.assert_allclose(D[:, TILT] + D[:, HEADING], motion.D_bias, atol=1e-12)
    up_j = (sequence.calibration.start.pose() * motion.i_T_j).rotation().matrix()[2]
    np.testing.assert_allclose(np.cross(up_j, D[:3, HEADING].T), 0.0, atol=1e-12)
    np.testing.assert_allclose(up_j @ D[:3, TILT], 0.0, atol=1e-12)
    assert np.abs(D[:3, HEADING]).max() > 3.0
    b = np.arange(11.0)
    assert gyro_bias_of(b, Vec3(0.0, 0.0, 1.0)) == pytest.approx([0.0, 1.0, 5.0])


def test_the_scale_lengthens_the_way_of_the_doppler_log():
    """By differences, with its lever arm, level ways alone; what is known of scale and gyro bias leaves the rows."""
    exact = motion_of(turning(known()))
    longer = motion_of(turning(known(), scale=1e-4))
    moved = gtsam.Pose3.Logmap(longer.i_T_j.between(exact.i_T_j)) / 1e-4
    dR = exact.i_T_j.rotation().matrix()
    dp = exact.i_T_j.translation()
    vertical = np.array([0.6, 0.0, 0.8])
    level = np.eye(3) - np.outer(vertical @ dR, vertical @ dR)
    for up in (vertical, np.zeros(3)):  # with gravity and without
        by_b = by_biases(np.zeros((6, 3)), dR, dp, up, vertical, np.array(ARM))
        np.testing.assert_allclose(
            by_b[:, SCALE], [*moved[:3], *(level @ moved[3:])], atol=1e-3
        )
    assert np.abs(moved[3:] - level @ moved[3:]).max() > 0.1
    bias = np.array([0.01, -0.02, 0.03])
    sequence = turning(known(), scale=0.05)
    biases = {"gyro_bias_rad_s": tuple(bias), "accel_bias_m_s2": tuple(10.0 * bias)}
    imu = sequence.calibration.imu.model_copy(update=biases)
    dvl = sequence.calibration.dvl.model_copy(update={"scale_error": 0.05})
    told = sequence.calibration.model_copy(update={"imu": imu, "dvl": dvl})
    biased = replace(
        sequence.imu,
        angular_velocity=sequence.imu.angular_velocity + bias,
        specific_force=sequence.imu.specific_force + 10.0 * bias,
    )
    found = motion_of(replace(sequence, calibration=told, imu=biased))
    assert found.i_T_j.equals(exact.i_T_j, 1e-9)
    np.testing.assert_allclose(
        found.mean_specific_force, exact.mean_specific_force, atol=1e-9
    )
    assert not motion_of(replace(sequence, imu=biased)).i_T_j.equals(exact.i_T_j, 1e-2)


estimators = pytest.mark.parametrize("kind", [InvariantEkf, Isam2])


@pytest.mark.parametrize("kind", [DeadReckoning, EkfSlam, InvariantEkf, Isam2])
def test_the_heading_of_a_tilted_start_stays_as_unsure_as_stated(kind):
    """A sigma about the body's own axis would be a tilt, too, and gravity would correct it."""
    start = Start(rpy_sigma_rad=(1e-3, 1e-3, 0.2))
    calibration = known(gyro_bias_sigma=0.0).model_copy(update={"start": start})
    _, estimates = ran(kind, turning(calibration))
    up = estimates[-1].world_T_body.rotation().matrix()[2]
    assert up @ estimates[-1].covariance[:3, :3] @ up == pytest.approx(0.04, rel=1e-2)


@pytest.mark.parametrize("kind", [DeadReckoning, InvariantEkf, Isam2])
def test_gravity_tells_the_tilt_and_nothing_of_the_heading(kind):
    """Rolled by 17 degrees it would show the gyro's bias about the vertical, if that were there once."""
    with_it = known(gyro_bias_sigma=1e-2, gyro_bias_walk_density=0.0)
    without = with_it.model_copy(update={"use_gravity": False})
    both = [ran(kind, turning(calibration)) for calibration in (with_it, without)]
    told, untold = (estimates[-1].covariance[:3, :3] for _, estimates in both)
    up = both[0][1][-1].world_T_body.rotation().matrix()[2]
    assert up @ told @ up == pytest.approx(up @ untold @ up, rel=1e-2)
    share = 0.3 if kind is DeadReckoning else 0.1  # which estimates no bias
    assert np.trace(told) - up @ told @ up < share * (
        np.trace(untold) - up @ untold @ up
    )
    if kind is DeadReckoning:
        return
    turned = biases_of(both[0][0])[1][HEADING, HEADING]
    np.testing.assert_allclose(turned, 1e-4 * np.eye(3), atol=1e-6)
    assert biases_of(both[0][0])[1][TILT, TILT][0, 0] < 0.1 * 1e-4


@estimators
def test_turns_tell_the_accelerometers_bias_from_a_tilt(kind):
    """The tilt stays in the world and the bias in the body; ``b_accel = 0`` leaves the vehicle askew."""
    bias = np.array([0.1, -0.05, 0.0])
    exact = {"gyro_noise_density": 1e-5, "gyro_bias_sigma": 0.0}
    start = Start(rpy_sigma_rad=(0.02, 0.02, 1e-3))
    found = {}
    for sigma in (0.1, 1e-9):
        calibration = known(
            accel_bias_sigma=sigma, accel_bias_walk_density=0.0, **exact
        )
        sequence = turning(
            calibration.model_copy(update={"start": start}), 0.0, 0.2, bias
        )
        estimator, estimates = ran(kind, sequence)
        up = estimates[-1].world_T_body.rotation().matrix()[2]
        found[sigma] = np.linalg.norm(up[:2])
        if sigma == 0.1:
            b, cov = biases_of(estimator)
            assert b[6:8] == pytest.approx(bias[:2], abs=0.01)
            assert cov[6, 6] < 0.01 * 0.1**2
    assert found[0.1] < 1e-3
    assert found[1e-9] > 2 * found[0.1]


def headings(sequence: Sequence, off_rad: float, every: int = 10) -> Heading:
    stamps_ns = sequence.imu.stamps_ns[::every]
    return Heading(
        stamps_ns, 0.3 * stamps_ns * 1e-9 + off_rad, np.full(len(stamps_ns), 0.02)
    )


def circle_fixes(
    sequence: Sequence, at_ns: np.ndarray, antenna: np.ndarray
) -> PositionFixes:
    angle = 0.3 * at_ns * 1e-9
    centre_out = (
        0.5
        / 0.3
        * np.column_stack([np.sin(angle), 1.0 - np.cos(angle), np.zeros(len(angle))])
    )
    arms = (
        Rotation.from_euler("z", angle[:, None]) * Rotation.from_euler("x", 0.3)
    ).apply(antenna)
    return PositionFixes(
        at_ns, centre_out + arms, np.tile(0.04 * np.eye(3), (len(at_ns), 1, 1))
    )


def aided(**update) -> Sequence:
    calibration = known(gyro_bias_sigma=1e-2).model_copy(
        update={"start": Start(rpy_sigma_rad=(0.3, 0.3, 0.5))}
    )
    sequence = turning(calibration)
    start = sequence.calibration.start.model_copy(update={"rpy_rad": (0.3, 0.0, 0.4)})
    return replace(
        sequence,
        calibration=sequence.calibration.model_copy(update={"start": start} | update),
    )


def yaw_error(estimate) -> float:
    true = 0.3 * estimate.stamp_ns * 1e-9
    return abs(
        float(np.angle(np.exp(1j * (estimate.world_T_body.rotation().yaw() - true))))
    )


every_estimator = pytest.mark.parametrize("kind", [EkfSlam, InvariantEkf, Isam2])


@every_estimator
def test_headings_turn_an_estimator_right_in_spite_of_outliers(kind):
    """0.4 rad off at the start; a fifth of the samples half a turn off; the compass' bias leaves the rest unsure."""
    sequence = aided()
    plain = headings(sequence, 0.0)
    wrong = replace(
        plain,
        yaw_rad=plain.yaw_rad + np.where(np.arange(len(plain)) % 5 == 2, np.pi, 0.0),
    )
    assert yaw_error(ran(kind, sequence)[1][-1]) > 0.3
    for heading in (plain, wrong):
        assert yaw_error(ran(kind, replace(sequence, heading=heading))[1][-1]) < 0.03
    _, estimates = ran(kind, replace(sequence, heading=plain))
    up = estimates[-1].world_T_body.rotation().matrix()[2]
    assert up @ estimates[-1].covariance[:3, :3] @ up == pytest.approx(
        0.05**2, rel=0.1
    ), "the bias of all samples"


@every_estimator
def test_fixes_give_place_heading_and_the_compass_its_bias(
    kind,
):
    antenna = np.array([0.5, -0.3, 1.0])
    positions = aided().calibration.positions.model_copy(
        update={"antenna_m": tuple(antenna)}
    )
    sequence = aided(positions=positions)
    fixes = circle_fixes(
        sequence, np.arange(500_000_000, END_NS, 1_030_000_000), antenna
    )
    biased = replace(sequence, positions=fixes, heading=headings(sequence, 0.1))
    estimator, estimates = ran(kind, biased)
    assert yaw_error(estimates[-1]) < 0.05
    compass = (
        estimator.state()[1][6] if kind is EkfSlam else biases_of(estimator)[0][COMPASS]
    )
    assert compass == pytest.approx(0.1, abs=0.05)
    true = circle_fixes(sequence, np.array([END_NS]), np.zeros(3)).position_m[0]
    near = np.linalg.norm(estimates[-1].world_T_body.translation() - true)
    assert near < 0.15
    unaware = replace(biased, calibration=aided().calibration, heading=None)
    off = ran(kind, unaware)[1][-1].world_T_body.translation() - true
    assert np.linalg.norm(off) > 2 * near, "without the lever arm"
