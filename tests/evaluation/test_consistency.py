import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_graph.calibration import Calibration, Mounting, SonarCalibration
from sonar_graph.evaluation import consistency
from sonar_graph.evaluation.results import Score
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, Estimate, LandmarkMap, Outcome, Trajectory

angles = st.floats(-3.0, 3.0)
tilts = st.floats(-1.2, 1.2)


def random_covariance(seed: int, size: int = 6, scale: float = 1e-3) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(size, size)) * scale
    return root @ root.T


def single(pose: gtsam.Pose3, covariance: np.ndarray) -> Trajectory:
    return Trajectory.from_estimates([Estimate(0, pose, covariance)])


def numerical_covariance(pose: gtsam.Pose3, covariance: np.ndarray) -> np.ndarray:
    """Of world position and yaw, by differences through gtsam's own exponential."""
    step = 1e-6
    columns = []
    for axis in np.eye(6):
        plus, minus = pose.retract(step * axis), pose.retract(-step * axis)
        yaw = plus.rotation().yaw() - minus.rotation().yaw()
        columns.append(
            np.append(plus.translation() - minus.translation(), yaw) / (2 * step)
        )
    J = np.array(columns).T
    return J @ covariance @ J.T


@settings(max_examples=50)
@given(st.integers(0, 10_000), tilts, tilts, angles)
def test_world_covariances_equal_numerical_propagation(seed, roll, pitch, yaw):
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), np.array([1.0, 2.0, 3.0]))
    trajectory = single(pose, random_covariance(seed))
    expected = numerical_covariance(pose, random_covariance(seed))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(
        consistency.world_position_covs(trajectory)[0],
        expected[:3, :3],
        atol=1e-6 * scale,
    )
    assert consistency.yaw_variances(trajectory)[0] == pytest.approx(
        expected[3, 3], abs=1e-6 * scale
    )


@pytest.mark.parametrize("dof", [2, 3])
def test_nees_of_samples_from_the_reported_covariance_is_chi_square(dof):
    rng = np.random.default_rng(7)
    n = 4000
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 1.0), np.array([3.0, -2.0, 1.0]))
    covariance = random_covariance(1)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=n)
    estimate = Trajectory.from_estimates(
        [Estimate(i, pose, covariance) for i in range(n)]
    )
    truth = Trajectory.from_estimates(
        [Estimate(i, pose.retract(e), covariance) for i, e in enumerate(errors)]
    )
    series = consistency.error_series(estimate, truth, dof)
    low, high = consistency.anees_interval(n, dof, 0.999)
    assert low < consistency.mean_normalised(series.nees_position, dof) < high
    low, high = consistency.anees_interval(n, 1, 0.999)
    assert low < consistency.mean_normalised(series.nees_yaw, 1) < high
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
    interval = consistency.time_average_interval(
        consistency.effective_samples(unit), dof
    )
    return Score(float(np.mean(unit**2)), "1", "By hand.", interval, "inside").verdict


@pytest.mark.parametrize("dof", [1, 2])
@pytest.mark.parametrize("tau", [0.01, 10.0, 100.0, 1e4])
def test_of_healthy_runs_hardly_one_is_called_inconsistent_however_slow_its_errors(
    tau, dof
):
    rng = np.random.default_rng(4)
    verdicts = [judged(drawn(rng, 600, dof, tau)) for _ in range(200)]
    assert np.mean([verdict == "over-confident" for verdict in verdicts]) <= 0.05
    assert np.mean([verdict == "over-cautious" for verdict in verdicts]) <= 0.08
    # then a run is worth enough samples to tell errors of twice the size
    fast = tau <= 10
    bad = [judged(2 * drawn(rng, 600, dof, tau)) for _ in range(50)]
    assert np.mean([verdict == "over-confident" for verdict in bad]) >= (
        0.9 if fast else 0.0
    )


def test_a_constant_error_is_one_sample_and_white_ones_are_all_and_unknown_none():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((500, 3))
    assert consistency.effective_samples(white) > 400
    assert consistency.effective_samples(10 * white) == consistency.effective_samples(
        white
    ), "size does not matter"
    assert consistency.effective_samples(np.full((500, 1), 3.0)) == 1
    half = white.copy()
    half[::2] = np.nan
    assert 200 < consistency.effective_samples(half) <= 250
    assert consistency.effective_samples(np.full((5, 1), np.nan)) == 0
    assert consistency.time_average_interval(0, 1) is None


def test_nis_takes_used_detections_only():
    outcomes = [Outcome.NEW, Outcome.USED, Outcome.GATED]
    covs = np.array([np.full((2, 2), np.nan), np.diag([4.0, 1.0]), np.eye(2)])
    log = DetectionLog(
        np.arange(3),
        np.ones(3, int),
        np.array([[np.nan] * 2, [2.0, 3.0], [9.0, 9.0]]),
        covs,
        outcomes,
    )
    np.testing.assert_allclose(consistency.nis(log), [1.0 + 9.0])
    empty = DetectionLog(
        np.empty(0, int), np.empty(0, int), np.empty((0, 2)), np.empty((0, 2, 2)), []
    )
    assert consistency.nis(empty).shape == (0,)


MOUNTING = Mounting(translation_m=(0.3, 0.1, -0.1), rpy_rad=(0.0, 0.5, 0.1))
LANDMARKS_M = np.array([[3.0, 0.5, -1.0], [5.0, -2.0, -1.1]])
IDS = np.array([11, 7])
STILL_NS = np.array([0, 10**9])


def turning_truth() -> Trajectory:
    stamps_ns = np.arange(11) * 10**8
    yaw = Rotation.from_euler(
        "ZYX",
        np.column_stack([0.3 * np.arange(11), 0.02 * np.arange(11), np.zeros(11)]),
    )
    positions = np.column_stack([0.1 * np.arange(11), np.zeros(11), np.full(11, -0.5)])
    return Trajectory.without_covariances(stamps_ns, positions, yaw.as_quat())


def seen_at(stamp_ns: int, point: np.ndarray) -> tuple[float, float]:
    """Range and azimuth of a world point, with transforms written out."""
    truth = turning_truth()
    row = truth.stamps_ns.tolist().index(stamp_ns)
    in_body = truth.rotations()[row].inv().apply(point - truth.positions[row])
    q = (
        Rotation.from_euler("ZYX", [0.1, 0.5, 0.0])
        .inv()
        .apply(in_body - [0.3, 0.1, -0.1])
    )
    return float(np.linalg.norm(q)), float(np.arctan2(q[1], q[0]))


def run_with(
    rows: list[tuple[int, float, float]], named: list[int], probability: list[float]
) -> Sequence:
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    ids, probabilities = np.array(named)[:, None], np.array(probability)[:, None]
    detections = LandmarkDetections(
        *columns, np.zeros((len(rows), 2, 2)), ids, probabilities
    )
    return Sequence(
        "hand",
        Calibration(sonar=SonarCalibration(mounting=MOUNTING)),
        imu=Imu(STILL_NS, np.zeros((2, 3)), np.zeros((2, 3))),
        dvl=Dvl(STILL_NS, np.zeros((2, 3)), np.full((2, 3, 3), np.nan)),
        detections=detections,
        truth=turning_truth(),
        true_landmarks=LandmarkMap(IDS, LANDMARKS_M, np.full((2, 3, 3), np.nan)),
    )


def test_a_detection_is_of_the_landmark_that_lies_there():
    """Two stamps, detections 10 cm off, 25 cm off (cannot be told) and 60 cm off (none)."""
    rows = []
    for stamp_ns, landmark in ((2 * 10**8, 0), (6 * 10**8, 1)):
        r, a = seen_at(stamp_ns, LANDMARKS_M[landmark])
        off = (0.1, 0.0), (0.0, 0.1 / r), (0.25, 0.0), (0.0, 0.6 / r)
        rows += [(stamp_ns, r + along, a + turn) for along, turn in off]
    run = run_with(rows, [0] * 8, [1.0] * 8)
    labels = consistency.true_identities(run, run.detections)
    neither = [consistency.UNJUDGED, consistency.NONE]
    assert labels.tolist() == [11, 11, *neither, 7, 7, *neither]


def test_azimuths_are_compared_round_the_circle_and_what_lies_outside_the_truth_is_not_judged():
    r, a = seen_at(0, LANDMARKS_M[0])
    rows = [
        (-5, r, a),
        (0, r, a),
        (0, r, a - 2 * np.pi),
        (0, r, a + np.pi),
        (10**9, r, a),
        (10**9 + 1, r, a),
    ]
    run = run_with(rows, [0] * 6, [1.0] * 6)
    labels = consistency.true_identities(run, run.detections)
    assert labels[[0, 5]].tolist() == [consistency.UNJUDGED] * 2
    assert labels[1:4].tolist() == [11, 11, consistency.NONE]
    early = run_with([(-5, r, a)], [0], [1.0])
    assert consistency.true_identities(early, early.detections).tolist() == [
        consistency.UNJUDGED
    ]


def test_planar_nees_ignores_height():
    pose, above = gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 5.0]))
    covariance = np.diag([1e-2] * 3 + [1e-2] * 3)
    planar = consistency.error_series(
        single(above, covariance), single(pose, covariance), 2
    )
    spatial = consistency.error_series(
        single(above, covariance), single(pose, covariance), 3
    )
    assert planar.nees_position[0] == pytest.approx(1.0)
    assert spatial.nees_position[0] == pytest.approx(1.0 + 2500.0)
