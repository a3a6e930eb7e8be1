from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    Mounting,
    SonarCalibration,
    Start,
)
from sonar_graph.measurements import Depth, Dvl, Imu
from sonar_graph.recognition.sonar_motion import SonarMotion, SonarMotions, level_from_up
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.sensors import dvl_readings, imu_readings, regular_stamps, seconds_since_start
from sonar_graph.simulation.vehicle import VehiclePath, rpy_from_rotation, smooth_noise
from sonar_graph.sonar.geometry import FloorView

FLOOR_Z_M = -1.7
MOUNTED = Calibration(
    imu=ImuCalibration(gyro_bias_sigma=0.0, mounting=Mounting(translation_m=(0.1, 0.05, 0.0), rpy_rad=(0.0, 0.0, 0.3))),
    dvl=DvlCalibration(mounting=Mounting(translation_m=(-0.2, 0.0, -0.15), rpy_rad=(0.0, 0.0, 0.7))),
    depth=DepthCalibration(sigma_m=0.01, port_m=(0.3, 0.05, 0.1)),
    sonar=SonarCalibration(mounting=Mounting(translation_m=(0.4, 0.1, -0.05), rpy_rad=(0.1, np.radians(30), 0.2))),
    floor=FloorPrior(z_m=FLOOR_Z_M, sigma_m=0.01),
)


def exact_run(path: VehiclePath, calibration: Calibration = MOUNTED) -> Sequence:
    """Sensors without any noise, and a start that is true."""
    imu_ns, dvl_ns, depth_ns = (regular_stamps(rate, path.duration_s) for rate in (100.0, 20.0, 10.0))
    start = path.at(np.zeros(1))
    rpy_rad = rpy_from_rotation(start.world_R_body)[0]
    begin = Start(position_m=tuple(start.position[0].tolist()), rpy_rad=tuple(rpy_rad.tolist()))
    calibration = calibration.model_copy(update={"start": begin})
    motion = path.at(seconds_since_start(depth_ns))
    port = motion.position + motion.world_R_body.apply(np.array(calibration.depth.port_m))
    return Sequence(
        "exact",
        calibration,
        imu=Imu(imu_ns, *imu_readings(path.at(seconds_since_start(imu_ns)), calibration.imu.mounting, 9.80665)),
        dvl=Dvl(
            dvl_ns,
            dvl_readings(path.at(seconds_since_start(dvl_ns)), calibration.dvl.mounting),
            np.tile(np.eye(3) * 1e-6, (len(dvl_ns), 1, 1)),
        ),
        depth=Depth(depth_ns, port[:, 2], np.full(len(depth_ns), np.nan)),
    )


@pytest.fixture(scope="module")
def path() -> VehiclePath:
    """It wanders by decimetres and sways by degrees."""
    seconds = np.linspace(0, 20, 41)
    sway = smooth_noise(seconds, np.array([0.6, 0.6, 0.2, 0.1, 0.1, 0.6]), 4.0, 6, np.random.default_rng(4))
    return VehiclePath.through(seconds, sway + np.array([0, 0, -0.7, 0, 0, 0]))


@pytest.fixture(scope="module")
def exact(path) -> Sequence:
    return exact_run(path)


def sonar_pose(path: VehiclePath, stamp_ns: int) -> gtsam.Pose3:
    """world_T_sonar by the simulator's truth."""
    motion = path.at(seconds_since_start(np.array([stamp_ns])))
    body = gtsam.Pose3(gtsam.Rot3(motion.world_R_body.as_matrix()[0]), motion.position[0])
    return body.compose(MOUNTED.sonar.mounting.pose())


def frames_of(sequence: Sequence, count: int = 40) -> list[int]:
    """Between the stamps of all sensors."""
    return (sequence.start_ns + 37_100_000 + 230_000_000 * np.arange(count)).tolist()


def along(sequence: Sequence, stamps_ns: list[int]) -> list[SonarMotion]:
    motions = SonarMotions(sequence)
    return [motions.at(stamp_ns) for stamp_ns in stamps_ns]


def test_motion_tilt_and_height_are_those_of_the_simulators_truth(path, exact):
    stamps_ns = frames_of(exact)
    poses = [sonar_pose(path, stamp_ns) for stamp_ns in stamps_ns]
    found = along(exact, stamps_ns)
    assert found[0].previous_T_sonar is None
    for before, here, motion in zip(poses, poses[1:], found[1:], strict=False):
        true = before.between(here)
        assert np.abs(true.localCoordinates(motion.previous_T_sonar)).max() < 1e-3
        view = FloorView.from_pose(here, FLOOR_Z_M)
        np.testing.assert_allclose(motion.level_R_sonar, view.level_R_sonar, atol=2e-3)
        assert motion.height_m == pytest.approx(view.height_m, abs=5e-3)
    moved = poses[0].between(poses[-1]).translation()
    joined = gtsam.Pose3()
    for motion in found[1:]:
        joined = joined.compose(motion.previous_T_sonar)
    np.testing.assert_allclose(joined.translation(), moved, atol=5e-3)
    assert np.linalg.norm(moved) > 0.1


def test_nothing_stamped_after_a_frame_influences_it(exact):
    stamps_ns = frames_of(exact, 12)
    expected = along(exact, stamps_ns)
    for k in (0, 5, 11):
        spoiled = along(_spoiled_after(exact, stamps_ns[k]), stamps_ns[: k + 1])
        for one, other in zip(expected, spoiled, strict=False):
            assert one.height_m == other.height_m
            np.testing.assert_array_equal(one.level_R_sonar, other.level_R_sonar)
            np.testing.assert_array_equal(one.covariance, other.covariance)
            if one.previous_T_sonar is not None:
                np.testing.assert_array_equal(one.previous_T_sonar.matrix(), other.previous_T_sonar.matrix())
    later = along(_spoiled_after(exact, stamps_ns[5]), stamps_ns)
    assert abs(later[-1].height_m - expected[-1].height_m) > 0.1


def _spoiled_after(run: Sequence, stamp_ns: int) -> Sequence:
    def wrong(values: np.ndarray, block: Imu | Dvl | Depth) -> np.ndarray:
        later = block.stamps_ns > stamp_ns
        return np.where(later.reshape(-1, *[1] * (values.ndim - 1)), values + 3.0, values)

    imu, dvl, depth = run.imu, run.dvl, run.depth
    return replace(
        run,
        imu=replace(
            imu, angular_velocity=wrong(imu.angular_velocity, imu), specific_force=wrong(imu.specific_force, imu)
        ),
        dvl=replace(dvl, velocity=wrong(dvl.velocity, dvl), velocity_cov=wrong(dvl.velocity_cov, dvl)),
        depth=replace(depth, z_m=wrong(depth.z_m, depth)),
    )


def test_frames_that_are_left_out_leave_their_motion_to_the_next(exact):
    stamps_ns = frames_of(exact, 9)
    every, some = along(exact, stamps_ns), along(exact, stamps_ns[::4])
    joined = gtsam.Pose3()
    for motion in every[1:5]:
        joined = joined.compose(motion.previous_T_sonar)
    assert np.abs(joined.localCoordinates(some[1].previous_T_sonar)).max() < 2e-3
    np.testing.assert_allclose(some[2].level_R_sonar, every[8].level_R_sonar, atol=1e-6)


def at_rest(rpy_rad: tuple[float, float, float], **calibration: object) -> Sequence:
    """A vehicle that does not move."""
    seconds = np.linspace(0, 20, 41)
    pose = np.array([1.0, 2.0, -0.7, *rpy_rad])
    path = VehiclePath.through(seconds, np.tile(pose, (41, 1)))
    return exact_run(path, MOUNTED.model_copy(update=calibration))


def with_start(run: Sequence, **changes: object) -> Sequence:
    start = run.calibration.start.model_copy(update=changes)
    return replace(run, calibration=run.calibration.model_copy(update={"start": start}))


@pytest.mark.parametrize("is_force_measured", [True, False])
def test_gravity_corrects_a_start_that_is_tilted_wrongly(is_force_measured: bool):
    """Without accelerometers (negative control) the error stays."""
    run = with_start(at_rest((0.05, -0.1, 1.0)), rpy_rad=(0.0, 0.0, 1.0), rpy_sigma_rad=(0.1, 0.1, 0.1))
    if not is_force_measured:
        run = replace(run, imu=replace(run.imu, specific_force=np.full_like(run.imu.specific_force, np.nan)))
    stamps_ns = [run.start_ns + s * 10**9 for s in (0, 2, 10)]
    first, _, last = along(run, stamps_ns)
    true = gtsam.Rot3.RzRyRx(0.05, -0.1, 0.0).matrix().T[:, 2]
    up = MOUNTED.sonar.mounting.pose().rotation().matrix().T @ true
    off = [np.linalg.norm(motion.level_R_sonar[2] - up) for motion in (first, last)]
    assert off[0] == pytest.approx(np.hypot(0.05, 0.1), rel=0.02)
    assert first.tilt_sigma_rad == pytest.approx(0.1, rel=0.01)
    if is_force_measured:
        assert off[1] < 0.1 * off[0]
        assert last.tilt_sigma_rad < 0.02
    else:
        assert off[1] == pytest.approx(off[0], rel=1e-6)
        assert last.tilt_sigma_rad >= 0.1


def test_gravity_is_left_alone_where_the_calibration_says_so():
    run = at_rest((0.0, 0.0, 0.0), use_gravity=False)
    run = with_start(run, rpy_rad=(0.05, 0.0, 0.0), rpy_sigma_rad=(0.1, 0.1, 0.1))
    first, last = along(run, [run.start_ns, run.start_ns + 8 * 10**9])
    np.testing.assert_allclose(last.level_R_sonar, first.level_R_sonar, atol=1e-12)


def test_tilt_is_as_uncertain_as_gyros_make_it():
    """Between two looks at gravity: white noise and a bias, from the start's variance."""
    imu = MOUNTED.imu.model_copy(update={"gyro_bias_sigma": 0.003, "gyro_noise_density": 0.002})
    run = with_start(at_rest((0.0, 0.0, 0.0), imu=imu, use_gravity=False), rpy_sigma_rad=(0.01, 0.02, 0.5))
    (motion,) = along(run, [run.start_ns + 800_000_000])
    assert motion.tilt_sigma_rad**2 == pytest.approx(0.02**2 + 0.002**2 * 0.8 + (0.003 * 0.8) ** 2, rel=1e-6)


def test_depth_corrects_a_start_that_is_too_high():
    """Two variances: 1 = z and z0 = 1.3, weighed by hand."""
    run = with_start(at_rest((0.0, 0.0, 0.0)), position_m=(1.0, 2.0, -0.4), position_sigma_m=(0.1, 0.1, 0.1))
    before, after = along(run, [run.start_ns, run.start_ns + 1])
    lever = gtsam.Pose3().compose(MOUNTED.sonar.mounting.pose()).translation()[2]
    assert before.height_m == pytest.approx(-0.4 + lever - FLOOR_Z_M, abs=1e-9)
    assert before.height_sigma_m == pytest.approx(np.hypot(0.1, 0.01), rel=1e-6)
    assert after.height_m == before.height_m  # no sample since
    (later,) = along(run, [run.start_ns + 100_000_000])
    variance = 0.1**2
    gain = variance / (variance + 0.01**2)
    assert later.height_m == pytest.approx(-0.4 - gain * 0.3 + lever - FLOOR_Z_M, abs=1e-4)
    assert later.height_sigma_m == pytest.approx(np.sqrt(variance * (1 - gain) + 0.01**2), rel=1e-2)


def test_a_depth_sample_that_states_its_variance_counts_by_it():
    run = with_start(at_rest((0.0, 0.0, 0.0)), position_m=(1.0, 2.0, -0.4), position_sigma_m=(0.1, 0.1, 0.1))
    loose = replace(run, depth=replace(run.depth, variance_m2=np.full(len(run.depth), 1.0)))
    one, other = (along(r, [r.start_ns + 100_000_000])[0].height_m for r in (run, loose))
    assert one - other == pytest.approx(0.3 * (0.01 / 1.01 - 0.01 / 0.0101), abs=1e-4)


@pytest.mark.parametrize("every", [1, 12])
def test_height_follows_the_doppler_log_between_depth_samples(path, every: int):
    """One sample only; the vehicle climbs by centimetres and sways by degrees, also between two frames."""
    run = exact_run(path)
    run = replace(run, depth=run.depth.rows(slice(0, 2)))
    stamps_ns = frames_of(run, 49)[::every]
    found = along(run, stamps_ns)
    true = [sonar_pose(path, s).translation()[2] - FLOOR_Z_M for s in stamps_ns]
    assert np.ptp(true) > 0.02
    np.testing.assert_allclose([m.height_m for m in found], true, atol=6e-3)
    assert (np.diff([m.height_sigma_m for m in found[2:]]) > 0).all()


def test_height_grows_uncertain_by_the_doppler_log_and_not_by_the_gyros():
    """At rest, by hand: 20 samples a second of 1 mm/s, over a second; the gyros' own variance is 300 times that."""
    density, sigma_v = 0.004, 1e-3
    imu = MOUNTED.imu.model_copy(update={"gyro_noise_density": density, "gyro_bias_sigma": 0.0})
    dvl = MOUNTED.dvl.model_copy(update={"mounting": Mounting()})
    run = at_rest((0.0, 0.0, 0.0), imu=imu, dvl=dvl)
    run = replace(run, depth=run.depth.rows(slice(0, 2)))
    first_ns = run.start_ns + 10**9
    first, second = along(run, [first_ns, first_ns + 10**9])
    grown = second.height_sigma_m**2 - first.height_sigma_m**2
    assert grown == pytest.approx(sigma_v**2 / 20, rel=0.1)
    assert density**2 > 300 * sigma_v**2 / 20


def test_covariance_of_a_step_is_that_of_gyros_and_doppler_log_seen_from_the_sonar():
    """At rest, by hand: the lever arm from body to sonar turns with the gyros' error."""
    density, sigma_v = 0.004, 1e-3
    imu = MOUNTED.imu.model_copy(update={"gyro_noise_density": density, "gyro_bias_sigma": 0.0})
    dvl = MOUNTED.dvl.model_copy(update={"mounting": Mounting()})
    run = at_rest((0.0, 0.0, 0.0), imu=imu, dvl=dvl)
    first_ns = run.start_ns + 10**9
    _, motion = along(run, [first_ns, first_ns + 10**9])
    body_T_sonar = MOUNTED.sonar.mounting.pose()
    R, lever = body_T_sonar.rotation().matrix(), body_T_sonar.translation()
    skew = np.array([[0, -lever[2], lever[1]], [lever[2], 0, -lever[0]], [-lever[1], lever[0], 0]])
    rotation, translation = density**2 * np.eye(3), sigma_v**2 / 20 * np.eye(3)  # 20 samples a second, over a second
    expected = np.block(
        [
            [R.T @ rotation @ R, R.T @ rotation @ skew @ R],
            [R.T @ skew.T @ rotation @ R, R.T @ (skew @ rotation @ skew.T + translation) @ R],
        ]
    )
    np.testing.assert_allclose(motion.covariance, expected, atol=0.03 * np.abs(expected).max())


def test_without_floor_or_depth_the_height_is_not_known(exact):
    for run in (
        replace(exact, depth=None),
        replace(exact, calibration=exact.calibration.model_copy(update={"floor": None})),
    ):
        (motion,) = along(run, frames_of(run, 1))
        assert motion.height_m is None
        assert motion.floor_view() is None


def test_the_recogniser_is_given_the_motion_and_the_view(exact):
    first, second = along(exact, frames_of(exact, 2))
    assert first.step() is None
    step, view = second.step(), second.floor_view()
    assert step is not None
    assert view is not None
    assert step.previous_T_sonar is second.previous_T_sonar
    np.testing.assert_array_equal(step.covariance, second.covariance)
    np.testing.assert_array_equal(view.level_R_sonar, second.level_R_sonar)
    said = (view.height_m, view.height_sigma_m, view.tilt_sigma_rad)
    assert said == (second.height_m, second.height_sigma_m, second.tilt_sigma_rad)
    assert replace(second, height_m=-0.1).floor_view() is None


def test_only_instants_with_odometry_and_in_order_are_covered(exact):
    motions, stamps_ns = SonarMotions(exact), frames_of(exact, 3)
    assert not motions.covers(exact.start_ns - 1)
    assert not motions.covers(exact.end_ns + 1)
    assert motions.covers(exact.start_ns)
    assert motions.covers(exact.end_ns)
    motions.at(stamps_ns[1])
    assert motions.passed(stamps_ns[0])
    assert not motions.covers(stamps_ns[0])
    assert motions.covers(stamps_ns[1])
    assert motions.covers(stamps_ns[2])


@given(st.floats(-0.5, 0.5), st.floats(-1.2, 1.2), st.floats(-3, 3))
def test_level_axes_follow_from_up_alone(roll: float, pitch: float, yaw: float):
    up = gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix()[2]
    found = level_from_up(up)
    np.testing.assert_allclose(found, gtsam.Rot3.RzRyRx(roll, pitch, 0.0).matrix(), atol=1e-9)
    np.testing.assert_allclose(found @ up, [0, 0, 1], atol=1e-9)


def test_a_gap_of_the_doppler_log_is_carried_by_the_accelerometers(path, exact):
    """Seven seconds without bottom lock: a held velocity is wrong by decimetres."""
    stamps_ns = frames_of(exact)
    seconds = (exact.dvl.stamps_ns - exact.start_ns) * 1e-9
    lost = replace(exact, dvl=exact.dvl.rows(np.flatnonzero((seconds < 2.0) | (seconds > 9.0))))
    held = lost.calibration.model_copy(update={"dvl": MOUNTED.dvl.model_copy(update={"gap_s": 100.0})})
    errors = {}
    for name, sequence in (("carried", lost), ("held", replace(lost, calibration=held))):
        joined, before = gtsam.Pose3(), sonar_pose(path, stamps_ns[0])
        for motion in along(sequence, stamps_ns)[1:]:
            joined = joined.compose(motion.previous_T_sonar)
        errors[name] = np.linalg.norm(before.between(sonar_pose(path, stamps_ns[-1])).between(joined).translation())
    assert errors["carried"] < 0.01
    assert errors["held"] > 0.1
