import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import chi2

from sonar_graph.evaluation import Score, consistency
from sonar_graph.states import DetectionLog, Estimate, Outcome, Trajectory

angles = st.floats(-3.0, 3.0)
tilts = st.floats(-1.2, 1.2)


def random_covariance(seed: int, size: int = 6, scale: float = 1e-3) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(size, size)) * scale
    return root @ root.T


def single(pose: gtsam.Pose3, covariance: np.ndarray) -> Trajectory:
    return Trajectory.from_estimates([Estimate(0, pose, covariance)])


def numerical_covariance(pose: gtsam.Pose3, covariance: np.ndarray) -> np.ndarray:
    """Of world position and yaw, by differences through gtsam's own exponential."""
    columns = []
    for step in 1e-6 * np.eye(6):
        plus, minus = (pose.retract(sign * step) for sign in (1, -1))
        yaw = plus.rotation().yaw() - minus.rotation().yaw()
        columns.append([*(plus.translation() - minus.translation()), yaw])
    J = np.array(columns).T / 2e-6
    return J @ covariance @ J.T


@settings(max_examples=50)
@given(st.integers(0, 10_000), tilts, tilts, angles)
def test_world_covariances_equal_numerical_propagation(seed, roll, pitch, yaw):
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([1.0, 2.0, 3.0]))
    covariance = random_covariance(seed)
    trajectory = single(pose, covariance)
    expected = numerical_covariance(pose, covariance)
    near = {"rtol": 0, "atol": 1e-6 * np.abs(expected).max()}
    (found,) = consistency.world_position_covs(trajectory)
    np.testing.assert_allclose(found, expected[:3, :3], **near)
    variances = consistency.yaw_variances(trajectory)
    np.testing.assert_allclose(variances, expected[3, 3], **near)


@pytest.mark.parametrize("dof", [2, 3])
def test_nees_of_samples_from_the_reported_covariance_is_chi_square(dof):
    n = 4000
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 1.0), np.array([3.0, -2.0, 1.0]))
    covariance = random_covariance(1)
    rng = np.random.default_rng(7)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=n)
    estimate, truth = (
        Trajectory.from_estimates(
            [Estimate(i, pose.retract(e), covariance) for i, e in enumerate(of)]
        )
        for of in (0 * errors, errors)
    )
    series = consistency.error_series(estimate, truth, dof)
    for squares, freedom in ((series.nees_position, dof), (series.nees_yaw, 1)):
        low, high = consistency.anees_interval(n, freedom, 0.999)
        assert low < consistency.mean_normalised(squares, freedom) < high
    below_median = np.mean(series.nees_position < chi2.ppf(0.5, dof))
    assert below_median == pytest.approx(0.5, abs=0.03)


def drawn(rng: np.random.Generator, n: int, dof: int, tau: float) -> np.ndarray:
    """Normalised errors that forget themselves over ``tau`` instants."""
    kept = np.exp(-1 / tau)
    steps = np.sqrt(1 - kept**2) * rng.standard_normal((n, dof))
    steps[0] = rng.standard_normal(dof)
    return lfilter([1], [1, -kept], steps, axis=0)


def judged(unit: np.ndarray) -> str:
    dof = unit.shape[1]
    samples = consistency.effective_samples(unit)
    interval = consistency.time_average_interval(samples, dof)
    return Score(float(np.mean(unit**2)), "1", "By hand.", interval, "inside").verdict


@pytest.mark.parametrize("dof", [1, 2])
@pytest.mark.parametrize("tau", [0.01, 10.0, 100.0, 1e4])
def test_healthy_runs_are_hardly_ever_inconsistent(tau, dof):
    rng = np.random.default_rng(4)
    verdicts = [judged(drawn(rng, 600, dof, tau)) for _ in range(200)]
    assert verdicts.count("over-confident") <= 0.05 * 200
    assert verdicts.count("over-cautious") <= 0.08 * 200
    if tau <= 10:  # a run is worth enough samples to detect errors of twice the size
        bad = [judged(2 * drawn(rng, 600, dof, tau)) for _ in range(50)]
        assert bad.count("over-confident") >= 0.9 * 50


def test_a_constant_error_is_one_independent_sample():
    samples = consistency.effective_samples
    white = np.random.default_rng(0).standard_normal((500, 3))
    assert samples(white) > 400
    assert samples(10 * white) == samples(white), "size does not matter"
    assert samples(np.full((500, 1), 3.0)) == 1
    white[::2] = np.nan
    assert 200 < samples(white) <= 250
    assert samples(np.full((5, 1), np.nan)) == 0
    assert consistency.time_average_interval(0, 1) is None


def sightings(
    rho: float, step_s: float = 0.5, count: int = 2000, outcome: Outcome = Outcome.USED
) -> DetectionLog:
    """Two landmarks in turn, their range errors with this correlation from one sighting to the next of the same."""
    rng = np.random.default_rng(1)
    u = rng.standard_normal((count, 2))
    for k in range(2, count):
        u[k, 0] = rho * u[k - 2, 0] + np.sqrt(1 - rho**2) * u[k, 0]
    sigmas = np.array([0.2, 0.01])
    stamps_ns = (np.arange(count) * step_s * 1e9).astype(np.int64)
    covs = np.tile(np.diag(sigmas**2), (count, 1, 1))
    ids = np.arange(count) % 2
    return DetectionLog(stamps_ns, ids, u * sigmas, covs, [outcome] * count)


def test_likeness_is_the_correlation_of_successive_sightings_of_a_landmark():
    for rho in (0.0, 0.8):
        found = consistency.likeness(sightings(rho))
        assert found.pairs == 1998
        np.testing.assert_allclose(found.correlation, [rho, 0.0], atol=0.05)
        np.testing.assert_allclose(found.mean_square, 1.0, atol=0.15)
        # of the mean of many errors
        expected = [np.sqrt((1 + rho) / (1 - rho)), 1.0]
        np.testing.assert_allclose(found.sigma_factors(), expected, rtol=0.15)
    wider = sightings(0.8)
    wider.innovation_covs[:] *= np.linspace(1, 9, 2000)[:, None, None]
    in_sigmas = wider.innovations[:, 0] / np.sqrt(wider.innovation_covs[:, 0, 0])
    a = in_sigmas[:-2]
    b = in_sigmas[2:]
    expected_rho = np.sum(a * b) / np.sqrt(np.sum(a**2) * np.sum(b**2))
    assert consistency.likeness(wider).correlation[0] == pytest.approx(expected_rho)
    # sightings that are 2.2 s apart are no pairs, and what was refused is no sighting
    for none in ({"step_s": 1.1}, {"outcome": Outcome.GATED}):
        found = consistency.likeness(sightings(0.8, **none))
        assert found.pairs == 0
        np.testing.assert_array_equal(found.correlation, 0.0)


def test_nis_takes_used_detections_only():
    outcomes = [Outcome.NEW, Outcome.USED, Outcome.GATED]
    covs = np.tile(np.diag([4.0, 1.0]), (3, 1, 1))
    innovations = np.tile([2.0, 3.0], (3, 1))
    log = DetectionLog(np.arange(3), np.ones(3, int), innovations, covs, outcomes)
    np.testing.assert_allclose(consistency.nis(log), [1.0 + 9.0])
