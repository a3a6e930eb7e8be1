"""Motion while the Doppler log has no bottom lock."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting, Start
from sonar_graph.estimator import load_estimator
from sonar_graph.measurements import Dvl, Imu, Measurements
from sonar_graph.navigation.odometry import Odometry, motion_between_nodes, motion_since_node
from sonar_graph.navigation.preintegration.motion import Preintegrator
from sonar_graph.states import Refusal

from .rows import NS, T0_NS, stamps

IMU_HZ, DVL_HZ, GRAVITY = 50.0, 5.0, np.array([0.0, 0.0, -9.8])
LOST_S, FOUND_S = 6.0, 16.0
GYRO, ACCEL, SIGMA = 2e-4, 1e-3, 0.005
QUIET = ImuCalibration(
    gyro_noise_density=0.0,
    gyro_bias_sigma=0.0,
    accel_noise_density=0.0,
    accel_bias_sigma=0.0,
    mounting=Mounting(translation_m=(0.2, -0.1, 0.1)),
)
NOISY = QUIET.model_copy(update={"gyro_noise_density": GYRO, "accel_noise_density": ACCEL, "accel_bias_sigma": 5e-3})
DVL = DvlCalibration(velocity_sigma_m_s=(SIGMA,) * 3, mounting=Mounting(translation_m=(-0.3, 0.2, -0.1)))
KNOWN_START = Start(position_sigma_m=(0.0,) * 3, rpy_sigma_rad=(0.0,) * 3)


class Vehicle:
    """Surging and swaying while it turns, by hand: x(t), v(t), a(t) and a constant rate about a tilted axis."""

    axis = np.array([0.05, -0.04, 0.12])

    def attitude(self, t):
        return Rotation.from_rotvec(np.outer(t, self.axis))

    def position(self, t):
        return np.column_stack([0.3 * t + 0.5 * np.sin(0.4 * t), 0.8 * np.cos(0.3 * t), 0.2 * np.sin(0.5 * t)])

    def velocity(self, t):
        return np.column_stack([0.3 + 0.2 * np.cos(0.4 * t), -0.24 * np.sin(0.3 * t), 0.1 * np.cos(0.5 * t)])

    def acceleration(self, t):
        return np.column_stack([-0.08 * np.sin(0.4 * t), -0.072 * np.cos(0.3 * t), -0.05 * np.sin(0.5 * t)])

    def imu(self, at_ns):
        t = (at_ns - T0_NS) * 1e-9
        lever, body_R_world = np.array(QUIET.mounting.translation_m), self.attitude(t).inv()
        force = body_R_world.apply(self.acceleration(t) - GRAVITY)
        force += np.cross(self.axis, np.cross(self.axis, lever))
        return Imu(at_ns, np.tile(self.axis, (len(t), 1)), force)

    def dvl(self, at_ns):
        t = (at_ns - T0_NS) * 1e-9
        velocity = self.attitude(t).inv().apply(self.velocity(t)) + np.cross(self.axis, DVL.mounting.translation_m)
        return Dvl(at_ns, velocity, np.full((len(t), 3, 3), np.nan))

    def displacement(self, start_s, end_s):
        ends = np.array([start_s, end_s])
        return self.attitude(np.array([start_s])).inv().apply(np.diff(self.position(ends), axis=0))[0]


def rows(seconds=20.0):
    """Of the whole run but the Doppler log's gap; a row before its end, to confirm that."""
    vehicle, dvl_ns = Vehicle(), stamps(DVL_HZ, seconds)
    t = (dvl_ns - T0_NS) * 1e-9
    return vehicle.imu(stamps(IMU_HZ, seconds + 0.1)), vehicle.dvl(dvl_ns[(t <= LOST_S) | (t > FOUND_S - 0.3)])


def at(seconds):
    return T0_NS + round(seconds * NS)


def motion(imu_rows, dvl_rows, imu=QUIET, until_s=FOUND_S, dvl=DVL):
    calibration = Calibration(imu=imu, dvl=dvl)
    odometry, preintegrator = Odometry(calibration), Preintegrator.from_calibration(calibration)
    confirmed_ns = at(until_s) + (NS // 4 if until_s >= FOUND_S else 0)
    odometry.add(imu_rows.between(0, at(until_s) + NS), dvl_rows.between(0, confirmed_ns))
    ends = at(LOST_S), at(until_s)
    if until_s >= FOUND_S:
        return motion_between_nodes(odometry, preintegrator, *ends, np.zeros(3), None)
    return motion_since_node(odometry, preintegrator, *ends, np.zeros(3), None)


@pytest.mark.parametrize("until_s", [FOUND_S, 15.9])
def test_accelerometers_carry_the_velocity_through_a_gap(until_s):
    """Closed or open; a straight line between the ends is wrong by metres."""
    truth = Vehicle().displacement(LOST_S, until_s)
    assert motion(*rows(), until_s=until_s).i_T_j.translation() == pytest.approx(truth, abs=0.01)
    straight = motion(*rows(), until_s=until_s, dvl=DVL.model_copy(update={"gap_s": 100.0}))
    assert np.linalg.norm(straight.i_T_j.translation() - truth) > 0.5


@pytest.mark.parametrize("until_s", [FOUND_S, 14.0])
def test_the_covariance_of_a_gap_is_that_of_many_runs(until_s):
    """Noise of gyros, accelerometers and Doppler log, and an accelerometer bias of its own for each run."""
    imu_rows, dvl_rows = rows()
    truth, rng = motion(imu_rows, dvl_rows, until_s=until_s).i_T_j.translation(), np.random.default_rng(0)
    errors = []
    for _ in range(400):
        noise = rng.standard_normal((2, len(imu_rows), 3)) * np.sqrt(IMU_HZ)
        bias = NOISY.accel_bias_sigma * rng.standard_normal(3)
        measured = Imu(
            imu_rows.stamps_ns,
            imu_rows.angular_velocity + GYRO * noise[0],
            imu_rows.specific_force + ACCEL * noise[1] + bias,
        )
        velocity = dvl_rows.velocity + SIGMA * rng.standard_normal(dvl_rows.velocity.shape)
        found = motion(measured, Dvl(dvl_rows.stamps_ns, velocity, dvl_rows.velocity_cov), NOISY, until_s)
        errors.append(found.i_T_j.rotation().unrotate(found.i_T_j.translation() - truth))
    cov = found.covariance[3:, 3:]
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(cov), errors).mean() / 3
    assert nees == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("until_s", [FOUND_S, 14.0])
def test_the_gyro_bias_derivative_of_a_gap_is_that_of_integrating_again(until_s):
    imu_rows, dvl_rows = rows()
    base, columns = motion(imu_rows, dvl_rows, until_s=until_s), []
    for axis in np.eye(3) * 1e-6:
        moved = Imu(imu_rows.stamps_ns, imu_rows.angular_velocity - axis, imu_rows.specific_force)
        change = base.i_T_j.between(motion(moved, dvl_rows, until_s=until_s).i_T_j)
        columns.append(np.r_[change.rotation().rpy(), change.translation()] / 1e-6)
    assert base.D_bias == pytest.approx(np.column_stack(columns), rel=2e-3, abs=0.05)


@pytest.mark.parametrize(("until_s", "share"), [(FOUND_S, 12.0), (15.0, 3.0)])
def test_without_accelerometer_the_velocity_is_a_random_walk(until_s, share):
    imu_rows, dvl_rows = rows()
    blind = Imu(imu_rows.stamps_ns, imu_rows.angular_velocity, np.full((len(imu_rows), 3), np.nan))
    exact = DVL.model_copy(update={"velocity_sigma_m_s": (0.0,) * 3, "velocity_walk_density": 0.05})
    found, T = motion(blind, dvl_rows, until_s=until_s, dvl=exact), until_s - LOST_S
    assert np.diag(found.covariance)[3:] == pytest.approx([0.05**2 * T**3 / share] * 3)


def test_nothing_changes_where_no_sample_is_missing():
    """The same bits with and without a model of gaps, between nodes and since one."""
    imu_rows, dvl_rows = Vehicle().imu(stamps(IMU_HZ, 8.1)), Vehicle().dvl(stamps(DVL_HZ, 8.0))
    odometry = Odometry(Calibration(imu=NOISY, dvl=DVL))
    odometry.add(imu_rows, dvl_rows)
    bridging = Preintegrator.from_calibration(Calibration(imu=NOISY, dvl=DVL))
    plain = Preintegrator(bridging.gyro_noise_density, bridging.body_p_dvl)
    for function, until_s in ((motion_between_nodes, 7.0), (motion_since_node, 1.3)):
        one, other = (function(odometry, p, at(1.0), at(until_s), np.zeros(3), None) for p in (bridging, plain))
        assert one.i_T_j.equals(other.i_T_j, 0.0)
        assert np.array_equal(one.covariance, other.covariance)


def estimate(name, imu_rows, dvl_rows, calls, start=KNOWN_START):
    calibration = Calibration(imu=NOISY, dvl=DVL, start=start, use_gravity=False)
    estimator, after_ns, out = load_estimator(name)(calibration), 0, None
    for until_ns in calls:
        out = estimator.process(
            Measurements(until_ns, imu_rows.between(after_ns, until_ns), dvl_rows.between(after_ns, until_ns))
        )
        after_ns = until_ns
    return out


@pytest.mark.parametrize("until_s", [13.0, 18.0])
def test_every_estimator_moves_alike_over_a_gap(until_s):
    start = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)
    found = [
        estimate(name, *rows(), [at(until_s)], start)
        for name in ("dead-reckoning", "ekf-slam", "invariant-ekf", "isam2")
    ]
    for other in found[1:]:
        assert other.world_T_body.translation() == pytest.approx(found[0].world_T_body.translation(), abs=1e-4)
        assert other.covariance == pytest.approx(found[0].covariance, rel=0.01, abs=1e-6)


@pytest.mark.parametrize("name", ["dead-reckoning", "ekf-slam", "invariant-ekf"])
def test_an_estimate_in_a_gap_does_not_depend_on_how_rows_are_cut(name):
    whole = estimate(name, *rows(), [at(14.0)])
    pieces = estimate(name, *rows(), [at(0.37 * k) for k in range(1, 37)] + [at(14.0)])
    assert pieces.world_T_body.equals(whole.world_T_body, 1e-9)
    assert pieces.covariance == pytest.approx(whole.covariance, rel=1e-9, abs=1e-15)


def test_an_outlying_velocity_is_gated_and_becomes_a_row():
    vehicle, dvl_ns = Vehicle(), stamps(DVL_HZ, 8.0)
    imu_rows, dvl_rows = vehicle.imu(stamps(IMU_HZ, 8.1)), vehicle.dvl(dvl_ns)
    velocity = dvl_rows.velocity.copy()
    velocity[17] += [0.0, 2.0, 0.0]
    odometry, without = Odometry(Calibration(dvl=DVL)), Odometry(Calibration(dvl=DVL))
    odometry.add(imu_rows, Dvl(dvl_ns, velocity, dvl_rows.velocity_cov))
    without.add(imu_rows, dvl_rows.rows(np.arange(len(dvl_ns)) != 17))
    (row,) = odometry.refused
    assert (row.sensor, row.stamp_ns, row.reason) == ("dvl", dvl_ns[17], Refusal.OUTLIER)
    assert row.distance > 44.8
    assert not without.refused
    here, there = (o.steps_between_nodes(int(dvl_ns[0]), int(dvl_ns[-1])) for o in (odometry, without))
    assert np.array_equal(here.velocity, there.velocity)


def test_a_wrong_first_velocity_costs_seconds():
    vehicle, dvl_ns = Vehicle(), stamps(DVL_HZ, 8.0)
    velocity = vehicle.dvl(dvl_ns).velocity.copy()
    velocity[0] += 3.0
    odometry = Odometry(Calibration(dvl=DVL))
    odometry.add(vehicle.imu(stamps(IMU_HZ, 8.1)), Dvl(dvl_ns, velocity, np.full((len(dvl_ns), 3, 3), np.nan)))
    assert 0 < len(odometry.refused) < 3 * DVL_HZ


@pytest.mark.parametrize("name", ["dead-reckoning", "ekf-slam", "invariant-ekf", "isam2"])
def test_samples_out_of_order_give_the_same_estimate_as_in_order(name):
    """A block of each sensor overtakes the one before it."""
    start = Start(position_sigma_m=(1e-6,) * 3, rpy_sigma_rad=(1e-6,) * 3)
    imu_rows, dvl_rows = rows()
    calibration = Calibration(imu=NOISY, dvl=DVL, start=start, use_gravity=False)
    ends = [0, at(2.0), at(2.45), at(2.55), at(5.0)]
    blocks = [(imu_rows.between(a, b), dvl_rows.between(a, b)) for a, b in pairwise(ends)]
    blocks[1] = blocks[1][0], dvl_rows.between(ends[1], ends[1] + NS // 4)
    found = []
    for order in ([0, 1, 2, 3], [0, 2, 1, 3]):
        estimator = load_estimator(name)(calibration)
        for k in order:
            out = estimator.process(Measurements(at(2.0) if k != 3 else at(5.0), *blocks[k]))
        found.append(out)
    assert found[1].world_T_body.equals(found[0].world_T_body, 1e-9)
    assert found[1].covariance == pytest.approx(found[0].covariance, rel=1e-6, abs=1e-12)
