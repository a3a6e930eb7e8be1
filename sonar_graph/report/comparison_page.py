"""The report of a comparison: one HTML page that needs nothing but itself, beside the files it links to.

Layout and explanations: ``templates/comparison.html``. Design: docs/design/0008.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonar_graph.errors import ArgumentError, EvaluationError
from sonar_graph.evaluation import (
    Comparison,
    aligned_to_truth,
    compact_table,
    repeats_published,
    run_columns,
    score_keys,
    score_table,
    write_comparison,
    write_viewer_files,
)
from sonar_graph.files import COMPARISON, as_path, refused, result_written
from sonar_graph.logs import PICTURES
from sonar_graph.report import sentences
from sonar_graph.report.figures import RAW_VIEW, illustrations
from sonar_graph.report.given_map import given_map_table
from sonar_graph.report.landmark_table import PAPER, landmark_table, landmarks_left_out
from sonar_graph.report.rendering import PageSection, html_of, write_html
from sonar_graph.states import Outcome
from sonar_graph.table import ABSENT, Column, Table, text_table

if TYPE_CHECKING:
    from sonar_graph.recognition import Recognition

PAGE = "report.html"
SECTIONS = (
    PageSection("over-time", "Errors"),
    PageSection("consistency", "Heading and consistency"),
    PageSection("detections", "Detections"),
    PageSection("recognition", "Sonar images"),
    PageSection("landmarks", "Landmarks"),
    PageSection("tables", "Tables"),
    PageSection("method", "Method"),
    PageSection("protocol", "Protocol", is_folded=True),
    PageSection("provenance", "Provenance", is_folded=True),
    PageSection("files", "Files"),
)
# files of a run, and the field of `RunResult` without which a file is absent
RUN_FILES = {
    "trajectory.tum": "smoothed",
    "causal.tum": "causal",
    "landmarks.csv": "landmarks",
}


def write_report(
    comparison: Comparison, folder: str | Path, *, overwrite: bool = False
) -> Path:
    """Write a comparison into a folder: all the files that ``sonar-graph compare`` writes.

    The folder is made where it does not exist. It gets ``report.html``, ``comparison.json``, ``sequence.npz``,
    ``runs/NAME/`` for each estimator, the pictures of recognised landmarks, and ``result.mcap`` with its layouts for
    Foxglove and RViz. An earlier comparison in the folder is replaced when the new one is complete; other files stay.

    Parameters
    ----------
    comparison
        Result of `sonar_graph.evaluation.compare`.
    folder
        Path of the folder.
    overwrite
        Replace files of these names also where this package did not write them, or they were changed since.

    Returns
    -------
    Path of ``report.html``.

    Raises
    ------
    EvaluationError
        When the folder cannot be written to, another command writes there, it holds others' files under these names, or
        the name of an estimator cannot be the name of a folder.
    ArgumentError
        When `comparison` is something else, such as a list of runs.
    LogError
        When ``result.mcap`` cannot be written, or a stamp does not fit into a ROS 2 message.

    Examples
    --------
    >>> import tempfile
    >>> from sonar_graph.evaluation import compare
    >>> from sonar_graph.report import write_report
    >>> from sonar_graph.simulation import MissionOptions, simulate_mission
    >>> comparison = compare(simulate_mission(MissionOptions(duration_s=10.0)), ["dead-reckoning"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_report(comparison, folder).name
    'report.html'
    """
    given: object = comparison
    if not isinstance(given, Comparison):
        raise ArgumentError(
            f"write_report(comparison, folder): expected a Comparison, not {type(given).__name__}; "
            "compare(sequence, names) gives one"
        )
    folder = as_path(folder, "write_report(comparison, folder)")
    with (
        refused(folder, EvaluationError, "choose another folder"),
        result_written(folder, COMPARISON, overwrite=overwrite),
    ):
        write_comparison(comparison, folder)
        write_viewer_files(comparison, folder)
        return write_page(comparison, folder)


def write_page(comparison: Comparison, folder: Path) -> Path:
    """Write only ``report.html``, beside the other files of a comparison, and return its path.

    The page needs nothing but itself, and has no script. Links lead to the files beside it (``comparison.json``,
    ``result.mcap``, ``runs/NAME/``).

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sonar_graph import compare
    >>> from sonar_graph.report import write_page
    >>> from sonar_graph.testing import small_world
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_page(compare(small_world(), ["dead-reckoning"]), Path(folder)).name
    'report.html'
    """
    with result_written(folder, COMPARISON):
        return write_html(folder / PAGE, "comparison", *_page(comparison))


def render_report(comparison: Comparison) -> str:
    """The page as text."""
    return html_of("comparison", *_page(comparison))


def _page(comparison: Comparison) -> tuple[list[PageSection], dict[str, Any]]:
    """The sections of the page, and the values that their macros use."""
    # None without errors: then figures and tables have one view
    aligned = aligned_to_truth(comparison)
    figures = illustrations(comparison)
    landmarks = _views(
        "landmarks", landmark_table(aligned or comparison), landmark_table(comparison)
    )
    outcomes = outcome_table(comparison)
    names = [run.estimator for run in comparison.runs]
    content: dict[str, Any] = {
        "name": comparison.sequence.name,
        "names": names,
        "comparison": comparison,
        "sentences": sentences,
        "detections": len(comparison.sequence.detections or ()),
        "aligned": aligned,
        "failed": text_table(
            "failed",
            "Runs that did not come to an end",
            ["Estimator", "Reason"],
            [[run.estimator, run.reason] for run in comparison.failed_runs],
            numbers=False,
        ),
        "compact": _views(
            "compact",
            compact_table(comparison),
            compact_table(comparison, aligned=aligned is None),
        ),
        "scores": score_table(comparison),
        "protocols": protocols(comparison),
        "figures": figures,
        "landmarks": landmarks,
        "left_out": landmarks_left_out(comparison),
        "given_map": given_map_table(comparison),
        "paper": PAPER if repeats_published(comparison.sequence) else "",
        "outcomes": outcomes,
        "topic": PICTURES,
        "run_files": RUN_FILES,
    }
    found = comparison.recognition
    if found is not None:
        content |= _recognition_tables(found, comparison.sequence.start_ns)
    is_shown = {
        "detections": content["detections"] or outcomes.rows,
        "recognition": found,
        "landmarks": landmarks or figures["growth"].svg,
    }
    return [one for one in SECTIONS if is_shown.get(one.anchor, True)], content


def _views(name: str, aligned: Table | None, raw: Table | None) -> dict[str, Table]:
    """A table by name, and with `RAW_VIEW` the one before alignment where it differs; empty without a table."""
    if aligned is None or raw is None:
        return {}
    if raw == aligned:
        return {name: aligned}
    return {name: aligned, name + RAW_VIEW: replace(raw, name=name + RAW_VIEW)}


def comparison_tables(comparison: Comparison) -> list[Table]:
    """All tables of numbers that the page has, but the compact one."""
    tables = (
        score_table(comparison),
        landmark_table(comparison),
        outcome_table(comparison),
    )
    return [table for table in tables if table and table.rows]


def protocols(
    comparison: Comparison,
) -> dict[str, list[tuple[str, str, list[tuple[str, str]]]]]:
    """The measuring rules by block of the score table: label, key, and each rule with the runs that it is of.

    The runs are left out where one rule is of all.
    """
    # labels and their order are those of the table
    table = score_table(comparison)
    found: dict[str, list[tuple[str, str, list[tuple[str, str]]]]] = {}
    keys = score_keys(comparison)
    for place, (key, row) in enumerate(zip(keys, table.rows, strict=True)):
        # the place of a row is also the place of its block's heading
        if place in table.sections:
            told = found.setdefault(table.sections[place], [])
        # runs may be measured by different rules, as where one has no covariance
        rules = sentences.named_by(
            (comparison.scores[run.estimator][key].protocol, run.estimator)
            for run in comparison.runs
            if key in comparison.scores.get(run.estimator, {})
        )
        is_shared = len(rules) == 1
        named = [("" if is_shared else names, rule) for rule, names in rules.items()]
        told.append((row[0].text, key, named))
    return found


def outcome_table(comparison: Comparison) -> Table:
    """Outcomes of detections, with count and share by run; a total in the last row."""
    counts = [Counter(sentences.outcomes_of(run)) for run in comparison.runs]
    rows = []
    for outcome in Outcome:
        # outcomes that no run has would be most of the table
        if any(count[outcome] for count in counts):
            shares = [_share(count, outcome) for count in counts]
            rows.append([outcome.value.capitalize(), *shares])
    if rows:
        totals = [str(count.total()) if count else ABSENT for count in counts]
        rows.append(["All detections", *totals])
    heads = [Column("outcome", "Outcome", is_number=False), *run_columns(comparison)]
    return text_table("outcomes", "What became of each detection", heads, rows)


def _share(count: Counter[Outcome], outcome: Outcome) -> str:
    """Detections with an outcome, with their share of all; a dash without detections."""
    number = count[outcome]
    if not number:
        return "0" if count else ABSENT
    return f"{number} ({100 * number / count.total():.1f} %)"


def _recognition_tables(found: Recognition, start_ns: int) -> dict[str, Any]:
    """The tables of outcomes and warnings, and the probability from which on an identity is sure."""
    # a recogniser takes a while to load, and most logs have detections
    from sonar_graph.recognition import SURE

    return {
        "sure": SURE,
        "recognised": text_table(
            "recognition",
            "What became of candidates, tracks and frames",
            ["Outcome", "Count"],
            [[outcome, str(count)] for outcome, count in found.outcomes.most_common()],
        ),
        "warnings": text_table(
            "frames",
            "Frames that were not used, and changes of the sonar's window",
            ["Time (s)", "Reason"],
            [
                [f"{(stamp_ns - start_ns) * 1e-9:.2f}", reason]
                for stamp_ns, reason in found.warnings
            ],
            numbers=False,
        ),
    }
