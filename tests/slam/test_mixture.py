"""Components of the mixture: densities by scipy, kernels by integration and by GTSAM, choices by trying all."""

from itertools import product

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from scipy.integrate import trapezoid
from scipy.stats import multivariate_normal

from sonar_graph.measurements import Floats
from sonar_graph.slam import GaussianKernel, RobustKernel
from sonar_graph.slam.landmarks import mixture
from sonar_graph.slam.landmarks.mixture import (
    REPEATED_LOSS,
    IdentityPosterior,
    Mixture,
    RecogniserErrors,
    TrackedObject,
)
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.smoother import Sightline

from .made import polar, values_of

ERRORS = RecogniserErrors()
LOG_U = -np.log(20.0)
MIXTURE = Mixture(ERRORS, GaussianKernel())
KERNELS = [GaussianKernel(), RobustKernel(shape="huber", width=1.3), RobustKernel()]
NAMES = [kernel.shape for kernel in KERNELS]
MOUNTED = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.4, 0.2), np.array([0.3, 0.1, -0.1]))
R = np.array([[4e-4, 1.2e-4], [1.2e-4, 1e-4]])
PLACES = {
    7: np.array([3.0, 0.5, -1.0]),
    4: np.array([3.2, 1.4, -1.1]),
    9: np.array([2.6, -0.6, -0.9]),
}


def world() -> gtsam.Values:
    poses = [
        gtsam.Pose3(
            gtsam.Rot3.Ypr(3 + 0.1 * k, 0.05, -0.03), np.array([6, 1, -0.2 * k])
        )
        for k in range(6)
    ]
    named = {f"X{k}": pose for k, pose in enumerate(poses)} | {
        f"L{i}": place for i, place in PLACES.items()
    }
    return values_of(**named)


def shown(values: gtsam.Values, k: int, point: Floats) -> Floats:
    """Range and azimuth of a point from pose k."""
    return polar(values.atPose3(X(k)).compose(MOUNTED), point)


def wrapped(e: Floats) -> Floats:
    return np.array([e[0], (e[1] + np.pi) % (2 * np.pi) - np.pi])


def watch(
    values: gtsam.Values,
    point: Floats,
    frames: list[int],
    off: Floats,
    said: dict[int, float],
) -> TrackedObject:
    """Something seen in some frames, off by this, shape (n, 2), in standard deviations."""
    noise = np.linalg.cholesky(R)
    return TrackedObject(
        IdentityPosterior(said),
        [
            Sighting(
                k,
                k,
                Sightline(X(k), MOUNTED, shown(values, k, point) + noise @ e),
                R,
                None,
            )
            for k, e in zip(frames, off, strict=True)
        ],
    )


def log_density(values: gtsam.Values, seen: TrackedObject, point: Floats) -> float:
    """Of all sightings of a watch, were they of something at a point."""
    at = [(s.line.z, shown(values, s.stamp_ns, point)) for s in seen.sightings]
    return sum(
        float(multivariate_normal.logpdf(wrapped(z - h), np.zeros(2), R)) for z, h in at
    )


def log_weights(said: dict[int, float], i: int, count: int = 20) -> tuple[float, float]:
    """Of a landmark and of none, q = 0.05."""
    none = 0.95 * (1.0 - sum(said.values())) + 0.025
    return np.log(0.95 * said.get(i, 0.0) + 0.025 / count), np.log(none)


def of_nothing(seen: TrackedObject) -> float:
    """Log density of a watch of something whose place is not known."""
    peak = float(multivariate_normal.logpdf(np.zeros(2), np.zeros(2), R))
    return LOG_U + (len(seen.sightings) - 1) * max(LOG_U, peak - REPEATED_LOSS)


@pytest.mark.parametrize("kernel", KERNELS, ids=NAMES)
def test_a_kernels_density_integrates_to_one(kernel):
    e = np.sinh(np.linspace(-18.0, 18.0, 400_001))  # as far as Cauchy's tails matter
    assert trapezoid(
        np.exp(kernel.log_normaliser - kernel.loss(e)), e
    ) == pytest.approx(1.0, abs=1e-6)


def test_a_new_detections_components_are_predictive_densities():
    """Of three landmarks, one of them across the cut of the azimuth; of one that is not in the graph, and of none."""
    rng = np.random.default_rng(2)
    A = rng.standard_normal((3, 2, 2))
    S = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(2)
    z = np.array([3.0, 3.1])
    expected = np.array([[3.2, 3.0], [2.0, -3.1], [3.5, 2.0]])
    said = {4: 0.6, 5: 0.3}
    found = MIXTURE.at_first(IdentityPosterior(said), [7, 4, 9], z, expected, S)
    for k, i in enumerate((7, 4, 9)):
        density = multivariate_normal.logpdf(
            wrapped(z - expected[k]), np.zeros(2), S[k]
        )
        assert found[i] == pytest.approx(density + log_weights(said, i)[0])
    assert found[5] == pytest.approx(LOG_U + log_weights(said, 5)[0])
    assert found[None] == pytest.approx(LOG_U + log_weights(said, 5)[1])
    assert found.keys() == {7, 4, 9, 5, None}


@pytest.mark.parametrize("seed", range(4))
def test_the_best_choices_are_the_most_probable_of_all(seed):
    """Five watches of three landmarks or of something else, half of them misnamed, two of them in the same frames."""
    values = world()
    rng = np.random.default_rng(seed)
    watches = []
    for frames in ([0, 1], [0, 1], [2], [3], [4, 5]):
        place = [*PLACES.values(), np.array([3.5, 0.9, -1.0])][int(rng.integers(4))]
        said = {int(rng.choice(list(PLACES))): float(rng.choice([0.4, 0.9]))}
        watches.append(
            watch(values, place, frames, rng.standard_normal((len(frames), 2)), said)
        )
    found = MIXTURE.best(watches, values, [None] * 5, dict.fromkeys(PLACES, 9))
    table: list[dict[int | None, float]] = []
    for seen in watches:
        weights = {i: log_weights(seen.posterior.probability, i) for i in PLACES}
        placed = {
            i: named + log_density(values, seen, PLACES[i])
            for i, (named, _) in weights.items()
        }
        table.append(placed | {None: weights[7][1] + of_nothing(seen)})
    total = {}
    for choices in product([*PLACES, None], repeat=5):
        frames = [
            (i, k)
            for seen, i in zip(watches, choices, strict=True)
            if i is not None
            for k in seen.stamps_ns
        ]
        if len(set(frames)) == len(frames):  # no landmark is twice in a frame
            total[choices] = sum(row[i] for row, i in zip(table, choices, strict=True))
    best, second = sorted(total, key=total.__getitem__, reverse=True)[:2]
    assert tuple(found) == best
    assert total[best] > total[second] + 1e-3


SAID = {7: 0.9}
HERE = PLACES[7]
THERE = PLACES[7] + np.array([0.0, 0.4, 0.0])


def vote(watches: list[TrackedObject], point: Floats) -> float:
    values = world()
    weight, none = log_weights(SAID, 7)
    gains = (
        weight + log_density(values, w, point) - none - of_nothing(w) for w in watches
    )
    return sum(max(gain, 0.0) for gain in gains)


@pytest.mark.parametrize(
    ("here", "there"), [(6, 2), (6, 5), (4, 4), (2, 6), (1, 3), (0, 2)]
)
@pytest.mark.parametrize("strays", [0, 1, 3])
def test_the_place_with_most_votes_wins_whatever_lies_far_off(here, there, strays):
    """What fits nowhere has no voice, however far off it is; summed errors would be drawn to it."""
    values = world()
    far = [HERE + np.array([0.0, 1.2 + 0.5 * k, 0.0]) for k in range(strays)]
    rng = np.random.default_rng(3)
    points = [HERE] * here + [THERE] * there + far
    watches = [
        watch(values, point, [0], 0.3 * rng.standard_normal((1, 2)), SAID)
        for point in points
    ]
    elsewhere = [seen.sightings[0].line.point(values) for seen in watches[here:]]
    best = max(elsewhere, key=lambda p: vote(watches, p))
    is_moved = bool(vote(watches, best) >= vote(watches, HERE) + mixture.LEAST_MARGIN)
    choices = [7] * here + [None] * (len(watches) - here)
    supporters = mixture.supporters_elsewhere(7, watches, choices, values, MIXTURE)
    assert (supporters is not None) is is_moved is (there > here)
    if supporters is not None:
        assert supporters == watches[here : here + there]
