"""Another solution of the history: what it costs, and when it is taken."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.slam import rival_history
from sonar_graph.slam.rival_history import RivalHistory

from .dive import Dive
from .test_doubtful_identities import PLACES, dive, doubting, misnamed, watch


def rival_of(world: Dive) -> RivalHistory:
    doubtful = world.sightings._doubtful
    handles = {handle for w in doubtful.watches for s in w.sightings for handle in s.handles}
    return RivalHistory(
        world.smoother.graph_without(handles), doubtful.watches, doubtful._mixture, doubtful._landmarks.maker
    )


@pytest.mark.parametrize("move_m", [[0.05, 0.0, 0.0], [0.0, -0.05, 0.0], [0.0, 0.0, 0.05]])
def test_the_cost_rises_as_the_error_of_the_graph_does(move_m: list[float]) -> None:
    """As long as choices stay; a landmark that leaves its floor pays for that too."""
    world, _ = misnamed(doubting())
    rival, chosen = rival_of(world), world.sightings._doubtful.history()
    graph, moved = rival._chosen_graph(chosen.choices), gtsam.Values(chosen.values)
    moved.update(L(7), chosen.values.atPoint3(L(7)) + move_m)
    rise = graph.error(moved) - graph.error(chosen.values)
    assert rise > 10.0
    found = rival.cost(moved, chosen.choices) - rival.cost(chosen.values, chosen.choices)
    assert found == pytest.approx(rise, rel=0.05)  # the camera shrinks azimuths at an elevation


def test_the_cheaper_of_both_solutions_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that stands has taken all sightings of landmark 9 for no landmark; the other knows better, or worse."""
    world, rng = dive(doubting()), np.random.default_rng(3)
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
