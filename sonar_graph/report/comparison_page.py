"""The report of a comparison: one HTML page that needs nothing but itself, beside the files it links to.

Layout and explanations: ``templates/comparison.html``. Design: docs/design/0008.
"""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sonar_graph.errors import ArgumentError, EvaluationError
from sonar_graph.evaluation import (
    Comparison,
    aligned_to_truth,
    compact_table,
    format_value,
    repeats_published,
    run_columns,
    score_keys,
    score_table,
    write_comparison,
    write_viewer_files,
)
from sonar_graph.files import COMPARISON, as_path, result_written
from sonar_graph.logs import PICTURES
from sonar_graph.report import sentences
from sonar_graph.report.figures import RAW_VIEW, illustrations
from sonar_graph.report.given_map import given_map_table
from sonar_graph.report.landmark_table import PAPER, landmark_table, landmarks_left_out
from sonar_graph.report.rendering import PageSection, data_address, html_of, write_html
from sonar_graph.sequence import Sequence
from sonar_graph.states import Outcome, counted
from sonar_graph.table import ABSENT, Column, Table, text_table, words

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
    try:
        with result_written(folder, COMPARISON, overwrite=overwrite):
            write_comparison(comparison, folder)
            write_viewer_files(comparison, folder)
            return write_page(comparison, folder)
    except OSError as error:
        raise EvaluationError(
            f"{folder}: cannot be written: {error.strerror}; choose another folder"
        ) from error


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
    sequence = comparison.sequence
    runs = comparison.runs
    detections = len(sequence.detections) if sequence.detections else 0
    # None without errors: then figures and tables have one view
    aligned = aligned_to_truth(comparison)
    outcomes = outcome_table(comparison)
    content: dict[str, Any] = {
        "name": sequence.name,
        "names": [run.estimator for run in runs],
        "beside_the_paper": sentences.beside_the_paper(comparison),
        "summary": (
            f"{', '.join(run.estimator for run in runs)} on {format_value(round(sequence.duration_s, 1))} s of "
            f"{'planar' if sequence.calibration.planar else 'three-dimensional'} motion {_of_truth(sequence)}: "
            f"{counted(detections, 'landmark detection')}."
        ),
        "headlines": {
            "aligned": sentences.headline(comparison),
            "raw": sentences.headline(comparison, aligned=False) if aligned else "",
        },
        "published": sentences.published_filters(comparison),
        "remarks": sentences.remarks(comparison),
        "doubts": sentences.doubts(comparison),
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
        "figures": illustrations(comparison),
        "landmarks": _views(
            "landmarks",
            landmark_table(aligned or comparison),
            landmark_table(comparison),
        ),
        "left_out": landmarks_left_out(comparison),
        "given_map": given_map_table(comparison),
        "has_true_landmarks": sequence.true_landmarks is not None,
        "nameless": sentences.nameless_landmarks(comparison),
        "paper": PAPER if repeats_published(sequence) else "",
        "outcomes": outcomes,
        "refused": sentences.refusal_lines(comparison),
        "recognition": recognition_content(comparison),
        "files": {
            run.estimator: {
                name: f"runs/{quote(run.estimator)}/{name}"
                for name, field in RUN_FILES.items()
                if getattr(run, field) is not None
            }
            for run in runs
        },
        "settings": {run.estimator: _as_json(run.params) for run in runs},
        "calibration": _as_json(sequence.calibration.model_dump(mode="json")),
        "notes": sequence.notes,
        "environment": comparison.environment,
    }
    is_shown = {
        "detections": detections > 0 or bool(outcomes.rows),
        "recognition": content["recognition"] is not None,
        "landmarks": content["landmarks"] or content["figures"]["growth"].svg,
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


def _as_json(values: Any) -> str:
    return json.dumps(values, indent=2, default=str, ensure_ascii=False)


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
    columns = [Column("outcome", "Outcome", is_number=False), *run_columns(comparison)]
    cells = [[words(text) for text in row] for row in rows]
    return Table("outcomes", "What became of each detection", "", columns, cells)


def _share(count: Counter[Outcome], outcome: Outcome) -> str:
    """Detections with an outcome, with their share of all; a dash without detections."""
    number = count[outcome]
    if not number:
        return "0" if count else ABSENT
    return f"{number} ({100 * number / count.total():.1f} %)"


def recognition_content(comparison: Comparison) -> dict[str, Any] | None:
    """Pictures, outcomes and warnings; None where nothing was recognised here."""
    found = comparison.recognition
    sequence = comparison.sequence
    if found is None:
        return None
    # a recogniser takes a while to load, and most logs have detections
    from sonar_graph.recognition import SURE

    start_ns = sequence.start_ns
    pictures = []
    for picture in found.shown():
        pairs = zip(picture.landmark_ids, picture.probabilities, strict=True)
        named = ", ".join(f"ID {landmark} ({share:.2f})" for landmark, share in pairs)
        caption = f"T = {(picture.stamp_ns - start_ns) * 1e-9:.1f} s: {named}"
        address = data_address(picture.jpeg, "image/jpeg")
        pictures.append({"address": address, "caption": caption})
    return {
        "frames": found.frames,
        "detections": 0 if sequence.detections is None else len(sequence.detections),
        "sure": SURE,
        "topic": PICTURES,
        "pictures": pictures,
        "outcomes": text_table(
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


def _of_truth(sequence: Sequence) -> str:
    if sequence.truth is None:
        return "without ground truth"
    orientation = (
        "" if sequence.true_poses else "true positions, but no true orientation"
    )
    return f"with {orientation or 'ground truth'}"
