"""The report of a batch: one HTML page that needs nothing but itself. Layout and wording: templates/batch.html."""

from __future__ import annotations

import base64
import re
from collections import Counter
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from sonar_graph.batch import LEAST_PAIRS, RESULTS, Metric, RecordedBatch, estimate_sentences, metrics_of
from sonar_graph.files import replacing
from sonar_graph.report.batch_figures import (
    Drawing,
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
    Tests,
    accuracy_table,
    all_tests,
    consistency_table,
    cost_table,
    difference_table,
    failure_table,
    run_lists,
)
from sonar_graph.report.figure_style import ESTIMATOR_COLOURS
from sonar_graph.report.tables import Table, as_csv, as_latex, write_tables

FOLDED_ROWS = 24
"""Tables with more rows are folded on the screen: what is in them is drawn above them."""
FEW_LOGS = 2
TEMPLATE, PAGE = "batch.html", "report.html"
SAME_FOR_ALL = (
    *("machine", "versions", "sonar_graph", "source", "estimator_source"),
    *("gtsam", "numpy", "scipy", "numba", "python"),
)


@dataclass(frozen=True)
class Chapter:
    """What the page shows about one metric."""

    metric: Metric
    drawings: list[Drawing]
    tables: list[Table]


def write_batch_report(batch: RecordedBatch, folder: Path) -> Path:
    """Write ``report.html``, and each table as CSV and LaTeX into ``tables/``.

    Nothing is run: everything comes from the results.

    Returns
    -------
    Path of the page.
    """
    metrics = metrics_of(batch.metrics)
    content = _content(batch, metrics, all_tests(batch, metrics))
    write_tables(content["tables"], folder)
    with replacing(folder / PAGE) as partial:
        partial.write_text(_render(content), "utf-8")
    return folder / PAGE


def render_batch(batch: RecordedBatch) -> str:
    """The page as text. Everything that comes from a suite, a log or an estimator is escaped."""
    metrics = metrics_of(batch.metrics)
    return _render(_content(batch, metrics, all_tests(batch, metrics)))


def _render(content: dict[str, Any]) -> str:
    environment = Environment(
        loader=PackageLoader("sonar_graph.report", "templates"),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "svg": Markup,
        "csv_uri": _csv_uri,
        "table_csv": as_csv,
        "latex_uri": _latex_uri,
        "breakable": _breakable,
    }
    return environment.get_template(TEMPLATE).render(**content)


def _content(batch: RecordedBatch, metrics: list[Metric], tests: Tests) -> dict[str, Any]:
    """What the template shows, by the names it uses."""
    chapters = [_chapter(batch, metric, tests) for metric in metrics]
    shown = [chapter for chapter in chapters if chapter.drawings or chapter.tables]
    head = head_metric(batch, metrics)
    overview = marked(batch, overview_table(batch, head, tests)) if head else None
    others = (failure_table(batch), consistency_table(batch), cost_table(batch))
    failures, consistency, costs = (marked(batch, table) for table in others)
    return {
        "name": batch.name,
        "description": batch.description,
        "summary": _summary(batch),
        "failed": [*missing_told(batch), *failures_told(batch)],
        "is_complete": not batch.missing,
        "warnings": [*reference_told(batch), *instants_told(batch), *power_told(tests)],
        "headlines": headlines(batch, head, tests) if head else [],
        "overview": overview,
        "log_findings": errors_told(batch, metrics, tests),
        "few_logs": len(batch.logs) <= FEW_LOGS,
        "folded_rows": FOLDED_ROWS,
        "reference": batch.reference,
        "colours": len(ESTIMATOR_COLOURS),
        "contestants": batch.contestants,
        "estimates": estimate_sentences(),
        "failures": failures,
        "failure_drawing": failure_drawing(batch),
        "chapters": shown,
        "consistency": consistency,
        "consistency_drawings": _drawn(consistency_drawing(batch, what) for what in ("position", "yaw")),
        "costs": costs,
        "cost_drawings": _drawn([cost_drawing(batch)]),
        "run_lists": [(log, list(lists)) for log, lists in groupby(run_lists(batch, metrics), lambda one: one.log)],
        "tables": [*filter(None, [overview]), failures, *_chapter_tables(shown), consistency, costs],
        "least_pairs": LEAST_PAIRS,
        "same_evidence": SAME_EVIDENCE,
        "suite": batch.suite,
        "settings": _settings(batch),
        "origins": _origins(batch),
        "results": RESULTS,
    }


def _chapter_tables(chapters: list[Chapter]) -> list[Table]:
    return [table for chapter in chapters for table in chapter.tables]


def _chapter(batch: RecordedBatch, metric: Metric, tests: Tests) -> Chapter:
    if not any(batch.is_asked(log, name, key) for key in metric.keys.values() for log, name in _places(batch)):
        return Chapter(metric, [], [])
    tables = [accuracy_table(batch, metric), difference_table(batch, metric, tests)]
    drawings = _drawn([spread_drawing(batch, metric), difference_drawing(batch, metric, tests)])
    return Chapter(metric, drawings, [marked(batch, table) for table in tables if table.rows])


def _places(batch: RecordedBatch) -> list[tuple[str, str]]:
    return [(log, name) for log in batch.logs for name in batch.contestants]


def _drawn(drawings: Any) -> list[Drawing]:
    return [drawing for drawing in drawings if drawing is not None]


def _summary(batch: RecordedBatch) -> str:
    seeds = max(len(batch.group(log, name)) for log, name in _places(batch))
    return (
        f"{len(batch.runs)} runs of {len(batch.contestants)} estimators on {len(batch.logs)} logs, up to {seeds} "
        f"seed{'s' * (seeds != 1)} each, compared with {batch.reference}."
    )


def _settings(batch: RecordedBatch) -> dict[str, str]:
    """Options of logs and settings of estimators, as recorded with the first run of each."""
    found: dict[str, str] = {}
    for run in batch.runs:
        if options := run.texts.get("options"):
            found.setdefault(f"log {run.log}", options)
        if params := run.texts.get("params"):
            found.setdefault(f"estimator {run.contestant}", params)
    return dict(sorted(found.items(), key=lambda item: item[0].startswith("estimator")))


def _origins(batch: RecordedBatch) -> dict[str, list[str]]:
    """Versions and machines, each with the number of runs where they differ."""
    found = {}
    for name in SAME_FOR_ALL:
        counts = Counter(run.texts[name] for run in batch.runs if name in run.texts)
        many = len(counts) > 1
        found[name] = [f"{text} ({count} runs)" if many else text for text, count in counts.items()]
    return {name: texts for name, texts in found.items() if texts}


def _breakable(name: str) -> Markup:
    """A name that may go on in the next line after the signs that join its parts."""
    return Markup(re.sub(r"([/=_,])", r"\1<wbr>", str(escape(name))))


def _csv_uri(text: str) -> str:
    return _data_uri(text, "text/csv")


def _latex_uri(table: Table) -> str:
    return _data_uri(as_latex(table), "application/x-tex")


def _data_uri(text: str, kind: str) -> str:
    return f"data:{kind};charset=utf-8;base64,{base64.b64encode(text.encode()).decode()}"
