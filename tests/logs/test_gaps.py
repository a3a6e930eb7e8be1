from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration
from sonar_graph.devices.dvl_beams import UNMEASURED_M_S
from sonar_graph.logs.checks import gap_warnings
from sonar_graph.measurements import Dvl, Floats, Imu
from sonar_graph.navigation.imu_gaps import hole_ns

UPWARDS = (0.0, 0.0, 9.8)


def stamps(times_s: Floats) -> Any:
    return np.rint((1000.0 + times_s) * 1e9).astype(np.int64)


def imu(times_s: Floats | None = None, force: tuple[float, ...] = UPWARDS) -> Imu:
    at_s = np.arange(0, 300, 0.01) if times_s is None else times_s
    return Imu(stamps(at_s), np.zeros((len(at_s), 3)), np.tile(force, (len(at_s), 1)))


def dvl(times_s: Floats | None = None, partial: Any = False) -> Dvl:
    at_s = np.arange(0, 300, 0.2) if times_s is None else times_s
    cov = np.tile(1e-4 * np.eye(3), (len(at_s), 1, 1))
    cov[np.broadcast_to(partial, len(at_s)), 1, 1] = UNMEASURED_M_S**2
    return Dvl(stamps(at_s), np.ones((len(at_s), 3)), cov)


def without(times_s: Floats, *spans_s: tuple[float, float]) -> Floats:
    for first_s, last_s in spans_s:
        times_s = times_s[(times_s <= first_s) | (times_s >= last_s)]
    return times_s


PINGS, SAMPLES = np.arange(1500) * 0.2, np.arange(30000) * 0.01


def test_whole_logs_have_nothing_to_say() -> None:
    assert list(gap_warnings(imu(), dvl(), Calibration())) == []


def test_a_gap_of_the_doppler_log_is_named_with_its_times_and_what_bridges_it() -> None:
    (text,) = gap_warnings(imu(), dvl(without(PINGS, (100, 220))), Calibration())
    assert text.startswith("dvl: no velocity 100.000 to 220.000 s after the start: bridged by the IMU")
    nothing_felt = imu(force=(float("nan"),) * 3)
    (text,) = gap_warnings(nothing_felt, dvl(without(PINGS, (100, 220))), Calibration())
    assert "100.000 to 220.000 s after the start, and no accelerometer: bridged by a random walk" in text


@pytest.mark.parametrize(("gap_s", "is_named"), [(1.4, False), (1.6, True)])
def test_a_gap_is_what_the_calibration_calls_one(gap_s: float, is_named: bool) -> None:
    calibration = Calibration(dvl=DvlCalibration(gap_s=1.5))
    pings = np.concatenate([PINGS[:500], PINGS[500:] - PINGS[500] + PINGS[499] + gap_s])
    assert bool(list(gap_warnings(imu(), dvl(pings), calibration))) is is_named


def test_pings_of_too_few_beams_are_named_as_such() -> None:
    (text,) = gap_warnings(imu(), dvl(PINGS, (PINGS > 100) & (PINGS < 130)), Calibration())
    assert text.startswith("dvl: too few beams for a whole velocity 100.000 to 130.000 s after the start")
    (text,) = gap_warnings(imu(), dvl(PINGS, PINGS < 12), Calibration())
    assert text == "dvl: no whole velocity until 12.000 s after the start: too few beams"


def test_a_hole_in_the_imu_is_named_with_its_times() -> None:
    (text,) = gap_warnings(imu(without(SAMPLES, (100, 110))), dvl(), Calibration())
    assert text.startswith("imu: no sample 100.000 to 110.000 s after the start: the turn in between is guessed")


def test_only_the_first_steps_of_a_slower_imu_are_holes() -> None:
    """100 Hz, 5 Hz for 50 s, 100 Hz: until more than four of the eight intervals before are slow."""
    slow = np.concatenate([SAMPLES[:10000], 100 + 0.2 * np.arange(250), 150 + SAMPLES[:15000]])
    (text,) = gap_warnings(imu(slow), dvl(), Calibration())
    assert "in 5 gaps of 1.0 s together" in text


@pytest.mark.parametrize("seed", range(20))
def test_the_holes_named_are_those_that_estimators_count_with(seed: int) -> None:
    """Intervals of all sizes, from the very first on; all told by their number and sum."""
    rng = np.random.default_rng(seed)
    at_s = np.cumsum(np.round(10.0 ** rng.uniform(-2.3, 0.3, 60), 3))
    rows, pings = imu(at_s), dvl(np.array([at_s[0], at_s[-1]]))
    ns = rows.stamps_ns
    lengths = [hole_ns(ns, len(ns), row, int(ns[row])) for row in range(1, len(ns))]
    count, sum_s = np.count_nonzero(lengths), sum(lengths) * 1e-9
    assert count > 3
    found = [text for text in gap_warnings(rows, pings, Calibration()) if text.startswith("imu")]
    assert f"in {count} gaps of {sum_s:.1f} s together" in found[0]


@pytest.mark.parametrize(("first_s", "is_hole"), [(0.9, False), (1.1, True)])
def test_the_first_interval_has_none_before_it(first_s: float, is_hole: bool) -> None:
    at_s = np.concatenate([[0.0], first_s + SAMPLES])
    assert bool(list(gap_warnings(imu(at_s), dvl(), Calibration()))) is is_hole


def test_a_hole_is_named_as_far_as_it_is_used() -> None:
    """Not before the first velocity, nor after the last."""
    holed = imu(without(SAMPLES, (5, 7), (9, 11), (290, 291)))
    *_, text = gap_warnings(holed, dvl(PINGS[50:1449]), Calibration())
    assert text.startswith("imu: no sample 0.000 to 1.000 s after the start: ")


def test_where_no_turns_are_allowed_for_no_growth_is_promised() -> None:
    still = Calibration(imu=ImuCalibration(turn_sigma_rad_s=(0.0, 0.0, 0.0)))
    (text,) = gap_warnings(imu(without(SAMPLES, (100, 110))), dvl(), still)
    assert "unsure" not in text
    assert "counts as measured, since imu.turn_sigma_rad_s is zero" in text


def test_a_few_lost_samples_are_no_hole() -> None:
    assert list(gap_warnings(imu(without(SAMPLES, (100, 100.04))), dvl(), Calibration())) == []


def test_of_many_holes_the_longest_are_named_and_all_are_counted() -> None:
    holes = [(10.0 * k, 10.0 * k + 0.1 * k) for k in range(1, 7)]
    (text,) = gap_warnings(imu(without(SAMPLES, *holes)), dvl(), Calibration())
    expected = "in 6 gaps of 2.1 s together, the longest 40.000 to 40.400, 50.000 to 50.500, 60.000 to 60.600 s"
    assert expected in text


def test_times_count_from_the_first_instant_with_both() -> None:
    _, text = gap_warnings(imu(without(SAMPLES, (100, 110))), dvl(PINGS[50:]), Calibration())
    assert "90.000 to 100.000 s after the start" in text


def test_samples_that_hold_for_the_time_before_them_leave_no_gap() -> None:
    held = Calibration(odometry_interpolation="hold-past")
    assert list(gap_warnings(imu(without(SAMPLES, (100, 110))), dvl(without(PINGS, (100, 220))), held)) == []


@pytest.mark.parametrize("interpolation", ["linear", "hold-past"])
def test_a_sensor_that_ends_or_begins_apart_is_named(interpolation: Any) -> None:
    calibration = Calibration(odometry_interpolation=interpolation)
    of_imu = list(gap_warnings(imu(SAMPLES[300:29000]), dvl(PINGS[:1451]), calibration))
    assert of_imu == ["IMU begins 3.0 s after the Doppler log; not estimated until then"]
    of_imu = list(gap_warnings(imu(SAMPLES[:28001]), dvl(PINGS[:1451]), calibration))
    assert of_imu == ["IMU ends 10.0 s before the Doppler log; not estimated from there"]
    of_dvl = list(gap_warnings(imu(SAMPLES[:29001]), dvl(PINGS[20:1401]), calibration))
    assert of_dvl == [
        "Doppler log begins 4.0 s after the IMU; not estimated until then",
        "Doppler log ends 10.0 s before the IMU; not estimated from there",
    ]


@pytest.mark.parametrize(("apart_s", "is_named"), [(1.4, False), (1.6, True)])
def test_apart_is_more_than_a_gap(apart_s: float, is_named: bool) -> None:
    for shift_s in (apart_s, -apart_s):
        found = list(gap_warnings(imu(SAMPLES[1000:20001]), dvl(10.0 + shift_s + PINGS[:951]), Calibration()))
        assert len(found) == 2 * is_named
