"""Doppler log against accelerometers; truth from the simulator, whose kinematics share no code with navigation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.devices.dvl_beams import UNMEASURED_M_S
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.alignment.dvl_imu import (
    DvlMatch,
    InertialPath,
    match_dvl_to_imu,
    stretches_of,
    velocity_changes,
)
from sonar_graph.navigation.alignment.time_offset import OffsetFit, SampleSeries, fit, rate_noise_power
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.mission import MissionOptions, simulate_mission

T_S = np.arange(0, 20, 0.02)
STAMPS_NS = np.round(T_S * 1e9).astype(np.int64)
RATE = np.column_stack([0.2 * np.sin(T_S), 0.1 * np.cos(0.7 * T_S), 0.3 + 0.2 * np.sin(0.4 * T_S)])
FORCE = np.column_stack([np.sin(0.5 * T_S), 0.3 * np.cos(T_S), 9.8 + 0.1 * T_S])


def path_with(gyro_bias: np.ndarray, accel_bias: np.ndarray) -> InertialPath:
    return InertialPath.of(Imu(STAMPS_NS, RATE + gyro_bias, FORCE + accel_bias))


@pytest.mark.parametrize("axis", range(3))
def test_impulse_changes_with_biases_as_its_derivatives_say(axis):
    bias, none = 1e-5 * np.eye(3)[axis], np.zeros(3)
    path = path_with(none, none)
    by_accel = path_with(none, bias).impulse - path.impulse
    by_gyro = 0.5 * (path_with(bias, none).impulse - path_with(-bias, none).impulse)
    assert by_accel == pytest.approx(path.turned_time @ bias, abs=1e-12)
    assert by_gyro == pytest.approx(-path.tilted_impulse @ bias, abs=5e-4 * np.abs(by_gyro).max())
    assert np.abs(by_gyro[-1]).max() > 3e-4


def test_a_hole_ends_a_part_and_what_is_about_it_is_not_covered():
    """Between 5 s and 7 s there is no sample; 80 ms are no hole."""
    kept = ((T_S <= 5.001) | (T_S >= 6.999)) & ((T_S <= 12.001) | (T_S >= 12.079))
    path = InertialPath.of(Imu(STAMPS_NS[kept], RATE[kept], FORCE[kept]))
    assert np.flatnonzero(np.diff(path.parts)).tolist() == [250]
    assert path.parts_at(np.array([0.0, 5.0, 6.9, 7.0, 19.9])).tolist() == [0, 0, 0, 1, 1]
    asked = np.array([-0.1, 0.0, 5.0, 5.01, 6.99, 7.0, 12.04, 19.98, 20.0])
    assert path.covers(asked).tolist() == [False, True, True, False, False, True, True, True, False]
    assert path.covers(np.array([0.9, 3.99, 4.01, 7.99, 8.01, 18.99]), 1.0).tolist() == [
        False,
        True,
        False,
        False,
        True,
        False,
    ]


def test_integrals_at_samples_are_those_of_the_samples():
    path = path_with(np.zeros(3), np.zeros(3))
    rows = np.array([3, 500, 700])
    assert path.rotations_at(T_S[rows]) == pytest.approx(path.rotations[rows])
    assert path.linear_at(T_S[rows], path.tilted_impulse) == pytest.approx(path.tilted_impulse[rows])
    between = 0.5 * (path.rotations[3] + path.rotations[4])
    assert path.rotations_at(T_S[3:4] + 0.01)[0] == pytest.approx(between, abs=1e-4)


OFFSET_S, YAW_RAD, SCALE = 0.13, np.radians(3), 1.01


def spoilt(seed: int, offset_s: float = OFFSET_S, yaw_rad: float = YAW_RAD, scale: float = SCALE) -> Sequence:
    """A mission whose Doppler log is stamped early, turned and short by known amounts."""
    run = simulate_mission(MissionOptions(seed=seed, duration_s=240, landmarks=1))
    early = run.dvl.stamps_ns - round(offset_s * 1e9)
    velocity = Rotation.from_euler("z", -yaw_rad).apply(run.dvl.velocity) / scale
    return replace(run, dvl=Dvl(early, velocity, run.dvl.velocity_cov))


def matched(run: Sequence) -> DvlMatch:
    return match_dvl_to_imu(run.imu, run.dvl, run.calibration)


def test_offset_yaw_and_scale_are_found():
    found = matched(spoilt(1))
    assert abs(found.offset.value - OFFSET_S) < 4 * found.offset.sigma < 0.4
    assert abs(found.yaw.value - YAW_RAD) < 4 * found.yaw.sigma < 0.03
    assert abs(found.scale.value - SCALE) < 4 * found.scale.sigma < 0.02


def test_straight_and_steady_driving_tells_nothing():
    rng = np.random.default_rng(0)
    n = 12_000
    imu = Imu(
        np.arange(n, dtype=np.int64) * 10_000_000,
        1e-4 * rng.standard_normal((n, 3)),
        [0, 0, 9.81] + 1e-2 * rng.standard_normal((n, 3)),
    )
    velocity = [1.0, 0, 0] + 0.01 * rng.standard_normal((600, 3))
    dvl = Dvl(np.arange(600, dtype=np.int64) * 200_000_000, velocity, np.full((600, 3, 3), np.nan))
    found = match_dvl_to_imu(imu, dvl, simulate_mission(MissionOptions(duration_s=10)).calibration)
    assert not found.offset.is_known
    assert not found.scale.is_known
    assert not found.yaw.is_known


def test_without_accelerometers_nothing_can_be_told():
    run = spoilt(1)
    blind = replace(run, imu=Imu(run.imu.stamps_ns, run.imu.angular_velocity, np.full((len(run.imu), 3), np.nan)))
    assert "no accelerometers" in matched(blind).offset.reason


@pytest.mark.slow
def test_rows_of_few_beams_say_what_they_would_say_were_they_not_there():
    run = spoilt(1)
    some = np.random.default_rng(0).random(len(run.dvl)) < 0.2
    velocity, cov = run.dvl.velocity.copy(), run.dvl.velocity_cov.copy()
    velocity[some, 1:], cov[some] = 0.0, np.diag([1e-4, UNMEASURED_M_S**2, UNMEASURED_M_S**2])
    found = matched(replace(run, dvl=Dvl(run.dvl.stamps_ns, velocity, cov)))
    without = matched(replace(run, dvl=run.dvl.rows(np.flatnonzero(~some))))
    for one, other in ((found.offset, without.offset), (found.yaw, without.yaw), (found.scale, without.scale)):
        assert one == other
    assert abs(found.offset.value - OFFSET_S) < 4 * found.offset.sigma < 0.4


@pytest.mark.slow
def test_a_gyro_bias_changes_no_estimate():
    """Ten times a good MEMS gyro's: turning while it tilts gravity must not look like a turn of the mounting."""
    run = spoilt(1)
    bias = np.array([2e-3, -2e-3, 1e-3])
    biased = replace(run, imu=Imu(run.imu.stamps_ns, run.imu.angular_velocity + bias, run.imu.specific_force))
    here, there = matched(run), matched(biased)
    for one, other in ((here.offset, there.offset), (here.yaw, there.yaw), (here.scale, there.scale)):
        assert abs(one.value - other.value) < 0.2 * one.sigma
        assert other.sigma < 1.1 * one.sigma


HOLE_AT_S = 100.0


def without_rows(run: Sequence, hole_s: float) -> Sequence:
    t = (run.imu.stamps_ns - run.imu.stamps_ns[0]) * 1e-9
    return replace(run, imu=run.imu.rows((t <= HOLE_AT_S) | (t >= HOLE_AT_S + hole_s)))


def errors_over_sigma(found: DvlMatch) -> np.ndarray:
    """Of offset, yaw, scale and gyro biases; the simulator's gyros have none to speak of."""
    told = (found.offset, found.yaw, found.scale, *found.gyro_bias)
    return np.array([(one.value - true) / one.sigma for one, true in zip(told, (0, 0, 1, 0, 0, 0), strict=True)])


@pytest.mark.slow
@pytest.mark.parametrize("hole_s", [2.0, 5.0])
def test_a_hole_of_the_imu_ends_a_stretch(hole_s: float, monkeypatch: pytest.MonkeyPatch):
    """What the vehicle did in there is nobody's knowledge; taken as linear it spoils scale and noise."""
    run = simulate_mission(MissionOptions(seed=4, duration_s=240, landmarks=1))
    whole, holed = matched(run), matched(without_rows(run, hole_s))
    assert np.abs(errors_over_sigma(holed)).max() < 2.5
    assert holed.scale.sigma < 1.5 * whole.scale.sigma
    assert abs(holed.scale.value - whole.scale.value) < 2 * whole.scale.sigma
    monkeypatch.setattr("sonar_graph.navigation.alignment.dvl_imu.holes_before", np.zeros_like)
    blind = matched(without_rows(run, hole_s))
    assert blind.scale.sigma > 1.25 * whole.scale.sigma
    assert hole_s < 5.0 or abs(blind.scale.value - 1.0) > 2.5 * blind.scale.sigma


def test_a_hole_ends_a_stretch_of_a_slow_doppler_log_too():
    """Of one row in two seconds, whose gaps are no longer than what it always has."""
    seconds = np.arange(0.0, 200.0, 2.0)
    parts = (seconds > 101).astype(np.int64)
    assert not any(run.start <= 50 < run.stop - 1 for run in stretches_of(seconds, parts))
    assert any(run.start <= 50 < run.stop - 1 for run in stretches_of(seconds, np.zeros_like(parts)))


def with_imu_at(run: Sequence, place_m: tuple[float, float, float]) -> Sequence:
    """The same run whose calibration says that the IMU is elsewhere."""
    imu = run.calibration.imu
    moved = imu.model_copy(update={"mounting": imu.mounting.model_copy(update={"translation_m": place_m})})
    return replace(run, calibration=run.calibration.model_copy(update={"imu": moved}))


@pytest.mark.slow
def test_the_lever_arm_is_found_whatever_the_calibration_says():
    """The simulator's: (-0.2, 0, -0.15) m. From calibrations metres apart comes one arm."""
    run = spoilt(1)
    here, there = matched(run), matched(with_imu_at(run, (1.4, -1.2, 1.0)))
    for found in (here, there):
        for one, true in zip(found.lever, (-0.2, 0.0, -0.15), strict=True):
            assert abs(one.value - true) < 4 * one.sigma < 0.4
    for one, other in zip(here.lever, there.lever, strict=True):
        assert abs(one.value - other.value) < 0.25 * one.sigma
    assert there.yaw.value == pytest.approx(here.yaw.value, abs=0.25 * here.yaw.sigma)


def on_a_plane(arm_m: np.ndarray) -> tuple[Imu, Dvl]:
    """By hand: at 1 m/s along a swinging heading a sin(b t), level throughout; IMU at the body's origin."""
    rng, a, b = np.random.default_rng(0), 1.5, 0.3
    t, dvl_t = np.arange(0, 150, 0.01), np.arange(0, 150, 0.2)
    turning = a * b * np.cos(b * t)
    force = np.column_stack([0.2 * np.cos(0.2 * t), (1 + np.sin(0.2 * t)) * turning, np.full_like(t, 9.81)])
    rate = np.outer(turning, [0.0, 0.0, 1.0])
    along = np.outer(1 + np.sin(0.2 * dvl_t), [1.0, 0.0, 0.0])
    velocity = along + np.cross(np.outer(a * b * np.cos(b * dvl_t), [0.0, 0.0, 1.0]), arm_m)
    imu_noise, dvl_noise = rng.standard_normal((2, len(t), 3)), rng.standard_normal((len(dvl_t), 3))
    imu_ns, dvl_ns = (np.round(1e9 * seconds).astype(np.int64) for seconds in (t, dvl_t))
    unknown = np.full((len(dvl_t), 3, 3), np.nan)
    imu = Imu(imu_ns, rate + 1e-4 * imu_noise[0], force + 1e-2 * imu_noise[1])
    return imu, Dvl(dvl_ns, velocity + 0.01 * dvl_noise, unknown)


def test_turning_about_one_axis_tells_the_arm_across_it_alone():
    arm = np.array([0.7, -0.4, 0.5])
    found = match_dvl_to_imu(*on_a_plane(arm), Calibration())
    for one, true in zip(found.lever[:2], arm, strict=False):
        assert abs(one.value - true) < 4 * one.sigma < 0.1
    assert not found.lever[2].is_known
    assert found.lever[2].reason == "too little turning"


def test_the_gyro_bias_is_found_in_body_axes():
    """The readings of an IMU that is mounted on its side, with a bias on its own axes."""
    run, bias = spoilt(1), np.array([2e-3, -3e-3, 4e-3])
    on_its_side = Rotation.from_euler("ZYX", [0.3, 0.2, 1.5])
    own = [on_its_side.inv().apply(columns) for columns in (run.imu.angular_velocity, run.imu.specific_force)]
    mounting = Mounting(rpy_rad=(1.5, 0.2, 0.3))
    calibration = run.calibration.model_copy(
        update={"imu": run.calibration.imu.model_copy(update={"mounting": mounting})}
    )
    found = match_dvl_to_imu(Imu(run.imu.stamps_ns, own[0] + bias, own[1]), run.dvl, calibration)
    for one, true in zip(found.gyro_bias, on_its_side.apply(bias), strict=True):
        assert abs(one.value - true) < 4 * one.sigma < 0.3 * np.linalg.norm(bias)


def test_what_the_shared_noise_adds_is_taken_off_every_parameter_and_the_offset():
    """The column of the scale holds it: see the same law, with noise, of `test_time_offset`."""
    rng, m = np.random.default_rng(3), 30
    B = np.tile(np.eye(3), (m, 1, 1))
    stretch = SampleSeries(rng.standard_normal((m, 3)), rng.standard_normal((m, 3, 14)), B, np.ones(m))
    found = fit([stretch], np.full(14, 10.0), np.array([0.5, 0.1]))
    corrected = OffsetFit(found, 0.3, "").without_shared_noise([stretch], 1)
    added = found.covariance[:, 1] * rate_noise_power([stretch], found.ratios)
    assert corrected.fit.parameters == pytest.approx(found.parameters - added, rel=1e-9)
    assert corrected.offset_s == pytest.approx(0.3 - added[0], rel=1e-9)
    assert added[1] > 0.1 * np.sqrt(found.covariance[1, 1])


def test_the_third_axis_of_a_stretch_is_the_vertical_and_does_not_walk():
    """However the IMU lies: gravity is all in the third, 9.81 m/s in each second, the others have what is driven."""
    imu, dvl = on_a_plane(np.zeros(3))
    lying = Rotation.from_euler("ZYX", [0.4, -0.8, 2.0])
    turned = [lying.apply(columns) for columns in (imu.angular_velocity, imu.specific_force, dvl.velocity)]
    path = InertialPath.of(Imu(imu.stamps_ns, turned[0], turned[1]))
    seconds = path.since_origin(dvl.stamps_ns)[:-50]
    stretches = velocity_changes(
        path, seconds, turned[2][:-50], list(stretches_of(seconds, path.parts_at(seconds))), np.zeros(3), 0.0
    )
    assert len(stretches) > 3
    for stretch in stretches:
        assert stretch.walks == (True, True, False)
        assert stretch.y[:, 2] / stretch.duration_s == pytest.approx(-9.81, abs=0.1)
        assert np.abs(stretch.y[:, :2]).max() < 0.3


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("kind", ["lever", "force", "gyro"])
def test_derivatives_are_those_of_what_is_lined_up(kind: str, axis: int):
    """The first stretch with an arm or a bias of its own, less without: the column, but for gravity and its turning."""
    column = {"lever": 4, "force": 7, "gyro": 10}[kind] + axis
    size = {"lever": 0.1, "force": 1e-3, "gyro": 1e-4}[kind]
    change = size * np.eye(3)[axis]

    def first(arm: np.ndarray, rate: np.ndarray, force: np.ndarray) -> SampleSeries:
        imu, dvl = on_a_plane(arm)
        path = InertialPath.of(Imu(imu.stamps_ns, imu.angular_velocity + rate, imu.specific_force + force))
        seconds = path.since_origin(dvl.stamps_ns)[:150]
        return velocity_changes(path, seconds, dvl.velocity[:150], [slice(0, 150)], np.zeros(3), 0.0)[0]

    nothing = np.zeros(3)
    before = first(nothing, nothing, nothing)
    after = first(*(change if kind == name else nothing for name in ("lever", "gyro", "force")))
    own = np.linalg.qr(before.B.reshape(len(before.y) * 3, -1))[0]
    shown, said = (after.y - before.y).ravel(), (size * before.A[:, :, column]).ravel()
    shown, said = (values - own @ (own.T @ values) for values in (shown, said))
    assert np.linalg.norm(shown - said) < 0.02 * np.linalg.norm(shown) + 1e-4
