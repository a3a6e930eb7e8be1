"""Truth by hand: places, arms, biases and a vehicle that lies tilted; and the simulator's moving one."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    STANDARD_GRAVITY,
    Calibration,
    ImuCalibration,
    Mounting,
    Start,
)
from sonar_graph.diagnosis import Finding
from sonar_graph.diagnosis.start import (
    StartTilt,
    bias_findings,
    find_start_tilt,
    lever_findings,
    start_heading_finding,
    tilt_findings,
    with_bias,
    with_fitted,
)
from sonar_graph.measurements import Floats, Imu, Ints
from sonar_graph.navigation.alignment import DvlMatch, Estimate1D
from sonar_graph.sequence import Sequence
from sonar_graph.settings import parse
from sonar_graph.simulation import MissionOptions, simulate_mission
from sonar_graph.states import Trajectory

from .runs import dvl_rows, heading_rows, lines_of, recalibrated, spoilt, unstated

UNKNOWN = Estimate1D(np.nan, np.inf, "too little turning")
GIVEN = parse(
    Calibration,
    {
        "imu": {
            "mounting": {"translation_m": [0.5, 0.1, 0.0]},
            "gyro_bias_sigma": 1e-4,
        },
        "dvl": {"mounting": {"translation_m": [-1.0, 0.2, 0.3]}},
    },
    "by hand",
)
"""An arm of (-1.5, 0.1, 0.3) m."""


def with_arm(*lever: Estimate1D) -> DvlMatch:
    return replace(DvlMatch.unknown(UNKNOWN.reason), lever=lever)


def along(*values: float, sigma: float = 0.01) -> Any:
    """Estimates of as many numbers."""
    return tuple(Estimate1D(value, sigma) for value in values)


def biases_of(
    found: tuple[Estimate1D, ...], imu: ImuCalibration, turned_s: float = 60.0
) -> list[Finding]:
    """Findings about biases with which the yaw turns for so long."""
    sources = ("from 20 s of rest", "from turns", "from turns")
    return bias_findings(found, sources, imu, np.array([0.0, 0.0, turned_s]))


def test_either_line_makes_the_arm_of_the_calibration_the_one_found():
    match = with_arm(*along(-0.2, 0.11, 0.9))
    rows = lever_findings(match, GIVEN)
    assert [row.acts for row in rows] == [True, False, True]
    first, second, third = (row.text() for row in rows)
    assert "not the calibration's -1.50 m" in first
    assert second == "+0.110 ± 0.020 m: the calibration's +0.10 m fits, no need to act"
    assert third == "+0.900 ± 0.020 m: put right by the line above"
    imu, dvl = lines_of(rows[0])
    of_imu = imu["imu"]["mounting"]["translation_m"]
    of_dvl = dvl["dvl"]["mounting"]["translation_m"]
    found = pytest.approx([-0.2, 0.1, 0.9])
    assert np.subtract((-1.0, 0.2, 0.3), of_imu) == found
    assert np.subtract(of_dvl, (0.5, 0.1, 0.0)) == found
    place = with_fitted(match, GIVEN).imu.mounting.translation_m
    assert place == pytest.approx(of_imu)


def test_an_unobservable_axis_of_the_lever_arm_keeps_its_value():
    rows = lever_findings(with_arm(UNKNOWN, *along(0.6, 0.3)), GIVEN)
    assert rows[0].text() == "cannot be told: too little turning"
    assert [row.acts for row in rows] == [False, True, False]
    assert "`imu.mounting.translation_m = [0.500, -0.400, 0.000]`" in rows[1].advice
    nothing = (UNKNOWN,) * 3
    (arm,) = lever_findings(with_arm(*nothing), GIVEN)
    (bias,) = biases_of(nothing, GIVEN.imu)
    assert arm.text() == bias.text() == "cannot be told: too little turning"
    assert with_fitted(with_arm(*nothing), GIVEN) == GIVEN


def test_a_bias_beyond_its_sigma_is_stated_along_the_axes_of_the_imu():
    biases = along(1e-3, 1.5e-4, -4e-3, sigma=1e-4)
    turned = Mounting(rpy_rad=(0.0, 0.0, np.pi / 2))
    before = {"gyro_bias_rad_s": (0.0, 0.0, 5e-4), "mounting": turned}
    imu = GIVEN.imu.model_copy(update=before)
    rows = biases_of(biases, imu)
    assert [row.acts for row in rows] == [True, False, True]
    assert "from 20 s of rest" in rows[0].text()
    stated, sigma = (line["imu"] for line in lines_of(rows[0]))
    expected = [0.0, -1e-3, -4e-3 + 5e-4]
    assert stated["gyro_bias_rad_s"] == pytest.approx(expected, abs=1e-6)
    assert sigma["gyro_bias_sigma"] == 1e-4
    assert rows[2].advice == "put right by the line above"
    # 0.24 rad over a minute
    assert rows[0].grave
    assert not biases_of(biases, imu, turned_s=6.0)[0].grave
    left = along(0.0, 1.5e-4, 0.0, sigma=1e-4)
    assert not any(row.acts for row in biases_of(left, with_bias(biases, imu)))


@pytest.mark.parametrize(("rate", "acts"), [(7.3e-5, False), (1.2e-4, True)])
def test_the_rotation_of_the_earth_is_no_fault_of_a_gyro(rate, acts):
    fibre = ImuCalibration(gyro_bias_sigma=3e-6)
    rows = biases_of(along(rate, 0.0, 0.0, sigma=1e-5), fibre)
    assert [row.acts for row in rows] == [acts, False, False]


ROLL = 0.12
PITCH = -0.07
BIAS = np.array([3e-4, -2e-4, 1e-4])


def nanoseconds(t: Floats) -> Ints:
    return np.round(1e9 * t).astype(np.int64)


UP = Rotation.from_euler("ZYX", [0.0, PITCH, ROLL]).inv().apply([0.0, 0.0, 1.0])


def started(**start: object) -> Calibration:
    """Calibration with a stated start."""
    return Calibration(start=Start(source="stated", **start))


def resting(rest_s: float, lay_s: float = 0.0) -> Sequence:
    """Tilted and still for so long, then off at 0.4 m/s² for two seconds; the Doppler log may begin later."""
    rng = np.random.default_rng(2)
    t = np.arange(0, 60.0, 0.01)
    dvl_t = np.arange(lay_s, 60.0, 0.2)
    ahead = [1.0, 0.0, 0.0]
    off = np.outer((t > rest_s) & (t < rest_s + 2.0), ahead)
    force = STANDARD_GRAVITY * UP + 0.4 * off + 1.2e-2 * rng.standard_normal(off.shape)
    rate = BIAS + 1.2e-3 * rng.standard_normal(off.shape)
    speed = np.outer(0.4 * np.clip(dvl_t - rest_s, 0.0, 2.0), ahead)
    velocity = speed + 0.01 * rng.standard_normal(speed.shape)
    imu = Imu(nanoseconds(t), rate, force)
    dvl = dvl_rows(nanoseconds(dvl_t), velocity)
    return Sequence("by hand", Calibration(), imu, dvl)


TURNS = {
    "turning": (0.011, 0.011, 0.0),
    "turning, compass mirrored": (0.011, -0.011, 0.0),
    "gyro bias": (0.011, 0.0, 0.011),
    "compass drifts": (0.0, 0.011, 0.0),
    "no compass": (0.011, None, 0.011),
}


@pytest.mark.parametrize("case", TURNS)
def test_a_slow_turn_that_the_heading_confirms_is_no_gyro_bias(case):
    """About the vertical of a tilted vehicle; and no turn without a heading that distinguishes it from a bias."""
    turn_rad_s, said_rad_s, left = TURNS[case]
    run = resting(50.0)
    rate = run.imu.angular_velocity + turn_rad_s * UP
    run = spoilt(run, "imu", angular_velocity=rate)
    if said_rad_s is not None:
        t = np.arange(0, 60, 0.1)
        noise = 0.005 * np.random.default_rng(0).standard_normal(len(t))
        heading = heading_rows(nanoseconds(t), 3.0 + said_rad_s * t + noise)
        run = replace(run, heading=heading)
    found = find_start_tilt(run)
    bias = [one.value for one in found.gyro_bias()]
    assert bias == pytest.approx(BIAS + left * UP, abs=8e-4)
    is_said = turn_rad_s != 0 and bool(said_rad_s)
    assert ("less the turn of the heading" in found.said) == is_said


def test_without_rest_the_first_minute_of_motion_gives_the_tilt():
    assert "in motion" in find_start_tilt(resting(15.0, lay_s=14.0)).said
    run = simulate_mission(MissionOptions(seed=8, duration_s=70, landmarks=1))
    _, pitch, roll = run.truth.rotations()[0].as_euler("ZYX").tolist()
    for sequence, rpy in ((resting(4.0), (ROLL, PITCH)), (run, (roll, pitch))):
        found = find_start_tilt(sequence)
        assert found.said.endswith("s in motion")
        assert found.gyro_bias() is None
        for axis, true in enumerate(rpy):
            angle = found.angle(axis)
            assert abs(angle.value - true) < 4 * angle.sigma < 0.01


def test_a_wrong_start_is_found_with_the_line_that_mends_it():
    found = find_start_tilt(resting(50.0))
    rows = tilt_findings(found, started(rpy_rad=(0.0, PITCH, 0.3)), yaw_rad=0.9)
    assert [row.acts for row in rows] == [True, False]
    assert "from 40 s of rest, not the calibration's +0.00°" in rows[0].text()
    assert "the calibration's -4.01° fits, no need to act" in rows[1].text()
    rpy, sigma, of_imu = lines_of(rows[0])
    near = 5e-3
    mounting = of_imu["imu"]["mounting"]["rpy_rad"]
    assert mounting == pytest.approx([ROLL, 0.0, 0.0], abs=near)
    assert rpy["start"]["rpy_rad"] == pytest.approx([ROLL, PITCH, 0.9], abs=near)
    sigmas = [found.angle(0).sigma, found.angle(1).sigma, 1e-3]
    assert sigma["start"]["rpy_sigma_rad"] == pytest.approx(sigmas, rel=0.05)
    for fits in (rpy["start"] | sigma["start"], {"rpy_sigma_rad": (0.1, 0.1, 0.1)}):
        assert not any(row.acts for row in tilt_findings(found, started(**fits), 0.9))


def test_what_speaks_against_both_ways_is_said_in_one_row():
    """No accelerometers; velocities that have nothing to do with the accelerations; a calibration without noise."""
    run = resting(4.0)
    blind = spoilt(run, "imu", specific_force=unstated(len(run.imu), 3))
    (row,) = tilt_findings(find_start_tilt(blind), Calibration(), 0.0)
    assert row.text() == "cannot be told: no accelerometers"
    velocity = np.random.default_rng(0).standard_normal((len(run.dvl), 3))
    found = find_start_tilt(spoilt(run, "dvl", velocity=velocity))
    assert found == StartTilt(None, found.said)
    assert "at rest: Imu.specific_force: varies" in found.said
    assert "in motion: alignment: velocities and accelerations differ" in found.said
    assert "inspect" not in found.said
    silent = {"gyro_noise_density": 0.0, "accel_noise_density": 0.0}
    silent = recalibrated(run, "imu", **silent)
    silent = recalibrated(silent, "dvl", velocity_sigma_m_s=(0.0, 0.0, 0.0))
    said = find_start_tilt(silent).said
    assert said.endswith("in motion: the calibration's noise is zero")


@pytest.mark.parametrize(
    "begin_s", [-5.0, 0.0, 0.2, -60.0], ids=["within", "first", "after", "last"]
)
def test_a_heading_is_as_unsure_as_the_offset_times_the_turn_rate(begin_s):
    """0.1 rad/s and an offset of 0.1 s: 0.01 rad beside a tenth of a degree, wherever the reference begins or ends."""
    run = resting(50.0)
    t = np.arange(0.0, 60.01, 0.1) + begin_s
    turning = Rotation.from_euler("z", 0.1 * t[:, None]).as_quat()
    places = np.zeros((len(t), 3))
    stamps_ns = run.start_ns + nanoseconds(t)
    reference = Trajectory.without_covariances(stamps_ns, places, turning)
    offset = Estimate1D(0.0, 0.1)
    no_tilt = StartTilt(None, "no rows")
    found, yaw_rad = start_heading_finding(run, reference, offset, no_tilt)
    sigma = np.hypot(0.1, np.degrees(0.01))
    assert found.estimate.sigma == pytest.approx(sigma, rel=1e-6)
    assert yaw_rad == pytest.approx(0.1 * max(begin_s, 0.0), abs=1e-6)
