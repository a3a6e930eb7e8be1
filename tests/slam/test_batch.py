import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

from sonar_graph.navigation.preintegration.motion import PreintegratedMotion
from sonar_graph.slam.models import factors
from sonar_graph.slam.smoother.batch_solution import MAX_ITERATIONS, solve

TURN = gtsam.Pose3(gtsam.Rot3.Rz(0.3), np.array([0.5, 0.0, 0.02]))
SONAR = gtsam.Pose3(gtsam.Rot3.Ry(0.4), np.array([0.3, 0.0, -0.1]))
LANDMARKS = {3: np.array([3.0, 1.0, -1.0]), 5: np.array([2.0, 3.0, -0.8]), 8: np.array([-0.5, 2.5, -1.2])}


def plain(noise):
    return noise


def huber(noise):
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.0), noise)


def round_trip(seed: int, poses: int = 12, with_bias: bool = False, kernel=plain):
    """A noisy graph of a vehicle on a circle, and values that are far from its solution."""
    rng = np.random.default_rng(seed)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    prior = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01] * 3 + [0.02] * 3))
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), prior))
    if with_bias:
        graph.push_back(factors.bias_prior(B(0), 0.01))
        values.insert(B(0), np.zeros(3))
    truth, cov = gtsam.Pose3(), np.diag([1e-4] * 3 + [4e-4] * 3)
    for k in range(poses):
        values.insert(X(k), truth.compose(gtsam.Pose3.Expmap(0.2 * rng.standard_normal(6))))
        for i, p in LANDMARKS.items():
            q = truth.compose(SONAR).transformTo(p)
            z = [np.linalg.norm(q), np.arctan2(q[1], q[0])] + [0.02, 0.009] * rng.standard_normal(2)
            for factor in factors.landmark_sighting(X(k), L(i), SONAR, z, np.diag([4e-4, 8e-5]), kernel, 0.3):
                graph.push_back(factor)
        noisy = TURN.compose(gtsam.Pose3.Expmap(np.sqrt(np.diag(cov)) * rng.standard_normal(6)))
        motion = PreintegratedMotion(noisy, cov, -np.eye(6)[:, :3], np.zeros(3), 1.0, np.zeros(3))
        if k + 1 < poses:
            graph.push_back(
                factors.odometry_with_bias(X(k), X(k + 1), B(0), motion)
                if with_bias
                else factors.odometry(X(k), X(k + 1), motion)
            )
        truth = truth.compose(TURN)
    for i, p in LANDMARKS.items():
        values.insert(L(i), p + 0.3 * rng.standard_normal(3))
    return graph, values


def gtsams_solution(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setMaxIterations(200)
    return gtsam.LevenbergMarquardtOptimizer(graph, initial, params).optimize()


@pytest.mark.parametrize("with_bias", [False, True])
@pytest.mark.parametrize("kernel", [plain, huber])
@pytest.mark.parametrize("seed", range(4))
def test_the_solution_costs_what_gtsams_own_optimiser_finds(seed, kernel, with_bias):
    graph, initial = round_trip(seed, kernel=kernel, with_bias=with_bias)
    ours, theirs = solve(graph, initial), gtsams_solution(graph, initial)
    assert graph.error(initial) > 100 * graph.error(theirs)
    assert graph.error(ours) == pytest.approx(graph.error(theirs), rel=1e-6)
    assert ours.atPose3(X(11)).equals(theirs.atPose3(X(11)), 1e-3)


def test_the_initial_values_stay_as_they_were():
    graph, initial = round_trip(0)
    before = graph.error(initial)
    solve(graph, initial)
    assert graph.error(initial) == before


def test_a_solution_stays_where_it_is():
    graph, initial = round_trip(1)
    once = solve(graph, initial)
    assert solve(graph, once).equals(once, 1e-5)


class Watched:
    """A graph that keeps the errors of the values it was linearised at."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph) -> None:
        self.graph = graph
        self.errors: list[float] = []

    def error(self, values: gtsam.Values) -> float:
        return self.graph.error(values)

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        self.errors.append(self.graph.error(values))
        return self.graph.linearize(values)


@pytest.mark.parametrize("seed", range(3))
def test_no_iteration_raises_the_error(seed):
    graph, initial = round_trip(seed)
    wild = initial.retract(_scatter(initial, 0.6, seed))
    watched = Watched(graph)
    final = solve(watched, wild)
    assert np.all(np.diff([*watched.errors, graph.error(final)]) < 0) or len(watched.errors) == 1
    assert graph.error(final) < graph.error(wild)
    assert len(watched.errors) <= MAX_ITERATIONS


def _scatter(values: gtsam.Values, sigma: float, seed: int) -> gtsam.VectorValues:
    rng, delta = np.random.default_rng(seed), gtsam.VectorValues()
    for key in list(values.keys()):
        delta.insert(key, sigma * rng.standard_normal(len(values.zeroVectors().at(key))))
    return delta


def test_damping_recovers_from_an_indeterminate_step():
    """A landmark behind the camera has no derivative at all; the rest is solved all the same."""
    graph, initial = round_trip(2)
    graph.push_back(factors.landmark_sighting(X(0), L(9), SONAR, np.array([2.0, 0.0]), np.eye(2), plain)[0])
    initial.insert(L(9), SONAR.transformFrom(np.array([-2.0, 0.0, 0.0])))
    with pytest.raises(RuntimeError):
        graph.linearize(initial).optimize()
    final = solve(graph, initial)
    reference_graph, reference_initial = round_trip(2)
    reference = gtsams_solution(reference_graph, reference_initial)
    assert reference_graph.error(final) == pytest.approx(reference_graph.error(reference), rel=1e-4)


def rosenbrock() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Residuals 10 (y - x^2) and 1 - x: Gauss-Newton's first step from (-1.2, 1) raises the error a hundredfold."""

    def residual(_, values, jacobians):
        x, y, _ = values.atPoint3(L(0))
        if jacobians is not None:
            jacobians[0] = np.array([[-20 * x, 10.0, 0], [-1.0, 0, 0], [0, 0, 1.0]])
        return np.array([10 * (y - x**2), 1 - x, values.atPoint3(L(0))[2]])

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [L(0)], residual))
    values.insert(L(0), np.array([-1.2, 1.0, 0.0]))
    return graph, values


def test_a_step_that_would_raise_the_error_is_shortened():
    graph, initial = rosenbrock()
    undamped = initial.retract(graph.linearize(initial).optimize())
    assert graph.error(undamped) > 50 * graph.error(initial)
    watched = Watched(graph)
    assert np.allclose(solve(watched, initial).atPoint3(L(0)), [1, 1, 0], atol=1e-6)
    assert np.all(np.diff(watched.errors) < 0)


def test_where_nothing_lowers_the_error_the_initial_values_are_returned():
    def unwise(_, values, jacobians):
        """A derivative of the wrong sign: every step, however short, goes up."""
        if jacobians is not None:
            jacobians[0] = -np.eye(3)
        return values.atPoint3(L(0))

    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [L(0)], unwise))
    initial.insert(L(0), np.ones(3))
    assert solve(graph, initial).equals(initial, 0.0)


def test_what_cholesky_refuses_is_solved_in_one_step(monkeypatch):
    """A pose known to 20 m with steps of 2 mm is linear enough for one undamped step."""
    monkeypatch.setattr("sonar_graph.slam.smoother.batch_solution.MAX_ITERATIONS", 1)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    wide, narrow = (gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3] * 3 + [s] * 3)) for s in (20.0, 0.002))
    graph.push_back(gtsam.PriorFactorPose3(0, gtsam.Pose3(gtsam.Rot3(), np.array([9.0, 0.0, 0.0])), wide))
    graph.push_back(gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(), narrow))
    for key in (0, 1):
        values.insert(key, gtsam.Pose3())
    with pytest.raises(RuntimeError, match="Indeterminate"):
        graph.linearize(values).optimize()
    assert solve(graph, values).atPose3(1).translation() == pytest.approx([9.0, 0.0, 0.0], abs=1e-6)
