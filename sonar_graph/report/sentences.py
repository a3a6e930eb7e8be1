"""Sentences about a comparison: errors, consistency, and the warnings that a reader must see first.

No sentence claims more than its numbers support. A landmark is called wrong when its squared error, or too many of its
squared innovations, exceed `ABSURD`; where covariances hold, that has a probability of 1e-9. Where sigmas are f times
too small it has 1e-9 to the power of 1/f².
"""

import math
from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np

from sonar_graph.evaluation import (
    FITTED,
    GATED_SHARE,
    HEADLINES,
    HEIGHTS,
    MOST_ROWS_NAMED,
    RAW,
    Comparison,
    RunResult,
    Score,
    gathered,
    headline_metric,
    label,
    landmark_errors,
    likeness,
    nis,
    normalised_squares,
    rmse,
    scored_map,
    used_squares,
)
from sonar_graph.models import MOVED
from sonar_graph.numerics import chi_square_quantile
from sonar_graph.settings import flattened
from sonar_graph.states import FIRST_ANONYMOUS_ID, Outcome, counted, landmark_name

Said = TypeVar("Said")
# the filter with the robust kernel and the gyro bias that filters as published lack
FAIR = "invariant-ekf"
# relative difference of two errors below which one run cannot decide which is the smaller one
TOO_CLOSE = 0.05
CONSISTENCY_KEYS = {"position": "causal.nees_position", "yaw": "causal.nees_yaw"}
NO_DETECTIONS = (
    "The log has no landmark detections; without them nothing corrects the drift."
)
# 41.4: the chi-square quantile of two degrees of freedom at 1 - 1e-9
ABSURD = chi_square_quantile(1 - 1e-9, 2)
# above this share of innovations above `ABSURD` the sightings of a landmark contradict each other; below it
# they are outliers, which a robust estimator outvotes
CONTRADICTING_SHARE = 0.2
# above this share of innovations above `ABSURD` outliers are named
OUTLYING_SHARE = 0.05
# correlation of the innovations of successive sightings from which they are named, and the fewest pairs of sightings
ALIKE = 0.5
FEWEST_PAIRS = 100
# error of runs over their distance from each other and their sigmas, from which on something that they share is wrong
SHARED_TIMES = 5.0
# factor of a sigma from which it is said
LEAST_FACTOR = 1.5
# findings about the reference, which no estimator uses
REFERENCE = "reference"
MOST_NAMED = 5
# outcomes of detections whose landmark an estimator does not know
NAMELESS = {Outcome.NO_IDENTITY, Outcome.WAITING, Outcome.FORGOTTEN, Outcome.UNFIT}
# outcomes of detections that were refused before their landmark mattered
UNHEARD = {Outcome.UNSOUND, Outcome.LATE, Outcome.UNLOCATED, Outcome.TRACK_REPEATED}
POLICY = "identity.policy"
UNKNOWN = "identity.unknown.policy"
WARNING = "Warning"
DOUBTFUL = "Doubtful"
# beginnings of lines that put results in doubt
IN_DOUBT = (f"{WARNING}:", f"{DOUBTFUL}:")
BEYOND = "beyond doubt"
CONTRADICTED = "sightings contradict the map"
# sigma of a start in a map, from which on wrong first sightings lead far away
LOOSE_START_M = 1.0
# ratio of squared innovations to their covariance, typical of a sensor, that no noise makes
BEYOND_DOUBT = 100.0
# notes that the terminal shows, and the word before each, causes first; the report has all notes
SAID_NOTES = {
    "log.doubtful": DOUBTFUL,
    "log.sensors": WARNING,
    "log.ending": "Log",
    "log.damage": "Log",
    "log.start": "Log",
    "log.start_pose": WARNING,
    "log.map": "Map",
    FITTED: "Truth",
    HEIGHTS: "Truth",
    "log.stamps": "Log",
    "log.dropped": "Log, left out",
    "log.warnings": WARNING,
    "log.gaps": WARNING,
}


def remarks(comparison: Comparison) -> list[str]:
    """Sentences about the whole comparison that put nothing in doubt: where the truth is, and the lack of detections."""
    fitted = comparison.sequence.notes.get(FITTED)
    sentences = [f"{fitted[0].upper()}{fitted[1:]}."] if fitted else []
    if not comparison.sequence.detections:
        sentences.append(no_detections(comparison))
    return sentences


def failed_lines(comparison: Comparison) -> list[str]:
    """A sentence for each reason for which runs failed."""
    names = named_by(
        (run.reason.rstrip("."), run.estimator) for run in comparison.failed_runs
    )
    return [f"{own} failed: {reason}." for reason, own in names.items()]


def ends(comparison: Comparison) -> list[str]:
    """Where the path of each run ends, how sure of it the run is, and how many landmarks it has."""
    lines = list[str]()
    for run in comparison.runs:
        if not run.causal:
            continue
        x, y, z = run.causal.positions[-1]
        # the trace is the same along any axes
        sigma_m = math.sqrt(np.trace(run.causal.covariances[-1, 3:, 3:]))
        text = f"{run.estimator} ends at ({x:.2f}, {y:.2f}, {z:.2f}) m"
        if math.isfinite(sigma_m):
            text += f" with a sigma of {sigma_m:.2g} m in all"
        if run.landmarks:
            text += f", {counted(len(run.landmarks), 'landmark')}"
        lines.append(text)
    return lines


def named_by(pairs: Iterable[tuple[Said, str]]) -> dict[Said, str]:
    """Each thing that runs have, with the names of the runs: most have the same, and one line is enough for all."""
    names: dict[Said, list[str]] = {}
    for said, name in pairs:
        names.setdefault(said, []).append(name)
    return {said: ", ".join(own) for said, own in names.items()}


def doubts(comparison: Comparison) -> list[str]:
    """Everything that puts results in doubt and is not the headline, worst first."""
    notes = comparison.sequence.notes
    doubtful = doubtful_lines(comparison)
    return [
        *failed_lines(comparison),
        *lost_runs(comparison),
        *doubtful[1:],
        *doubt_of_identities(comparison),
        *outliers(comparison),
        *shared_error(comparison),
        *alike_errors(comparison),
        *(
            line
            for line in doubt_lines(notes)
            if line.startswith(IN_DOUBT) and line not in doubtful
        ),
        *withheld_lines(comparison),
    ]


def headline(comparison: Comparison, *, aligned: bool = True) -> str:
    """The finding: the estimator nearest to the truth, how far off it is, and what its covariances are worth.

    Where sensors contradict each other beyond doubt, the sentence is a warning about that instead.

    Where no run has a position error, the reason, or the errors of maps.

    Parameters
    ----------
    comparison
        Runs with their scores.
    aligned
        Errors after alignment to the truth, where the runs have them, instead of before.
    """
    # numbers of sensors that contradict each other are no finding
    if doubtful := doubtful_lines(comparison):
        return doubtful[0]
    metric = headline_metric(comparison)
    if metric is None:
        return _without_errors(comparison)
    if not aligned:
        metric = RAW
    (name, least), *others = _in_order(comparison, f"causal.{metric}")
    # one run is too little to separate such errors
    close = [
        other
        for other, score in others
        if score.value > 0 and 1 - least.value / score.value < TOO_CLOSE
    ]
    equals = f", {' and '.join(close)} equally near" if close else ""
    what = label(HEADLINES[metric], comparison)
    # one estimator is not nearest to anything
    leads = f"is nearest to the truth{equals}:" if others else "is"
    opening = f"{name} {leads} {least.with_unit} off{'' if others else ' the truth'} ({what}, causal)"
    # a wrong map can come with a small error by luck
    lines = [*doubt_of_identities(comparison), *lost_runs(comparison)]
    if any(name in line for line in lines):
        return f"{opening}, but its warning must be settled first."
    return f"{opening}. {_worth_of_covariances(comparison, name)}".strip()


def _in_order(comparison: Comparison, key: str) -> list[tuple[str, Score]]:
    """Runs with an error, smallest first."""
    known = [
        (run.estimator, score)
        for run in comparison.runs
        if (score := comparison.score_of(run.estimator, key))
    ]
    return sorted(known, key=lambda item: item[1].value)


def _worth_of_covariances(comparison: Comparison, name: str) -> str:
    """One sentence on whether the covariances of a run fit its errors; empty where it has no NEES."""
    known = {
        what: score
        for what, key in CONSISTENCY_KEYS.items()
        if (score := comparison.score_of(name, key))
    }
    if not known:
        return ""
    verdicts = {score.verdict for score in known.values()}
    misfits = [
        f"of {what} {score.text()}"
        for what, score in known.items()
        if score.verdict.startswith("over")
    ]
    if misfits:
        is_small = "over-confident" in verdicts
        fault = "too small: do not rely on them" if is_small else "too large"
        return f"Its covariances are {fault} (NEES {' and '.join(misfits)}, 1 fits)."
    if any(verdicts):
        return "Its covariances fit its errors."
    return "Its errors do not contradict its covariances; one run cannot confirm them."


def published_filters(comparison: Comparison) -> str:
    """Which filters have the settings of their publication, with their fair neighbour; empty without any."""
    # a reader must not take the filter of a paper for a poor implementation
    names = [run.estimator for run in comparison.runs if run.is_as_published]
    if not names:
        return ""
    where = f"; add it with --estimators {','.join([*names, FAIR])}"
    if FAIR in [run.estimator for run in comparison.runs]:
        where = ""
    return (
        f"{' and '.join(names)}: as published, without gate, robust kernel or gyro bias. "
        f"The fair neighbour is {FAIR}, which has kernel and bias{where}."
    )


def _without_errors(comparison: Comparison) -> str:
    """The headline where no run has a position error."""
    if len(comparison.failed_runs) == len(comparison.runs):
        return "No estimator came to an end, so there is nothing to compare."
    # maps can be judged where paths cannot
    maps = _in_order(comparison, "landmarks.se2_m")
    listed = ", ".join(f"{name} {score.with_unit}" for name, score in maps)
    if listed:
        return f"No true path is known, but the landmarks are; maps after SE(2) alignment (RMS): {listed}."
    if comparison.sequence.truth is None:
        return "The log has no ground truth, so paths, maps and times can be compared, but no errors given."
    return "No position error could be computed against the log's ground truth."


def no_detections(comparison: Comparison) -> str:
    """The sentence about the drift of a log, or of the chosen part of it, without detections."""
    part = comparison.sequence.notes.get("log.part")
    has_heading = comparison.sequence.heading is not None
    has_fixes = comparison.sequence.positions is not None
    aids = ["headings"] * has_heading + ["position fixes"] * has_fixes
    if there := " and ".join(aids):
        return f"The log has no landmark detections; only its {there} limit the drift."
    if not part:
        return NO_DETECTIONS
    return f"The part of the log that was chosen ({part}) has no landmark detections; nothing corrects the drift in it."


def lost_runs(comparison: Comparison) -> list[str]:
    """A sentence on each run whose gate refused more than `GATED_SHARE` of the detections."""
    said = []
    for run in comparison.runs:
        outcomes = outcomes_of(run)
        gated = outcomes.count(Outcome.GATED)
        # a map that the log contradicts has a message of its own, and no other gate mends it
        is_of_map = "the map, and too few others agree" in "\n".join(run.withheld)
        # a gate that refuses so much refuses the truth
        if gated > GATED_SHARE * len(outcomes) and not is_of_map:
            advice = ""
            without = "gate_probability = 1"
            if flattened(run.params).get(POLICY) == "gate":
                advice = ' (try identity.policy = "max-mixture")'
                without = 'identity.policy = "robust"'
            said.append(
                f"{run.estimator} refused {gated} of {len(outcomes)} detections as outside its gate: it has lost its "
                f"way, identities are wrong{advice}, or noise is set far too small, and the gate may keep it there "
                f"(try {without}); its NIS only tells of what the gate let through."
            )
    return said


def beside_the_paper(comparison: Comparison) -> str | None:
    """What ekf-slam used in this log beside the paper's equations, one sentence; None without ekf-slam.

    The table of docs/theory/ekf_slam.md has the same rows.
    """
    run = next((run for run in comparison.runs if run.estimator == "ekf-slam"), None)
    if run is None:
        return None
    sequence = comparison.sequence
    calibration = sequence.calibration
    params = flattened(run.params)
    # bridged by accelerometers, which the paper does not do
    longest_s = float(np.diff(sequence.dvl.stamps_ns).max(initial=0)) * 1e-9
    is_held = calibration.odometry_interpolation == "hold-past"
    has_gaps = longest_s > calibration.dvl.gap_s and not is_held
    additions = {
        "depth": sequence.depth is not None,
        "gravity for roll and pitch": calibration.use_gravity,
        "the plane of the calibration": calibration.planar is not None,
        "the floor's height": calibration.floor is not None,
        "headings with Huber's kernel and the compass' bias": sequence.heading
        is not None,
        "position fixes with Huber's kernel": sequence.positions is not None,
        "accelerometers and larger noise where the Doppler log has no sample for long": has_gaps,
        "far_views": has_gaps and params.get("far_views", False),
        "gate_probability": params.get("gate_probability", 1.0) < 1.0,
        "kernel_width": params.get("kernel_width", 0.0) > 0.0,
    }
    used = [name for name, is_used in additions.items() if is_used]
    if not used:
        return "In this log ekf-slam used nothing beside the paper's equations."
    return f"Beside the paper's equations ekf-slam used in this log: {', '.join(used)}."


def doubt_of_identities(comparison: Comparison) -> list[str]:
    """Warnings, a line each: runs for which no detection has an identity, then runs whose map is wrong.

    A map is wrong where it contradicts the true landmarks or, where these are unknown, the sightings.
    """
    lines = []
    blind = {}
    hint = f'; isam2 maps them by place with {UNKNOWN} = "associate"'
    for run in comparison.runs:
        outcomes = [one for one in outcomes_of(run) if one not in UNHEARD]
        # no identity can be used, so nothing is mapped
        if outcomes and set(outcomes) <= NAMELESS:
            blind[run.estimator] = len(outcomes)
            if flattened(run.params).get(UNKNOWN) == "associate":
                hint = ""
    if blind:
        lines.append(
            f"{WARNING}: none of {max(blind.values())} detections has an identity that {', '.join(blind)} can use: "
            f"no landmark is mapped{hint}"
        )
    true = comparison.sequence.true_landmarks
    for run in comparison.runs:
        wrong: dict[int, float] = {}
        if run.landmarks is not None and true is not None:
            scored = scored_map(run.landmarks, comparison.sequence)
            if scored is None:
                continue
            # with a truth the errors show which landmark is wrong
            errors = landmark_errors(scored.landmarks, true)
            squares = normalised_squares(errors.horizontal_m, errors.horizontal_covs)
            for id_, square in zip(errors.ids.tolist(), squares.tolist(), strict=True):
                if square > ABSURD:
                    wrong[id_] = square / 2
            said = f" puts {_landmarks(wrong)} far outside its covariance (NEES up to"
        elif run.landmarks is not None and (log := run.detections) is not None:
            squares = used_squares(log)
            for id_ in run.landmarks.ids.tolist():
                own = squares[np.isfinite(squares) & (log.landmark_ids == id_)]
                if own.size and np.mean(own > ABSURD) > CONTRADICTING_SHARE:
                    wrong[id_] = float(own.mean() / 2)
            said = (
                f": sightings of {_landmarks(wrong)} contradict its map (mean NIS up to"
            )
        if wrong:
            policy = flattened(run.params).get(POLICY)
            named = "" if policy is None else f' ({POLICY} is "{policy}")'
            has_map = comparison.sequence.calibration.map is not None
            of_map = "sigmas of the map, then at " if has_map else ""
            advice = f"look at {of_map}identities{named}, then at noise and start"
            lines.append(
                f"{WARNING}: {run.estimator}{said} {max(wrong.values()):.0f}); {advice}"
            )
    return lines


def outcomes_of(run: RunResult) -> list[Outcome]:
    """Outcomes of a run's detections; none where it has no log of them."""
    return run.detections.outcomes if run.detections else []


def outliers(comparison: Comparison) -> list[str]:
    """A warning about runs that used more than `OUTLYING_SHARE` of their detections although these are absurd."""
    said = []
    for run in comparison.runs:
        far, of = absurd_detections(run)
        if far > OUTLYING_SHARE * of:
            said.append(
                f"{run.estimator} {far} of {of}{_weight(flattened(run.params))}"
            )
    if not said:
        return []
    return [
        f"{WARNING}: sonar, detections that were used although as far off as one in a billion should be: "
        f"{'; '.join(said)}: look at their ranges, azimuths and identities, then at noise and start"
    ]


def shared_error(comparison: Comparison) -> list[str]:
    """A warning where runs that used landmarks agree with each other, and not with the truth that they are aligned to."""
    used = {}
    for run in comparison.runs:
        error = comparison.score_of(run.estimator, "causal.ate_se2_m")
        errors = comparison.errors_of(run)
        if error and errors and Outcome.USED in outcomes_of(run):
            used[run.estimator] = (error.value, errors)
    if len(used) < 2:
        return []
    error_m = min(value for value, _ in used.values())
    # all runs of a comparison are scored at the same instants
    paths_m = [errors.position_m[:, :2] for _, errors in used.values()]
    apart_m = max(rmse(path_m - paths_m[0]) for path_m in paths_m)
    sigmas_m = [
        np.nanmedian(np.linalg.norm(errors.position_sigma_m[:, :2], axis=1))
        for _, errors in used.values()
    ]
    if not error_m > SHARED_TIMES * max(apart_m, *sigmas_m):
        return []
    return [
        f"{WARNING}: {', '.join(used)} agree to {apart_m:.2g} m, and are {error_m:.2g} m off the truth they are aligned "
        "to: the truth is of another point of the vehicle or in another frame, or what they share is wrong (Doppler log, "
        "mountings, calibration)"
    ]


def absurd_detections(run: RunResult) -> tuple[int, int]:
    """Detections that were used although their squared innovation exceeds `ABSURD`, and all that were used."""
    if run.detections is None:
        return 0, 0
    squares = nis(run.detections)
    return int(np.count_nonzero(squares > ABSURD)), len(squares)


def alike_errors(comparison: Comparison) -> list[str]:
    """A warning each for range and azimuth where successive sightings of a landmark err alike (`likeness`).

    By the run in which they are least alike. None where a sensor of the vehicle is in doubt, or innovations are absurd:
    these are the cause then, and have lines of their own.
    """
    sequence = comparison.sequence
    # the worst finding comes first
    sensors = sequence.notes.get("log.sensors", REFERENCE)
    if "log.doubtful" in sequence.notes or not sensors.startswith(REFERENCE):
        return []
    found = []
    for run in comparison.runs:
        far, of = absurd_detections(run)
        if run.detections is not None and far <= OUTLYING_SHARE * of:
            each = likeness(run.detections)
            if each.pairs >= FEWEST_PAIRS:
                found.append((run.estimator, each))
    if not found:
        return []
    given = sequence.detections
    lines = []
    for column, key in enumerate(("range_sigma_m", "azimuth_sigma_rad")):
        name, least = min(found, key=lambda one: one[1].correlation[column])
        rho = least.correlation[column]
        factor = least.sigma_factors()[column]
        if rho <= ALIKE or factor <= LEAST_FACTOR:
            continue
        sigma = factor * getattr(sequence.calibration.sonar, key)
        remedy = f"write `{key} = {sigma:.2g}` under [sonar]"
        if given and np.isfinite(given.range_azimuth_cov).any():
            remedy = f"give sigmas {factor:.1f} times as large with the detections"
        lines.append(
            f"{WARNING}: {name}: errors of {key.split('_')[0]} are alike in successive sightings of a landmark "
            f"(correlation {rho:.2f} in {least.pairs} pairs, 0 where independent): covariances are too small, also where "
            f"NIS is below 1; mend a constant error of sonar, start or gyros, else {remedy}"
        )
    return lines


def _weight(settings: Mapping[str, object]) -> str:
    """How much an outlier counts by the kernel of these settings, with a comma before; empty where they have none."""
    for name in ("kernel.shape", "kernel_width"):
        if name in settings:
            if settings[name] in ("none", 0):
                return f", with full weight ({name} sets a kernel)"
            return ", with less weight by its kernel"
    return ""


def nameless_landmarks(comparison: Comparison) -> list[str]:
    """A sentence for each run with landmarks of unknown identity: their number, and their identities by place."""
    said = []
    true = comparison.sequence.true_landmarks
    for run in comparison.runs:
        ids = run.landmarks.ids if run.landmarks else np.empty(0)
        count = int((ids >= FIRST_ANONYMOUS_ID).sum())
        if run.landmarks is None or not count:
            continue
        which = "none is at the place of a true one"
        scored = scored_map(run.landmarks, comparison.sequence)
        if true is None:
            which = f"u0 stands for identity {FIRST_ANONYMOUS_ID} in the files"
        elif scored and (found := np.setdiff1d(scored.landmarks.ids, ids).tolist()):
            which = f"scored by place, as {_listed(found)}"
        said.append(
            f"{run.estimator} found {counted(count, 'landmark')} without a name ({UNKNOWN}); {which}."
        )
    return said


def _landmarks(ids: Iterable[int]) -> str:
    """The word and the identities; empty without identities."""
    ids = list(ids)
    return f"landmark{'s' * (len(ids) > 1)} {_listed(ids)}" if ids else ""


def _listed(ids: list[int]) -> str:
    """The first identities, and the number of the others."""
    names = [landmark_name(id_) for id_ in ids]
    if len(ids) > MOST_NAMED:
        return f"{', '.join(names[:MOST_NAMED])} and {len(ids) - MOST_NAMED} more"
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def doubt_lines(notes: Mapping[str, str]) -> list[str]:
    """A line for each of `SAID_NOTES` that a log has: damage, rows left out, gaps, unlikely numbers."""
    found = SAID_NOTES.items()
    return [f"{word}: {notes[name]}" for name, word in found if name in notes]


def doubtful_lines(comparison: Comparison) -> list[str]:
    """Sentences about sensors that contradict the others beyond doubt, so that the results are not to be relied on.

    By the comparison of sensors, or by what estimators made of their rows: most depths refused, innovations whose
    median is `BEYOND_DOUBT` times what their covariance allows, headings or fixes as far from the estimate.
    """
    sequence = comparison.sequence
    lines = list[str]()
    of_depth = (
        "depth contradicts the start or the Doppler log; `sonar-graph inspect` compares them, `use = false` under [depth] "
        "in the log configuration leaves them out"
    )
    of_sightings = "ranges, azimuths, identities or the sonar's mounting; `use = false` under [detections] leaves them out"
    if "log.doubtful" in sequence.notes:
        lines.append(f"{DOUBTFUL}: {sequence.notes['log.doubtful']}")
        # a sensor that is wrong makes right ones contradict the estimate
        of_depth = of_sightings = "mend what is named above first"
    for run in comparison.runs:
        refused = sum(row.sensor == "depth" for row in run.refused)
        if sequence.depth is not None and refused > len(sequence.depth) / 2:
            lines.append(
                f"{DOUBTFUL}: {run.estimator} refused {refused} of {len(sequence.depth)} depths: {of_depth}"
            )
        if (log := run.detections) is not None:
            ratios = nis(log) / 2
            if len(ratios) and np.median(ratios) > BEYOND_DOUBT:
                lines.append(
                    f"{DOUBTFUL}: {run.estimator}: sightings of landmarks contradict the motion beyond doubt, "
                    f"typically {np.median(ratios):.0f} times what their noise allows: {of_sightings}"
                )
    lines += [
        f"{DOUBTFUL}: {names}: {message}"
        for message, names in said_by(comparison).items()
        if BEYOND in message
    ]
    return lines


def refusal_lines(comparison: Comparison) -> list[str]:
    """A line for each refused row, or for many at once: sensor, time, reason, distance, and the runs."""
    names = named_by(
        (refused, run.estimator)
        for run in comparison.runs
        for refused in gathered(run.refused)
    )
    lines = []
    for refused, own in names.items():
        count = "" if refused.count == 1 else f"{refused.count} rows, "
        distances = refused.distances()
        distance = f" (squared distance {distances})" if distances else ""
        at = f"{count}{refused.times(comparison.sequence.start_ns)} s"
        lines.append(
            f"{WARNING}: {refused.sensor}, {at}: {refused.reason}{distance}; {own}"
        )
    return lines


def said_by(comparison: Comparison, most: int | None = None) -> dict[str, str]:
    """The first messages of each run about what it could not use, with the names of the runs that say the same."""
    return named_by(
        (message, run.estimator)
        for run in comparison.runs
        for message in run.withheld[:most]
    )


def withheld_lines(comparison: Comparison) -> list[str]:
    """What runs could not use, in their own words: the first messages, and the number of the others."""
    said = said_by(comparison, MOST_ROWS_NAMED)
    lines = [
        f"{WARNING}: {names}: {message}"
        for message, names in said.items()
        if BEYOND not in message
    ]
    for run in comparison.runs:
        more = len(run.withheld) - MOST_ROWS_NAMED
        if more > 0:
            lines.append(
                f"{WARNING}: {run.estimator} withheld {more} more: comparison.json has all"
            )
    calibration = comparison.sequence.calibration
    start_sigma_m = max(calibration.start.position_sigma_m[:2])
    is_stated = calibration.start.source != "map"
    is_doubted = start_sigma_m > LOOSE_START_M or any(
        MOVED in message or CONTRADICTED in message for message in said
    )
    if is_stated and calibration.map and is_doubted:
        map_sigma_m = math.sqrt(np.diag(calibration.map.joint()).max())
        # the first landmark that is seen corrects such a start, and if it is the one that moved, others seem to have moved
        if start_sigma_m > map_sigma_m:
            lines.append(
                f"{WARNING}: the start is less certain ({start_sigma_m:.2g} m) than the map ({map_sigma_m:.2g} m): first "
                "sightings decide; if they are wrong, so is the pose, and other landmarks seem to have moved; "
                '`source = "map"` under [start] finds it by all landmarks'
            )
    return lines
