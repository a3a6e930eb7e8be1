"""The report of a batch: one HTML page that needs nothing but itself. Explanations: ``templates/batch.html``."""

from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

from sonar_graph.batch import LEAST_PAIRS, RESULTS, RecordedBatch, metrics_of
from sonar_graph.evaluation import ESTIMATES
from sonar_graph.files import BATCH, result_written
from sonar_graph.report import batch_figures as figures
from sonar_graph.report import batch_summary as summary
from sonar_graph.report import batch_tables as tables
from sonar_graph.report.figure_style import sized
from sonar_graph.report.rendering import PageSection, html_of, write_html, write_tables
from sonar_graph.states import counted

# Tables with more rows are folded on the screen: figures above them show the same
FOLDED_ROWS = 24
PAGE = "report.html"
SECTIONS = (
    PageSection("reading", "How to read this page"),
    PageSection("ended", "Runs that ended"),
    PageSection("errors", "Errors"),
    PageSection("consistency", "Consistency"),
    PageSection("protocol", "Protocol"),
    PageSection("provenance", "Provenance"),
)
# columns of the results that are normally the same for all runs
ORIGINS = (
    *("machine", "versions", "sonar_graph", "source", "estimator_source"),
    *("gtsam", "numpy", "scipy", "numba", "python"),
)


def write_batch_report(
    batch: RecordedBatch, folder: Path, *, overwrite: bool = False
) -> Path:
    """Write ``report.html``, and each table as CSV into ``tables/``, from the results alone.

    Files that this package did not write are replaced only with ``overwrite``.

    Returns
    -------
    Path of the page.
    """
    sections, content = _page(batch)
    with result_written(folder, BATCH, overwrite=overwrite):
        write_tables(content["tables"], folder)
        return write_html(folder / PAGE, "batch", sections, content)


def render_batch(batch: RecordedBatch) -> str:
    """The page as text."""
    return html_of("batch", *_page(batch))


def _page(batch: RecordedBatch) -> tuple[list[PageSection], dict[str, Any]]:
    """The sections of the page, without that of errors where no run has any, and the values that their macros use."""
    with sized():
        content = batch_content(batch)
    sections = (
        one for one in SECTIONS if content["chapters"] or one.anchor != "errors"
    )
    return list(sections), content


def batch_content(batch: RecordedBatch) -> dict[str, Any]:
    """Values by the names that the template uses."""
    metrics = metrics_of(batch.metrics)
    tests = tables.all_tests(batch, metrics)
    # a metric is a chapter only where some run can have it
    chapters: list[dict[str, Any]] = []
    for metric in metrics:
        if any(summary.is_asked(batch, log, metric) for log in batch.logs):
            accuracy = tables.accuracy_table(batch, metric)
            differences = tables.difference_table(batch, metric, tests)
            both = [one for one in (accuracy, differences) if one.rows]
            drawing = figures.spread_drawing(batch, metric)
            marked = [summary.marked(batch, one) for one in both]
            chapters.append({"metric": metric, "drawing": drawing, "tables": marked})
    # tables leave the page as files, and must state there too what is missing
    overview = None
    if head := summary.head_metric(batch, metrics):
        overview = summary.marked(batch, summary.overview_table(batch, head, tests))
    failures = summary.marked(batch, tables.failure_table(batch))
    consistency = summary.marked(batch, tables.consistency_table(batch))
    # logs may have different numbers of seeds
    groups = product(batch.logs, batch.contestants)
    seeds = max(len(batch.group(log, name)) for log, name in groups)
    settings: dict[str, str] = {}
    for column, name in (
        ("options", "log {0.log}"),
        ("params", "estimator {0.contestant}"),
    ):
        # the first run of each log and estimator is enough: all of one have the same settings
        for run in batch.runs:
            if run.texts.get(column):
                settings.setdefault(name.format(run), run.texts[column])
    origins = {}
    for name in ORIGINS:
        # a batch that was resumed on another machine has several values
        counts = Counter(run.texts[name] for run in batch.runs if name in run.texts)
        if len(counts) > 1:
            origins[name] = [f"{text} ({n} runs)" for text, n in counts.items()]
        elif counts:
            origins[name] = list(counts)
    return {
        "name": batch.name,
        "names": batch.contestants,
        "batch": batch,
        "summary": (
            f"{counted(len(batch.runs), 'run')} of {counted(len(batch.contestants), 'estimator')} on "
            f"{counted(len(batch.logs), 'log')}, up to {counted(seeds, 'seed')} each, compared with {batch.reference}."
        ),
        "warnings": summary.warnings_of(batch),
        "overview": overview,
        "folded_rows": FOLDED_ROWS,
        "estimates": [f"{sentence}." for sentence in ESTIMATES.values()],
        "failures": failures,
        "unended": tables.unended_table(batch),
        "chapters": chapters,
        "consistency": consistency,
        "tables": [
            *filter(None, [overview]),
            failures,
            *(one for chapter in chapters for one in chapter["tables"]),
            consistency,
        ],
        "least_pairs": LEAST_PAIRS,
        "settings": settings,
        "origins": origins,
        "results": RESULTS,
    }
