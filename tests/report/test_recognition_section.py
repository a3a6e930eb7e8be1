from __future__ import annotations

import base64
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.evaluation.consistency import reliability, reliability_of
from sonar_graph.evaluation.results import Comparison
from sonar_graph.evaluation.tables import Table
from sonar_graph.recognition.session import with_detections
from sonar_graph.report.comparison_page import recognition_content, render_report
from sonar_graph.report.figures import reliability_figure
from tests.synthetic import basin_comparison


def texts(table: Table) -> dict[str, list[str]]:
    """The texts of each row by its first cell."""
    return {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}


@pytest.fixture(scope="module")
def comparison(lane, lane_recognition) -> Comparison:
    """Some runs, with the sequence and the recognition of a lane."""
    sequence = with_detections(lane.sequence, lane_recognition)
    return replace(basin_comparison(), sequence=sequence, recognition=lane_recognition)


def test_a_comparison_without_images_has_no_such_section() -> None:
    assert recognition_content(basin_comparison()) is None


def test_the_section_shows_pictures_counts_and_reliability(comparison, lane_recognition) -> None:
    content = recognition_content(comparison)
    assert content is not None
    assert content["frames"] == lane_recognition.frames
    assert texts(content["outcomes"]) == {outcome: [str(n)] for outcome, n in lane_recognition.outcomes.items()}
    assert len(content["pictures"]) == len(lane_recognition.shown()) == 4
    first, shown = content["pictures"][0], lane_recognition.shown()[0]
    address = first["address"].removeprefix("data:image/jpeg;base64,")
    assert base64.b64decode(address) == shown.jpeg
    seconds = (shown.stamp_ns - comparison.sequence.start_ns) * 1e-9
    assert first["caption"].startswith(f"T = {seconds:.1f} s: ")
    for landmark, probability in zip(shown.landmark_ids, shown.probabilities, strict=True):
        assert f"ID {landmark} ({probability:.2f})" in first["caption"]
    judged = reliability_of(comparison.sequence)
    assert judged is not None
    assert content["expected_error"] == f"{judged.expected_error:.3f}"
    assert "<svg" in content["reliability"]


def test_the_report_holds_pictures_and_warnings_with_their_time(comparison) -> None:
    start_ns = comparison.sequence.start_ns
    warned = replace(
        comparison, recognition=replace(comparison.recognition, warnings=[(start_ns + 1_250_000_000, "<b> & so on")])
    )
    content = recognition_content(warned)
    assert content is not None
    assert texts(content["warnings"]) == {"1.25": ["<b> & so on"]}
    page = render_report(warned).split('id="recognition"')[1].split("</section>")[0]
    assert "1.25" in page
    assert "&lt;b&gt; &amp; so on" in page
    assert "<b> & so on" not in page
    assert page.count("data:image/jpeg;base64,") == 4
    assert content["expected_error"] in page


def test_without_truth_nothing_is_judged(comparison) -> None:
    blind = replace(comparison, sequence=replace(comparison.sequence, truth=None))
    content = recognition_content(blind)
    assert content is not None
    assert content["expected_error"] is None
    assert content["reliability"] == ""


def test_the_figure_shows_shares_over_confidence_and_counts() -> None:
    judged = reliability(np.array([0.95, 0.95, 0.55]), np.array([1.0, 0.0, 1.0]))
    shares, counts = reliability_figure(judged).axes
    (dots,) = shares.collections
    x, y = np.ma.filled(dots.get_offsets(), np.nan).T
    known = np.isfinite(y)
    assert x[known].tolist() == pytest.approx([0.55, 0.95])
    assert y[known].tolist() == [1.0, 0.5]
    assert [bar.get_height() for bar in counts.patches] == judged.count.tolist()
    assert counts.patches[9].get_x() + counts.patches[9].get_width() / 2 == pytest.approx(0.95)


def test_detections_are_counted_by_what_they_truly_are(comparison, lane_recognition) -> None:
    """Right, wrong and taken for no landmark: in all as many as there are detections."""
    content = recognition_content(comparison)
    assert content is not None
    assert content["detections"] == len(lane_recognition.detections)
    named = texts(content["named"])
    assert list(named)[:5] == [*(f"landmark {k}" for k in (1, 2, 3, 4)), "no landmark"]
    counts = np.array([[int(n) if n.isdigit() else 0 for n in row] for row in named.values()])
    assert counts.sum() == content["detections"]
    assert (counts[:4, 0] > 10).all()
    assert (counts[:4, 1] == 0).all()
    assert counts[4].tolist()[:2] == [0, 0]
    assert counts[4, 2] > 20


def test_a_landmark_that_is_named_as_another_is_named_wrongly(comparison) -> None:
    detections = comparison.sequence.detections
    swapped = replace(detections, candidate_ids=detections.candidate_ids % 4 + 1)
    before = recognition_content(comparison)
    after = recognition_content(replace(comparison, sequence=replace(comparison.sequence, detections=swapped)))
    assert before is not None
    assert after is not None
    for what in (f"landmark {k}" for k in (1, 2, 3, 4)):
        right, wrong, none = texts(before["named"])[what]
        assert texts(after["named"])[what] == [wrong, right, none]
