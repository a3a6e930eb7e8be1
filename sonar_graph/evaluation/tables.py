"""The scores of a comparison as tables: all of them, metrics down, estimators across; and those that are read first."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sonar_graph.table import ABSENT, Cell, Column, Table, absent, number, words

if TYPE_CHECKING:
    from sonar_graph.evaluation.results import Comparison, Score
    from sonar_graph.sequence import Sequence

FITTED = "truth.world"
"""Note of a sequence whose truth was brought into the world of the estimates."""
HEIGHTS = "truth.height"
"""Note of a sequence whose truth has positions without heights."""
NO_HEIGHTS = (
    "its heights are all alike, so not measured: errors and NEES are of x and y"
)
NOT_ALIGNED = "not aligned"
RAW = "ate_raw_m"
AS_PUBLISHED = "as published"

DIRECTIONS = {
    "lower": "lower is better",
    "higher": "higher is better",
    "inside": "1 is consistent",
    "none": "",
}
UNITS = {"m": "m", "rad": "rad", "ms": "ms", "s": "s", "mb": "MB"}
"""Units by the ends of the names of scores."""


@dataclass(frozen=True)
class ScoreKind:
    """One score, as ``scores.toml`` defines it for all runs."""

    name: str
    """Key without what it is a score of, such as ``ate_se2_m``."""
    label: str
    rule: str
    """Sentence of the measuring rule, with values in braces."""
    better: Literal["lower", "higher", "inside", "none"] = "lower"

    @property
    def unit(self) -> str:
        """Unit of the value, "1" for a number."""
        return UNITS.get(self.name.rpartition("_")[2], "1")


DEFINED = tomllib.loads(Path(__file__).with_name("scores.toml").read_text("utf-8"))
BLOCKS: dict[str, str] = DEFINED["titles"]
ESTIMATES: dict[str, str] = DEFINED["estimates"]
HEADLINES: dict[str, str] = DEFINED["headlines"]


def _defined_scores() -> dict[str, ScoreKind]:
    found = {}
    for block in BLOCKS:
        shared = DEFINED["trajectory"] if block in ESTIMATES else {}
        for name, kind in (shared | DEFINED.get(block, {})).items():
            found[f"{block}.{name}"] = ScoreKind(name, **kind)
    return found


SCORES = _defined_scores()
"""Every score by its key, in the order of tables."""
# scores that the compact table shows beside the name of the estimator
MOST_SCORES = 5


def unaligned(sequence: Sequence) -> str:
    """Words for scores and pictures in which no run is aligned; the truth may have been, once for all runs."""
    is_fitted = FITTED in sequence.notes
    return "the truth brought into the estimates' world" if is_fitted else NOT_ALIGNED


def label(text: str, comparison: Comparison) -> str:
    """Label or name in a headline of a score, with what was brought where in this comparison."""
    return text.replace(NOT_ALIGNED, unaligned(comparison.sequence))


def score_keys(comparison: Comparison) -> list[str]:
    """All keys of scores in the order of the table: those of `SCORES`, then others by name."""
    found = set[str]().union(*comparison.scores.values())
    return [
        *(key for key in SCORES if key in found),
        *sorted(found.difference(SCORES)),
    ]


def headline_metric(comparison: Comparison) -> str | None:
    """The position error that most runs have, without its ``causal.`` or ``smoothed.``; None where no run has one."""

    # runs may lack different errors: the headline is about the one that most have
    def count(metric: str) -> int:
        return len(list(filter(None, scores_of(comparison, f"causal.{metric}"))))

    best = max(HEADLINES, key=count)
    return best if count(best) else None


def scores_of(comparison: Comparison, key: str) -> list[Score | None]:
    """One score of each run; None where a run lacks it, or it is not a number."""
    return [comparison.score_of(run.estimator, key) for run in comparison.runs]


def compact_table(comparison: Comparison, *, aligned: bool = True) -> Table:
    """The scores that are read first: runs down, errors and NEES across, at most `MOST_SCORES` of them.

    Scores that no run has are left out. Beside a NEES stands what the covariance is judged to be, where it misfits;
    beside a filter with the settings of its publication, that it is "as published".

    Parameters
    ----------
    comparison
        Runs with their scores.
    aligned
        Position and map errors after alignment to the truth, as in `aligned_to_truth`, instead of before.
    """
    metric = headline_metric(comparison)
    # only this error has a version before alignment
    if metric and not aligned:
        metric = RAW
    world = "aligned" if aligned and metric != RAW else unaligned(comparison.sequence)
    headings = {
        f"causal.{metric}": f"Position error, {world}",
        f"smoothed.{metric}": f"Smoothed, {world}",
    }
    headings[f"landmarks.{'se2_m' if aligned else 'raw_m'}"] = f"Map error, {world}"
    columns, cells = scores_across(
        comparison, headings | DEFINED["compact"], most=MOST_SCORES
    )
    rows = []
    for index, run in enumerate(comparison.runs):
        # whoever compares must see that a filter lacks what its neighbours have
        note = AS_PUBLISHED if run.is_as_published else ""
        name = replace(words(run.estimator, run=index), note=note)
        rows.append([name, *cells[index]])
    caption = (
        f"Position error: {label(HEADLINES[metric], comparison)}, causal. NEES 1: covariances fit."
        if metric
        else ""
    )
    columns = [Column("estimator", "Estimator", is_number=False), *columns]
    return Table("compact", "Scores at a glance", caption, columns, rows)


def scores_across(
    comparison: Comparison,
    headings: dict[str, str],
    *,
    most: int | None = None,
    before_unit: str = " ",
) -> tuple[list[Column], list[list[Cell]]]:
    """Columns of the first scores with these headings that some run has, and below them the cells of each run.

    The note of a cell is the verdict on a covariance that misfits.
    """
    # a column of dashes would take the place of one with numbers
    known = {key: found for key in headings if any(found := scores_of(comparison, key))}
    columns: list[Column] = []
    rows: list[list[Cell]] = [[] for _ in comparison.runs]
    for key in list(known)[:most]:
        unit = next(filter(None, known[key])).shown_unit
        heading = headings[key] + (f"{before_unit}({unit})" if unit else "")
        columns.append(Column(key, heading))
        for row, score in zip(rows, known[key], strict=True):
            if score is None:
                row.append(absent())
                continue
            verdict = "" if score.verdict == "consistent" else score.verdict
            row.append(number(score.value, score.text(), note=verdict))
    return columns, rows


def run_columns(comparison: Comparison) -> list[Column]:
    """A column for each run, in its colour, with a word where it failed."""
    return [
        Column(
            run.estimator,
            run.estimator,
            run=index,
            warning="failed" if run.status == "failed" else "",
        )
        for index, run in enumerate(comparison.runs)
    ]


def score_table(comparison: Comparison) -> Table:
    """Every score of every run; a dash where a run lacks one.

    Beside the numbers stands what a covariance is judged to be, and at the end of the row the interval in which the
    value of a consistent estimator lies, where it is the same for all runs.
    """
    columns = [
        Column("metric", "Metric", is_number=False),
        Column("unit", "Unit", is_number=False),
    ]
    columns += [*run_columns(comparison), Column("reading", "Reading", is_number=False)]
    rows: list[list[Cell]] = []
    sections: dict[int, str] = {}
    for key in score_keys(comparison):
        prefix = key.partition(".")[0]
        block = BLOCKS.get(prefix, prefix)
        if block not in sections.values():
            sections[len(rows)] = block
        scores = [
            comparison.scores.get(run.estimator, {}).get(key) for run in comparison.runs
        ]
        known = [score for score in scores if score is not None]
        # one interval for all stands in the last column, others beside their values
        intervals = {_expected(score) for score in known}
        common = intervals.pop() if len(intervals) == 1 else ""
        name = label(SCORES[key].label, comparison) if key in SCORES else key
        row = [words(name), words(known[0].shown_unit)]
        for score in scores:
            if score is None:
                row.append(Cell(ABSENT))
                continue
            own = "" if common else _expected(score)
            note = "; ".join(filter(None, [score.verdict, own]))
            row.append(Cell(score.text(), (score.value,), note))
        reading = filter(None, [DIRECTIONS[known[0].better], common])
        rows.append([*row, words("; ".join(reading))])
    title = "Scores by metric and estimator"
    return Table("scores", title, "", columns, rows, sections)


def _expected(score: Score) -> str:
    """The interval of a consistent estimator's value, in words."""
    if score.interval is None:
        return ""
    lowest, highest = map(score.text, score.interval)
    return f"expected {lowest} to {highest}"
