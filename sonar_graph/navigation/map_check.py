"""Check of a known map against the sightings of a log: other identities, axes, units and sigmas, another start.

Where not all landmarks agree with the best start (`map_start`), the map is tried with each mistake of `MISTAKES` undone. One
with which more landmarks agree, and most of them, is named, where its evidence (2) is `CLEAR` times as large, or only half
of the landmarks agree without it. A wrong sign of the heights may leave the
start where it is. It is named where the sonar's vertical aperture allows far more of the sightings with the other sign, for
which one landmark is enough, or where the evidence (2) of the best start is `CLEAR` times as large with it. Two exchanged
identities are named by the evidence of the map with that exchange undone: a priori each of the n (n - 1) / 2 exchanges is
equally probable.
"""

import math
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from sonar_graph.calibration import KnownMap
from sonar_graph.measurements import Floats, Measurements
from sonar_graph.navigation.map_start import (
    AGREES,
    MOST_OF_LANDMARK,
    ODDS,
    WATCHED_S,
    FoundStart,
    MapData,
    MapLocator,
    MapSighting,
    candidates,
    least_squares,
    located,
    map_data,
    moved_landmarks,
    newest_of_each,
    refined,
)
from sonar_graph.sequence import Sequence

CLEAR = 10.0 * ODDS
"""Ratio of evidences from which on a mistake is named: a map with one is a tenth as probable a priori."""
ENOUGH = 4
"""Number of landmarks that show an exchange of two identities. As long as fewer, or not all of a small map, were seen,
sightings count also after `WATCHED_S`, when the odometry has drifted."""
NEWEST_OF_EACH = 2
"""Number of sightings of each landmark in which an exchange is looked for."""
FEWEST_SIGHTINGS = 5
"""Number of sightings that tell the sign of the heights by the vertical aperture."""
WINDOW_S = 5.0
"""Time between two attempts to find the start."""
FEWEST = 3
"""Number of landmarks that must agree with a corrected map: two fit its mirror image too."""
Z_UP = np.diag([1.0, 1.0, -1.0])
SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
NEGATED = "z_m has the wrong sign; the world's z points up"
MIRRORED = (
    "it is a mirror image: x_m and y_m are swapped, or one of them has the wrong sign"
)
OTHER_ZERO = "its heights count from another zero than the depth"
NORTH_EAST_DOWN = "the axes are north, east, down; the world's z points up"
MISTAKES = {
    NEGATED: Z_UP,
    MIRRORED: SWAPPED,
    NORTH_EAST_DOWN: SWAPPED @ Z_UP,
    "it is in feet": 0.3048 * np.eye(3),
    "it is in centimetres": 0.01 * np.eye(3),
    "it is in millimetres": 0.001 * np.eye(3),
}
"""Mistake of a map, and the matrix that undoes it."""
OR_FORWARD = ", where x_m counts to the north; else negate y_m and z_m"
OTHER_REMEDIES = {
    MIRRORED: ", where they are swapped; else negate the one of the wrong sign",
    NORTH_EAST_DOWN: OR_FORWARD,
}
"""What else undoes a mistake: sightings leave the heading of the world open."""
MORE_SHOWN = 0.25
"""Share of the sightings that the vertical aperture allows only with the other sign of the heights."""
LEAST_SHOWN = 0.5
"""Share of the sightings that it allows with the right heights, at least: wrong identities and side lobes are fewer."""
RISES_M = (-2.0, -1.4, -1.0, -0.7, -0.5, -0.3, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Heights by which a tilted sonar shows that all landmarks are wrong; each is near enough to the ones between."""
SIGMA_FACTORS = (10.0, 100.0)
"""Factors by which sigmas of a map may be too small."""
WIDEST_M = 0.5
"""Sigma of landmarks up to which the second one is tried."""


class MapFit(NamedTuple):
    """Fit of the sightings to the map."""

    start: FoundStart | None
    """None where the sightings give no start."""
    mistake: str = ""
    """Mistake of the map; empty where none is known."""
    remedy: str = ""
    """Change of the map that undoes it."""
    is_checked: bool = True
    """False where fewer than `FEWEST` landmarks were seen, and nothing else shows a mistake."""
    elsewhere: tuple[int, ...] = ()
    """Identities of landmarks that stand elsewhere than in the map, seen from the start."""
    rise_m: float = 0.0
    """Height by which most landmarks are outside of the sonar's vertical aperture; 0 where they are not."""


def map_fit(sequence: Sequence) -> MapFit:
    """Fit of a log's first sightings to the map of its calibration."""
    known = sequence.calibration.map
    assert known is not None
    start = first_start(sequence, known)
    given = followed(sequence, known)
    negated = followed(sequence, undone(known, Z_UP))
    are_enough = len(given.sightings) >= FEWEST_SIGHTINGS
    is_hidden = are_enough and shown(negated) - shown(given) > MORE_SHOWN
    rise_m = 0.0
    if are_enough and shown(given) < LEAST_SHOWN:
        rise_m = float(np.median([sighting.rise_m for sighting in given.sightings]))
    is_checked = len(seen_rows(given)) >= FEWEST
    if not (is_checked or is_hidden):
        return MapFit(start, is_checked=False, rise_m=rise_m)
    gain = 0.0 if start is None else evidence(negated) - evidence(given)
    if is_hidden or gain > math.log(CLEAR):
        T = MISTAKES[NORTH_EAST_DOWN]
        # the same heights, and x and y exchanged: the other landmarks decide
        exchanged = followed(sequence, undone(known, T))
        if evidence(exchanged) - evidence(negated) > math.log(CLEAR):
            return MapFit(None, NORTH_EAST_DOWN, remedy_of(known, T) + OR_FORWARD)
        return MapFit(start, NEGATED, remedy_of(known, Z_UP))
    moved: list[int] = []
    elsewhere: tuple[int, ...] = ()
    is_misfit = start is None
    of_each = newest_of_each(given.sightings, MOST_OF_LANDMARK)
    if start is not None:
        data = map_data(of_each, known)
        # odometry has drifted since the first start
        start = refined(start.parameters, data) or start
        moved = moved_landmarks(start, data)
        surely = surely_elsewhere(start, moved, data)
        elsewhere = tuple(sorted(known.ids[row] for row in surely))
        is_misfit = bool(elsewhere) or misfits(start, data)
        if len(moved) >= len(start.agreeing):
            start = None
    # a sonar that is tilted shows landmarks elsewhere by their heights
    if is_misfit or rise_m:
        common_m = common_rise(sequence, given, (*RISES_M, rise_m))
        if common_m:
            return MapFit(start, OTHER_ZERO, f"add about {common_m:+.1f} m to each z_m")
    # of a map with other axes a few landmarks fit somewhere, and some of the others in pairs
    before = 0 if moved and start is None else agreeing(given)
    seen = len(seen_rows(given))
    is_doubted = 2 * before <= seen
    for mistake, T in MISTAKES.items() if before < seen else ():
        corrected = followed(sequence, undone(known, T))
        after = agreeing(corrected)
        if after <= before or 2 * after <= seen:
            continue
        gain = evidence(corrected) - evidence(given)
        # in another unit the map has another area, and wrong identities another density
        is_same_area = bool(np.isclose(abs(np.linalg.det(T)), 1.0))
        is_clear = is_same_area and math.isfinite(gain) and gain > math.log(CLEAR)
        if is_clear or (is_doubted and gives_start(sequence, corrected.map)):
            remedy = remedy_of(known, T) + OTHER_REMEDIES.get(mistake, "")
            return MapFit(None, mistake, remedy)
    swaps = exchanged_identities(given.sightings, known)
    if swaps:
        return MapFit(None, *of_swaps(swaps))
    if start is not None:
        gain = 0.0
        # beside landmarks that moved the others fit
        if elsewhere and misfits(start, data):
            looser = with_sigmas(known, SIGMA_FACTORS[0])
            gain = evidence(followed(sequence, looser)) - evidence(given)
        if rise_m or gain <= math.log(CLEAR):
            return MapFit(start, elsewhere=elsewhere, rise_m=rise_m)
    sigma_m = math.sqrt(np.median(np.diag(known.joint())))
    for factor in () if rise_m else SIGMA_FACTORS:
        # a map of another place fits too where its sigmas are metres
        is_wide = factor > SIGMA_FACTORS[0] and factor * sigma_m > WIDEST_M
        if not is_wide and gives_start(sequence, with_sigmas(known, factor)):
            remedy = f"give sigmas up to {factor:g} times as large"
            return MapFit(None, "its sigmas are too small", remedy)
    return MapFit(None, rise_m=rise_m)


def with_sigmas(known: KnownMap, factor: float) -> KnownMap:
    """The map with sigmas so many times as large."""
    joint = (factor**2 * known.joint()).tolist()
    return known.model_copy(update={"covariance_m2": joint})


def misfits(start: FoundStart, data: MapData) -> bool:
    """Check that the landmarks that agree with a start err more than stated, by three sigmas of a mean of chi-squares."""
    seen = data.rows[np.argmax(data.is_of, axis=1)]  # (l,)
    squared = squared_distances(start, np.isin(seen, [*start.agreeing]), data)
    return squared.mean() > 2.0 + 3.0 * 2.0 / math.sqrt(len(squared))


def starts(sequence: Sequence, known: KnownMap) -> Iterator[tuple[FoundStart, int]]:
    """Start at the end of each window that gives one, with the number of landmarks that were seen by then."""
    for locator in locators(sequence, known):
        newest = locator.newest()
        start = located(newest, known)
        if start is not None:
            yield start, len({sighting.row for sighting in newest})


def first_start(sequence: Sequence, known: KnownMap) -> FoundStart | None:
    """Start in the map; None where the sightings give none."""
    return next((start for start, _ in starts(sequence, known)), None)


def followed(sequence: Sequence, known: KnownMap) -> MapLocator:
    """The sightings of a map's landmarks in the part of the log that counts."""
    all_of_them = [*locators(sequence, known)]
    # one locator that takes in window after window
    return all_of_them[-1] if all_of_them else MapLocator(sequence.calibration)


def locators(sequence: Sequence, known: KnownMap) -> Iterator[MapLocator]:
    """The locator of a map after each window that shows its landmarks, in the part of the log that counts."""
    locator = MapLocator(sequence.calibration.model_copy(update={"map": known}))
    enough = min(ENOUGH, len(known.ids))
    for window in windows(sequence):
        is_late = window.end_ns - sequence.start_ns > WATCHED_S * 1e9
        if is_late and len(seen_rows(locator)) >= enough:
            return
        if any([*locator.frames_seen(window)]):
            yield locator


def surely_elsewhere(start: FoundStart, moved: list[int], data: MapData) -> list[int]:
    """Rows of the landmarks that moved, if the sightings err as much more than stated as those that agree do.

    The squared distances of n landmarks from where the others have them, two degrees of freedom each, have a mean of 2.
    On recordings of wheeled robots it is 4, and a right landmark can be 19 away.
    """
    seen = data.rows[np.argmax(data.is_of, axis=1)]  # (l,)
    agreeing = np.isin(seen, [*start.agreeing])
    squared = squared_distances(start, agreeing, data)
    limit = AGREES * max(1.0, 0.5 * float(np.mean(squared)))
    surely = []
    for row in moved:
        with_it = agreeing | (seen == row)
        place = int(np.flatnonzero(seen[with_it] == row)[0])
        if squared_distances(start, with_it, data)[place] > limit:
            surely.append(row)
    return surely


def squared_distances(start: FoundStart, fitted: Any, data: MapData) -> Floats:
    """Squared Mahalanobis distances of the landmarks that are fitted, shape (l,), from where the others have them."""
    fit = least_squares(start.parameters, data, fitted, ~fitted)
    return fit.squared if fit else np.zeros(np.count_nonzero(fitted))


def seen_rows(locator: MapLocator) -> set[int]:
    """Rows of the map's landmarks that were seen."""
    return {sighting.row for sighting in locator.sightings}


def exchanged_identities(
    sightings: list[MapSighting], known: KnownMap
) -> list[tuple[int, int]]:
    """Pairs of identities whose exchange makes the sightings fit the map; several where they fit as well, or none."""
    newest = newest_of_each(sightings, NEWEST_OF_EACH)
    seen = {sighting.row for sighting in newest}
    if len(seen) < ENOUGH:
        return []
    starts = candidates(map_data(newest, known))
    agreeing = starts[0].agreeing if starts else frozenset()
    # two that agree may be the exchanged ones, by a start that is turned round
    doubted = sorted(seen - agreeing if len(agreeing) >= FEWEST else seen)
    pairs = list(combinations(doubted, 2))
    found = []
    for a, b in pairs:
        swap = {a: b, b: a}
        renamed = [s._replace(row=swap.get(s.row, s.row)) for s in newest]
        fitting = candidates(map_data(renamed, known))
        if fitting and {a, b} <= fitting[0].agreeing:
            found.append((fitting[0].log_evidence, (a, b)))
    if not found:
        return []
    best = max(log_evidence for log_evidence, _ in found)
    before = starts[0].log_evidence if starts else -math.inf
    if best - before <= math.log(CLEAR * len(pairs)):
        return []
    ids = known.ids
    return [(ids[a], ids[b]) for fit, (a, b) in found if best - fit < math.log(CLEAR)]


def of_swaps(swaps: list[tuple[int, int]]) -> tuple[str, str]:
    """Mistake and remedy of exchanged identities."""
    pairs = " or ".join(f"{min(pair)} and {max(pair)}" for pair in swaps)
    return (
        f"identities {pairs} are exchanged, in the map or in the log",
        f"exchange the ids {pairs} in the map",
    )


def windows(sequence: Sequence) -> Iterator[Measurements]:
    """Measurements of a log, window by window."""
    step_ns = round(WINDOW_S * 1e9)
    instants_ns = np.arange(
        sequence.start_ns + step_ns, sequence.end_ns + step_ns, step_ns
    )
    return sequence.replay(np.minimum(instants_ns, sequence.end_ns))


def best_start(locator: MapLocator) -> FoundStart | None:
    """The start with the most evidence; None without one."""
    newest = locator.newest()
    starts = candidates(map_data(newest, locator.map)) if newest else []
    return starts[0] if starts else None


def evidence(locator: MapLocator) -> float:
    """Logarithm of the evidence of the best start; minus infinity without one."""
    best = best_start(locator)
    return -math.inf if best is None else best.log_evidence


def by_all(locator: MapLocator) -> FoundStart | None:
    """The best start by the newest sightings of each landmark; None without one."""
    best = best_start(locator)
    if best is None:
        return None
    of_each = newest_of_each(locator.sightings, MOST_OF_LANDMARK)
    return refined(best.parameters, map_data(of_each, locator.map))


def common_rise(
    sequence: Sequence, given: MapLocator, rises_m: tuple[float, ...]
) -> float:
    """The height that all landmarks lack, m, as a tilted sonar shows; 0 where none makes more of them agree.

    It must explain the sightings better than sigmas that are too small.
    """
    as_given = by_all(given)
    looser = by_all(followed(sequence, with_sigmas(given.map, SIGMA_FACTORS[0])))
    before = 0 if as_given is None else len(as_given.agreeing)
    least = -math.inf if as_given is None else as_given.log_evidence
    least += math.log(CLEAR)
    if looser is not None:
        least = max(least, looser.log_evidence)
    found_m = 0.0
    for rise_m in rises_m:
        raised = followed(sequence, moved_up(given.map, rise_m))
        best = by_all(raised)
        if best is None or shown(given) - shown(raised) > MORE_SHOWN:
            continue
        is_more = len(best.agreeing) > before and best.log_evidence > least
        if is_more and (as_given or gives_start(sequence, raised.map)):
            least = best.log_evidence
            found_m = rise_m
    return found_m


def agreeing(locator: MapLocator) -> int:
    """Number of landmarks that agree with the best start."""
    best = by_all(locator)
    return 0 if best is None else len(best.agreeing)


def shown(locator: MapLocator) -> float:
    """Share of the sightings whose landmark is within the sonar's vertical aperture by its height in the map."""
    return float(np.mean([sighting.rise_m == 0.0 for sighting in locator.sightings]))


def gives_start(sequence: Sequence, known: KnownMap) -> bool:
    """Check that sightings give a start, by enough landmarks and more than half of those that were seen by then."""
    return any(
        len(start.agreeing) >= max(FEWEST, 1 + seen // 2)
        for start, seen in starts(sequence, known)
    )


def undone(known: KnownMap, T: np.ndarray) -> KnownMap:
    """The map with all places multiplied by a matrix."""
    places = np.array(known.positions_m) @ T.T
    all_T = np.kron(np.eye(len(places)), T)
    return KnownMap.of(known.ids, places, covariance_m2=all_T @ known.joint() @ all_T.T)


def moved_up(known: KnownMap, rise_m: float) -> KnownMap:
    """The map with all heights raised."""
    places = np.array(known.positions_m)
    places[:, 2] += rise_m
    return KnownMap.of(known.ids, places, covariance_m2=known.joint())


def remedy_of(known: KnownMap, T: np.ndarray) -> str:
    """The first landmark as it should be in the file."""
    place = ", ".join(f"{value:.2f}" for value in T @ known.positions_m[0])
    return f"landmark {known.ids[0]} at ({place}) m, and all others alike"
