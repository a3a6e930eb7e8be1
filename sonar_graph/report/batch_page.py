"""The report of a batch: one HTML page that needs nothing but itself. Explanations: ``templates/batch.html``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from sonar_graph.batch import LEAST_PAIRS, RESULTS, Metric, RecordedBatch, metrics_of
from sonar_graph.evaluation import ESTIMATES, Table
from sonar_graph.files import replacing
from sonar_graph.report.batch_figures import (
    consistency_drawing,
    cost_drawing,
    difference_drawing,
    failure_drawing,
    spread_drawing,
)
from sonar_graph.report.batch_summary import (
    errors_told,
    failures_told,
    head_metric,
    headlines,
    instants_told,
    marked,
    missing_told,
    overview_table,
    power_told,
    reference_told,
)
from sonar_graph.report.batch_tables import (
    SAME_EVIDENCE,
    accuracy_table,
    all_tests,
    consistency_table,
    cost_table,
    difference_table,
    failure_table,
    run_lists,
)
from sonar_graph.report.figure_style import Illustration
from sonar_graph.report.rendering import render, write_tables

FOLDED_ROWS = 24
"""Tables with more rows are folded on the screen: figures above them show the same."""
FEW_LOGS = 2
TEMPLATE, PAGE = "batch.html", "report.html"
ORIGINS = (
    *("machine", "versions", "sonar_graph", "source", "estimator_source"),
    *("gtsam", "numpy", "scipy", "numba", "python"),
)
"""Columns of the results that are normally the same for all runs."""


@dataclass(frozen=True)
class Chapter:
    """The part of the page about one metric."""

    metric: Metric
    drawings: list[Illustration]
    tables: list[Table]


def write_batch_report(batch: RecordedBatch, folder: Path) -> Path:
    """Write ``report.html``, and each table as CSV and LaTeX into ``tables/``, from the results alone.

    Returns
    -------
    Path of the page.
    """
    content = _content(batch)
    write_tables(content["tables"], folder)
    with replacing(folder / PAGE) as partial:
        partial.write_text(render(TEMPLATE, content), "utf-8")
    return folder / PAGE


def render_batch(batch: RecordedBatch) -> str:
    """The page as text."""
    return render(TEMPLATE, _content(batch))


def _content(batch: RecordedBatch) -> dict[str, Any]:
    """Values by the names that the template uses."""
    metrics = metrics_of(batch.metrics)
    tests = all_tests(batch, metrics)
    groups = [(log, name) for log in batch.logs for name in batch.contestants]
    chapters = []
    for metric in metrics:
        if any(batch.is_asked(log, name, key) for key in metric.keys.values() for log, name in groups):
            drawings = [spread_drawing(batch, metric), difference_drawing(batch, metric, tests)]
            tables = [accuracy_table(batch, metric), difference_table(batch, metric, tests)]
            shown = [marked(batch, table) for table in tables if table.rows]
            chapters.append(Chapter(metric, [drawing for drawing in drawings if drawing], shown))
    head = head_metric(batch, metrics)
    overview = marked(batch, overview_table(batch, head, tests)) if head else None
    others = (failure_table(batch), consistency_table(batch), cost_table(batch))
    failures, consistency, costs = (marked(batch, table) for table in others)
    anees = [consistency_drawing(batch, what) for what in ("position", "yaw")]
    seeds = max(len(batch.group(log, name)) for log, name in groups)
    settings: dict[str, str] = {}
    for column, name in (("options", "log {0.log}"), ("params", "estimator {0.contestant}")):
        for run in batch.runs:
            if run.texts.get(column):
                settings.setdefault(name.format(run), run.texts[column])
    origins = {}
    for name in ORIGINS:
        counts = Counter(run.texts[name] for run in batch.runs if name in run.texts)
        if counts:
            many = len(counts) > 1
            origins[name] = [f"{text} ({count} runs)" if many else text for text, count in counts.items()]
    return {
        "name": batch.name,
        "names": batch.contestants,
        "description": batch.description,
        "summary": (
            f"{len(batch.runs)} runs of {len(batch.contestants)} estimators on {len(batch.logs)} logs, up to {seeds} "
            f"seed{'s' * (seeds != 1)} each, compared with {batch.reference}."
        ),
        "failed": [*missing_told(batch), *failures_told(batch)],
        "is_complete": not batch.missing,
        "warnings": [*reference_told(batch), *instants_told(batch), *power_told(tests)],
        "headlines": headlines(batch, head, tests) if head else [],
        "overview": overview,
        "log_findings": errors_told(batch, metrics, tests),
        "few_logs": len(batch.logs) <= FEW_LOGS,
        "folded_rows": FOLDED_ROWS,
        "reference": batch.reference,
        "estimates": [f"{sentence}." for sentence in ESTIMATES.values()],
        "failures": failures,
        "failure_drawing": failure_drawing(batch),
        "chapters": chapters,
        "consistency": consistency,
        "consistency_drawings": [drawing for drawing in anees if drawing],
        "costs": costs,
        "cost_drawing": cost_drawing(batch),
        "run_lists": [(log, list(lists)) for log, lists in groupby(run_lists(batch, metrics), lambda one: one.log)],
        "tables": [
            *filter(None, [overview]),
            failures,
            *(table for chapter in chapters for table in chapter.tables),
            consistency,
            costs,
        ],
        "least_pairs": LEAST_PAIRS,
        "same_evidence": SAME_EVIDENCE,
        "suite": batch.suite,
        "settings": settings,
        "origins": origins,
        "results": RESULTS,
    }
