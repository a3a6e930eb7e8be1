"""A result for a paper: figures as SVG and PDF, tables as CSV, and the protocol to cite beside them.

Widths are those of two-column journals: 3.5 in for a column, 7.16 in for a page. Text is 8 pt in a font like Times that
comes with matplotlib, so that it is the same on every machine: as outlines in SVG, embedded (type 42) in PDF.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from sonar_graph.batch import RecordedBatch
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import Comparison, compact_table
from sonar_graph.files import PAPER, replacing, result_written
from sonar_graph.report.batch_page import batch_content
from sonar_graph.report.comparison_page import comparison_tables, protocols
from sonar_graph.report.figure_style import arrange, sized
from sonar_graph.report.figures import drawings
from sonar_graph.report.rendering import write_tables
from sonar_graph.table import Table

COLUMN_IN = 3.5
PAGE_IN = 7.16
TEXT_PT = 8.0
FONT = "STIXGeneral"
FIGURES = "figures"
PROTOCOL = "protocol.txt"
EMBEDDED: Any = {
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "sonar_graph",
}


@dataclass(frozen=True)
class PaperFigure:
    """One figure with its caption."""

    name: str
    caption: str
    figure: Figure


def write_paper(
    result: Comparison | RecordedBatch, folder: str | Path, *, overwrite: bool = False
) -> Path:
    """Write the figures and tables of a comparison or a batch for a paper.

    The folder is made where it does not exist. It gets ``figures/NAME.svg`` and ``.pdf``, ``tables/NAME.csv``, and
    ``protocol.txt`` with how the numbers were got and a caption for each figure.

    Parameters
    ----------
    result
        Result of `sonar_graph.evaluation.compare` or `read_comparison`, or of `sonar_graph.batch.read_batch`.
    folder
        Path of the folder.
    overwrite
        Replace files of these names also where this package did not write them, or they were changed since.

    Returns
    -------
    Path of ``protocol.txt``.

    Raises
    ------
    EvaluationError
        When the folder cannot be written to, another command writes there, or it holds others' files of these names.

    Examples
    --------
    >>> import tempfile
    >>> from sonar_graph.evaluation import compare
    >>> from sonar_graph.report import write_paper
    >>> from sonar_graph.testing import small_world
    >>> comparison = compare(small_world(), ["dead-reckoning"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_paper(comparison, folder).name
    'protocol.txt'
    """
    folder = Path(folder)
    if isinstance(result, Comparison):
        figures, tables, protocol = _of_comparison(result)
    else:
        figures, tables, protocol = _of_batch(result)
    try:
        with result_written(folder, PAPER, overwrite=overwrite) as written:
            # figures of an earlier result would be included by hand and be wrong
            written.remove(written.names)
            for one in figures:
                _write_figure(one, folder)
            write_tables(tables, folder)
            captions = [f"{one.name}: {one.caption}" for one in figures]
            with replacing(folder / PROTOCOL) as partial:
                partial.write_text("\n\n".join([protocol, *captions]) + "\n", "utf-8")
    except OSError as error:
        raise EvaluationError(
            f"{folder}: cannot be written: {error.strerror}; choose another folder with -o"
        ) from error
    return folder / PROTOCOL


def _of_comparison(
    comparison: Comparison,
) -> tuple[list[PaperFigure], list[Table], str]:
    figures = []
    for name, (shown, drawing) in drawings(comparison).items():
        # drawn again at this width: a scaled figure has scaled text
        with sized(PAGE_IN if drawing.columns > 1 else COLUMN_IN, TEXT_PT, FONT):
            figure = drawing.draw(shown)
        if figure is not None:
            caption = f"{drawing.title}. {drawing.caption}"
            figures.append(PaperFigure(name.replace("_", "-"), caption, figure))
    rules = [
        f"{block}, {label}{names and f' of {names}'}: {rule}"
        for block, scores in protocols(comparison).items()
        for label, _, found in scores
        for names, rule in found
    ]
    sequence = comparison.sequence
    environment = comparison.environment
    lines = [
        f"{', '.join(run.estimator for run in comparison.runs)} were run by sonar_graph {environment['sonar_graph']} "
        f"(GTSAM {environment['gtsam']}) on {sequence.name}, {sequence.duration_s:.1f} s, with the same measurements "
        f"in the same order, and asked for estimates at the same {len(comparison.instants_ns)} instants. "
        f"Scored: {environment.get('scored instants', 'none')}.",
        *rules,
        f"Settings of every run and all scores: comparison.json. Command: {environment['command']}",
    ]
    tables = [compact_table(comparison), *comparison_tables(comparison)]
    return figures, tables, "\n\n".join(lines)


def _of_batch(batch: RecordedBatch) -> tuple[list[PaperFigure], list[Table], str]:
    with sized(PAGE_IN, TEXT_PT, FONT):
        content = batch_content(batch)
    figures = [
        PaperFigure(one.name, f"{one.title}. {one.caption}", one.figure)
        for one in filter(None, (chapter["drawing"] for chapter in content["chapters"]))
    ]
    versions = {name: " or ".join(found) for name, found in content["origins"].items()}
    metrics = [chapter["metric"] for chapter in content["chapters"]]
    lines = [
        f"{content['summary']} Suite {batch.name}, sonar_graph {versions.get('sonar_graph', 'of unknown version')}.",
        *(f"{metric.label}: {metric.protocol}" for metric in metrics),
        f"{' '.join(content['estimates'])} Tests of a metric are corrected by Holm (1979). "
        f"Every run: {content['results']}.",
    ]
    tables = [table for table in content["tables"] if table.rows]
    return figures, tables, "\n\n".join(lines)


def _write_figure(one: PaperFigure, folder: Path) -> None:
    """The figure as SVG and PDF; the same result gives the same bytes."""
    # margins depend on the size of the text, which is the paper's
    arrange(one.figure)
    with mpl.rc_context(EMBEDDED):
        for suffix, about in (
            ("svg", {"Date": None}),
            ("pdf", {"CreationDate": None, "Producer": None}),
        ):
            with replacing(folder / FIGURES / f"{one.name}.{suffix}") as partial:
                one.figure.savefig(partial, format=suffix, metadata=about)
