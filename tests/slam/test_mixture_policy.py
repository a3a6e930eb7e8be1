"""Max-mixture in the window: a fixed point that another solver finds, and choices that follow the estimate."""

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.models import Kernel
from sonar_graph.slam import (
    GaussianKernel,
    MixtureIdentity,
    RobustIdentity,
    RobustKernel,
)
from sonar_graph.slam.landmarks import mixture_policy as doubtful_identities
from sonar_graph.states import Outcome

from .dive import CALIBRATION, FLOOR, T0_NS, Dive, spherical

PLACES = {
    7: np.array([2.6, 0.5, -1.0]),
    4: np.array([2.9, 1.4, -1.0]),
    9: np.array([3.2, 0.1, -1.0]),
}
"""Of landmarks, in the world of `Dive`: on the floor, within its sonar's fan."""
GAUSSIAN = GaussianKernel()


def dive(policy: str, kernel: Kernel = GAUSSIAN) -> Dive:
    identity = RobustIdentity() if policy == "robust" else MixtureIdentity()
    return Dive(CALIBRATION.model_copy(update={"floor": FLOOR}), identity, kernel)


def watch(
    world: Dive,
    after_s: float,
    said: dict[int, int],
    rng: np.random.Generator,
    track: int = -1,
    surely: float = 1.0,
) -> None:
    """A frame with the landmarks that are the keys, each named by its value."""
    z = [
        spherical(0.5 * after_s, PLACES[i]) + [0.02, 0.01] * rng.standard_normal(2)
        for i in said
    ]
    show(world, after_s, z, list(said.values()), [track] * len(z), surely)


def show(
    world: Dive,
    after_s: float,
    z,
    named: list[int],
    tracks: list[int],
    surely: float = 1.0,
) -> None:
    world.show(
        T0_NS + round(after_s * 1e9), z, np.array(named)[:, None], [surely], tracks
    )


def misnamed(
    policy: str, kernel: Kernel = GAUSSIAN, share: float = 0.25
) -> tuple[Dive, list[int]]:
    """Thirty frames in which a share of the names, not of the first two frames, is wrong; the true ones in order."""
    world = dive(policy, kernel)
    rng = np.random.default_rng(5)
    truth = []
    for k in range(30):
        named = {i: i for i in PLACES}
        if k > 1 and rng.random() < 3 * share:
            wrong = int(rng.choice(list(PLACES)))
            others = [i for i in PLACES if i != wrong]
            named = {wrong: int(rng.choice(others))} | {i: i for i in others}
        watch(world, 0.1 * (k + 1), named, rng)
        truth += list(named)
    return world, truth


def worst_landmark_m(world: Dive) -> float:
    values = world.sightings.smoothed().values
    return max(
        float(np.linalg.norm(values.atPoint3(L(i)) - p)) for i, p in PLACES.items()
    )


@pytest.mark.parametrize("kernel", [GaussianKernel(), RobustKernel()])
def test_wrong_names_cost_nothing_and_accepting_them_does(kernel):
    right_m = worst_landmark_m(misnamed("robust", share=0.0)[0])
    assert worst_landmark_m(misnamed("max-mixture", kernel)[0]) < right_m + 0.02
    assert worst_landmark_m(misnamed("robust")[0]) > right_m + 0.1


@pytest.mark.parametrize("can_move", [True, False])
def test_a_landmark_that_begins_in_a_wrong_place_is_moved(can_move, monkeypatch):
    if not can_move:
        monkeypatch.setattr(
            doubtful_identities, "supporters_elsewhere", lambda *_: None
        )
    world = dive("max-mixture")
    rng = np.random.default_rng(2)
    watch(world, 0.3, {4: 7}, rng)
    for k in range(2, 8):
        watch(world, 0.3 * k, {7: 7}, rng)
    values, _ = world.smoother.solve_history()
    off_m = float(np.linalg.norm(values.atPoint3(L(7)) - PLACES[7]))
    assert (off_m < 0.1) is can_move
    assert world.outcomes.count(Outcome.UNFIT) == (1 if can_move else 6)


def test_a_misnamed_landmark_gets_its_name_with_all_sightings():
    """A landmark 4 that nothing else was seen of becomes 9 when its track is named so."""
    world = dive("max-mixture")
    rng = np.random.default_rng(2)
    for k in range(1, 4):
        watch(world, 0.3 * k, {7: 7}, rng)
    for k, name in enumerate([4, 4, 4, 9, 9], start=4):
        watch(world, 0.3 * k, {9: name}, rng, track=2)
    assert world.sightings.landmarks.ids == [7, 9]
    assert len(world.sightings.landmarks.sightings(9)) == 5
    values = world.sightings.smoothed().values
    assert np.linalg.norm(values.atPoint3(L(9)) - PLACES[9]) < 0.1
