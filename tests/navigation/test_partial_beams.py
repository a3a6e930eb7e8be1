"""Velocities of which beams measured a part: completed, as uncertain as they are, and their use in the odometry."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.devices.dvl_beams import velocity_of_beams
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation.dvl_screening.partial_beams import (
    EARTH_RATE_RAD_S,
    LONGEST_STRETCH_NS,
    InertialRows,
    PartialVelocities,
    carry,
)
from sonar_graph.navigation.samples import VelocityRows, is_partial
from tests.devices.test_dvl_beams import JANUS

from .rows import NS, T0_NS, at
from .ways import DVL, QUIET, motion

STEP_NS, STEP_S, WALK, SIGMA = 200_000_000, 0.2, 0.1, 0.01
CALIBRATION = Calibration(dvl=DvlCalibration(velocity_walk_density=WALK))
NO_FORCE = InertialRows(
    np.array([0, 10**12]), np.zeros((2, 3)), np.full((2, 3), np.nan)
)


def completed(stamps_ns, velocity, cov, imu=NO_FORCE, calibration=CALIBRATION):
    """All rows in one block."""
    rows = VelocityRows(stamps_ns, velocity, cov)
    return PartialVelocities(calibration).completed(rows, is_partial(cov), imu)


def pings(valid, rng, velocities):
    """Rows of noisy beams."""
    along = velocities @ JANUS.T + SIGMA * rng.standard_normal((len(valid), 4))
    return velocity_of_beams(JANUS, along, valid, SIGMA)


def walk(n, rng):
    """Velocities that do a random walk from sample to sample."""
    return np.cumsum(
        WALK * np.sqrt(STEP_S) * rng.standard_normal((n, 3)), axis=0
    ) + np.array([1.0, 0.0, 0.0])


def valid_beams(*counts):
    return np.array([[k < count for k in range(4)] for count in counts])


def stamps(n):
    return np.arange(n, dtype=np.int64) * STEP_NS


def test_rows_with_three_beams_or_more_stay_as_they_are_to_the_bit():
    rng = np.random.default_rng(0)
    velocity, cov = pings(valid_beams(4, 3, 2, 4, 1, 3), rng, walk(6, rng))
    found = completed(stamps(6), velocity, cov)
    for column, before in zip(found, (stamps(6), velocity, cov), strict=True):
        np.testing.assert_array_equal(column[[0, 1, 3, 5]], before[[0, 1, 3, 5]])
    assert np.trace(found[2], axis1=1, axis2=2).max() < 1.0


def test_what_no_beam_measured_is_half_way_between_the_whole_rows_and_shares_their_errors():
    """A vertical beam alone, x by hand: (z_0 + z_2) / 2, (s^2 + q T) / 2, and s^2 / 2 shared with either end."""
    velocity = np.array([[0.7, 0.1, 0.0], [0.0, 0.0, 0.2], [0.9, 0.1, 0.0]])
    cov = np.array(
        [SIGMA**2 * np.eye(3), np.diag([1e4, 1e4, SIGMA**2]), SIGMA**2 * np.eye(3)]
    )
    _, velocities, covs = completed(stamps(3), velocity, cov)
    bridge = 0.5 * (SIGMA**2 + WALK**2 * STEP_S)
    assert velocities[1, :2] == pytest.approx([0.8, 0.1], abs=1e-6)
    assert velocities[1, 2] == pytest.approx(0.2 * bridge / (bridge + SIGMA**2))
    assert covs[1, 0, 0] == pytest.approx(bridge + 2 * SIGMA**2, rel=1e-4)


COUNTS = [
    *([4, 2] * 6 + [4], [4, 2, 2, 2] * 4 + [4], [4, 1, 1] * 5 + [4]),
    [4, 1, 4, 4, 1, 1, 4, 2, 3, 2, 1, 4, 4, 4, 1, 4],
    *(
        [4, 4, *[2] * 12, 4],
        [4, 4, *[1] * 12, 4],
        [4, 4, 2, 2, 1, 1, 2, 0, 1, 1, 2, 2, 1, 2, 4],
    ),
]
TURNING = InertialRows(
    np.arange(0, 401, dtype=np.int64) * 10_000_000,
    np.tile([0.8, -0.5, 1.1], (401, 1)),
    np.tile([0.3, 0.2, 9.8], (401, 1)),
)


@pytest.mark.parametrize("imu", [NO_FORCE, TURNING], ids=["no force", "turning"])
@pytest.mark.parametrize("counts", COUNTS, ids=str)
def test_the_variance_of_a_displacement_is_that_of_every_noise_propagated(counts, imu):
    """In stretches side by side and long ones.

    Rows are affine in beams and true velocities: a unit error of each, one by one, gives the exact variance.
    """
    n, at, valid = len(counts), stamps(len(counts)), valid_beams(*counts)
    turned = np.array([1.0, 1.0, 1.0]) if imu is TURNING else np.zeros(3)
    R = Rotation.from_rotvec(np.outer(at * 1e-9, turned * imu.rate[0]))

    def displaced(true_in_world, beam_errors):
        """Error of the displacement, and the covariances of the rows, both in the world."""
        true = R.inv().apply(true_in_world)
        velocity, cov = velocity_of_beams(
            JANUS, true @ JANUS.T + beam_errors, valid, SIGMA
        )
        kept, velocities, covs = completed(at, velocity, cov, imu)
        assert len(kept) == n
        return STEP_S * R.apply(velocities - true).sum(
            axis=0
        ), R.as_matrix() @ covs @ R.as_matrix().transpose(0, 2, 1)

    still, no_errors = np.zeros((n, 3)), np.zeros((n, 4))
    offset, covs = displaced(still, no_errors)
    columns = []
    for k, beam in zip(*np.nonzero(valid), strict=True):
        noise = no_errors.copy()
        noise[k, beam] = 1.0
        columns.append(SIGMA * (displaced(still, noise)[0] - offset))
    whole = np.flatnonzero(np.array(counts) > 2)
    for first, last in pairwise(whole):
        walked = carry(imu, at[first : last + 1], CALIBRATION).walk_density * np.sqrt(
            STEP_S
        )
        for k in range(first + 1, last + 1):
            for axis in range(3):
                true = still.copy()
                true[k:, axis] = 1.0
                columns.append(walked * (displaced(true, no_errors)[0] - offset))
    variance = np.transpose(columns) @ columns
    np.testing.assert_allclose(
        STEP_S**2 * covs.sum(axis=0), variance, atol=2e-3 * np.trace(variance)
    )


def test_a_row_before_the_first_whole_one_after_the_last_or_in_an_endless_stretch_is_passed_over():
    rng = np.random.default_rng(3)
    velocity, cov = pings(valid_beams(2, 4, 2, 4, 2, 4, 2), rng, walk(7, rng))
    late = np.array([0, 1, 2, 3, 4, 4 + LONGEST_STRETCH_NS, 5 + LONGEST_STRETCH_NS])
    kept, *_ = completed(late, velocity, cov)
    assert kept.tolist() == [1, 2, 3, 4 + LONGEST_STRETCH_NS]


def test_accelerometers_and_gyros_complete_what_the_beam_did_not_see_exactly():
    """A vehicle that turns and speeds up in a world with gravity, levers to both sensors, no noise."""
    w, a, g = (
        np.array([0.1, -0.2, 0.4]),
        np.array([0.3, -0.2, 0.1]),
        np.array([0.0, 0.0, -9.8]),
    )
    calibration = Calibration(
        imu=ImuCalibration(mounting=Mounting(translation_m=(0.3, 0.1, -0.2))),
        dvl=DvlCalibration(mounting=Mounting(translation_m=(-0.5, 0.4, 0.2))),
    )
    arm = np.subtract(
        calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m
    )
    imu_ns, at = np.arange(0, 801, dtype=np.int64) * 5_000_000, stamps(20)

    def in_body(stamps_ns, vectors):
        return Rotation.from_rotvec(np.outer(stamps_ns * 1e-9, w)).inv().apply(vectors)

    imu = InertialRows(imu_ns, np.tile(w, (801, 1)), in_body(imu_ns, a - g))
    true = in_body(at, np.array([0.5, 0.1, 0.0]) + np.outer(at * 1e-9, a)) + np.cross(
        w, arm
    )
    velocity, cov = velocity_of_beams(
        JANUS, true @ JANUS.T, valid_beams(4, 4, *[1] * 15, 4, 4, 4), SIGMA
    )
    kept, found, _ = completed(at, velocity, cov, imu, calibration)
    assert len(kept) == 20
    assert np.abs(velocity - true).max() > 0.5
    assert found == pytest.approx(true, abs=2e-3)


def ats(*seconds: float) -> np.ndarray:
    return np.array([at(second) for second in seconds])


RATE, FORCE = np.array([0.1, -0.2, 0.4]), np.array([0.3, -0.5, 9.7])
MOUNTED = Calibration(
    imu=QUIET, dvl=DVL.model_copy(update={"velocity_walk_density": 0.123})
)


def steady(seconds: float = 10.0) -> InertialRows:
    """Fifty rows a second."""
    stamps_ns = ats(*np.arange(round(seconds * 50) + 1) / 50)
    return InertialRows(
        stamps_ns,
        np.tile(RATE, (len(stamps_ns), 1)),
        np.tile(FORCE, (len(stamps_ns), 1)),
    )


def gained(seconds: float) -> np.ndarray:
    """Integral of the turned force by many small steps."""
    middle = (np.arange(20_000) + 0.5) / 20_000 * seconds
    return (
        Rotation.from_rotvec(np.outer(middle, RATE)).apply(FORCE).mean(axis=0) * seconds
    )


def density(seconds: float, **imu: float) -> float:
    sensors = QUIET.model_copy(update=imu)
    return carry(
        steady(), ats(1.0, 1.0 + seconds), Calibration(imu=sensors)
    ).walk_density


def test_rotation_and_velocity_since_the_first_row_are_those_of_the_integrals():
    """Rows lie between those of the IMU; the first is the frame of all."""
    stamps_ns = ats(1.013, 1.7, 3.331, 5.0)
    found = carry(steady(), stamps_ns, MOUNTED)
    assert found.is_inertial
    for k, seconds in enumerate([0.0, 0.687, 2.318, 3.987]):
        assert found.rotation[k] == pytest.approx(
            Rotation.from_rotvec(seconds * RATE).as_matrix(), abs=1e-9
        )
        assert found.velocity[k] == pytest.approx(
            gained(seconds) if seconds else np.zeros(3), abs=2e-4
        )


def test_rates_and_forces_are_linear_between_rows():
    """Between two rows 1 s apart the turn and the gain are those of the trapezoid."""
    rows = InertialRows(
        ats(0.0, 1.0),
        np.array([[0, 0, 0], [0, 0, 1e-3]]),
        np.array([[1.0, 0, 0], [3.0, 0, 0]]),
    )
    found = carry(rows, ats(0.0, 0.5, 1.0), MOUNTED)
    assert found.velocity[:, 0] == pytest.approx([0.0, 0.75, 2.0], abs=1e-6)
    assert found.rotation[:, 1, 0] == pytest.approx([0.0, 0.125e-3, 0.5e-3], abs=1e-9)


def test_inertial_rows_after_the_last_are_not_used_and_the_newest_holds():
    rows = steady(2.0)
    spoilt = rows.specific_force.copy()
    spoilt[rows.stamps_ns > ats(1.51)] = 1e6
    here, there = (
        carry(InertialRows(*rows[:2], f), ats(0.5, 1.51), MOUNTED)
        for f in (rows.specific_force, spoilt)
    )
    np.testing.assert_array_equal(here.velocity, there.velocity)
    beyond = carry(rows, ats(1.5, 4.5), MOUNTED)
    assert beyond.velocity[1] == pytest.approx(gained(3.0), abs=2e-4 + 1.0)
    assert beyond.rotation[1] == pytest.approx(
        Rotation.from_rotvec(3.0 * RATE).as_matrix(), abs=1e-9
    )


def unfelt(row: int) -> InertialRows:
    rows = steady()
    rows.specific_force[row] = np.nan
    return rows


def holed(begin_s: float, end_s: float) -> InertialRows:
    rows = steady()
    kept = (rows.stamps_ns <= ats(begin_s)) | (rows.stamps_ns >= ats(end_s))
    return InertialRows(*(column[kept] for column in rows))


@pytest.mark.parametrize(
    ("rows", "is_carried"),
    [
        *((unfelt(row), False) for row in (50, 75)),
        (InertialRows(*(column[:0] for column in steady())), False),
        # right after the first row too, which alone tells no typical interval; one of five intervals is no hole
        *(
            (holed(begin_s, begin_s + 0.9), begin_s > 4.0)
            for begin_s in (1.0, 2.0, 5.0)
        ),
        *((holed(begin_s, begin_s + 0.1), True) for begin_s in (1.0, 2.0)),
    ],
)
def test_without_a_force_or_over_a_hole_nothing_is_carried(rows, is_carried):
    found = carry(rows, ats(1.0, 2.5, 4.0), MOUNTED)
    assert found.is_inertial == is_carried
    if not is_carried:
        assert found.walk_density == 0.123
        np.testing.assert_array_equal(found.rotation, np.tile(np.eye(3), (3, 1, 1)))
        assert not found.velocity.any()
        assert not found.from_lever.any()


G = Calibration().gravity_m_s2


@pytest.mark.parametrize(
    ("sensor", "value", "walk"),
    [
        ("accel_noise_density", 3e-3, 3e-3**2),
        (
            "gyro_bias_sigma",
            1e-3,
            4 / 6 * (G * 1e-3 * 6**2 / 8) ** 2,
        ),  # the peak of its parabola in mid-stretch
        (
            "accel_bias_sigma",
            0.05,
            (0.05 * np.linalg.norm(RATE) * 6) ** 2 * 6 / 16,
        ),  # of what turns
    ],
)
def test_the_walk_over_six_seconds_is_of_each_noise_beside_the_earth(
    sensor, value, walk
):
    earth = (G * EARTH_RATE_RAD_S) ** 2 * 6**3 / 16.0
    assert density(6.0, **{sensor: value}) ** 2 == pytest.approx(walk + earth)


def test_the_walk_of_gyro_noise_is_the_variance_in_mid_stretch_over_a_quarter_of_its_length():
    """A tilt that walks with density n, integrated twice and bound at both ends: simulated."""
    n, T, steps, rng = 2e-3, 4.0, 200, np.random.default_rng(0)
    dt = T / steps
    tilt = np.cumsum(n * np.sqrt(dt) * rng.standard_normal((4000, steps)), axis=1)
    velocity = np.cumsum(G * tilt * dt, axis=1)
    t = dt * np.arange(1, steps + 1)
    off_line = velocity[:, steps // 2] - velocity[:, -1] * t[steps // 2] / T
    found = density(T, gyro_noise_density=n)
    earth = (G * EARTH_RATE_RAD_S) ** 2 * T**3 / 16.0
    assert found**2 == pytest.approx((G * n * T) ** 2 / 12.0 + earth)
    assert found**2 * T / 4.0 == pytest.approx(off_line.var(), rel=0.1)


IMU_HZ, SECONDS = 100, 40.0
VEHICLE = Calibration(
    imu=ImuCalibration(mounting=Mounting(translation_m=(0.1, 0.0, 0.05))),
    dvl=DvlCalibration(
        mounting=Mounting(translation_m=(-0.4, 0.1, -0.1)), velocity_walk_density=0.1
    ),
)


def drive(rng, with_force):
    """IMU at 100 Hz, true velocities of the Doppler log at 5 Hz, and the displacement in the first body frame."""
    fine = np.arange(0.0, SECONDS + 1e-9, 1.0 / (10 * IMU_HZ))
    yaw = 0.5 * np.sin(0.15 * fine)
    surge, sway = 0.8 + 0.4 * np.sin(0.4 * fine), 0.1 * np.sin(0.23 * fine)
    rate = np.outer(np.gradient(yaw, fine), [0.0, 0.0, 1.0])
    velocity = np.column_stack([surge, sway, 0.05 * np.sin(0.3 * fine)])
    R = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    at_imu = R.apply(velocity + np.cross(rate, VEHICLE.imu.mounting.translation_m))
    force = R.inv().apply(
        np.gradient(at_imu, fine, axis=0) + np.array([0.0, 0.0, VEHICLE.gravity_m_s2])
    )
    every, noise = slice(None, None, 10), VEHICLE.imu
    white = np.sqrt(IMU_HZ) * rng.standard_normal((2, len(fine[every]), 3))
    force = (
        force[every]
        + noise.accel_noise_density * white[1]
        + noise.accel_bias_sigma * rng.standard_normal(3)
    )
    stamps_ns = ats(*fine[every])
    imu = Imu(
        stamps_ns,
        rate[every] + noise.gyro_noise_density * white[0],
        force if with_force else force * np.nan,
    )
    at_dvl = velocity + np.cross(rate, VEHICLE.dvl.mounting.translation_m)
    return (
        imu,
        stamps_ns[::20],
        at_dvl[::200],
        R[0].inv().apply(np.trapezoid(R.apply(velocity), fine, axis=0)),
    )


@pytest.mark.parametrize("with_force", [False, True])
def test_one_beam_is_better_than_a_gap_and_two_than_one(with_force):
    """All four, but for 20 s only some, which ones changes every second; or none, which the odometry bridges."""
    squares, nees_of_3, (none, one, two, four) = (
        np.zeros((20, 4)),
        np.zeros((20, 4)),
        range(4),
    )
    for seed in range(20):
        rng = np.random.default_rng(seed)
        imu, stamps_ns, truth, path = drive(rng, with_force)
        along = truth @ JANUS.T + SIGMA * rng.standard_normal((len(truth), 4))
        for column, count in enumerate((0, 1, 2, 4)):
            valid = np.ones((len(stamps_ns), 4), dtype=bool)
            for k in np.flatnonzero((stamps_ns > at(10.0)) & (stamps_ns < at(30.0))):
                second = (stamps_ns[k] - T0_NS) // NS
                valid[k] = np.isin(
                    np.arange(4), np.random.default_rng(second).permutation(4)[:count]
                )
            velocity, cov = velocity_of_beams(JANUS, along, valid, SIGMA)
            some = valid.any(axis=1)
            found = motion(
                imu,
                Dvl(stamps_ns[some], velocity[some], cov[some]),
                VEHICLE,
                0.0,
                SECONDS,
            )
            error = found.i_T_j.rotation().unrotate(found.i_T_j.translation() - path)
            squares[seed, column] = error @ error
            nees_of_3[seed, column] = error @ np.linalg.solve(
                found.covariance[3:, 3:], error
            )
    rms = np.sqrt(squares.mean(axis=0))
    print(
        f"0, 1, 2, 4 beams: rms {rms.round(3)} m, NEES over 3 {(nees_of_3.mean(axis=0) / 3).round(2)}"
    )
    assert rms[four] < rms[two] < rms[one] < 0.5 * rms[none]
    assert np.all((nees_of_3.mean(axis=0) > 0.6) & (nees_of_3.mean(axis=0) < 4.8))
