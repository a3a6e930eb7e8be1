"""Numbers and findings in words: as many digits as mean something, and no claim beyond them.

Numbers with as many digits as their standard error supports.
"""

from __future__ import annotations

import math

from sonar_graph.evaluation import ABSENT, GATED_SHARE, Comparison, RunResult, Score, format_value
from sonar_graph.settings import flattened
from sonar_graph.states import Outcome

TOO_CLOSE = 0.05
"""Relative difference below which one run says nothing about which of two errors is the smaller one."""
CONSISTENCY_KEYS = {"position": "causal.nees_position", "yaw": "causal.nees_yaw"}
TOLERATED_FACTOR = 2.0
"""How far from 1 a normalised squared error may lie where no interval is known, before it is called inconsistent."""
NO_DETECTIONS = "The log has no landmark detections; without them nothing corrects the drift."
HEADLINES = {
    "ate_se2_m": "RMS after SE(2) alignment",
    "ate_se3_m": "RMS after SE(3) alignment",
    "ate_yaw_m": "RMS after alignment of yaw and translation",
    "ate_raw_m": "RMS, not aligned",
}
"""Position errors that can stand in the headline, best suited first, with what each one is."""


def display_unit(score: Score) -> str:
    """The unit in which people are shown the score: degrees for radians."""
    return {"rad": "°", "1": "", "-": ""}.get(score.unit, score.unit)


def display_value(score: Score, value: float | None = None) -> str:
    """The score's value, or another value in its unit, in `display_unit`."""
    number = score.value if value is None else value
    return format_value(math.degrees(number) if score.unit == "rad" else number)


def with_unit(score: Score) -> str:
    """The score's value and unit."""
    unit = display_unit(score)
    return display_value(score) + ("" if unit in ("", "°") else "\N{NO-BREAK SPACE}") + unit


def consistency(score: Score) -> str:
    """What a normalised squared error says of the reported covariances.

    Outside the score's interval, or where it has none outside `TOLERATED_FACTOR` about 1, it is over-confident or
    over-cautious. Inside the interval it is consistent; inside the factor nothing is said, as one run proves little.
    Empty for scores of other kinds.
    """
    if score.better != "inside" or math.isnan(score.value):
        return ""
    lowest, highest = score.interval or (1 / TOLERATED_FACTOR, TOLERATED_FACTOR)
    if score.value > highest:
        return "over-confident"
    if score.value < lowest:
        return "over-cautious"
    return "consistent" if score.interval else ""


def has_detections(comparison: Comparison) -> bool:
    """Whether the log holds any landmark detection."""
    return bool(comparison.sequence.detections)


def no_detections(comparison: Comparison) -> str:
    """That nothing corrects the drift, in the log or in the part of it that was chosen."""
    part = comparison.sequence.notes.get("log.part")
    if not part:
        return NO_DETECTIONS
    return f"The part of the log that was chosen ({part}) has no landmark detections; nothing corrects the drift in it."


def failed_runs(comparison: Comparison) -> list[RunResult]:
    """Runs that did not come to an end."""
    return [run for run in comparison.runs if run.status == "failed"]


def lost_runs(comparison: Comparison) -> list[str]:
    """A sentence on each run whose gate refused more than `GATED_SHARE` of the detections."""
    said = []
    for run in comparison.runs:
        outcomes = run.detections.outcomes if run.detections else []
        gated = outcomes.count(Outcome.GATED)
        if gated > GATED_SHARE * max(len(outcomes), 1):
            said.append(
                f"{run.estimator} refused {gated} of {len(outcomes)} detections as outside its gate: it has lost its "
                f"way, identities are wrong{_advice(run)}, or noise is set far too small; its NIS only tells of what "
                "the gate let through."
            )
    return said


def _advice(run: RunResult) -> str:
    return ' (try identity.policy = "max-mixture")' if flattened(run.params).get("identity.policy") == "gate" else ""


def score_of(comparison: Comparison, name: str, key: str) -> Score | None:
    """A run's score, or None where it is missing or not a number."""
    score = comparison.scores.get(name, {}).get(key)
    return None if score is None or math.isnan(score.value) else score


def headline_metric(comparison: Comparison) -> str | None:
    """The position error that most runs have, without its ``causal.`` or ``smoothed.``; None where no run has one."""
    counts = {
        metric: sum(score_of(comparison, run.estimator, f"causal.{metric}") is not None for run in comparison.runs)
        for metric in HEADLINES
    }
    best = max(counts, key=lambda metric: counts[metric])
    return best if counts[best] else None


def finding(comparison: Comparison) -> list[str]:
    """What the comparison found, a sentence each: failures first, then errors, then whether covariances hold.

    A log without detections, and runs that lost their way, are mentioned after the failures.
    """
    sentences = [f"{run.estimator} failed: {run.reason.rstrip('.')}." for run in failed_runs(comparison)]
    if not has_detections(comparison):
        sentences.append(no_detections(comparison))
    sentences += lost_runs(comparison)
    metric = headline_metric(comparison)
    if metric is None:
        return [*sentences, _why_no_error(comparison), *_nis_sentence(comparison)]
    sentences.append(_causal_sentence(comparison, metric))
    return [*sentences, *_smoothed_sentence(comparison, metric), *_consistency_sentence(comparison)]


def _why_no_error(comparison: Comparison) -> str:
    if len(failed_runs(comparison)) == len(comparison.runs):
        return "No estimator came to an end, so there is nothing to compare."
    if comparison.sequence.truth is None:
        return "The log has no ground truth, so paths, maps and times can be compared, but no errors given."
    return "No position error could be computed against the log's ground truth."


def _causal_sentence(comparison: Comparison, metric: str) -> str:
    scored = [
        (run.estimator, score)
        for run in comparison.runs
        if (score := score_of(comparison, run.estimator, f"causal.{metric}")) is not None
    ]
    scored.sort(key=lambda item: item[1].value)
    listed = ", ".join(f"{name} {with_unit(score)}" for name, score in scored)
    opening = f"Causal position error ({HEADLINES[metric]}): {listed}"
    if len(scored) == 1:
        return opening + "."
    (first, least), *others = scored
    close = [name for name, score in others if _reduction(least, score) < TOO_CLOSE]
    far = [f"{100 * _reduction(least, score):.0f} % below {name}" for name, score in others if name not in close]
    said = [f"{first} is {' and '.join(far)}"] if far else []
    if close:
        said.append(
            f"{first} and {' and '.join(close)} differ by less than 5 %, too little for one run to tell them apart"
        )
    return f"{opening}; {'; '.join(said)}."


def _reduction(least: Score, score: Score) -> float:
    """How much smaller the least error is, relative to another."""
    return 1 - least.value / score.value if score.value > 0 else 0.0


def _smoothed_sentence(comparison: Comparison, metric: str) -> list[str]:
    improved = []
    for run in comparison.runs:
        causal = score_of(comparison, run.estimator, f"causal.{metric}")
        smoothed = score_of(comparison, run.estimator, f"smoothed.{metric}")
        if causal and smoothed and not math.isclose(causal.value, smoothed.value, rel_tol=1e-3):
            improved.append(f"{run.estimator} {with_unit(smoothed)}")
    return [f"Looking back from the end of the run (smoothed): {', '.join(improved)}."] if improved else []


def _consistency_sentence(comparison: Comparison) -> list[str]:
    judged = [_worst_nees(comparison, run.estimator) for run in comparison.runs]
    if not any(judged):
        return []
    listed = ", ".join(filter(None, judged))
    return [f"NEES, of position or yaw whichever is further from the 1 of a fitting uncertainty: {listed}."]


def _nis_sentence(comparison: Comparison) -> list[str]:
    """Without truth innovations alone tell whether covariances hold."""
    judged = [
        f"{run.estimator} {display_value(score)} ({consistency(score)})"
        for run in comparison.runs
        if (score := score_of(comparison, run.estimator, "detections.nis")) is not None and consistency(score)
    ]
    return [f"NIS, 1 where innovations fit their covariances: {', '.join(judged)}."] if judged else []


def _worst_nees(comparison: Comparison, name: str) -> str:
    """A run's NEES that is furthest from 1 by ratio, with what it is of and what it says; empty where it has none."""
    scores = {what: score_of(comparison, name, key) for what, key in CONSISTENCY_KEYS.items()}
    known = {what: score for what, score in scores.items() if score is not None}
    if not known:
        return ""
    what, score = max(known.items(), key=lambda item: abs(math.log(max(item[1].value, math.ulp(0.0)))))
    said = ", ".join(filter(None, [what, consistency(score)]))
    return f"{name} {display_value(score)} ({said})"


MOST_DECIMALS = 12
"""What is nothing at so many decimals has three significant digits and a power of ten."""
LEAST_DIGITS = 2
"""Of a value that stands without its error: with fewer it may look like nothing at all."""
MINUS = "\N{MINUS SIGN}"


def decimals_of(standard_error: float) -> int:
    """Decimals down to the first digit of the standard error, one more where that is 1; negative before the point.

    0.034 gives 2, 0.012 gives 3, 340 gives -2.
    """
    leading, exponent = f"{standard_error:.6e}".split("e")
    return (1 if float(leading) < 2 else 0) - int(exponent)


def supported(value: float, standard_error: float) -> str:
    """The value, rounded where its standard error begins; three significant digits where no error is known.

    Examples
    --------
    >>> supported(0.123456, 0.0034), supported(1234.5, 86.0), supported(0.123456, float("nan"))
    ('0.123', '1230', '0.123')
    """
    if not math.isfinite(value) or not math.isfinite(standard_error) or standard_error <= 0:
        return shown(value)
    return fixed(value, decimals_of(standard_error))


def quantile_text(value: float, error: float) -> str:
    """A median or another quantile, rounded where its error begins, but with two significant digits at least.

    Examples
    --------
    >>> quantile_text(0.123456, 0.0034), quantile_text(0.123456, 40.0), quantile_text(0.123456, float("nan"))
    ('0.123', '0.12', '0.123')
    """
    if not math.isfinite(value) or not math.isfinite(error) or error <= 0:
        return shown(value)
    least = LEAST_DIGITS - 1 - math.floor(math.log10(abs(value))) if value else 0
    return fixed(value, max(decimals_of(error), least))


def with_error(value: float, standard_error: float) -> str:
    """Value and standard error with the same decimals, ``0.123 ± 0.003``; the value alone where no error is known."""
    if not math.isfinite(value) or not math.isfinite(standard_error) or standard_error <= 0:
        return shown(value)
    decimals = decimals_of(standard_error)
    return f"{fixed(value, decimals)} ± {fixed(standard_error, decimals)}"


def between(low: float, high: float, standard_error: float = math.nan) -> str:
    """Two bounds, rounded alike; a dash where there are none."""
    if math.isnan(low) or math.isnan(high):
        return ABSENT
    return f"{supported(low, standard_error)} to {supported(high, standard_error)}"


def fixed(value: float, decimals: int) -> str:
    """Rounded to so many decimals, at most 12; negative ones round before the point."""
    if decimals > MOST_DECIMALS and round(value, MOST_DECIMALS) == 0:
        return shown(value)
    decimals = min(decimals, MOST_DECIMALS)
    rounded = round(value, decimals)
    text = f"{rounded:.{max(0, decimals)}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", MINUS)


def shown(value: float) -> str:
    """Three significant digits; a dash for NaN; what is infinite is no number but a run without one."""
    return "no value" if math.isinf(value) else format_value(value)
