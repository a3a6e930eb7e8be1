"""What gyros and accelerometers carry from one Doppler row to the next, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.navigation.dvl_screening.partial_beams import EARTH_RATE_RAD_S, InertialRows, carry

NS = 10**9
T0_NS = 1_700_000_000 * NS
RATE, FORCE = np.array([0.1, -0.2, 0.4]), np.array([0.3, -0.5, 9.7])
QUIET = ImuCalibration(gyro_noise_density=0.0, gyro_bias_sigma=0.0, accel_noise_density=0.0, accel_bias_sigma=0.0)
MOUNTED = Calibration(
    imu=QUIET.model_copy(update={"mounting": Mounting(translation_m=(0.3, 0.1, -0.2))}),
    dvl=DvlCalibration(mounting=Mounting(translation_m=(-0.1, 0.4, 0.2)), velocity_walk_density=0.123),
)


def steady(seconds: float = 10.0, hz: int = 50) -> InertialRows:
    stamps_ns = at(*np.arange(round(seconds * hz) + 1) / hz)
    return InertialRows(stamps_ns, np.tile(RATE, (len(stamps_ns), 1)), np.tile(FORCE, (len(stamps_ns), 1)))


def gained(seconds: float) -> np.ndarray:
    """Integral of the turned force by many small steps."""
    middle = (np.arange(20_000) + 0.5) / 20_000 * seconds
    return Rotation.from_rotvec(np.outer(middle, RATE)).apply(FORCE).mean(axis=0) * seconds


def at(*seconds: float) -> np.ndarray:
    return T0_NS + np.round(np.array(seconds) * NS).astype(np.int64)


def density(imu: ImuCalibration, stamps_ns: np.ndarray, rows: InertialRows | None = None) -> float:
    return carry(rows or steady(), stamps_ns, Calibration(imu=imu)).walk_density


def test_rotation_and_velocity_since_the_first_row_are_those_of_the_integrals():
    """Rows lie between those of the IMU; the first is the frame of all."""
    stamps_ns = at(1.013, 1.7, 3.331, 5.0)
    found = carry(steady(), stamps_ns, MOUNTED)
    assert found.is_inertial
    for k, seconds in enumerate([0.0, 0.687, 2.318, 3.987]):
        assert found.rotation[k] == pytest.approx(Rotation.from_rotvec(seconds * RATE).as_matrix(), abs=1e-9)
        assert found.velocity[k] == pytest.approx(gained(seconds) if seconds else np.zeros(3), abs=2e-4)


def test_rates_and_forces_are_linear_between_rows():
    """Between two rows 1 s apart the turn and the gain are those of the trapezoid."""
    rows = InertialRows(
        at(0.0, 1.0), np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e-3]]), np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    )
    found = carry(rows, at(0.0, 0.5, 1.0), MOUNTED)
    assert found.velocity[:, 0] == pytest.approx([0.0, 0.75, 2.0], abs=1e-6)
    assert found.rotation[:, 1, 0] == pytest.approx([0.0, 0.125e-3, 0.5e-3], abs=1e-9)


def test_the_lever_is_from_the_doppler_log_to_the_imu():
    stamps_ns = at(1.0, 2.0)
    expected = np.cross(RATE, np.array([0.3, 0.1, -0.2]) - np.array([-0.1, 0.4, 0.2]))
    assert carry(steady(), stamps_ns, MOUNTED).from_lever == pytest.approx(np.tile(expected, (2, 1)))


def test_inertial_rows_after_the_last_are_not_used_and_the_newest_holds():
    rows = steady(2.0)
    spoilt = rows.specific_force.copy()
    spoilt[rows.stamps_ns > at(1.51)] = 1e6
    here, there = (carry(InertialRows(*rows[:2], f), at(0.5, 1.51), MOUNTED) for f in (rows.specific_force, spoilt))
    np.testing.assert_array_equal(here.velocity, there.velocity)
    beyond = carry(rows, at(1.5, 4.5), MOUNTED)
    assert beyond.velocity[1] == pytest.approx(gained(3.0), abs=2e-4 + 1.0)
    assert beyond.rotation[1] == pytest.approx(Rotation.from_rotvec(3.0 * RATE).as_matrix(), abs=1e-9)


def test_a_force_measured_at_the_last_row_counts():
    rows = InertialRows(at(0.0, 1.0), np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    assert carry(rows, at(0.0, 1.0), MOUNTED).velocity[1, 0] == pytest.approx(2.0)


@pytest.mark.parametrize("missing", ["row", "before", "all"])
def test_without_a_force_nothing_is_carried(missing):
    rows, stamps_ns = steady(), at(1.0, 2.0, 3.0)
    if missing == "all":
        rows, stamps_ns = InertialRows(*(column[:0] for column in rows)), stamps_ns
    else:
        force = rows.specific_force.copy()
        force[75 if missing == "row" else 50] = np.nan
        rows = InertialRows(*rows[:2], force)
    found = carry(rows, stamps_ns, MOUNTED)
    assert (found.is_inertial, found.walk_density) == (False, 0.123)
    np.testing.assert_array_equal(found.rotation, np.tile(np.eye(3), (3, 1, 1)))
    np.testing.assert_array_equal(found.velocity, np.zeros((3, 3)))
    np.testing.assert_array_equal(found.from_lever, np.zeros((3, 3)))


def without(begin_s: float, end_s: float) -> InertialRows:
    rows = steady()
    kept = (rows.stamps_ns <= at(begin_s)) | (rows.stamps_ns >= at(end_s))
    return InertialRows(*(column[kept] for column in rows))


@pytest.mark.parametrize("begin_s", [1.0, 2.0])
def test_over_a_hole_nothing_is_carried_wherever_it_begins(begin_s):
    """Right after the first row too, which alone tells no typical interval; one of five intervals is no hole."""
    stamps_ns = at(1.0, 2.5, 4.0)
    assert not carry(without(begin_s, begin_s + 0.9), stamps_ns, MOUNTED).is_inertial
    assert carry(without(begin_s, begin_s + 0.1), stamps_ns, MOUNTED).is_inertial
    assert carry(without(5.0, 5.9), stamps_ns, MOUNTED).is_inertial


def test_a_force_that_is_missing_elsewhere_does_not_matter():
    rows = steady()
    force = rows.specific_force.copy()
    force[[49, 151]] = np.nan
    assert carry(InertialRows(*rows[:2], force), at(1.0, 3.0), MOUNTED).is_inertial


G = Calibration().gravity_m_s2


def test_the_walk_of_accelerometer_noise_is_its_density():
    T, earth = 4.0, (G * EARTH_RATE_RAD_S) ** 2
    noisy = density(QUIET.model_copy(update={"accel_noise_density": 3e-3}), at(1.0, 1.0 + T))
    assert noisy**2 == pytest.approx(9e-6 + earth * T**3 / 16.0)


def test_the_walk_of_gyro_noise_is_the_variance_in_mid_stretch_over_a_quarter_of_its_length():
    """A tilt that walks with density n, integrated twice and bound at both ends: simulated."""
    n, T, steps, rng = 2e-3, 4.0, 200, np.random.default_rng(0)
    dt = T / steps
    tilt = np.cumsum(n * np.sqrt(dt) * rng.standard_normal((4000, steps)), axis=1)
    velocity = np.cumsum(G * tilt * dt, axis=1)
    t = dt * np.arange(1, steps + 1)
    off_line = velocity[:, steps // 2] - velocity[:, -1] * t[steps // 2] / T
    found = density(QUIET.model_copy(update={"gyro_noise_density": n}), at(1.0, 1.0 + T))
    earth = (G * EARTH_RATE_RAD_S) ** 2 * T**3 / 16.0
    assert found**2 == pytest.approx((G * n * T) ** 2 / 12.0 + earth)
    assert found**2 * T / 4.0 == pytest.approx(off_line.var(), rel=0.1)


def test_the_walk_of_a_gyro_bias_has_the_peak_of_its_parabola_in_mid_stretch():
    b, T = 1e-3, 6.0
    found = density(QUIET.model_copy(update={"gyro_bias_sigma": b}), at(1.0, 1.0 + T))
    peak = G * np.hypot(b, EARTH_RATE_RAD_S) * T**2 / 8.0
    assert found**2 * T / 4.0 == pytest.approx(peak**2)


def test_the_walk_of_an_accelerometer_bias_is_of_what_turns():
    b, T = 0.05, 6.0
    biased, turned = QUIET.model_copy(update={"accel_bias_sigma": b}), np.linalg.norm(RATE) * T
    earth = (G * EARTH_RATE_RAD_S) ** 2 * T**3 / 16.0
    assert density(biased, at(1.0, 1.0 + T)) ** 2 == pytest.approx((b * turned) ** 2 * T / 16.0 + earth)
    still = InertialRows(steady().stamps_ns, np.zeros((501, 3)), steady().specific_force)
    assert density(biased, at(1.0, 1.0 + T), still) ** 2 == pytest.approx(earth)


def test_the_earth_turns_once_in_a_sidereal_day():
    assert pytest.approx(2 * np.pi / 86164.1, rel=2e-3) == EARTH_RATE_RAD_S
