import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    ImuCalibration,
    Mounting,
    SonarImage,
    Start,
)
from sonar_graph.errors import CalibrationError, SettingError
from sonar_graph.images import decibels
from sonar_graph.settings import parse

angles = st.floats(-3, 3)
lengths = st.floats(-5, 5)


@given(st.tuples(lengths, lengths, lengths), st.tuples(angles, angles, angles))
def test_mounting_turns_about_z_after_y_after_x(translation_m, rpy_rad):
    body_T_sensor = Mounting(translation_m=translation_m, rpy_rad=rpy_rad).pose()
    expected = Rotation.from_euler(
        "xyz", rpy_rad
    ).as_matrix()  # fixed axes x, y, z: Rz Ry Rx
    np.testing.assert_allclose(body_T_sensor.rotation().matrix(), expected, atol=1e-12)
    np.testing.assert_array_equal(body_T_sensor.translation(), translation_m)


def test_the_start_s_covariance_is_of_roll_pitch_yaw_and_the_worlds_axes():
    """Many starts, drawn by these angles and coordinates; a pitch of 46 degrees tells the angles from the axes."""
    start = Start(
        position_m=(1, 2, 3),
        rpy_rad=(0.3, -0.8, 1.2),
        position_sigma_m=(0.5, 0.02, 0.1),
        rpy_sigma_rad=(0.01, 0.02, 0.03),
    )
    draws = np.random.default_rng(0).standard_normal((5000, 6))
    drawn = Rotation.from_euler(
        "ZYX", (start.rpy_rad + draws[:, :3] * start.rpy_sigma_rad)[:, ::-1]
    )
    body_R_world = Rotation.from_matrix(start.pose().rotation().matrix()).inv()
    turned = (body_R_world * drawn).as_rotvec()
    shifted = body_R_world.apply(draws[:, 3:] * start.position_sigma_m)
    errors = np.hstack([turned, shifted])
    whitened = np.linalg.solve(np.linalg.cholesky(start.covariance()), errors.T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.08)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"dvl": {"velocity_sigma_m_s": [0.01, -0.01, 0.01]}},
            "velocity_sigma_m_s.1: expected a number greater than or equal to 0",
        ),
        (
            {"start": {"rpy_rad": [0.0, 1.57, 0.0]}},
            "start.rpy_rad: pitch 1.57 is vertical, where roll and yaw turn about one axis",
        ),
        (
            {"start": {"rpy_sigma_rad": [0.01, 0.01, -0.01]}},
            "rpy_sigma_rad.2: expected a number greater than or equal to 0",
        ),
        (
            {"start": {"position_m": [0, float("nan"), 0]}},
            "position_m.1: expected a finite number",
        ),
        (
            {"imu": {"gyro_noise_density": float("inf")}},
            "gyro_noise_density: expected a finite number",
        ),
        (
            {"imu": {"gyro_noise_density": "1e-4"}},
            "gyro_noise_density: expected a number, not '1e-4'",
        ),
        (
            {"earth_rate_latitude_rad": 48.0},
            "earth_rate_latitude_rad: expected radians between -π/2 and π/2",
        ),
        (
            {"dvl": {"mounting": {"rpy_rad": [0, 0, 45]}}},
            "dvl.mounting.rpy_rad.2: expected radians between -2π and 2π",
        ),
        (
            {"start": {"rpy_rad": [0, 0, -90]}},
            "start.rpy_rad.2: expected radians between -2π and 2π",
        ),
        (
            {"imu": {"gyro_bias_rad_s": [0, 1000, 0]}},
            "imu.gyro_bias_rad_s.1: expected rad/s between -1 and 1",
        ),
        (
            {"dvl": {"scale_sigma": 5}},
            "dvl.scale_sigma: expected a relative error between 0 and 0.2",
        ),
        (
            {"heading": {"bias_sigma_rad": 90}},
            "heading.bias_sigma_rad: expected radians between 0 and 2π",
        ),
        (
            {"heading": {"sigma_rad": 90}},
            "heading.sigma_rad: expected radians between 0 and 2π",
        ),
        ({"gravity_m_s2": 9810}, "gravity_m_s2: expected m/s² between 9 and 10.5"),
        ({"odometry_interpolation": "cubic"}, "odometry_interpolation"),
    ],
)
def test_what_nothing_can_have_is_refused_by_source_and_name(values, message):
    with pytest.raises(CalibrationError) as refusal:
        parse(Calibration, values, "vehicle.toml")
    assert str(refusal.value).startswith("vehicle.toml: ")
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_numbers_at_the_edge_of_what_can_be_are_taken():
    exact = {
        "start": {"rpy_sigma_rad": [0, 0, 0], "rpy_rad": [0, 0, -2 * np.pi]},
        "imu": {"gyro_noise_density": 0},
    }
    aided = {
        "heading": {"bias_sigma_rad": 0, "sigma_rad": 2 * np.pi},
        "dvl": {"scale_sigma": 0.2},
    }
    biased = parse(Calibration, {"imu": {"gyro_bias_rad_s": [1, 0, -1]}} | aided, "x")
    assert biased.imu.gyro_bias_rad_s == (1, 0, -1)
    at_pole = {"earth_rate_latitude_rad": -np.pi / 2, "gravity_m_s2": 9.832}
    assert parse(Calibration, exact | at_pole, "x").gravity_m_s2 == 9.832


def test_every_wrong_field_is_named_at_once():
    with pytest.raises(CalibrationError, match=r"gravity_m_s2.*nonsense"):
        parse(Calibration, {"gravity_m_s2": -1, "nonsense": 1}, "x")


def test_calibration_cannot_be_changed():
    with pytest.raises(
        SettingError, match=r"Calibration.gravity_m_s2 cannot be set; model_copy"
    ):
        Calibration().gravity_m_s2 = 1.0  # type: ignore[misc]


@given(st.floats(20.0, 120.0))
def test_logarithmic_counts_are_decibels_by_their_span(span):
    level_db = np.linspace(0, span, 50)
    counts = np.rint(level_db * 255 / span).astype(np.uint8)
    found = decibels(counts, SonarImage(decibel_span=span))
    np.testing.assert_allclose(found, level_db, atol=0.51 * span / 255)


@given(st.floats(0.2, 1.0))
def test_linear_counts_are_decibels_of_the_amplitude_whatever_the_gamma(gamma):
    level_db = np.linspace(0, 40, 50)
    counts = (10 ** (level_db / 20)) ** gamma
    found = decibels(counts, SonarImage(scale="linear", gamma=gamma, full_scale=1e4))
    np.testing.assert_allclose(np.diff(found), np.diff(level_db), atol=1e-3)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: ImuCalibration(gyro_noise_density=-1),
            "ImuCalibration.gyro_noise_density: expected a number greater",
        ),
        (
            lambda: Mounting(rpy=(0, 0, 1)),
            "Mounting.rpy: there is no such field; there are: translation_m, rpy_rad",
        ),
        (
            lambda: Calibration(imu={"gyro": 1}),
            "Calibration.imu.gyro: there is no such field$",
        ),
        (
            lambda: Calibration(heading=False),
            "Calibration.heading: expected a section, not False",
        ),
        (
            lambda: Calibration(use_gravity="perhaps"),
            "Calibration.use_gravity: expected true or false, not 'perhaps'",
        ),
        (
            lambda: Start(position_m=3, rpy_rad=(9, 0, 0)),
            "Start.position_m: expected a list.*; Start.rpy_rad.0: expec",
        ),
    ],
)
def test_a_section_made_by_hand_names_what_does_not_fit_in_one_line(make, said):
    with pytest.raises(SettingError, match=said) as refusal:
        make()
    assert "\n" not in str(refusal.value)
    assert "pydantic" not in str(refusal.value)
