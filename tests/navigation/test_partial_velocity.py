"""Velocities of which beams measured a part: completed, and as uncertain as they are."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import Calibration, DvlCalibration, ImuCalibration, Mounting
from sonar_graph.devices.dvl_beams import is_partial, velocity_of_beams
from sonar_graph.navigation.dvl_screening.partial_beams import (
    LONGEST_STRETCH_NS,
    InertialRows,
    PartialVelocities,
    carry,
)

STEP_NS = 200_000_000
STEP_S = 0.2
WALK = 0.1
SIGMA = 0.01
TILT = np.radians(30.0)
JANUS = np.array(
    [
        [np.sin(TILT) * np.cos(azimuth), np.sin(TILT) * np.sin(azimuth), np.cos(TILT)]
        for azimuth in np.radians([45.0, -45.0, -135.0, 135.0])
    ]
)


CALIBRATION = Calibration(dvl=DvlCalibration(velocity_walk_density=WALK))
NO_FORCE = InertialRows(np.array([0, 10**12]), np.zeros((2, 3)), np.full((2, 3), np.nan))


def completed(stamps_ns, velocity, cov, imu=NO_FORCE, calibration=CALIBRATION):
    """All rows in one block."""
    return PartialVelocities(calibration).completed(stamps_ns, velocity, cov, is_partial(cov), imu)


def pings(valid, rng, velocities):
    """Rows of noisy beams."""
    along = velocities @ JANUS.T + SIGMA * rng.standard_normal((len(valid), 4))
    return velocity_of_beams(JANUS, along, valid, SIGMA)


def walk(n, rng, runs=None):
    """Velocities that do a random walk from sample to sample."""
    shape = (n, 3) if runs is None else (runs, n, 3)
    return np.cumsum(WALK * np.sqrt(STEP_S) * rng.standard_normal(shape), axis=-2) + np.array([1.0, 0.0, 0.0])


def valid_beams(*counts):
    return np.array([[k < count for k in range(4)] for count in counts])


def stamps(n):
    return np.arange(n, dtype=np.int64) * STEP_NS


def test_rows_with_three_beams_or_more_stay_as_they_are_to_the_bit():
    rng = np.random.default_rng(0)
    velocity, cov = pings(valid_beams(4, 3, 2, 4, 1, 3), rng, walk(6, rng))
    kept, velocities, covs = completed(stamps(6), velocity, cov)
    whole = [0, 1, 3, 5]
    np.testing.assert_array_equal(kept, stamps(6))
    np.testing.assert_array_equal(velocities[whole], velocity[whole])
    np.testing.assert_array_equal(covs[whole], cov[whole])
    assert np.trace(covs, axis1=1, axis2=2).max() < 1.0


def test_results_do_not_depend_on_how_rows_are_cut_into_blocks():
    rng = np.random.default_rng(1)
    velocity, cov = pings(valid_beams(4, 4, 2, 1, 1, 4, 4, 2, 2, 3), rng, walk(10, rng))
    whole = completed(stamps(10), velocity, cov)
    for cut in range(1, 9):
        piecewise = PartialVelocities(CALIBRATION)
        blocks = [
            piecewise.completed(stamps(10)[rows], velocity[rows], cov[rows], is_partial(cov[rows]), NO_FORCE)
            for rows in (slice(0, cut), slice(cut, cut + 1), slice(cut + 1, 10))
        ]
        for together, column in zip(whole, zip(*blocks, strict=True), strict=True):
            np.testing.assert_array_equal(np.concatenate(column), together)


def test_what_no_beam_measured_is_half_way_between_the_whole_rows_and_shares_their_errors():
    """A vertical beam alone, x by hand: (z_0 + z_2) / 2, (s^2 + q T) / 2, and s^2 / 2 shared with either end."""
    velocity = np.array([[0.7, 0.1, 0.0], [0.0, 0.0, 0.2], [0.9, 0.1, 0.0]])
    cov = np.array([SIGMA**2 * np.eye(3), np.diag([1e4, 1e4, SIGMA**2]), SIGMA**2 * np.eye(3)])
    _, velocities, covs = completed(stamps(3), velocity, cov)
    bridge = 0.5 * (SIGMA**2 + WALK**2 * STEP_S)
    assert velocities[1, :2] == pytest.approx([0.8, 0.1], abs=1e-6)
    assert velocities[1, 2] == pytest.approx(0.2 * bridge / (bridge + SIGMA**2))
    assert covs[1, 0, 0] == pytest.approx(bridge + 2 * SIGMA**2, rel=1e-4)


@pytest.mark.parametrize("counts", [[2] * 12, [1] * 12, [2, 2, 1, 1, 2, 0, 1, 1, 2, 2, 1, 2]])
def test_the_variance_of_a_displacement_is_what_the_rows_say_together(counts):
    """Monte Carlo over 600 runs, two-sided."""
    counts = np.array([4, 4, *counts, 4])
    runs, n = 600, len(counts)
    rng = np.random.default_rng(2)
    truth = walk(n, rng, runs)
    errors, variance = [], np.zeros((3, 3))
    for k in range(runs):
        velocity, cov = pings(valid_beams(*counts), rng, truth[k])
        _, velocities, covs = completed(stamps(n), velocity, cov)
        errors.append(STEP_S * (velocities - truth[k]).sum(axis=0))
        variance = STEP_S**2 * covs.sum(axis=0)
    anees = np.mean(np.einsum("ki,ij,kj->k", errors, np.linalg.inv(variance), errors)) / 3
    assert 0.9 < anees < 1.1


FLICKERING = [
    [4, 2] * 6 + [4],
    [4, 2, 2, 2] * 4 + [4],
    [4, 1, 1] * 5 + [4],
    [4, 1, 4, 4, 1, 1, 4, 2, 3, 2, 1, 4, 4, 4, 1, 4],
]
TURNING = InertialRows(
    np.arange(0, 401, dtype=np.int64) * 10_000_000,
    np.tile([0.8, -0.5, 1.1], (401, 1)),
    np.tile([0.3, 0.2, 9.8], (401, 1)),
)


@pytest.mark.parametrize("imu", [NO_FORCE, TURNING], ids=["no force", "turning"])
@pytest.mark.parametrize("counts", FLICKERING, ids=str)
def test_stretches_side_by_side_have_the_variance_of_every_noise_propagated(counts, imu):
    """Rows are affine in beams and true velocities: a unit error of each, one by one, gives the exact variance."""
    n, at, valid = len(counts), stamps(len(counts)), valid_beams(*counts)
    turned = np.array([1.0, 1.0, 1.0]) if imu is TURNING else np.zeros(3)
    R = Rotation.from_rotvec(np.outer(at * 1e-9, turned * imu.rate[0]))

    def displaced(true_in_world, beam_errors):
        """Error of the displacement, and the covariances of the rows, both in the world."""
        true = R.inv().apply(true_in_world)
        velocity, cov = velocity_of_beams(JANUS, true @ JANUS.T + beam_errors, valid, SIGMA)
        kept, velocities, covs = completed(at, velocity, cov, imu)
        assert len(kept) == n
        return STEP_S * R.apply(velocities - true).sum(axis=0), R.as_matrix() @ covs @ R.as_matrix().transpose(0, 2, 1)

    still, no_errors = np.zeros((n, 3)), np.zeros((n, 4))
    offset, covs = displaced(still, no_errors)
    columns = []
    for k, beam in zip(*np.nonzero(valid), strict=True):
        noise = no_errors.copy()
        noise[k, beam] = 1.0
        columns.append(SIGMA * (displaced(still, noise)[0] - offset))
    whole = np.flatnonzero(np.array(counts) > 2)
    for first, last in pairwise(whole):
        walked = carry(imu, at[first : last + 1], CALIBRATION).walk_density * np.sqrt(STEP_S)
        for k in range(first + 1, last + 1):
            for axis in range(3):
                true = still.copy()
                true[k:, axis] = 1.0
                columns.append(walked * (displaced(true, no_errors)[0] - offset))
    variance = np.transpose(columns) @ columns
    np.testing.assert_allclose(STEP_S**2 * covs.sum(axis=0), variance, atol=2e-3 * np.trace(variance))


def test_a_row_before_the_first_whole_one_after_the_last_or_in_an_endless_stretch_is_passed_over():
    rng = np.random.default_rng(3)
    velocity, cov = pings(valid_beams(2, 4, 2, 4, 2, 4, 2), rng, walk(7, rng))
    late = np.array([0, 1, 2, 3, 4, 4 + LONGEST_STRETCH_NS, 5 + LONGEST_STRETCH_NS])
    kept, *_ = completed(late, velocity, cov)
    assert kept.tolist() == [1, 2, 3, 4 + LONGEST_STRETCH_NS]


def test_more_beams_are_never_less_certain():
    rng = np.random.default_rng(4)
    truth = walk(7, rng)
    traces = []
    for count in range(5):
        velocity, cov = pings(valid_beams(4, *[count] * 5, 4), rng, truth)
        traces.append(np.trace(completed(stamps(7), velocity, cov)[2].sum(axis=0)))
    assert np.all(np.diff(traces) < 0)


def test_accelerometers_and_gyros_complete_what_the_beam_did_not_see_exactly():
    """A vehicle that turns and speeds up in a world with gravity, levers to both sensors, no noise."""
    w, a, g = np.array([0.1, -0.2, 0.4]), np.array([0.3, -0.2, 0.1]), np.array([0.0, 0.0, -9.8])
    calibration = Calibration(
        imu=ImuCalibration(mounting=Mounting(translation_m=(0.3, 0.1, -0.2))),
        dvl=DvlCalibration(mounting=Mounting(translation_m=(-0.5, 0.4, 0.2))),
    )
    arm = np.subtract(calibration.dvl.mounting.translation_m, calibration.imu.mounting.translation_m)
    imu_ns, at = np.arange(0, 801, dtype=np.int64) * 5_000_000, stamps(20)

    def in_body(stamps_ns, vectors):
        return Rotation.from_rotvec(np.outer(stamps_ns * 1e-9, w)).inv().apply(vectors)

    imu = InertialRows(imu_ns, np.tile(w, (801, 1)), in_body(imu_ns, a - g))
    true = in_body(at, np.array([0.5, 0.1, 0.0]) + np.outer(at * 1e-9, a)) + np.cross(w, arm)
    velocity, cov = velocity_of_beams(JANUS, true @ JANUS.T, valid_beams(4, 4, *[1] * 15, 4, 4, 4), SIGMA)
    kept, found, _ = completed(at, velocity, cov, imu, calibration)
    assert len(kept) == 20
    assert np.abs(velocity - true).max() > 0.5
    assert found == pytest.approx(true, abs=2e-3)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 0, 2)])
def test_rows_are_completed_from_the_newest_whole_one_in_whatever_blocks_it_came(order):
    rng = np.random.default_rng(3)
    velocity, cov = pings(valid_beams(4, 4, 4, 1, 1, 4), rng, walk(6, rng))
    at = stamps(6)
    whole = completed(at[2:], velocity[2:], cov[2:])
    pieces = PartialVelocities(CALIBRATION)
    for k in order:
        pieces.remember(at[k : k + 1], velocity[k : k + 1], cov[k : k + 1])
    found = pieces.completed(at[3:], velocity[3:], cov[3:], is_partial(cov[3:]), NO_FORCE)
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_allclose(one, other[1:], rtol=1e-12)
