"""Poses moved on in one call are those composed with `Odometry.motion`, whatever the rows and their order."""

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import MovedPoses, Odometry
from tests.navigation.rows import NS, at, dvl, imu, stamps, waves

CALIBRATION = Calibration(
    imu=ImuCalibration(mounting=Mounting(translation_m=(0.2, -0.1, 0.05), rpy_rad=(0.0, 0.1, 0.3))),
    dvl=DvlCalibration(mounting=Mounting(translation_m=(-0.4, 0.1, -0.2), rpy_rad=(0.02, 0.0, -0.4)), gap_s=0.6),
)


def logged(duration_s: float = 10.0) -> tuple[Imu, Dvl]:
    """Rows with a gap of the Doppler log from 4 s to 6 s and a hole of the IMU from 7.5 s to 7.9 s."""
    imu_ns, dvl_ns = stamps(100, duration_s), stamps(8, duration_s, 0.003)
    imu_ns = imu_ns[(imu_ns < at(7.5)) | (imu_ns > at(7.9))]
    dvl_ns = dvl_ns[(dvl_ns < at(4.0)) | (dvl_ns > at(6.0))]
    force, velocity = (
        waves(imu_ns, 2, 0.3) + np.array([0.0, 0.0, 9.8]),
        waves(dvl_ns, 3, 0.2) + np.array([0.5, 0.0, 0.0]),
    )
    return imu(imu_ns, waves(imu_ns, 1, 0.2), force), dvl(dvl_ns, velocity)


def arriving(inertial: Imu, log: Dvl, delay_s: float) -> list[tuple[int, Imu | None, Dvl | None]]:
    """Rows by themselves in the order of arrival, those of the Doppler log late."""
    rows = [(int(t), inertial.rows(slice(k, k + 1)), None) for k, t in enumerate(inertial.stamps_ns)]
    rows += [(int(t + delay_s * NS), None, log.rows(slice(k, k + 1))) for k, t in enumerate(log.stamps_ns)]
    return sorted(rows, key=lambda row: row[0])


@pytest.mark.parametrize("interpolation", ["linear", "hold-past"])
@pytest.mark.parametrize("delay_s", [0.0, 0.15])
def test_poses_moved_on_are_those_composed_with_the_motion(interpolation, delay_s):
    """At every row of the IMU, over a gap and a hole, begun anew every second, with an epoch placed before others."""
    calibration = CALIBRATION.model_copy(update={"odometry_interpolation": interpolation})
    odometry, errors, lost = Odometry(calibration), [], 0
    poses, rng, begun_ns, late = MovedPoses(odometry), np.random.default_rng(0), 0, None
    for _, inertial, log in arriving(*logged(), delay_s):
        if log is not None and int(log.stamps_ns[0]) // NS % 3 == 2 and late is None:
            late = log  # comes after the next one
            continue
        is_out_of_date = odometry.add(inertial, log)
        if late is not None and log is not None:
            is_out_of_date |= odometry.add(None, late)
            late = None
        if is_out_of_date:
            poses.sum_anew()
        if inertial is None or (now_ns := int(inertial.stamps_ns[0])) < at(2.0):
            continue
        if now_ns >= begun_ns + NS:
            begun_ns, factor = now_ns - NS // 2, rng.normal(size=(6, 6))
            starts = [gtsam.Pose3.Expmap(rng.normal(size=6)), gtsam.Pose3()]
            poses.begin(begun_ns, np.array([pose.matrix() for pose in starts]), P := factor @ factor.T)
        x_T_j, P_j, _ = poses.at(now_ns)
        motion = odometry.motion(begun_ns, now_ns, np.zeros(3))
        A = motion.i_T_j.inverse().AdjointMap()
        expected = np.array([pose.compose(motion.i_T_j).matrix() for pose in starts])
        errors.append((np.abs(x_T_j - expected).max(), np.abs(P_j - A @ P @ A.T - motion.covariance).max()))
        lost += len(odometry.epochs(now_ns - round(0.6e9), now_ns)) == 0
    assert len(errors) > 700
    assert lost > 100
    assert np.max(errors) < 1e-10


def test_velocity_is_that_of_the_imu_at_the_newest_epoch():
    inertial, log = logged()
    odometry = Odometry(CALIBRATION)
    odometry.add(inertial, log)
    poses = MovedPoses(odometry)
    poses.begin(at(2.0), np.eye(4)[None], np.zeros((6, 6)))
    for until_s in (3.0, 3.37, 5.0):
        newest_ns = odometry.epochs(0, at(until_s))[-1]
        velocity, _ = odometry.velocity_at_imu(newest_ns)
        np.testing.assert_allclose(poses.at(at(until_s))[2], velocity, atol=1e-15)


def test_an_earlier_instant_is_answered_as_if_no_later_one_had_been():
    inertial, log = logged()
    odometry = Odometry(CALIBRATION)
    odometry.add(inertial, log)
    poses, again = MovedPoses(odometry), MovedPoses(odometry)
    for one in (poses, again):
        one.begin(at(2.0), np.eye(4)[None], np.eye(6))
    poses.at(at(3.5))
    for mine, theirs in zip(poses.at(at(2.6)), again.at(at(2.6)), strict=True):
        assert np.array_equal(mine, theirs)
