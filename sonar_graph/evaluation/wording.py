"""Numbers and findings in words: as many digits as mean something, and no claim beyond them."""

from __future__ import annotations

import math

from sonar_graph.evaluation.results import Comparison, RunResult, Score

ABSENT = "\N{EN DASH}"
TOO_CLOSE = 0.05
"""Relative difference below which one run says nothing about which of two errors is the smaller one."""
CONSISTENCY_KEY = "causal.nees_position"

HEADLINES = {
    "ate_se2_m": "RMS after SE(2) alignment",
    "ate_se3_m": "RMS after SE(3) alignment",
    "ate_yaw_m": "RMS after alignment of yaw and translation",
    "ate_raw_m": "RMS, not aligned",
}
"""Position errors that can stand in the headline, best suited first, with what each one is."""


def format_value(value: float) -> str:
    """A number with three significant digits; whole numbers and thousands in full; a dash where there is none."""
    if math.isnan(value):
        return ABSENT
    if math.isinf(value):
        return "∞" if value > 0 else "\N{MINUS SIGN}∞"
    if float(value).is_integer() or abs(value) >= 1000:
        text = f"{value:.0f}"
    elif abs(value) < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        text = f"{mantissa}e{int(exponent)}"
    else:
        rounded = float(f"{value:.3g}")
        text = f"{rounded:.{max(0, 2 - math.floor(math.log10(abs(rounded))))}f}"
    return text.replace("-", "\N{MINUS SIGN}")


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
    """What a normalised squared error says of the reported covariances; empty where no interval was computed."""
    if score.interval is None or math.isnan(score.value):
        return ""
    lowest, highest = score.interval
    if score.value > highest:
        return "over-confident"
    return "over-cautious" if score.value < lowest else "consistent"


def failed_runs(comparison: Comparison) -> list[RunResult]:
    """Runs that did not come to an end."""
    return [run for run in comparison.runs if run.status == "failed"]


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
    """What the comparison found, a sentence each: failures first, then errors, then whether covariances hold."""
    sentences = [f"{run.estimator} failed: {run.reason.rstrip('.')}." for run in failed_runs(comparison)]
    metric = headline_metric(comparison)
    if metric is None:
        return [*sentences, _why_no_error(comparison)]
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
    judged = []
    for run in comparison.runs:
        score = score_of(comparison, run.estimator, CONSISTENCY_KEY)
        if score is not None:
            verdict = consistency(score)
            judged.append(f"{run.estimator} {display_value(score)}" + (f" ({verdict})" if verdict else ""))
    if not judged:
        return []
    return [f"Position NEES, 1 where the reported uncertainty fits, above it over-confident: {', '.join(judged)}."]
