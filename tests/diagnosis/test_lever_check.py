"""By hand: places, arms and biases, and the lines for a calibration that follow from them."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from sonar_graph.calibration import Calibration, ImuCalibration
from sonar_graph.diagnosis.findings import bias_findings, lever_findings, with_fitted
from sonar_graph.navigation.alignment.dvl_imu import DvlMatch
from sonar_graph.navigation.alignment.time_offset import Estimate1D

UNKNOWN = Estimate1D(np.nan, np.inf, "too little turning")
GIVEN = Calibration.parse(
    {
        "imu": {"mounting": {"translation_m": [0.5, 0.1, 0.0]}, "gyro_bias_sigma": 1e-4},
        "dvl": {"mounting": {"translation_m": [-1.0, 0.2, 0.3]}},
    },
    "by hand",
)
"""An arm of (-1.5, 0.1, 0.3) m."""


def match(lever: tuple[Estimate1D, ...], bias: tuple[Estimate1D, ...] = (UNKNOWN,) * 3) -> DvlMatch:
    return DvlMatch(UNKNOWN, UNKNOWN, UNKNOWN, lever, bias)  # type: ignore[arg-type]


def arm(*values: float, sigma: float = 0.01) -> tuple[Estimate1D, ...]:
    return tuple(Estimate1D(value, sigma) for value in values)


def test_either_line_makes_the_arm_of_the_calibration_the_one_found():
    rows = lever_findings(match(arm(-0.2, 0.11, 0.9)), GIVEN)
    assert [row.acts for row in rows] == [True, False, True]
    _, imu_line, _, dvl_line, _ = rows[0].advice.split("`")
    imu, dvl = (tomllib.loads(line) for line in (imu_line, dvl_line))
    places = [imu["imu"]["mounting"]["translation_m"], dvl["dvl"]["mounting"]["translation_m"]]
    assert np.subtract((-1.0, 0.2, 0.3), places[0]) == pytest.approx([-0.2, 0.1, 0.9])
    assert np.subtract(places[1], (0.5, 0.1, 0.0)) == pytest.approx([-0.2, 0.1, 0.9])
    assert with_fitted(match(arm(-0.2, 0.11, 0.9)), GIVEN).imu.mounting.translation_m == pytest.approx(places[0])


def test_the_line_is_said_once_and_the_calibration_that_fits_is_said_to_fit():
    texts = [row.text() for row in lever_findings(match(arm(-0.2, 0.11, 0.9)), GIVEN)]
    assert "not the calibration's -1.50 m" in texts[0]
    assert texts[1] == "+0.110 ± 0.020 m: the calibration's +0.10 m fits, no need to act"
    assert texts[2] == "+0.900 ± 0.020 m: put right by the line above"


def test_an_axis_that_cannot_be_told_keeps_the_place_of_the_calibration():
    rows = lever_findings(match((UNKNOWN, *arm(0.6, 0.3))), GIVEN)
    assert rows[0].text() == "cannot be told: too little turning"
    assert [row.acts for row in rows] == [False, True, False]
    assert "`imu.mounting.translation_m = [0.500, -0.400, 0.000]`" in rows[1].advice


@pytest.mark.parametrize(("error_m", "sigma_m", "acts"), [(0.04, 0.01, False), (0.06, 0.01, True), (0.5, 0.3, False)])
def test_an_arm_matters_by_centimetres_and_only_beyond_its_interval(error_m: float, sigma_m: float, acts: bool):
    (row, *_) = lever_findings(match(arm(-1.5 + error_m, 0.1, 0.3, sigma=sigma_m)), GIVEN)
    assert row.acts == acts


def biases(*values: float, sigma: float = 1e-5) -> tuple[Estimate1D, Estimate1D, Estimate1D]:
    x, y, z = (Estimate1D(value, sigma) for value in values)
    return x, y, z


def test_a_bias_beyond_its_sigma_asks_for_one_that_holds_the_largest():
    sources = ("from 20 s of rest", "from turns", "from turns")
    rows = bias_findings(biases(1e-3, 1.5e-4, -4e-3), sources, GIVEN.imu)
    assert [row.acts for row in rows] == [True, False, True]
    assert "from 20 s of rest" in rows[0].text()
    assert tomllib.loads(rows[0].advice.split("`")[1]) == {"imu": {"gyro_bias_sigma": 0.004}}
    assert rows[2].advice == "put right by the line above"
    changed = with_fitted(match(arm(-1.5, 0.1, 0.3), biases(1e-3, 1.5e-4, -4e-3)), GIVEN).imu
    assert changed.gyro_bias_sigma == 0.004
    assert not any(row.acts for row in bias_findings(biases(1e-3, 1.5e-4, -4e-3), sources, changed))


def test_the_rotation_of_the_earth_is_no_fault_of_a_gyro():
    fibre = ImuCalibration(gyro_bias_sigma=3e-6)
    sources = ("from turns",) * 3
    assert not any(row.acts for row in bias_findings(biases(7.3e-5, 0.0, -7.3e-5), sources, fibre))
    assert bias_findings(biases(1.2e-4, 0.0, 0.0), sources, fibre)[0].acts


def test_without_any_bias_the_sigma_stays():
    assert with_fitted(match((UNKNOWN,) * 3), GIVEN) == GIVEN


def test_where_no_axis_can_be_told_one_row_says_why():
    rows = [*lever_findings(match((UNKNOWN,) * 3), GIVEN), *bias_findings((UNKNOWN,) * 3, ("",) * 3, GIVEN.imu)]
    assert [row.quantity for row in rows] == ["lever arm from IMU to DVL", "gyro bias"]
    assert [row.text() for row in rows] == ["cannot be told: too little turning"] * 2
