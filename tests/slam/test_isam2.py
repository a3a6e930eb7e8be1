"""The estimator against its batch solution, on the basin, on MRCLAM and on faulty streams; its settings."""

from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L
from scipy.stats import chi2

from sonar_graph.errors import CalibrationError, EstimatorError
from sonar_graph.estimator import make_params
from sonar_graph.evaluation import normalised_squares
from sonar_graph.measurements import Floats
from sonar_graph.navigation import Odometry
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin
from sonar_graph.slam import Isam2
from sonar_graph.states import Estimate
from sonar_graph.testing import check_consistent, small_world, still_world

from .graphs import gtsams_solution
from .made import ran

BASIN_S = 130.0


@pytest.fixture(scope="module")
def basin() -> Sequence:
    return simulate_basin(BasinOptions(duration_s=BASIN_S, laps=1, seed=3))


def assert_is_batch(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Cost within 1 % and poses within 1 cm of Levenberg-Marquardt on the identical factors."""
    batch = gtsams_solution(graph, values, 1e-9)
    assert graph.error(batch) <= graph.error(values) * (1 + 1e-9)
    assert graph.error(values) == pytest.approx(graph.error(batch), rel=0.01)
    for key in poses_in(values):
        assert (
            np.linalg.norm(
                values.atPose3(key).translation() - batch.atPose3(key).translation()
            )
            < 0.01
        )


def poses_in(values: gtsam.Values) -> list[int]:
    return [key for key in list(values.keys()) if gtsam.Symbol(key).chr() == ord("x")]


PRECISE = {"smoother__lag_s": 1e6, "smoother__waiting_gain": 0.0}


@pytest.mark.parametrize(
    ("kernel", "bias"), [("none", 1.0), ("huber", 0.0), ("cauchy", 1.0)]
)
def test_incremental_equals_batch_in_the_basin(kernel, bias):
    """iSAM2's own estimate, when it keeps all poses and relinearises what moved by a tenth of a milliradian."""
    sequence = simulate_basin(
        BasinOptions(duration_s=BASIN_S, laps=1, seed=3, gyro_bias_scale=bias)
    )
    estimator, _ = ran(
        sequence, **PRECISE, kernel__shape=kernel, smoother__relinearize_threshold=1e-4
    )
    assert len(poses_in(estimator.values)) > 20
    assert_is_batch(estimator.graph, estimator.values)


def position_nees(sequence: Sequence, estimates: list[Estimate]) -> Floats:
    truth = sequence.truth.at(np.array([e.stamp_ns for e in estimates]))
    off = np.array([e.world_T_body.translation() for e in estimates]) - truth.positions
    rotations = [e.world_T_body.rotation().matrix() for e in estimates]
    covs = [
        R @ e.covariance[3:, 3:] @ R.T
        for R, e in zip(rotations, estimates, strict=True)
    ]
    return normalised_squares(off, np.array(covs))


def test_a_vehicle_stays_within_its_covariance():
    """A velocity of 1 cm/s at 5 Hz wanders by 1 cm/s x sqrt(0.2 s x 60 s) on each axis; depth holds the height."""
    world = small_world()
    assert position_nees(world, ran(world)[1]).max() < chi2.ppf(0.9999, 3)
    last = ran(still_world())[1][-1]
    R = last.world_T_body.rotation().matrix()
    sigmas = np.sqrt(np.diag(R @ last.covariance[3:, 3:] @ R.T))
    assert sigmas[:2] == pytest.approx([0.01 * np.sqrt(0.2 * 60)] * 2, rel=0.03)
    assert sigmas[2] < 0.01


@pytest.mark.slow
def test_twenty_basins_are_consistent():
    """Two-sided 99.9 % band of the mean over independent runs at the end of each, three degrees of freedom."""
    last = []
    for seed in range(20):
        sequence = simulate_basin(
            BasinOptions(duration_s=300.0, laps=1, seed=seed, gyro_bias_scale=0.0)
        )
        last.append(position_nees(sequence, ran(sequence, 1.0)[1])[-1])
    check_consistent(last, 3, confidence=0.999)


@pytest.mark.parametrize(
    ("section", "name"), [("imu", "gyro_noise_density"), ("start", "position_sigma_m")]
)
def test_noise_of_zero_is_refused_by_name(basin, section, name):
    part = getattr(basin.calibration, section)
    zero = 0.0 if section == "imu" else (0.0, 0.0, 0.0)
    calibration = basin.calibration.model_copy(
        update={section: part.model_copy(update={name: zero})}
    )
    with pytest.raises(CalibrationError, match=f"{section}.{name}"):
        Isam2(calibration, Odometry(calibration))


def test_the_newest_landmarks_are_those_of_the_window(basin):
    """For a live run, whose map must not wait for the solution of the whole graph; asking leaves no trace."""
    estimator, _ = ran(basin, 7.0)
    newest = estimator.newest_landmarks()
    solved = estimator.landmarks()
    assert newest.ids.tolist() == solved.ids.tolist() == [1, 2, 3, 4]
    for landmark, position, cov in zip(
        newest.ids.tolist(), newest.positions, newest.covariances, strict=True
    ):
        assert np.array_equal(position, estimator.values.atPoint3(L(landmark)))
        in_window = estimator.marginal(landmark=landmark, over="window")
        np.testing.assert_allclose(cov, in_window, rtol=1e-9)
    off = newest.positions - solved.positions
    assert 0.0 < normalised_squares(off, newest.covariances).max() < 1.0
    again = estimator.newest_landmarks()
    assert np.array_equal(again.positions, newest.positions)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "gate without its policy": (
        {"identity.gate_probability": 0.9},
        'identity.gate_probability: there is no such field with policy = "robust"; identity.policy = "gate" has it',
    ),
    "mixture without its policy": (
        {"identity.view_range_m": 5.0},
        'policy = "max-mixture" has it',
    ),
    "association without its policy": (
        {"identity.unknown.sightings": 3},
        'identity.unknown.policy = "associate" has',
    ),
    "mixture in a bounded history": (
        {"identity.policy": "max-mixture", "history.policy": "bounded"},
        'history.policy = "bounded" cannot be with identity.policy = "max-mixture", which chooses anew in the whole',
    ),
    "no such policy": (
        {"identity.policy": "gcn"},
        "identity.policy: there is no 'gcn'; there are: robust, gate, max-",
    ),
    "a policy for its section": (
        {"identity": "gate"},
        'identity: expected a section with policy = "gate"',
    ),
    "no such section": (
        {"smother.lag_s": 3},
        "smother: there is no such field; did you mean smoother?",
    ),
    "its section is missing": (
        {"unknown.density_m2": 1, "lag_s": 20},
        "lag_s: there is no such field; did you mean smoother.lag_s? it has: keyframes, smoother, history, kernel",
    ),
}


@pytest.mark.parametrize(("given", "fault"), REFUSED.values(), ids=REFUSED)
def test_what_a_policy_does_not_read_is_refused_by_name(given, fault):
    with pytest.raises(EstimatorError) as refused:
        make_params(Isam2, given, "isam2")
    assert fault in str(refused.value)
