"""Checks of a log's numbers: each fault x the sentence about it, and whole logs without a sentence."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
)
from sonar_graph.devices import UNMEASURED_M_S
from sonar_graph.errors import LogError
from sonar_graph.logs import axis_doubts
from sonar_graph.logs.checks import (
    clipped_axes,
    dead_axes,
    gap_warnings,
    magnitudes,
    repeated_sightings,
    repeats,
    row_doubts,
    spike_warning,
    stamp_doubts,
    stamp_faults,
    stuck_doubt,
    stuck_rows,
    stuck_warning,
    two_sensors,
    unlikely_zeros,
)
from sonar_graph.logs.reading import require_use
from sonar_graph.measurements import Depth, Dvl, Floats, Imu

PINGS = np.arange(1500) * 0.2
SAMPLES = np.arange(30000) * 0.01
NAN = (np.nan,) * 3


def stamps(times_s: Floats) -> Any:
    return np.rint((1000.0 + times_s) * 1e9).astype(np.int64)


def imu(times_s: Floats = SAMPLES, force: tuple[float, ...] = (0, 0, 9.8)) -> Imu:
    count = len(times_s)
    return Imu(stamps(times_s), np.zeros((count, 3)), np.tile(force, (count, 1)) * 1.0)


def dvl(times_s: Floats = PINGS, partial: Any = False) -> Dvl:
    cov = np.tile(1e-4 * np.eye(3), (len(times_s), 1, 1))
    cov[np.broadcast_to(partial, len(times_s)), 1, 1] = UNMEASURED_M_S**2
    return Dvl(stamps(times_s), np.ones((len(times_s), 3)), cov)


def without(times_s: Floats, *spans_s: tuple[float, float]) -> Floats:
    for first_s, last_s in spans_s:
        times_s = times_s[(times_s <= first_s) | (times_s >= last_s)]
    return times_s


# --- gaps -----------------------------------------------------------------------------------------------------------

GUESS = "the turn in between is guessed from the rates before and after"
USUAL = Calibration()


SHORT = Calibration(dvl=DvlCalibration(gap_s=1.5))

STILL = Calibration(imu=ImuCalibration(turn_sigma_rad_s=(0.0, 0.0, 0.0)))
HELD = Calibration(odometry_interpolation="hold-past")
HOLED = imu(without(SAMPLES, (100, 110)))
LATE = dvl(without(PINGS, (100, 220)))
HOLES = imu(without(SAMPLES, *((10.0 * k, 10.1 * k) for k in range(1, 7))))
SLOWER = np.concatenate(
    [SAMPLES[:10000], 100 + 0.2 * np.arange(250), 150 + SAMPLES[:15000]]
)
"""100 Hz, 5 Hz for 50 s, 100 Hz: a hole until more than four of the eight intervals before are slow."""
# fmt: off
GAPS: dict[str, tuple[Imu, Dvl, Calibration, list[str]]] = {
    "whole": (imu(), dvl(), USUAL, []),
    "held": (HOLED, LATE, HELD, []),
    "lost samples": (imu(without(SAMPLES, (100, 100.04))), dvl(), USUAL, []),
    "bridged by force": (imu(), LATE, USUAL, [
        "dvl: no velocity 100.000 to 220.000 s after the start: bridged by the IMU, with an error that grows fast"]),
    "bridged by a walk": (imu(force=NAN), LATE, USUAL, [
        "dvl: no velocity 100.000 to 220.000 s after the start, and no accelerometer: bridged by a random walk"]),
    "few beams": (imu(), dvl(PINGS, (PINGS > 100) & (PINGS < 130)), USUAL, [
        "dvl: too few beams for a whole velocity 100.000 to 130.000 s after the start: left out, and bridged as a gap"]),
    "few beams first": (imu(), dvl(PINGS, PINGS < 12), USUAL, [
        "dvl: no whole velocity until 12.000 s after the start: too few beams"]),
    "hole": (HOLED, dvl(), USUAL, [
        f"imu: no sample 100.000 to 110.000 s after the start: {GUESS}, with an error of imu.turn_sigma_rad_s"]),
    "hole without turns": (HOLED, dvl(), STILL, [
        f"imu: no sample 100.000 to 110.000 s after the start: {GUESS}, and counts as measured"]),
    "slower": (imu(SLOWER), dvl(), USUAL, ["imu: no sample in 5 gaps of 1.0 s together, the longest"]),
    "used part of holes": (imu(without(SAMPLES, (5, 7), (9, 11), (290, 291))), dvl(PINGS[50:1449]), USUAL, [
        "Doppler log begins 10.0 s after the IMU; not estimated until then",
        "Doppler log ends 10.4 s before the IMU; not estimated from there", "imu: no sample 0.000 to 1.000 s after the"]),
    "many": (HOLES, dvl(), USUAL, [
        "imu: no sample in 6 gaps of 2.1 s together, the longest 40.000 to 40.400, 50.000 to 50.500, 60.000 to 60.6"]),
    "begins late": (imu(SAMPLES[300:29000]), dvl(PINGS[:1451]), HELD, [
        "IMU begins 3.0 s after the Doppler log; not estimated until then"]),
    "ends early": (imu(SAMPLES[:28001]), dvl(PINGS[:1451]), USUAL, [
        "IMU ends 10.0 s before the Doppler log; not estimated from there"]),
}
# fmt: on


@pytest.mark.parametrize(
    ("inertial", "doppler", "calibration", "expected"), GAPS.values(), ids=GAPS
)
def test_each_gap_is_named_with_its_times_and_the_assumption_in_it(
    inertial, doppler, calibration, expected
):
    found = list(gap_warnings(inertial, doppler, calibration))
    assert len(found) == len(expected)
    assert all(
        text.startswith(start) for text, start in zip(found, expected, strict=True)
    )


@pytest.mark.parametrize(
    ("gap_s", "first_s", "is_told"), [(1.4, 0.9, False), (1.6, 1.1, True)]
)
def test_a_gap_begins_at_its_limit(gap_s, first_s, is_told):
    later = np.concatenate([PINGS[:500], PINGS[500:] - 0.2 + gap_s])
    for inertial, doppler, calibration in (
        (imu(SAMPLES[1000:20001]), dvl(10.0 + gap_s + PINGS[:951]), USUAL),
        (imu(SAMPLES[1000:20001]), dvl(10.0 - gap_s + PINGS[:951]), USUAL),
        (imu(), dvl(later), SHORT),
        (imu(np.concatenate([[0.0], first_s + SAMPLES])), dvl(), USUAL),
    ):
        assert any(gap_warnings(inertial, doppler, calibration)) == is_told


# --- stamps ---------------------------------------------------------------------------------------------------------

SECOND = 10**9
EVEN = np.arange(100) * SECOND // 10 + 10**18
FIRST = np.arange(100)


@pytest.mark.parametrize(
    ("stamps_ns", "log_times_ns", "expected"),
    [
        (EVEN, EVEN + SECOND // 20, None),
        (FIRST * SECOND, FIRST * SECOND, None),  # recorded at 0, a stamp of 0 is right
        (
            np.where(FIRST < 3, 0, EVEN),
            EVEN,
            "3 messages without a stamp: the time of recording is used",
        ),
        (EVEN[np.r_[:50, 52, 50:52, 53:100]], EVEN, "once backwards, by 0.2 s at most"),
        (
            EVEN[np.r_[1, 0, 2:50, 51, 50, 52:100]],
            EVEN,
            "2 times backwards, by 0.1 s at most",
        ),
        (
            np.where(FIRST == 7, EVEN[6], EVEN),
            EVEN,
            "1 message with the stamp of another",
        ),
        (EVEN - 5 * SECOND, EVEN, "stamped 5 s before recording"),
        (EVEN + 5 * SECOND, EVEN, "stamped 5 s after recording"),
        (
            EVEN + np.where(FIRST < 60, 0, SECOND * 9 // 10),
            EVEN,
            "stamps and recording drift apart by 0.9 s",
        ),
    ],
)
def test_each_fault_of_stamps_is_told_alone(stamps_ns, log_times_ns, expected):
    found = list(stamp_faults(stamps_ns, log_times_ns))
    assert len(found) == (expected is not None)
    assert expected is None or found[0].startswith(expected)


# --- spikes and stuck sensors ---------------------------------------------------------------------------------------


def turning(*changes: tuple[Any, float]) -> Floats:
    """A turn that swells and fades, with noise; changes are added at rows and axes."""
    yaw_rate = 0.6 * np.sin(0.009 * np.arange(3000))
    rate = np.column_stack([np.zeros((3000, 2)), yaw_rate])
    rate += 2e-3 * np.random.default_rng(0).standard_normal(rate.shape)
    for where, change_rad_s in changes:
        rate[where] += change_rad_s
    return rate


SHAKING = 2.0 * np.random.default_rng(3).standard_normal((3000, 3))


@pytest.mark.parametrize(
    ("rate", "expected"),
    [
        (turning(), None),
        (turning((slice(1000, None), 3.0)), None),  # a turn that begins at once
        (SHAKING, None),
        (np.array([[0.0, 0, 0], [0, 0, 90]]), None),
        (turning(((2000, 2), 30.0)), "1 angular rate stands out from both neighbours, by 30 rad/s at most, 20.000 s"),
        (turning(((100, 0), 5.0), ((700, 0), -9.0), ((1900, 0), 7.0)), "3 angular rates stand out from both"),
        *((turning((row, -4.0)), "1 angular rate stands out") for row in (1, 1500, 2998)),
    ],
)  # fmt: skip
def test_only_single_wild_rates_are_spikes(rate, expected):
    found = spike_warning(
        EVEN[0] + np.arange(len(rate)) * SECOND // 100, rate, "angular rate"
    )
    assert (found or "").startswith(expected or "")
    assert (found is None) == (expected is None)


def test_a_coarse_height_repeats_itself_and_one_that_hangs_is_stuck():
    rng = np.random.default_rng(4)
    stamps_ns = stamps(PINGS)
    fine = 3.0 + np.cumsum(0.003 * rng.standard_normal(1500))[:, None]

    def warning(height: Floats, speed_m_s: float = 0.5) -> str:
        return stuck_warning(stamps_ns, height, "height", speed_m_s * PINGS) or ""

    for step_m, hangs_s in ((1e-4, 5.0), (0.01, 60.0)):
        height = np.round(fine / step_m) * step_m
        assert not warning(height)
        height[500 : 500 + round(5 * hangs_s)] = height[500]
        assert "height the same to the last bit" in warning(height)
    # a vehicle that rests has one depth, but for the resolution
    assert not warning(height, 0.02)
    assert "in 1500 rows" in warning(0 * fine + 3.0)


def moving(*stretches: tuple[int, int, Any]) -> Floats:
    """Rows that change, but for stretches from a row to another."""
    values = np.random.default_rng(0).standard_normal((300, 3))
    for first, end, value in stretches:
        values[first:end] = value
    return values


ZEROS = [(60 + 40 * k, 80 + 41 * k, 0.0) for k in range(5)]


@pytest.mark.parametrize(
    ("values", "rate_hz", "expected"),
    [
        (moving(), 10, []),
        (np.zeros((1, 3)), 10, []),
        (np.column_stack([np.zeros((300, 2)), moving()[:, 2]]), 10, []),  # a vehicle in the plane
        (moving((100, 111, 0.0)), 10, []),
        (moving((100, 104, 0.0)), 1, []),
        (moving((100, 112, 0.0)), 10, ["velocity exactly zero in 12 rows, "]),
        (moving((100, 105, 0.0)), 1, ["in 5 rows, 100.000 to 104.000 s"]),
        (moving((100, 131, (0.4, 0, -0.1))), 10,
         ["velocity the same to the last bit in 31 rows, 10.000 to 13.000 s after the first: used as measured"]),
        (moving((0, 20, 0.0), (270, 300, 0.0)), 10, ["in 50 rows, 0.000 to 1.900, 27.000 to 29.900 s"]),
        (moving((10, 40, 1.0), *ZEROS), 10,
         ["exactly zero in 110 rows of 5 stretches, the longest 14.000 to 16.100, 18.000 to 20.200, 22.000 to",
          "and the same to the last bit in 30 rows, 1.000 to 3.900 s after the first"]),
    ],
)  # fmt: skip
def test_equal_rows_of_more_than_a_second_and_five_rows_are_named(
    values, rate_hz, expected
):
    found = stuck_warning(stamps(np.arange(len(values)) / rate_hz), values, "velocity")
    assert (found is not None) == bool(expected)
    assert all(part in str(found) for part in expected)


EVERY_TENTH_S = stamps(np.arange(300) / 10)
STOPPED = moving((100, 200, 0.3))


@pytest.mark.parametrize(
    ("quantity", "values", "others", "is_stuck"),
    [
        ("angular rate", STOPPED, moving(), True),
        ("angular rate", moving((100, 200, 0.0)), moving(), True),
        ("velocity", STOPPED, moving(), True),
        ("velocity", moving((100, 200, 0.0)), moving(), False),  # at rest
        ("velocity", STOPPED, moving((120, 160, 0.1)), False),  # a simulator at rest
        ("velocity", moving((100, 120, 0.3)), moving(), False),  # 2 s
    ],
)  # fmt: skip
def test_a_quantity_that_repeats_while_others_change_is_stuck(
    quantity, values, others, is_stuck
):
    rows = {quantity: (EVERY_TENTH_S, values), "force": (EVERY_TENTH_S, others)}
    stuck = stuck_rows(quantity, rows)
    at = np.arange(100, 200) if is_stuck else []
    np.testing.assert_array_equal(np.flatnonzero(stuck), at)
    said = f"{quantity} the same to the last bit in 100 rows, 10.000 to 19.900 s"
    found = stuck_doubt(EVERY_TENTH_S, stuck, quantity)
    assert (found or "").startswith(said) == is_stuck == bool(found)


def test_frames_that_repeat_while_the_vehicle_moves_are_stuck():
    """Three sightings a frame; the frames from the tenth on repeat it, or only its azimuth."""
    frame = np.repeat(np.arange(40), 3)
    is_later = frame > 9
    seen = np.random.default_rng(1).uniform(1.0, 9.0, (120, 2))
    repeated = np.concatenate([seen[:30], np.tile(seen[27:30], (30, 1))])
    held = np.where(is_later[:, None] * [False, True], 0.4, seen)
    # the first of the equal ones may be measured
    is_held = is_later & (np.arange(120) > 30)
    for sightings, step_m, expected in (
        (seen, 0.1, is_later & False),
        (repeated, 0.1, is_later),
        (held, 0.1, is_held),
        (repeated, 0.001, is_later & False),
    ):
        found = repeated_sightings(frame, sightings, step_m * frame, 0.5)
        np.testing.assert_array_equal(found, expected)


# --- enough for an estimator ----------------------------------------------------------------------------------------


def test_one_common_instant_is_enough_and_one_whole_velocity():
    five = np.arange(5.0)
    require_use("log.mcap", imu(five), dvl(five + 4))
    require_use("log.mcap", imu(five), dvl(five, five != 3))
    with pytest.raises(LogError, match=r"none of its 5 rows measures a velocity in"):
        require_use("log.mcap", imu(five), dvl(five, True))


def rates(seed: int, clip: float = np.inf, dead: int | None = None, step: float = 0.0):
    """Rates of a vehicle that turns to and fro, with noise, 2,000 rows."""
    rng = np.random.default_rng(seed)
    t = np.arange(2000) * 0.02
    turns = np.column_stack([np.sin(0.3 * t + k) for k in range(3)]) * [0.05, 0.04, 0.3]
    rate = np.clip(turns + 1e-3 * rng.standard_normal((2000, 3)), -clip, clip)
    if dead is not None:
        rate[:, dead] = 0.0
    return np.round(rate / step) * step if step else rate


RATE = "angular rate"
FAULTY: dict[str, tuple[Any, Any, list[str]]] = {
    "dead": (dead_axes, lambda seed: rates(seed, dead=2), ["angular rate along z is 0 in every row"]),
    "clipped": (clipped_axes, lambda seed: rates(seed, clip=0.2),
                [f"angular rate along z is never beyond {limit}" for limit in (-0.2, 0.2)]),
    "two sensors": (two_sensors, lambda seed: alternating(rates(seed)), ["angular rate along y changes by"]),
    "magnitudes": (magnitudes, lambda seed: np.abs(rates(seed)), ["angular rate is never negative"]),
}  # fmt: skip


def alternating(values: Floats) -> Floats:
    """Rows of a sensor and of another with other axes, by turns."""
    turned = values[:, [1, 0, 2]] * [1.0, -1.0, 1.0]
    return np.where(np.arange(len(values))[:, None] % 2, values, turned)


@pytest.mark.parametrize("fault", FAULTY)
@pytest.mark.parametrize("seed", range(3))
def test_a_faulty_axis_is_named_and_none_of_a_whole_sensor(fault, seed):
    check, values, expected = FAULTY[fault]
    found = list(check(values(seed), RATE))
    assert len(found) == len(expected)
    assert all(map(str.startswith, found, expected))
    ahead = np.abs(rates(seed)) + np.array([1.0, 1.0, 0.0])
    for whole in (*(rates(seed, step=step) for step in (0.0, 1e-3, 0.05)), ahead):
        assert fault == "two sensors" or not list(check(whole, RATE))
    noise = 0.1 * np.random.default_rng(seed).standard_normal((2000, 3))
    assert not list(check(rates(seed) + noise, RATE))


@pytest.mark.parametrize("has_depth", [True, False])
def test_a_constant_vertical_velocity_of_a_diving_vehicle_is_doubted(has_depth):
    t = SAMPLES[:2000]
    turning = replace(imu(t), angular_velocity=rates(0))
    level = replace(dvl(t), velocity=rates(1, dead=2))
    depth = Depth(stamps(t), np.sin(t), np.full(2000, 1e-4)) if has_depth else None
    found = list(axis_doubts(turning, level, depth, USUAL))
    assert len(found) == has_depth
    assert all(text.startswith("dvl: velocity along z is 0") for text in found)


def test_stamps_in_bursts_and_clock_steps_are_reported():
    even_ns = np.arange(300) * 200_000_000
    burst_ns = even_ns // 10**9 * 10**9 + np.arange(300) % 5 * 100_000
    assert not list(stamp_doubts(even_ns, even_ns))
    (in_bursts,) = stamp_doubts(burst_ns, even_ns)
    assert "bursts every 1 s" in in_bursts
    assert '`stamp = "log"`' in in_bursts
    (both,) = stamp_doubts(burst_ns, burst_ns)
    assert "let the driver stamp" in both
    stepped_ns = even_ns - np.where(even_ns > 30 * 10**9, 2 * 10**9, 0)
    (back,) = stamp_doubts(stepped_ns, even_ns)
    assert "stepped back by 1.8 s" in back


def test_zeros_far_from_the_rows_beside_them_are_no_measurements():
    t = np.arange(100) * 0.2
    height = -8 + 0.1 * t
    moved = 0.1 * t
    zeroed = np.where(np.arange(100) % 3 == 1, 0.0, height)
    assert (unlikely_zeros(zeroed[:, None], moved, 0.5) == (zeroed == 0)).all()
    # a dive from the surface begins with zeros
    dive = np.minimum(0.0, 1.0 - 0.1 * t)
    assert not unlikely_zeros(dive[:, None], moved, 0.5).any()


def test_two_imus_on_one_topic_are_named_and_gravity_is_not_missing():
    both = imu()
    both.specific_force[::2] *= -1.0
    (found,) = row_doubts(both, None, None, USUAL)
    assert "two IMUs" in found


def test_a_yaw_that_stands_still_while_the_vehicle_tilts_repeats_itself():
    """Yaw of quaternions whose roll changes is the same but for rounding."""
    yaw = np.minimum(np.linspace(0.5, 1.5, 200), 1.0)
    angles = np.column_stack([yaw, 0 * yaw, np.linspace(0.0, 0.3, 200)])
    read = Rotation.from_euler("ZYX", angles).as_euler("ZYX")[:, :1]
    assert np.unique(read[100:]).size > 1
    found = repeats(read, moved=np.linspace(0.0, 4.0, 200), least=0.2)
    assert found[101:].all()
    assert not found[:99].any()
