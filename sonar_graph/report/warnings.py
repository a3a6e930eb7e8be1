"""What a reader must know first of identities: that none came, that a map is wrong, what landmarks without a name are.

A squared error, or a squared innovation, of two degrees of freedom is above `ABSURD` with a probability of 10⁻⁹ where
covariances hold, so that no landmark of a consistent estimator is named here in practice. Where sigmas are f times too
small it is 10⁻⁹ to the power of 1/f²: a landmark is then named for its error in one case of 180 at f = 2 and of ten at
f = 3, for its sightings from f = 3.6 on.

What a log's notes say that a reader of results must know: damage, rows left out, gaps, numbers that look wrong.

What runs did not use: rows of IMU and Doppler log, gathered where they are many, and what was withheld; in words.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import chi2

from sonar_graph.evaluation import (
    MOST_ROWS_NAMED,
    Comparison,
    RefusedRows,
    RunResult,
    anonymous_named,
    gathered,
    landmark_errors,
    normalised_squares,
)
from sonar_graph.settings import flattened
from sonar_graph.states import FIRST_ANONYMOUS_ID, LandmarkMap, Outcome

QUANTILE = 1 - 1e-9
ABSURD = float(chi2.ppf(QUANTILE, 2))
"""41.4: the chi-square quantile of two degrees of freedom at `QUANTILE`."""
CONTRADICTING_SHARE = 0.2
"""Above this share of its innovations above `ABSURD` a landmark's sightings contradict each other; below it they are
outliers, which a robust estimator outvotes."""
MOST_NAMED = 5
NAMELESS = {Outcome.NO_IDENTITY, Outcome.WAITING, Outcome.FORGOTTEN, Outcome.UNFIT}
"""Outcomes of detections of which an estimator does not know what they are of."""
UNHEARD = {Outcome.UNSOUND, Outcome.LATE, Outcome.UNLOCATED, Outcome.TRACK_REPEATED}
"""Outcomes of detections that were refused before what they are of mattered."""
POLICY, UNKNOWN = "identity.policy", "identity.unknown.policy"


def doubt_of_identities(comparison: Comparison) -> list[str]:
    """Warnings, a line each: detections without identities, then runs whose map is wrong."""
    return [*_nothing_named(comparison), *_wrong_maps(comparison)]


def nameless_landmarks(comparison: Comparison) -> list[str]:
    """A sentence for each run that has landmarks without a name: how many, and which they are by their place."""
    said = []
    for run in comparison.runs:
        ids = [] if run.landmarks is None else run.landmarks.ids[run.landmarks.ids >= FIRST_ANONYMOUS_ID].tolist()
        if run.landmarks is not None and ids:
            counted = "1 landmark" if len(ids) == 1 else f"{len(ids)} landmarks"
            which = _by_place(run.landmarks, comparison.sequence.true_landmarks)
            said.append(f"{run.estimator} found {counted} without a name ({UNKNOWN}); {which}.")
    return said


def _by_place(landmarks: LandmarkMap, true: LandmarkMap | None) -> str:
    if true is None:
        return f"identities from {FIRST_ANONYMOUS_ID} on are made up"
    named = anonymous_named(landmarks, true)
    found = np.setdiff1d(named.ids, landmarks.ids).tolist()
    return f"scored by place, as {_listed(found)}" if found else "none is at the place of a true one"


def _nothing_named(comparison: Comparison) -> list[str]:
    """That of the detections that a run could use none had an identity."""
    heard = [(run, _heard(run)) for run in comparison.runs]
    blind = [(run, outcomes) for run, outcomes in heard if outcomes and set(outcomes) <= NAMELESS]
    if not blind:
        return []
    hint = "" if any(flattened(run.params).get(UNKNOWN) == "associate" for run, _ in blind) else _associate()
    names = ", ".join(run.estimator for run, _ in blind)
    count = max(len(outcomes) for _, outcomes in blind)
    return [f"Warning: none of {count} detections has an identity that {names} can use: no landmark is mapped{hint}"]


def _heard(run: RunResult) -> list[Outcome]:
    return [outcome for outcome in run.detections.outcomes if outcome not in UNHEARD] if run.detections else []


def _associate() -> str:
    return f'; isam2 maps them by place with {UNKNOWN} = "associate"'


def _wrong_maps(comparison: Comparison) -> list[str]:
    """With true landmarks those that are not where a run says; without, those whose sightings contradict it."""
    said = []
    for run in comparison.runs:
        misplaced, contradicting = _misplaced(run, comparison.sequence.true_landmarks), _contradicting(run)
        if misplaced:
            far = f"far outside its covariance (NEES up to {max(misplaced.values()):.0f})"
            said.append(f"Warning: {run.estimator} puts {_landmarks(misplaced)} {far}; {_look_at(run)}")
        elif comparison.sequence.true_landmarks is None and contradicting:
            sightings = f"sightings of {_landmarks(contradicting)} contradict its map"
            nis = f"(mean NIS up to {max(contradicting.values()):.0f})"
            said.append(f"Warning: {run.estimator}: {sightings} {nis}; {_look_at(run)}")
    return said


def _misplaced(run: RunResult, true: LandmarkMap | None) -> dict[int, float]:
    """NEES, per degree of freedom, of landmarks for which it is absurd."""
    if run.landmarks is None or true is None:
        return {}
    errors = landmark_errors(anonymous_named(run.landmarks, true), true)
    squares = normalised_squares(errors.horizontal_m, errors.horizontal_covs)
    return {
        id_: square / 2 for id_, square in zip(errors.ids.tolist(), squares.tolist(), strict=True) if square > ABSURD
    }


def _contradicting(run: RunResult) -> dict[int, float]:
    """Mean NIS, per degree of freedom, of landmarks for which too many innovations are absurd."""
    log = run.detections
    if log is None or run.landmarks is None:
        return {}
    squares = normalised_squares(log.innovations, log.innovation_covs)
    used = np.array([outcome is Outcome.USED for outcome in log.outcomes], dtype=bool) & np.isfinite(squares)
    found = {}
    for id_ in run.landmarks.ids.tolist():
        own = squares[used & (log.landmark_ids == id_)]
        if own.size and np.mean(own > ABSURD) > CONTRADICTING_SHARE:
            found[id_] = float(own.mean() / 2)
    return found


def _look_at(run: RunResult) -> str:
    policy = flattened(run.params).get(POLICY)
    if policy is None:
        return "look at identities, then at noise and start"
    return f'look at identities ({POLICY} is "{policy}"), then at noise and start'


def _landmarks(ids: dict[int, float]) -> str:
    return f"landmark{'s' if len(ids) > 1 else ''} {_listed(list(ids))}"


def _listed(ids: list[int]) -> str:
    if len(ids) > MOST_NAMED:
        return f"{', '.join(map(str, ids[:MOST_NAMED]))} and {len(ids) - MOST_NAMED} more"
    *first, last = map(str, ids)
    return f"{', '.join(first)} and {last}" if first else last


WARNING = "Warning"
SAID_NOTES = {
    "log.ending": "Log",
    "log.damage": "Log",
    "log.start": "Log",
    "log.stamps": "Log",
    "log.dropped": "Log, left out",
    "log.warnings": WARNING,
    "log.gaps": WARNING,
}
"""Notes that are said in the terminal, and after which word; the report has all."""


def doubt_lines(notes: Mapping[str, str]) -> list[str]:
    """A line for each of `SAID_NOTES` that a log has."""
    return [f"{word}: {notes[subject]}" for subject, word in SAID_NOTES.items() if subject in notes]


def warning_lines(notes: Mapping[str, str]) -> list[str]:
    """Of these the ones that put results in doubt."""
    return [line for line in doubt_lines(notes) if line.startswith(f"{WARNING}:")]


def by_runs(comparison: Comparison) -> dict[RefusedRows, list[str]]:
    """What was refused, with the names of the runs that refused it; alike in all whose odometry is the same."""
    names: dict[RefusedRows, list[str]] = {}
    for run in comparison.runs:
        for refused in gathered(run.refused):
            names.setdefault(refused, []).append(run.estimator)
    return names


def refusal_lines(comparison: Comparison) -> list[str]:
    """A line for each row, or for many at once: sensor, time, reason, distance, and the runs."""
    start_ns = comparison.sequence.start_ns
    lines = []
    for refused, names in by_runs(comparison).items():
        count = "" if refused.count == 1 else f"{refused.count} rows, "
        distance = f" (squared distance {refused.distances()})" if refused.distances() else ""
        at = f"{count}{refused.times(start_ns)} s"
        lines.append(f"Warning: {refused.sensor}, {at}: {refused.reason}{distance}; {', '.join(names)}")
    return lines


def withheld_lines(comparison: Comparison) -> list[str]:
    """What runs could not use for want of something else, in their own words: the first ones, and how many more."""
    lines = []
    for run in comparison.runs:
        lines += [f"Warning: {run.estimator}: {message}" for message in run.withheld[:MOST_ROWS_NAMED]]
        more = len(run.withheld) - MOST_ROWS_NAMED
        if more > 0:
            lines.append(f"Warning: {run.estimator} withheld {more} more: runs/{run.estimator}/result.json has all")
    return lines
