"""Another solution of the history: what it costs, and when it is taken."""

from itertools import product

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import multivariate_normal

from sonar_graph.calibration import FloorPrior, SonarCalibration
from sonar_graph.slam import KeyframeParams, MixtureIdentity
from sonar_graph.slam.landmarks import mixture_history as rival_history
from sonar_graph.slam.landmarks.mixture import Choices, TrackedObject
from sonar_graph.slam.landmarks.mixture_history import RivalHistory
from sonar_graph.slam.landmarks.sighting import SightingFactors

from . import dive as dive_module
from . import test_mixture as small
from .dive import CALIBRATION, FLOOR, Dive, spherical
from .test_doubtful_identities import PLACES, dive, misnamed, show, watch


def rival_of(world: Dive) -> RivalHistory:
    doubtful = world.sightings._doubtful
    handles = {handle for w in doubtful.watches for s in w.sightings for handle in s.handles}
    return RivalHistory(
        world.smoother.graph_without(handles), doubtful.watches, doubtful._mixture, doubtful._landmarks.maker
    )


@pytest.mark.parametrize("move_m", [[0.05, 0.0, 0.0], [0.0, -0.05, 0.0], [0.0, 0.0, 0.05]])
def test_the_cost_rises_as_the_error_of_the_graph_does(move_m: list[float]) -> None:
    """As long as choices stay; a landmark that leaves its floor pays for that too."""
    world, _ = misnamed("max-mixture")
    rival, chosen = rival_of(world), world.sightings._doubtful.history()
    graph, moved = rival._chosen_graph(chosen.choices), gtsam.Values(chosen.values)
    moved.update(L(7), chosen.values.atPoint3(L(7)) + move_m)
    rise = graph.error(moved) - graph.error(chosen.values)
    assert rise > 10.0
    found = rival.cost(moved, chosen.choices) - rival.cost(chosen.values, chosen.choices)
    assert found == pytest.approx(rise, rel=0.05)  # the camera shrinks azimuths at an elevation


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
MAKER = SightingFactors(SonarCalibration(elevation_aperture_rad=0.3), lambda noise: noise)


def named(k: int, place: int, said: int, values: gtsam.Values) -> TrackedObject:
    """One sighting from pose k of landmark 7 or 4, surely named."""
    found = small.watch(values, small.PLACES[place], [k], np.zeros((1, 2)), {said: 0.9})
    found.sightings[0].floor = FloorPrior(z_m=float(small.PLACES[place][2]), sigma_m=0.05)
    return found


def small_rival(watches: list[TrackedObject]) -> tuple[RivalHistory, gtsam.Values]:
    """Poses that are known to a centimetre, and no landmark yet."""
    rest, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(6):
        pose = small.world().atPose3(X(k))
        values.insert(X(k), pose)
        rest.push_back(gtsam.PriorFactorPose3(X(k), pose, gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
    return RivalHistory(rest, watches, small.MIXTURE, MAKER), values


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
    rival, start = small_rival(watches)
    values, choices = rival.settled(start, [None] * 6, is_graduated=False)
    assert choices == places
    assert rival.cost(values, choices) == pytest.approx(cost_of(rival, values, choices), abs=0.05)
    others = [list(c) for c in product(IDS, repeat=6) if list(c) != places]
    rng = np.random.default_rng(0)
    for other in [others[k] for k in rng.choice(len(others), 60, replace=False)]:
        assert cost_of(rival, rival._solve(start, other), other) > cost_of(rival, values, choices) + 1.0


def test_a_landmark_that_began_with_another_thing_is_moved_beside_the_run_too() -> None:
    """The first that was said to be 7 is of 4, and has put it there; no later one fits."""
    values = small.world()
    watches = [named(0, 4, 7, values), *(named(k, 7, 7, values) for k in range(1, 5))]
    rival, start = small_rival(watches)
    began = [7, None, None, None, None]
    start = rival._solve(start, began)
    assert np.linalg.norm(start.atPoint3(L(7)) - small.PLACES[4]) < 0.1
    found, choices = rival.settled(start, began, is_graduated=False)
    assert choices == [None, 7, 7, 7, 7]
    assert np.linalg.norm(found.atPoint3(L(7)) - small.PLACES[7]) < 0.1


# What the window chooses wrongly --------------------------------------------------------------------------------------


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
