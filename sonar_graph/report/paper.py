"""A result for a paper: figures as SVG and PDF, tables as LaTeX and CSV, and the protocol to cite beside them.

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
from sonar_graph.evaluation import Comparison, compact_table, score_table
from sonar_graph.files import PAPER, replacing, result_written
from sonar_graph.report.batch_page import batch_content
from sonar_graph.report.comparison_page import comparison_tables
from sonar_graph.report.figure_style import arrange, sized
from sonar_graph.report.figures import drawings
from sonar_graph.report.rendering import FOLDER, latex_text, write_tables
from sonar_graph.table import Table

COLUMN_IN = 3.5
PAGE_IN = 7.16
TEXT_PT = 8.0
FONT = "STIXGeneral"
FIGURES = "figures"
DOCUMENT = "paper.tex"
PROTOCOL = "protocol.txt"
EMBEDDED: Any = {
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "sonar_graph",
}


@dataclass(frozen=True)
class PaperFigure:
    """One figure with its caption; it fills so many of the two columns of a page."""

    name: str
    caption: str
    figure: Figure
    columns: int
    data: str = ""
    """The drawn values as CSV; empty where another file of the result has them."""


def write_paper(
    result: Comparison | RecordedBatch, folder: str | Path, *, overwrite: bool = False
) -> Path:
    """Write the figures and tables of a comparison or a batch for a paper.

    The folder is made where it does not exist. It gets ``figures/NAME.svg`` and ``.pdf``, ``tables/NAME.tex`` and
    ``.csv``, ``protocol.txt`` with how the numbers were got, and ``paper.tex``, a document that shows all of them.

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
    Path of ``paper.tex``.

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
    'paper.tex'
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
            for name, text in {
                PROTOCOL: protocol,
                DOCUMENT: _document(figures, tables, protocol),
            }.items():
                with replacing(folder / name) as partial:
                    partial.write_text(text, "utf-8")
    except OSError as error:
        raise EvaluationError(
            f"{folder}: cannot be written: {error.strerror}; choose another folder with -o"
        ) from error
    return folder / DOCUMENT


def _of_comparison(
    comparison: Comparison,
) -> tuple[list[PaperFigure], list[Table], str]:
    figures = []
    for name, (shown, drawing) in drawings(comparison).items():
        # drawn anew at this width: a scaled figure has scaled text
        with sized(PAGE_IN if drawing.columns > 1 else COLUMN_IN, TEXT_PT, FONT):
            figure = drawing.draw(shown)
        if figure is not None:
            caption = f"{drawing.title}. {drawing.caption}"
            figures.append(
                PaperFigure(name.replace("_", "-"), caption, figure, drawing.columns)
            )
    sequence = comparison.sequence
    environment = comparison.environment
    lines = [
        f"{', '.join(run.estimator for run in comparison.runs)} were run by sonar_graph {environment['sonar_graph']} "
        f"(GTSAM {environment['gtsam']}) on {sequence.name}, {sequence.duration_s:.1f} s, with the same measurements "
        f"in the same order, and asked for estimates at the same {len(comparison.instants_ns)} instants. "
        f"Scored: {environment.get('scored instants', 'none')}.",
        *_rules(comparison),
        f"Settings of every run and all scores: comparison.json. Command: {environment['command']}",
    ]
    return (
        figures,
        [compact_table(comparison), *comparison_tables(comparison)],
        "\n\n".join(lines) + "\n",
    )


def _rules(comparison: Comparison) -> list[str]:
    """Rules by which the scores of the compact table are measured, each once; where they differ, with their runs."""
    rules = []
    labels = {row[0].text for row in score_table(comparison).rows}
    for column in compact_table(comparison).columns[1:]:
        heading = f"{column.over}, {column.heading}".removeprefix(", ")
        names = dict[str, list[str]]()
        for run in comparison.runs:
            if score := comparison.score_of(run.estimator, column.key):
                names.setdefault(score.protocol, []).append(run.estimator)
        of = {
            rule: f" of {' and '.join(runs)}" if len(names) > 1 else ""
            for rule, runs in names.items()
        }
        rules += [f"{heading}{of[rule]}: {rule}" for rule in names]
    return rules if labels else []


def _of_batch(batch: RecordedBatch) -> tuple[list[PaperFigure], list[Table], str]:
    with sized(PAGE_IN, TEXT_PT, FONT):
        content = batch_content(batch)
    # in the order of the page
    drawn = [
        content["failure_drawing"],
        *(one for chapter in content["chapters"] for one in chapter["drawings"]),
    ]
    drawn += [*content["consistency_drawings"], content["cost_drawing"]]
    figures = [
        PaperFigure(one.name, f"{one.title}. {one.caption}", one.figure, 2, one.data)
        for one in drawn
        if one is not None
    ]
    versions = {name: " or ".join(found) for name, found in content["origins"].items()}
    lines = [
        f"{content['summary']} Suite {batch.name}, sonar_graph {versions.get('sonar_graph', 'of unknown version')}.",
        *(
            f"{chapter['metric'].label}: {chapter['metric'].protocol}"
            for chapter in content["chapters"]
        ),
        f"{' '.join(content['estimates'])} Tests of a metric are corrected by Holm (1979). "
        f"Every run: {content['results']}.",
    ]
    return (
        figures,
        [table for table in content["tables"] if table.rows],
        "\n\n".join(lines) + "\n",
    )


def _write_figure(one: PaperFigure, folder: Path) -> None:
    """The figure as SVG and PDF, and its data where it has any; the same result gives the same bytes."""
    # margins depend on the size of the text, which is the paper's
    arrange(one.figure)
    with mpl.rc_context(EMBEDDED):
        for suffix, about in (
            ("svg", {"Date": None}),
            ("pdf", {"CreationDate": None, "Producer": None}),
        ):
            with replacing(folder / FIGURES / f"{one.name}.{suffix}") as partial:
                one.figure.savefig(partial, format=suffix, metadata=about)
    if one.data:
        with replacing(folder / FIGURES / f"{one.name}.csv") as partial:
            partial.write_text(one.data, "utf-8")


def _document(figures: list[PaperFigure], tables: list[Table], protocol: str) -> str:
    """A document that includes every figure and table; the lines are there to be copied."""
    lines = [
        "% Copy what you need: each figure and table stands alone. Compile: pdflatex paper.tex",
        *(f"% {line}" for line in protocol.splitlines() if line),
        r"\documentclass[10pt,twocolumn]{article}",
        r"\usepackage[utf8]{inputenc}",
        r"\usepackage[letterpaper,margin=0.67in,columnsep=0.16in]{geometry}",
        r"\usepackage{graphicx,booktabs,textcomp}",
        r"\extrafloats{200}",
        r"\begin{document}",
    ]
    for one in figures:
        star = "*" if one.columns > 1 else ""
        lines += [
            rf"\begin{{figure{star}}}",
            r"\centering",
            rf"\includegraphics{{{FIGURES}/{one.name}.pdf}}",
            rf"\caption{{{latex_text(one.caption)}}}",
            rf"\label{{fig:{one.name}}}",
            rf"\end{{figure{star}}}",
        ]
    lines += [r"\onecolumn", r"\scriptsize", r"\setlength{\tabcolsep}{2.5pt}"]
    lines += [rf"\input{{{FOLDER}/{table.name}.tex}}" for table in tables]
    return (
        "\n".join(
            [
                *lines,
                r"\clearpage\normalsize",
                r"\section*{Protocol}",
                latex_text(protocol),
                r"\end{document}",
            ]
        )
        + "\n"
    )
