"""Whole histories under other choices: least cost by trying all, graduated non-convexity beside GTSAM."""

from itertools import product

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import multivariate_normal

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.slam import KeyframeParams, MixtureIdentity
from sonar_graph.slam.landmarks import mixture_history as rival_history
from sonar_graph.slam.landmarks.association import IdentityPosterior
from sonar_graph.slam.landmarks.mixture import Choices, TrackedObject
from sonar_graph.slam.landmarks.mixture_history import LEAST_WEIGHT, RivalHistory, WeighedHistory, graduated_weights
from sonar_graph.slam.landmarks.sighting import Sighting, SightingFactors
from sonar_graph.slam.smoother.batch_solution import Sightline

from . import dive as dive_module
from . import test_mixture as small
from .dive import CALIBRATION, FLOOR, Dive, spherical
from .made import graph_of, plain, point_prior, pose_prior, values_of
from .test_mixture_policy import PLACES, dive, show, watch


def rival_of(world: Dive) -> RivalHistory:
    doubtful = world.sightings._doubtful
    handles = {s.handle for w in doubtful.watches for s in w.sightings}
    return RivalHistory(
        world.smoother.graph_without(handles), doubtful.watches, doubtful._mixture, doubtful._landmarks.maker
    )


def test_the_cheaper_of_both_solutions_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that stands has taken all sightings of landmark 9 for no landmark; the other knows better, or worse."""
    world, rng = dive("max-mixture"), np.random.default_rng(3)
    for k in range(1, 9):
        watch(world, 0.3 * k, {i: i for i in PLACES}, rng)
    rival, chosen = rival_of(world), world.sightings._doubtful.history()
    worse = [None if choice == 9 else choice for choice in chosen.choices]
    monkeypatch.setattr(RivalHistory, "_fixed_point", lambda _, values, choices: (values, choices))
    monkeypatch.setattr(RivalHistory, "graduated", lambda _, values: (values, chosen.choices))
    assert rival.settled(chosen.values, worse, is_graduated=True)[1] == chosen.choices
    assert rival.settled(chosen.values, worse, is_graduated=False)[1] == worse
    monkeypatch.setattr(RivalHistory, "graduated", lambda _, values: (values, worse))
    assert rival.settled(chosen.values, chosen.choices, is_graduated=True)[1] == chosen.choices
    monkeypatch.setattr(rival_history, "LEAST_GAIN", np.inf)
    monkeypatch.setattr(RivalHistory, "graduated", lambda _, values: (values, chosen.choices))
    assert rival.settled(chosen.values, worse, is_graduated=True)[1] == worse


# A small world, in which all choices can be tried --------------------------------------------------------------------

IDS = (7, 4, None)
MAKER = SightingFactors(SonarCalibration(elevation_aperture_rad=0.3), plain)


def named(k: int, place: int, said: int, values: gtsam.Values) -> TrackedObject:
    """One sighting from pose k of landmark 7 or 4, surely named."""
    found = small.watch(values, small.PLACES[place], [k], np.zeros((1, 2)), {said: 0.9})
    found.sightings[0].floor = FloorPrior(z_m=float(small.PLACES[place][2]), sigma_m=0.05)
    return found


def cost_of(rival: RivalHistory, values: gtsam.Values, choices: Choices) -> float:
    """The error of the graph that was chosen, and logarithms of densities and weights; by scipy."""
    found, sizes = rival._chosen_graph(choices).error(values), rival._sizes(choices)
    for seen, choice in zip(rival._watches, choices, strict=True):
        weight, none = small.log_weights(seen.statement.probability, choice or 0)
        if choice is None:
            found -= none + small.LOG_U
        elif sizes[choice] == 1:  # its landmark is where it says: of unknown place
            found -= weight + small.LOG_U
        else:
            R = seen.sightings[0].noise
            found -= weight + float(multivariate_normal.logpdf(np.zeros(2), np.zeros(2), R))
    return float(found)


@pytest.mark.parametrize(
    "said",
    [[7, 4, 7, 4, 7, 4], [7, 4, 4, 4, 7, 4], [7, 4, 7, 7, 7, 4], [7, 4, 4, 7, 7, 4]],
    ids=["right", "a wrong 4", "a wrong 7", "exchanged"],
)
def test_the_choices_that_settle_are_the_cheapest_of_all(said: list[int]) -> None:
    """Three sightings of each of two landmarks, from nothing: each begins with one, and gets the others then."""
    places = [7, 4, 7, 4, 7, 4]
    watches = [named(k, place, name, small.world()) for k, (place, name) in enumerate(zip(places, said, strict=True))]
    poses = [small.world().atPose3(X(k)) for k in range(6)]
    known = graph_of(pose_prior(X(k), pose, 0.01) for k, pose in enumerate(poses))
    start = values_of(**{f"X{k}": pose for k, pose in enumerate(poses)})
    rival = RivalHistory(known, watches, small.MIXTURE, MAKER)
    values, choices = rival.settled(start, [None] * 6, is_graduated=False)
    assert choices == places
    assert rival.cost(values, choices) == pytest.approx(cost_of(rival, values, choices), abs=0.05)
    others = [list(c) for c in product(IDS, repeat=6) if list(c) != places]
    rng = np.random.default_rng(0)
    for other in [others[k] for k in rng.choice(len(others), 60, replace=False)]:
        assert cost_of(rival, rival._solve(start, other), other) > cost_of(rival, values, choices) + 1.0


def drifted(side_m: float, *, is_graduated: bool) -> tuple[Dive, list[int]]:
    """Three landmarks, and again after the vehicle has drifted aside; in two frames first only the middle one."""
    dvl = CALIBRATION.dvl.model_copy(update={"velocity_sigma_m_s": (0.2, 0.2, 0.2)})
    world = Dive(
        CALIBRATION.model_copy(update={"floor": FLOOR, "dvl": dvl}),
        MixtureIdentity(policy="gnc" if is_graduated else "max-mixture"),
    )
    rng, truth = np.random.default_rng(3), []
    for k in range(10):
        after_s, moved_m = (0.1 * (k + 1), 0.0) if k < 4 else (1.6 + 0.1 * k, side_m)
        seen = [4] if k in (4, 5) else list(PLACES)
        at = [spherical(0.5 * after_s, PLACES[i] - [0.0, moved_m, 0.0]) for i in seen]
        show(world, after_s, np.array(at) + [0.02, 0.01] * rng.standard_normal((len(at), 2)), seen, [-1] * len(at))
        truth += seen
    return world, truth


def test_graduated_non_convexity_finds_what_the_windows_choices_have_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The drift is of four standard deviations: a few wrong identities explain it as well until more is seen."""
    monkeypatch.setattr(dive_module, "POLICY", KeyframeParams(max_interval_s=1.0, motion_noise_share=0.0))
    costs, sides, side_m = [], [], 0.6
    for is_graduated in (False, True):
        world, truth = drifted(side_m, is_graduated=is_graduated)
        chosen, rival = world.sightings._doubtful.history(), rival_of(world)
        costs.append(rival.cost(chosen.values, chosen.choices))
        assert costs[-1] == pytest.approx(cost_of(rival, chosen.values, chosen.choices), abs=1.0)
        assert (chosen.choices == truth) is is_graduated
        last = max(w.sightings[0].line.pose_key for w in chosen.watches)
        sides.append(float(chosen.values.atPose3(last).translation()[1]))
        assert len(world.sightings.log()) == len(truth)
    assert sides == pytest.approx([0.0, side_m], abs=0.05)
    assert costs[0] - costs[1] == pytest.approx(123.0, abs=2.0)


MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.4, 0.0), np.array([0.3, 0.0, -0.1]))
WEIGHED = [7, 9, 7, 9]
NOISE = {"independent": np.diag([4e-4, 1e-4]), "correlated": np.array([[4e-4, 1e-4], [1e-4, 1e-4]])}
FLOORS = {"floor": FloorPrior(z_m=-1.0, sigma_m=0.05), "no floor": None}


def history(noise: str, floor: str):
    """Two landmarks, two watches each of three sightings; the earliest of landmark 7 is in its second watch."""
    rng = np.random.default_rng(1)
    values, rest = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k in range(3):
        values.insert(X(k), gtsam.Pose3.Expmap(0.1 * rng.standard_normal(6)))
        rest.push_back(pose_prior(X(k), gtsam.Pose3(), 0.1))
    for landmark_id in set(WEIGHED):
        values.insert(L(landmark_id), np.array([3.0, 0.2, -1.0]) + 0.1 * rng.standard_normal(3))
    watches = []
    for row, _ in enumerate(WEIGHED):
        z = np.array([3.0, 0.1]) + 0.02 * rng.standard_normal((3, 2))
        sightings = [
            Sighting(100 - 10 * row + k, row, Sightline(X(k), MOUNTED, z[k]), NOISE[noise], FLOORS[floor])
            for k in range(3)
        ]
        watches.append(TrackedObject(IdentityPosterior({}), sightings))
    return rest, watches, values


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("noise", NOISE)
def test_each_watch_counts_by_its_weight_and_the_beginning_of_landmarks_in_full(noise: str, floor: str) -> None:
    """With all weights one it is the history as it is made."""
    rest, watches, values = history(noise, floor)
    weighed = WeighedHistory(rest, watches, WEIGHED, MAKER)
    first = {7: watches[2].sightings[0], 9: watches[3].sightings[0]}
    said_once = rest.error(values) + sum(
        factor.error(values) for i, sighting in first.items() for factor in MAKER.beginning(sighting, L(i)).values()
    )
    alone = [
        sum(factor.error(values) for sighting in each.sightings for factor in MAKER.measured(sighting, L(i)).values())
        for each, i in zip(watches, WEIGHED, strict=True)
    ]
    for weights in ([1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 0.3, 0.02], [0.5, 0.25, 0.0, 0.9]):
        expected = said_once + np.maximum(weights, LEAST_WEIGHT) @ alone
        assert weighed.graph(np.array(weights)).error(values) == pytest.approx(expected, rel=1e-9)
    made = gtsam.NonlinearFactorGraph(rest)
    for each, i in zip(watches, WEIGHED, strict=True):
        for sighting in each.sightings:
            is_first = sighting in (watches[2].sightings[0], watches[3].sightings[0])
            for factor in MAKER.make(sighting, L(i), is_first=is_first).values():
                made.push_back(factor)
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(made)
    as_made, with_ones = (g.linearize(values).hessian(ordering) for g in (made, weighed.graph(np.ones(4))))
    for theirs, ours in zip(as_made, with_ones, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)


C2 = 9.0


@pytest.mark.parametrize("seed", range(5))
def test_graduated_weights_are_gtsams_and_those_of_the_least_truncated_cost_of_all_subsets(seed: int) -> None:
    """A point on a line, measured twelve times with a sigma of 1, four of them far off."""
    rng, start, costs = np.random.default_rng(seed), values_of(L0=np.array([12.0, 0.0, 0.0])), {}
    z = np.concatenate([rng.standard_normal(8), 8.0 + 30.0 * rng.random(4)])

    def graph(weights) -> gtsam.NonlinearFactorGraph:
        sigmas = 1.0 / np.sqrt(np.maximum(weights, 1e-12))
        return graph_of(point_prior(L(0), [at, 0.0, 0.0], sigma) for at, sigma in zip(z, sigmas, strict=True))

    def squared(values: gtsam.Values):
        return (values.atPoint3(L(0))[0] - z) ** 2

    values, weights = graduated_weights(graph, squared, np.full(len(z), C2), start)
    found = values.atPoint3(L(0))[0]
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    theirs = gtsam.GncLMOptimizer(graph(np.ones(len(z))), start, params)
    theirs.setInlierCostThresholds(C2 / 2)
    assert found == pytest.approx(theirs.optimize().atPoint3(L(0))[0], abs=1e-3)
    np.testing.assert_allclose(weights, theirs.getWeights(), atol=1e-2)
    for kept in product([False, True], repeat=len(z)):
        inside = z[list(kept)]
        if len(inside):
            costs[kept] = ((inside - inside.mean()) ** 2).sum() + C2 * (len(z) - len(inside))
    assert tuple((weights > 0.5).tolist()) == min(costs, key=costs.__getitem__)
    assert abs(np.mean(z) - found) > 3.0, "without weights the answer would be another one"
