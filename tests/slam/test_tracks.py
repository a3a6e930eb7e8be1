"""When a track's row decides, and when a track is over."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from sonar_graph.measurements import LandmarkDetections
from sonar_graph.slam.landmarks.sighting import Sighting
from sonar_graph.slam.landmarks.tracked import NO_LANDMARK, NS_PER_S, UNDECIDED, ObjectTracks, decide
from sonar_graph.slam.smoother.batch_solution import Sightline

LEAST = 0.75
WAIT_S = 2.0


def frame(*beliefs: list[float]) -> LandmarkDetections:
    """Of landmarks 4 and 7."""
    n = len(beliefs)
    return LandmarkDetections(
        np.zeros(n, dtype=int),
        np.ones(n),
        np.zeros(n),
        np.full((n, 2, 2), np.nan),
        np.tile([4, 7], (n, 1)),
        np.array(beliefs),
    )


@pytest.mark.parametrize(
    ("belief", "decided"),
    [
        ([0.75, 0.0], 4),  # binary fractions: exactly as much as is asked
        ([0.0, 0.75], 7),
        ([0.5, 0.25], UNDECIDED),
        ([0.125, 0.125], NO_LANDMARK),
        ([0.125, 0.1875], UNDECIDED),
        ([np.nextafter(0.75, 0.0), 0.0], UNDECIDED),
        ([0.0, 0.0], NO_LANDMARK),
    ],
)
def test_what_reaches_the_least_probability_is_decided(belief: list[float], decided: int) -> None:
    assert decide(frame(belief, [1.0, 0.0]), LEAST) == [decided, 4]


def sighting(stamp_ns: int) -> Sighting:
    return Sighting(stamp_ns, 0, Sightline(X(0), gtsam.Pose3(), np.array([2.0, 0.0])), np.eye(2), None)


@pytest.mark.parametrize(("late_ns", "is_over"), [(-1, False), (0, False), (1, True)])
def test_a_track_is_over_and_its_sightings_forgotten_after_the_longest_wait_and_not_at_it(
    late_ns: int, is_over: bool
) -> None:
    tracks, seen_ns = ObjectTracks(WAIT_S), 5 * NS_PER_S
    before, waiting = sighting(seen_ns - 2), sighting(seen_ns)
    tracks.seen(3, seen_ns).waiting += [before, waiting]
    tracks.seen(8, seen_ns + NS_PER_S)
    forgotten = tracks.forget(seen_ns + round(WAIT_S * NS_PER_S) + late_ns)
    assert forgotten == [(s, UNDECIDED) for s in ([before, waiting] if is_over else [before])]
    assert len(tracks) == (1 if is_over else 2)
