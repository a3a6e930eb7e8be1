import tomllib

import pytest
from pydantic import ValidationError

from sonar_graph.calibration import Calibration
from sonar_graph.settings import faults_in


def told(text: str) -> str:
    with pytest.raises(ValidationError) as fault:
        Calibration.model_validate(tomllib.loads(text))
    return faults_in(fault.value, Calibration)


@pytest.mark.parametrize(
    ("text", "place", "meant", "known"),
    [
        (
            "gravitiy = 9.8",
            "gravitiy",
            "gravity_m_s2",
            "it has: imu, dvl, depth, heading, positions, sonar, start, floor, planar",
        ),
        ("gravity = 9.8", "gravity", "gravity_m_s2", "it has: imu, dvl"),
        (
            "dvl.velocity_sigma = 1",
            "dvl.velocity_sigma",
            "velocity_sigma_m_s",
            "dvl has: velocity_sigma_m_s, mounting",
        ),
        (
            "imu.mounting.rpy = 1",
            "imu.mounting.rpy",
            "rpy_rad",
            "imu.mounting has: translation_m, rpy_rad",
        ),
        (
            "gyro_bias_sigma = 1",
            "gyro_bias_sigma",
            "imu.gyro_bias_sigma",
            "it has: imu, dvl",
        ),
        (
            "floor = {z_m = 1, sigma_m = 1, z = 1}",
            "floor.z",
            "z_m",
            "floor has: z_m, sigma_m",
        ),
    ],
)
def test_an_unknown_field_is_answered_with_what_is_meant_and_known(
    text, place, meant, known
):
    assert told(text).startswith(
        f"{place}: there is no such field; did you mean {meant}? {known}"
    )


@pytest.mark.parametrize("values", ["[1.0]", "[1.0, 2.0]", "[1.0, 2.0, 3.0, 4.0]"])
def test_a_list_of_another_length_is_told_once_with_the_length_expected(values):
    fault = f"expected 3 values, not {values}"
    assert told(
        f"dvl.mounting.translation_m = {values}\nstart.rpy_rad = {values}"
    ).split("; ") == [
        f"dvl.mounting.translation_m: {fault}",
        f"start.rpy_rad: {fault}",
    ]


def test_other_faults_name_field_expectation_and_value():
    assert told("wind = 3").startswith(
        "wind: there is no such field; it has: imu, dvl"
    ), "it resembles nothing"
    assert (
        told("depth.sigma_m = -1.0")
        == "depth.sigma_m: expected a number greater than 0, not -1.0"
    )
    assert told("floor.z_m = 1") == "floor.sigma_m: is missing"
    assert "not 'aaaa" in told(f"gravity_m_s2 = '{'a' * 500}'")
    assert len(told(f"gravity_m_s2 = '{'a' * 500}'")) < 200
