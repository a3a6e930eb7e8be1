"""Where those that name a landmark agree that it is: the vote by scipy's densities, each voice for or none."""

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.measurements import Floats
from sonar_graph.slam.landmarks.mixture import LEAST_MARGIN, TrackedObject, supporters_elsewhere

from .test_mixture import MIXTURE, PLACES, log_density, log_weights, of_nothing, watch, world

SAID = {7: 0.9}
HERE, THERE = PLACES[7], PLACES[7] + np.array([0.0, 0.4, 0.0])


def named(points: list[Floats], seed: int = 3) -> list[TrackedObject]:
    values, rng = world(), np.random.default_rng(seed)
    return [watch(values, p, [0], 0.3 * rng.standard_normal((1, 2)), SAID) for p in points]


def found_for(watches: list[TrackedObject], here: int) -> list[TrackedObject] | None:
    """Landmark 7 is where the first of them have it."""
    values = world()
    values.update(L(7), HERE)
    return supporters_elsewhere(7, watches, [7] * here + [None] * (len(watches) - here), values, MIXTURE)


def on_plane(values, seen: TrackedObject) -> Floats:
    """Where a watch of one sighting has the landmark, at elevation 0: the same for all of one pose."""
    return seen.sightings[0].line.point(values)


def vote(watches: list[TrackedObject], point: Floats) -> float:
    values, (weight, none) = world(), log_weights(SAID, 7)
    gains = (weight + log_density(values, w, point) - none - of_nothing(w) for w in watches)
    return sum(max(gain, 0.0) for gain in gains)


@pytest.mark.parametrize(("here", "there"), [(6, 2), (6, 5), (4, 4), (2, 6), (1, 3), (0, 2)])
@pytest.mark.parametrize("strays", [0, 1, 3])
def test_the_place_with_most_votes_wins_whatever_lies_far_off(here: int, there: int, strays: int) -> None:
    """What fits nowhere has no voice, however far off it is; summed errors would be drawn to it."""
    values = world()
    far = [HERE + np.array([0.0, 1.2 + 0.5 * k, 0.0]) for k in range(strays)]
    watches = named([HERE] * here + [THERE] * there + far)
    elsewhere = [on_plane(values, w) for w in watches[here:]]
    best = max(elsewhere, key=lambda p: vote(watches, p))
    is_moved = bool(vote(watches, best) >= vote(watches, HERE) + LEAST_MARGIN)
    supporters = found_for(watches, here)
    assert (supporters is not None) is is_moved is (there > here)
    if supporters is not None:
        assert supporters == watches[here : here + there]


def test_one_alone_moves_nothing() -> None:
    assert found_for(named([THERE]), 0) is None
    assert found_for(named([THERE] * 2), 0) is not None
