"""Asking for results changes nothing, whatever iSAM2 makes of wrong, missing and late identities."""

from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pytest
from gtsam.symbol_shorthand import L

from sonar_graph.slam import Isam2
from sonar_graph.states import Outcome
from sonar_graph.testing import laws
from sonar_graph.testing.drives import misnamed_world, small_world
from sonar_graph.testing.laws import run, unlike

from .made import isam2_params

LAG_S = 3.0
"""Much less than the worlds last: what is wrong leaves the window before it is known to be."""
QUICK = {
    ("max-mixture", "whole", "ignore"),
    ("gnc", "whole", "ignore"),
    ("robust", "bounded", "associate"),
    ("robust", "whole", "ignore"),
}
IN_THE_GRAPH = {Outcome.NEW, Outcome.USED, Outcome.USED_LATER, Outcome.REASSIGNED}
BELIEVING = product(("gate", "robust"), ("whole", "bounded"), ("ignore", "associate"))
DOUBTING = product(("max-mixture", "gnc"), ("whole",), ("ignore",))


def settings(policy: str, history: str, unknown_landmarks: str) -> Any:
    return isam2_params(
        identity__policy=policy,
        history__policy=history,
        identity__unknown__policy=unknown_landmarks,
        smoother__lag_s=LAG_S,
    )


@pytest.mark.parametrize(
    "chosen",
    [
        pytest.param(chosen, id="-".join(chosen), marks=[] if chosen in QUICK else pytest.mark.slow)
        for chosen in (*BELIEVING, *DOUBTING)
    ],
)
def test_asking_changes_nothing(chosen: tuple[str, str, str]) -> None:
    laws.asking_changes_nothing(partial(Isam2, params=settings(*chosen)))


def test_landmarks_list_and_covariances_are_of_one_choice() -> None:
    world = misnamed_world()
    estimator = Isam2(world.calibration, settings("max-mixture", "whole", "ignore"))
    differing = []
    for step in world.replay(world.instants(1.0)):
        estimator.process(step)
        found, log = estimator.landmarks(), estimator.detections()
        used = [i for i, said in zip(log.landmark_ids.tolist(), log.outcomes, strict=True) if said in IN_THE_GRAPH]
        assert set(used) == set(found.ids.tolist())
        for landmark_id, cov in zip(found.ids.tolist(), found.covariances, strict=True):
            np.testing.assert_array_equal(estimator.marginal(landmark=landmark_id, over="history"), cov)
        window = [estimator.values.atPoint3(L(i)) for i in found.ids.tolist() if estimator.values.exists(L(i))]
        if len(window) == len(found) > 0:
            differing.append(not np.allclose(window, found.positions, atol=0.1))
    assert any(differing), "else it is not seen which is asked"


def test_answers_that_differ_in_one_bit_are_unlike() -> None:
    one, other = (run(partial(Isam2, params=isam2_params()), small_world()) for _ in range(2))
    assert unlike(one, other) == []
    other.trajectory.positions[3, 1] += 1e-15
    other.landmarks.covariances[0, 0, 0] *= 1 + 1e-15
    other.detections.outcomes[0] = other.detections.outcomes[-1]
    assert unlike(one, other) == ["trajectory()", "landmarks()", "detections()"]
    del other.estimates[-1]
    assert "causal estimates" in unlike(one, other)
