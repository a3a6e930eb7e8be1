"""Doppler log against accelerometers and a reference against gyros, in simulated missions and by hand.

Kinematics of the simulator share no code with navigation.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment import (
    DvlMatch,
    Estimate1D,
    InertialPath,
    match_dvl_to_imu,
    match_reference_to_imu,
    stretches_of,
)
from sonar_graph.navigation.alignment.dvl_imu import Averaged, velocity_changes
from sonar_graph.navigation.alignment.reference_offset import ReferenceMatch
from sonar_graph.navigation.alignment.time_offset import SampleSeries
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.states import Trajectory

from .rows import dvl

OFFSET_S = 0.13
YAW_RAD = np.radians(3)
SCALE = 1.01


def assert_found(estimate: Estimate1D, truth: float, widest: float) -> None:
    assert abs(estimate.value - truth) < 4 * estimate.sigma < widest


def spoilt() -> Sequence:
    """A mission whose Doppler log is stamped early, turned and short by known amounts."""
    run = simulate_mission(MissionOptions(seed=1, duration_s=240, landmarks=1))
    early = run.dvl.stamps_ns - round(OFFSET_S * 1e9)
    velocity = Rotation.from_euler("z", -YAW_RAD).apply(run.dvl.velocity) / SCALE
    return replace(run, dvl=Dvl(early, velocity, run.dvl.velocity_cov))


def matched(run: Sequence) -> DvlMatch:
    return match_dvl_to_imu(run.imu, run.dvl, run.calibration)


def test_offset_yaw_scale_and_gyro_bias_are_found():
    """By an IMU that is mounted on its side, with a gyro bias on its own axes."""
    run = spoilt()
    bias = np.array([2e-3, -3e-3, 4e-3])
    on_its_side = Rotation.from_euler("ZYX", [0.3, 0.2, 1.5])
    rate = on_its_side.inv().apply(run.imu.angular_velocity)
    force = on_its_side.inv().apply(run.imu.specific_force)
    turned = Imu(run.imu.stamps_ns, rate + bias, force)
    known = with_mounting(run, translation_m=(0.0,) * 3, rpy_rad=(1.5, 0.2, 0.3))
    found = match_dvl_to_imu(turned, run.dvl, known)
    assert_found(found.offset, OFFSET_S, 0.4)
    assert_found(found.turn[2], YAW_RAD, 0.03)
    assert_found(found.scale, SCALE, 0.02)
    for one, truth in zip(found.gyro_bias, on_its_side.apply(bias), strict=True):
        assert_found(one, truth, 0.3 * np.linalg.norm(bias))


def test_straight_and_steady_driving_tells_nothing():
    rng = np.random.default_rng(0)
    n = 12_000
    rate = 1e-4 * rng.standard_normal((n, 3))
    force = [0, 0, 9.81] + 1e-2 * rng.standard_normal((n, 3))
    log = dvl(
        np.arange(600) * 200_000_000, [1.0, 0, 0] + 0.01 * rng.standard_normal((600, 3))
    )
    calibration = simulate_mission(MissionOptions(duration_s=10)).calibration
    found = match_dvl_to_imu(
        Imu(np.arange(n) * 10_000_000, rate, force), log, calibration
    )
    assert not any(one.is_known for one in (found.offset, found.scale, found.turn[2]))


def test_without_accelerometers_nothing_can_be_told():
    run = spoilt()
    blind = replace(run.imu, specific_force=np.full((len(run.imu), 3), np.nan))
    assert "no accelerometers" in matched(replace(run, imu=blind)).offset.reason


def without_rows(imu: Imu, is_lost: Callable[[np.ndarray], np.ndarray]) -> Imu:
    """Rows but of these seconds since the first."""
    return imu.rows(~is_lost((imu.stamps_ns - imu.stamps_ns[0]) * 1e-9))


def test_a_hole_ends_a_stretch_of_a_slow_doppler_log_too():
    """Of one row in two seconds, whose gaps are no longer than what it always has."""
    seconds = np.arange(0.0, 200.0, 2.0)
    parts = (seconds > 101).astype(np.int64)
    assert not any(
        run.start <= 50 < run.stop - 1 for run in stretches_of(seconds, parts)
    )
    assert any(
        run.start <= 50 < run.stop - 1
        for run in stretches_of(seconds, np.zeros_like(parts))
    )


def with_mounting(run: Sequence, **mounting: tuple[float, float, float]) -> Calibration:
    """The run's calibration, with another mounting of the IMU."""
    moved = run.calibration.imu.mounting.model_copy(update=mounting)
    imu = run.calibration.imu.model_copy(update={"mounting": moved})
    return run.calibration.model_copy(update={"imu": imu})


def on_a_plane(arm_m: np.ndarray) -> tuple[Imu, Dvl]:
    """By hand: at 1 m/s along a swinging heading a sin(b t), level throughout; IMU at the body's origin."""
    rng = np.random.default_rng(0)
    a = 1.5
    b = 0.3
    t = np.arange(0, 150, 0.01)
    dvl_t = np.arange(0, 150, 0.2)
    turning = a * b * np.cos(b * t)
    force = np.column_stack(
        [0.2 * np.cos(0.2 * t), (1 + np.sin(0.2 * t)) * turning, np.full_like(t, 9.81)]
    )
    rate = np.outer(turning, [0.0, 0.0, 1.0])
    along = np.outer(1 + np.sin(0.2 * dvl_t), [1.0, 0.0, 0.0])
    velocity = along + np.cross(
        np.outer(a * b * np.cos(b * dvl_t), [0.0, 0.0, 1.0]), arm_m
    )
    imu_noise = rng.standard_normal((2, len(t), 3))
    dvl_noise = rng.standard_normal((len(dvl_t), 3))
    imu_ns, dvl_ns = (
        np.round(1e9 * seconds).astype(np.int64) for seconds in (t, dvl_t)
    )
    imu = Imu(imu_ns, rate + 1e-4 * imu_noise[0], force + 1e-2 * imu_noise[1])
    return imu, dvl(dvl_ns, velocity + 0.01 * dvl_noise)


def test_turning_about_one_axis_tells_the_arm_across_it_alone():
    arm = np.array([0.7, -0.4, 0.5])
    found = match_dvl_to_imu(*on_a_plane(arm), Calibration())
    for one, truth in zip(found.lever[:2], arm, strict=False):
        assert_found(one, truth, 0.1)
    assert not found.lever[2].is_known
    assert found.lever[2].reason == "too little turning"


def circling(gyro_delay_s: float, seed: int) -> tuple[Imu, Dvl]:
    """At 0.6 m/s in a circle of 5 m, swaying, rolling and pitching by 2 degrees; IMU 50 Hz, Doppler log 5 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 300, 0.02)
    dvl_t = np.arange(0.2, 299.8, 0.2)
    phases = rng.uniform(0, 2 * np.pi, (3, 4))
    periods_s = np.geomspace(5.0, 20.0, 4) * rng.uniform(0.8, 1.2, (3, 4))

    def waves(at: np.ndarray) -> np.ndarray:
        """Roll and pitch, rad, and sway, m/s, shape (3, n)."""
        each = np.sin(2 * np.pi * at[:, None, None] / periods_s + phases)
        return each.sum(axis=2).T * np.array([[0.02], [0.02], [0.03]])

    def attitude(at: np.ndarray) -> Rotation:
        roll, pitch, _ = waves(at)
        return Rotation.from_euler("ZYX", np.column_stack([0.12 * at, pitch, roll]))

    def velocity(at: np.ndarray) -> np.ndarray:
        level = np.column_stack([0.6 + 0 * at, waves(at)[2], 0 * at])
        return Rotation.from_euler("z", 0.12 * at[:, None]).apply(level)

    gyro_t = t - gyro_delay_s
    turn = attitude(gyro_t - 1e-3).inv() * attitude(gyro_t + 1e-3)
    acceleration = (velocity(t + 1e-3) - velocity(t - 1e-3)) / 2e-3
    force = attitude(t).inv().apply(acceleration + np.array([0.0, 0.0, 9.80665]))
    imu_noise = rng.standard_normal((2, len(t), 3))
    doppler = attitude(dvl_t).inv().apply(velocity(dvl_t))
    doppler += 0.008 * rng.standard_normal(doppler.shape)
    imu_ns, dvl_ns = (
        np.round(1e9 * seconds).astype(np.int64) for seconds in (t, dvl_t)
    )
    imu = Imu(
        imu_ns,
        turn.as_rotvec() / 2e-3 + 1e-3 * imu_noise[0],
        force + 1e-2 * imu_noise[1],
    )
    return imu, dvl(dvl_ns, doppler)


@pytest.mark.parametrize("seed", range(4))
def test_gyros_with_a_slower_filter_make_no_pitch_of_the_doppler_log(seed):
    """Gravity felt through a tilt that comes 5 ms later changes the velocity as a log does that is pitched by degrees."""
    found = match_dvl_to_imu(*circling(0.005, seed), Calibration())
    _, pitch, _ = found.turn
    assert not pitch.is_known or abs(pitch.value) < 4 * pitch.sigma


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("kind", "column", "size"),
    [("lever", 4, 0.1), ("force", 7, 1e-3), ("gyro", 10, 1e-4)],
)
def test_derivatives_are_those_of_what_is_lined_up(kind, column, size, axis):
    """The first stretch with an arm or a bias of its own, less without: the column, but for gravity and its turning."""

    def first(change: np.ndarray) -> SampleSeries:
        arm, rate, force = (
            change if kind == name else np.zeros(3)
            for name in ("lever", "gyro", "force")
        )
        imu, dvl = on_a_plane(arm)
        path = InertialPath.of(
            Imu(imu.stamps_ns, imu.angular_velocity + rate, imu.specific_force + force)
        )
        seconds = path.since_origin(dvl.stamps_ns)[:150]
        run = Averaged.of(slice(0, 150), seconds)
        assert run is not None
        return velocity_changes(
            path, seconds, dvl.velocity[:150], [run], np.zeros(3), 0.0
        )[0]

    before = first(np.zeros(3))
    after = first(size * np.eye(3)[axis])
    own = np.linalg.qr(before.B.reshape(len(before.y) * 3, -1))[0]
    shown = (after.y - before.y).ravel()
    said = (size * before.A[:, :, column + axis]).ravel()
    shown, said = (values - own @ (own.T @ values) for values in (shown, said))
    assert np.linalg.norm(shown - said) < 0.02 * np.linalg.norm(shown) + 1e-4


RUN = simulate_mission(MissionOptions(seed=3, duration_s=200, landmarks=1))


def referenced(imu: Imu, reference: Trajectory) -> ReferenceMatch:
    return match_reference_to_imu(imu, reference, RUN.calibration)


def early(offset_s: float, wrong_rad: float = 0.0) -> Trajectory:
    truth = RUN.truth
    stamps = truth.stamps_ns[::50]
    noise = Rotation.from_rotvec(
        1e-3 * np.random.default_rng(0).standard_normal((len(stamps), 3))
    )
    seconds = (stamps - stamps[0]) * 1e-9
    turned = Rotation.from_euler("z", np.where(seconds < 11, wrong_rad, 0.0)[:, None])
    rotations = turned * Rotation.from_quat(truth.quaternions_xyzw[::50]) * noise
    return Trajectory.without_covariances(
        stamps - round(offset_s * 1e9), truth.positions[::50], rotations.as_quat()
    )


def test_a_wrong_start_heading_is_named():
    found = referenced(RUN.imu, early(-0.43, wrong_rad=0.07)).start_heading
    assert found.value == pytest.approx(0.07, abs=4 * found.sigma)
    assert abs(referenced(RUN.imu, early(0.1)).start_heading.value) < 0.005


def test_without_turning_the_offset_cannot_be_told():
    still = replace(RUN.imu, angular_velocity=1e-4 * np.ones((len(RUN.imu), 3)))
    level = replace(
        early(0.1), quaternions_xyzw=np.tile([0.0, 0, 0, 1], (len(early(0.1)), 1))
    )
    assert not referenced(still, level).offset.is_known


def test_nothing_is_compared_over_a_hole_of_the_gyros(monkeypatch):
    """5 s without a row in a turning vehicle."""
    holed = without_rows(RUN.imu, lambda t: (t > 80.0) & (t < 85.0))
    right = early(0.2)
    wrong = early(0.2, wrong_rad=0.07)
    offset = referenced(holed, right).offset
    heading = referenced(holed, wrong).start_heading
    assert abs(offset.value - 0.2) < 3 * offset.sigma < 0.01
    assert heading.value == pytest.approx(0.07, abs=4 * heading.sigma)
    assert heading.sigma < 0.005
    monkeypatch.setattr(
        "sonar_graph.navigation.alignment.dvl_imu.holes_before", np.zeros_like
    )
    assert referenced(holed, right).offset.sigma > 1.5 * offset.sigma
    assert referenced(holed, wrong).start_heading.sigma > 0.005


def test_a_hole_soon_after_the_start_leaves_its_heading_unknown():
    found = referenced(
        without_rows(RUN.imu, lambda t: (t > 20.0) & (t < 22.0)), early(0.2)
    )
    assert found.offset.is_known
    assert "too soon after the start" in found.start_heading.reason
    assert (
        "without a hole"
        in referenced(
            without_rows(RUN.imu, lambda t: t % 8.0 <= 0.5), early(0.2)
        ).offset.reason
    )


@pytest.mark.parametrize("together", [13, 14, 16, 20])
def test_a_doppler_log_in_short_pieces_is_not_matched_instead_of_an_error(together):
    """Rows in groups, with gaps between that end each stretch before it has more differences than parameters."""
    is_kept = np.arange(len(RUN.dvl)) % (together + 5) < together
    found = match_dvl_to_imu(RUN.imu, RUN.dvl.rows(is_kept), RUN.calibration)
    assert not found.offset.is_known
    assert found.offset.reason
