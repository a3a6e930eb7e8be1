"""A result for a paper: figures as SVG and PDF, tables as CSV, and the protocol to cite beside them.

Widths are those of two-column journals: 3.5 in for a column, 7.16 in for a page. Text is 8 pt in a font like Times that
comes with matplotlib, so that it is the same on every machine: as outlines in SVG, embedded (type 42) in PDF.
"""

from pathlib import Path
from typing import Any

import matplotlib as mpl

from sonar_graph.batch import RecordedBatch
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import Comparison, compact_table
from sonar_graph.files import PAPER, refused, replacing, result_written
from sonar_graph.report.batch_page import batch_content
from sonar_graph.report.comparison_page import comparison_tables, protocols
from sonar_graph.report.figure_style import Illustration, arrange, sized
from sonar_graph.report.figures import drawings
from sonar_graph.report.rendering import render, write_tables
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
    with (
        refused(folder, EvaluationError, "choose another folder with -o"),
        result_written(folder, PAPER, overwrite=overwrite) as written,
    ):
        # figures of an earlier result would be included by hand and be wrong
        written.remove(written.names)
        for one in figures:
            _write_figure(one, folder)
        write_tables(tables, folder)
        captions = [f"{one.name}: {one.title}. {one.caption}" for one in figures]
        with replacing(folder / PROTOCOL) as partial:
            partial.write_text(
                "\n\n".join([protocol.strip(), *captions]) + "\n", "utf-8"
            )
    return folder / PROTOCOL


def _of_comparison(
    comparison: Comparison,
) -> tuple[list[Illustration], list[Table], str]:
    figures = []
    for name, (shown, drawing) in drawings(comparison).items():
        # drawn again at this width: a scaled figure has scaled text
        with sized(PAGE_IN if drawing.columns > 1 else COLUMN_IN, TEXT_PT, FONT):
            figure = drawing.draw(shown)
        if figure is not None:
            drawn = Illustration(name, drawing.title, drawing.caption, figure=figure)
            figures.append(drawn)
    text = render("protocol.txt", {"comparison": comparison, "protocols": protocols})
    tables = [compact_table(comparison), *comparison_tables(comparison)]
    return figures, tables, text


def _of_batch(batch: RecordedBatch) -> tuple[list[Illustration], list[Table], str]:
    with sized(PAGE_IN, TEXT_PT, FONT):
        content = batch_content(batch)
    figures = [one["drawing"] for one in content["chapters"] if one["drawing"]]
    text = render("batch_protocol.txt", content)
    tables = [table for table in content["tables"] if table.rows]
    return figures, tables, text


def _write_figure(one: Illustration, folder: Path) -> None:
    """The figure as SVG and PDF; the same result gives the same bytes."""
    assert one.figure is not None, "a figure of a paper is drawn"
    # margins depend on the size of the text, which is the paper's
    arrange(one.figure)
    with mpl.rc_context(EMBEDDED):
        for suffix, about in (
            ("svg", {"Date": None}),
            ("pdf", {"CreationDate": None, "Producer": None}),
        ):
            with replacing(folder / FIGURES / f"{one.name}.{suffix}") as partial:
                one.figure.savefig(partial, format=suffix, metadata=about)
