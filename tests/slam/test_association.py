"""Identities that are accepted, decided and weighed, and pairings that trying all of them finds."""

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, multivariate_normal

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.models import ACCEPTED, identify
from sonar_graph.slam.landmarks.tracked import NO_LANDMARK, UNDECIDED, decide
from sonar_graph.slam.landmarks.unknown import (
    UNPAIRED,
    Innovations,
    Pairing,
    drop_unlikely,
    pair_jointly,
)
from sonar_graph.states import OUTCOME_NUMBERS, Outcome

from .made import detected


def stated(
    stamps_ns: list[int], ids: list, probabilities: list[list[float]]
) -> LandmarkDetections:
    return detected(stamps_ns, np.ones((len(stamps_ns), 2)), ids, probabilities)


REPEATED = Outcome.REPEATED
NO_IDENTITY = Outcome.NO_IDENTITY


@pytest.mark.parametrize(
    ("rows", "least", "ids", "refusals"),
    [
        (
            ([0, 1, 2], [3, 7], [[0.2, 0.8], [0.5, 0.1], [0.49, 0.48]]),
            0.5,
            [7, 3, 3],
            [None, None, NO_IDENTITY],
        ),
        (
            ([0, 1], [[-1, 2], [4, -1]], [[0.9, 0.1], [0.0, 0.0]]),
            0.0,
            [-1, 4],
            [NO_IDENTITY, None],
        ),
        (
            ([0, 0, 0, 1], [7], [[0.8], [0.9], [0.9], [0.8]]),
            0.5,
            [7] * 4,
            [REPEATED, None, REPEATED, None],
        ),
    ],
    ids=[
        "from the threshold on",
        "however low the threshold",
        "once a frame, of equals the first",
    ],
)
def test_the_most_probable_identity_is_accepted(rows, least, ids, refusals):
    found, outcomes = identify(stated(*rows), least)
    assert found.tolist() == ids
    assert outcomes.tolist() == [
        ACCEPTED if why is None else OUTCOME_NUMBERS[why] for why in refusals
    ]


@pytest.mark.parametrize(
    ("belief", "decided"),
    [
        ([0.75, 0.0], 4),  # binary fractions: exactly at the threshold
        ([0.0, 0.75], 7),
        ([0.5, 0.25], UNDECIDED),
        ([0.125, 0.125], NO_LANDMARK),
        ([0.125, 0.1875], UNDECIDED),
        ([np.nextafter(0.75, 0.0), 0.0], UNDECIDED),
        ([0.0, 0.0], NO_LANDMARK),
    ],
)
def test_what_reaches_the_least_probability_is_decided(belief, decided):
    assert decide(stated([0, 0], [4, 7], [belief, [1.0, 0.0]]), 0.75) == [decided, 4]


PROBABILITY = 0.95


def random_case(seed: int, m: int, n: int, spread: float) -> Innovations:
    """Landmarks seen by one vehicle whose error they share, some so near that many pairings are possible."""
    rng = np.random.default_rng(seed)
    expected = spread * rng.standard_normal((n, 2))
    shared = rng.standard_normal((2 * n, 3))
    own = 0.2 * rng.standard_normal((2 * n, 2 * n))
    cov = shared @ shared.T + own @ own.T
    noise = np.array(
        [
            0.1 * (root := rng.standard_normal((2, 2))) @ root.T + 0.05 * np.eye(2)
            for _ in range(m)
        ]
    )
    error = rng.multivariate_normal(np.zeros(2 * n), cov).reshape(n, 2)
    seen = rng.permutation(
        np.concatenate([expected + error, spread * rng.standard_normal((m, 2))])
    )[:m]
    return Innovations(seen[:, None] - expected[None], cov, noise)


def distance(case: Innovations, landmarks: tuple[int, ...]) -> tuple[int, float]:
    """Number of pairs and D², of the whole covariance at once."""
    pairs = [(i, j) for i, j in enumerate(landmarks) if j != UNPAIRED]
    if not pairs:
        return 0, 0.0
    e = np.concatenate([case.innovation[i, j] for i, j in pairs])
    C = np.zeros((2 * len(pairs), 2 * len(pairs)))
    for a, (i, j) in enumerate(pairs):
        for b, (_, k) in enumerate(pairs):
            block = case.expected_cov[2 * j : 2 * j + 2, 2 * k : 2 * k + 2]
            C[2 * a : 2 * a + 2, 2 * b : 2 * b + 2] = block + (
                case.noise[i] if a == b else 0.0
            )
    return len(pairs), float(e @ np.linalg.inv(C) @ e)


def all_pairings(m: int, n: int) -> list[tuple[int, ...]]:
    """Every pairing in which no landmark occurs twice."""
    every = product(range(UNPAIRED, n), repeat=m)
    return [
        p
        for p in every
        if len({j for j in p if j != UNPAIRED}) == sum(j != UNPAIRED for j in p)
    ]


def brute_force(case: Innovations) -> tuple[int, float, tuple[int, ...]]:
    """The largest compatible pairing of pairs that are compatible alone, the nearest of equals."""
    m, n = case.innovation.shape[:2]

    def is_compatible(landmarks: tuple[int, ...]) -> bool:
        size, squared = distance(case, landmarks)
        return size == 0 or squared <= chi2.ppf(PROBABILITY, 2 * size)

    found = []
    for landmarks in all_pairings(m, n):
        alone = [
            tuple(j if i == k else UNPAIRED for i in range(m))
            for k, j in enumerate(landmarks)
        ]
        if all(map(is_compatible, alone)) and is_compatible(landmarks):
            size, squared = distance(case, landmarks)
            found.append((size, -squared, landmarks))
    size, squared, landmarks = max(found)
    return size, -squared, landmarks


@example(
    seed=928, m=3, n=3, spread=1.5
)  # two pairs beyond their gate, and the third finds its landmark taken
@example(seed=15, m=3, n=3, spread=1.5)  # two pairs beyond their gate, three inside
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    m=st.integers(1, 4),
    n=st.integers(1, 4),
    spread=st.sampled_from([0.5, 1.5, 4.0]),
)
def test_the_pairing_is_that_of_trying_all(seed, m, n, spread):
    case = random_case(seed, m, n, spread)
    found = pair_jointly(case, PROBABILITY)
    size, squared, landmarks = brute_force(case)
    assert found.size == size
    assert found.distance == pytest.approx(squared, rel=1e-6, abs=1e-9)
    assert found.landmarks == landmarks


def test_two_that_share_a_wide_error_support_each_other():
    """A metre apart, seen by a vehicle that is off by nearly that metre.

    One alone has no weight beside a rival of 0.2 a unit; two at the right distance from each other do.
    Each given the other is denser than a rival of 3 a unit; where both are together is not.
    """
    rival = np.log(np.full(2, 0.2))
    expected = np.array([[0.0, 0.0], [1.0, 0.0]])
    z = expected + np.array([0.8, 0.0])
    shared = np.kron(np.ones((2, 2)), np.eye(2))
    noise = np.tile(0.01 * np.eye(2), (2, 1, 1))
    case = Innovations(z[:, None] - expected[None], shared + 1e-4 * np.eye(4), noise)
    both = Pairing((0, 1), 0.0)
    assert drop_unlikely(case, both, rival).landmarks == (0, 1)
    assert drop_unlikely(case, Pairing((0, UNPAIRED), 0.0), rival).size == 0
    e, C = case.of(both.landmarks)
    together = multivariate_normal.logpdf(e, cov=C)
    given_the_other = together - multivariate_normal.logpdf(e[2:], cov=C[2:, 2:])
    assert given_the_other > np.log(3.0) > together / 2
    assert drop_unlikely(case, both, np.log(np.full(2, 3.0))).size == 0
