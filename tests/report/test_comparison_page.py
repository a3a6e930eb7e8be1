"""The page of a comparison shows everything that the comparison holds, and what is missing."""

import base64
import re
from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation import (
    Comparison,
    Score,
    aligned_to_truth,
    landmark_errors,
    published_maps,
    rmse,
    score_keys,
    score_table,
)
from sonar_graph.recognition import with_detections
from sonar_graph.report import sentences, write_page, write_report
from sonar_graph.report.comparison_page import render_report
from tests.synthetic import (
    basin_comparison,
    only,
    with_failure,
    with_run,
    with_score,
)

from .test_pages import Page

REASON = "gave up at 12.5 s <script>alert(1)</script> & more"


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return basin_comparison(120)


@pytest.fixture(scope="module")
def page(comparison) -> Page:
    return Page(render_report(comparison))


def test_every_run_score_protocol_and_file_appears(comparison, page):
    cells = {cell.text for row in score_table(comparison).rows for cell in row}
    assert len(cells) > 20
    words = cells | set(comparison.scores)
    for scores in comparison.scores.values():
        words |= scores.keys()
        words |= {" ".join(score.protocol.split()) for score in scores.values()}
    assert all(word in page.text for word in words)
    addresses = {attrs["href"] for attrs in page.named("a")}
    runs = "runs/isam2/causal.tum", "runs/ekf-slam/trajectory.tum"
    assert {"comparison.json", "result.mcap", *runs} <= addresses
    assert "runs/dead-reckoning/landmarks.csv" not in addresses


@pytest.mark.usefixtures("unrendered")
def test_unknown_scores_and_doubts_are_shown(comparison):
    energy = Score(12.5, "J", "Read from the meter.")
    nees = Score(3.0, "1", "Mean.", (0.9, 1.1), "inside")
    odd = with_score(comparison, "isam2", "energy.used_j", energy)
    odd = with_score(odd, "isam2", "causal.nees_position", nees)
    gap = "imu: no sample 3.000 to 9.000 s after the start"
    notes = {"log.gaps": gap, "log.noise": "dvl: 5 of 5 rows"}
    html = render_report(replace(odd, sequence=replace(odd.sequence, notes=notes)))
    text = Page(html).text
    assert all(word in text for word in ("energy.used_j", "12.5", energy.protocol))
    rows = dict(zip(score_keys(odd), score_table(odd).rows, strict=True))
    assert rows["landmarks.nees"][-1].text == "1 is consistent"
    note = rows["causal.nees_position"][2].note
    assert note == "over-confident; expected 0.900 to 1.10"
    top = html[: html.index("<nav")]
    assert f"1 finding, worst: {gap}" in top
    assert "5 of 5 rows" not in top
    order = [
        *('class="summary"', 'class="headline aligned"'),
        *('id="figure-map"', 'id="table-compact"', 'id="warnings"'),
    ]
    places = [html.index(one) for one in order]
    assert places == sorted(places)


def test_a_failed_run_is_named_first_with_its_reason_escaped(comparison):
    """Beside one that took no detections and keeps no map."""
    bare = {"update_s": np.empty(0), "detections": None, "landmarks": None}
    shown = with_run(comparison, replace(comparison.runs[0], **bare))
    html = render_report(with_failure(shown, "ekf-slam", REASON))
    page = Page(html)
    assert "<script" not in html
    assert re.findall(r"\b(nan|NaN|inf|None)\b", page.text) == []
    assert page.text.count(REASON) == 3, "in a line, unfolded, and among the failures"
    addresses = [attrs["href"] or "" for attrs in page.named("a")]
    assert not any("ekf-slam" in address for address in addresses)


UNMEASURED = Score(float("nan"), "MB", "Not measured.")
ENDLESS = Score(float("inf"), "m", "Diverged.")


@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize(
    "change",
    [
        lambda c: only(c, "isam2"),
        lambda c: with_failure(only(c, "isam2"), "isam2", "no odometry"),
        lambda c: with_score(c, "isam2", "memory.peak_mb", UNMEASURED),
        lambda c: with_score(c, "isam2", "causal.ate_se2_m", ENDLESS),
        lambda c: replace(c, scores={run.estimator: {} for run in c.runs}, errors={}),
    ],
    ids=["one run", "all failed", "a nan score", "an infinite score", "no scores"],
)
def test_page_is_whole_whatever_is_missing(comparison, change):
    page = Page(render_report(change(comparison)))
    assert "basin-three-laps" in page.text
    assert re.findall(r"\b(nan|NaN|inf|None)\b", page.text) == []


@pytest.mark.usefixtures("unrendered")
def test_without_landmarks_no_figure_of_them_is_announced(comparison):
    def figures_in(html):
        return re.findall(r'<figure id="figure-([\w-]+)"', html)

    alone = only(comparison, "dead-reckoning")
    blind = replace(alone, sequence=replace(alone.sequence, detections=None))
    unmapped = replace(blind, sequence=replace(blind.sequence, true_landmarks=None))
    names = "map map-raw errors errors-raw bounds bounds-raw yaw nees"
    for shown, is_announced in ((alone, True), (blind, False), (unmapped, False)):
        html = render_report(shown)
        assert figures_in(html) == names.split()
        for told in ("No run reports what became of", '<a href="#detections">'):
            assert html.count(told) == is_announced
        assert ("Ellipses hold" in html) == (shown is not unmapped)
    assert "The log has no landmark detections" in html
    assert {"growth", "innovations"} <= set(figures_in(render_report(comparison)))


@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize("planar", [True, False], ids=["planar", "3-D"])
def test_without_truth_the_page_says_so_and_shows_the_rest(planar):
    page = Page(render_report(basin_comparison(60, planar=planar, truth=False)))
    assert "The log has no ground truth" in page.text
    assert "Per update, median" in page.text
    assert "Position error, not aligned" not in page.text
    assert len(page.named("svg")) == 4, "the map in two widths, and no aligned view"
    assert "show-raw" not in page.text


@pytest.mark.slow
def test_a_long_mission_still_makes_a_small_page(tmp_path):
    write_page(basin_comparison(4078), tmp_path)
    assert (tmp_path / "report.html").stat().st_size < 3_000_000


@pytest.mark.usefixtures("unrendered")
def test_only_the_repeated_experiment_stands_beside_the_paper(comparison):
    sequence = replace(comparison.sequence, true_landmarks=published_maps()[1])
    same = replace(comparison, sequence=sequence)
    totals = "Positions in the map at the end, metres; in brackets estimate minus truth"
    for shown, is_repeated in ((comparison, False), (same, True)):
        text = Page(render_report(shown)).text
        assert ("2014 paper" in text) == is_repeated
        assert ("4.81 (\N{MINUS SIGN}0.19)" in text) == is_repeated
        assert totals in text


@pytest.mark.usefixtures("unrendered")
def test_what_a_filter_used_beside_the_paper_is_listed(comparison, page):
    """Only where it was compared, and only what the log and the settings give it; a filter as published is named so."""
    said = sentences.beside_the_paper
    known = "Beside the paper's equations ekf-slam used in this log: gravity for roll"
    assert known in page.text
    assert "The fair neighbour" not in page.text
    assert "kernel_width" not in str(said(comparison))
    run = next(run for run in comparison.runs if run.estimator == "ekf-slam")
    robust = replace(run, params=run.params | {"kernel_width": 3.0})
    assert "kernel_width" in str(said(with_run(comparison, robust)))
    sequence = comparison.sequence
    free = sequence.calibration.model_copy(update={"planar": None})
    moved = replace(comparison, sequence=replace(sequence, calibration=free))
    assert "plane" in str(said(comparison))
    assert "plane" not in str(said(moved))
    assert said(only(comparison, "isam2")) is None
    plain = replace(run, params={"gate_probability": 1.0, "kernel_width": 0.0})
    text = Page(render_report(with_run(comparison, plain))).text
    assert "ekf-slam as published" in text
    assert "The fair neighbour is invariant-ekf" in text


@pytest.mark.parametrize("kind", ["causal", "smoothed"])
def test_aligned_errors_and_maps_are_those_of_the_aligned_scores(comparison, kind):
    """Figures and tables of one view agree: the series have the rms of the scores."""
    aligned = aligned_to_truth(comparison)
    sequence = comparison.sequence
    for run in aligned.runs:
        name = run.estimator
        errors = aligned.errors[name][kind]
        score = comparison.score_of(name, f"{kind}.ate_se2_m")
        assert rmse(errors.position_m[:, :2]) == pytest.approx(score.value)
        found = getattr(run, kind).at(errors.stamps_ns).positions
        off_m = found - sequence.truth.at(errors.stamps_ns).positions
        np.testing.assert_allclose(off_m, errors.position_m, atol=1e-9)
        raw = comparison.errors[name][kind]
        np.testing.assert_array_equal(errors.nees_position, raw.nees_position)
        if run.landmarks is not None:
            found = landmark_errors(run.landmarks, sequence.true_landmarks)
            wanted = comparison.score_of(name, "landmarks.se2_m")
            assert rmse(found.horizontal_m) == pytest.approx(wanted.value)


@pytest.mark.usefixtures("unrendered")
def test_pictures_counts_and_warnings_of_images_are_shown(lane, lane_recognition):
    """Warnings with their time, escaped."""
    sequence = with_detections(lane.sequence, lane_recognition)
    warnings = [(sequence.start_ns + 1_250_000_000, "<b> & so on")]
    recognition = replace(lane_recognition, warnings=warnings)
    plain = basin_comparison()
    html = render_report(replace(plain, sequence=sequence, recognition=recognition))
    assert "&lt;b&gt; &amp; so on" in html
    assert "<b> & so on" not in html
    section = html.split('<h2 id="recognition"')[1].split("</section>")[0]
    section = Page(f"<h2{section}")
    assert "1.25 <b> & so on" in section.text
    assert f"{recognition.frames} sonar images gave" in section.text
    for outcome, n in recognition.outcomes.items():
        assert f"{outcome} {n}" in section.text
    pictures = section.named("img")
    assert len(pictures) == len(recognition.shown()) == 4
    shown = recognition.shown()[0]
    address = pictures[0]["src"].removeprefix("data:image/jpeg;base64,")
    assert base64.b64decode(address) == shown.jpeg
    seconds = (shown.stamp_ns - sequence.start_ns) * 1e-9
    caption = " ".join(pictures[0]["alt"].split())
    assert caption.startswith(f"Sonar image. T = {seconds:.1f} s: ")
    for one in zip(shown.landmark_ids, shown.probabilities, strict=True):
        assert "ID {} ({:.2f})".format(*one) in caption
    assert 'id="recognition"' not in render_report(plain), "without images"


def test_without_truth_there_is_no_aligned_view():
    blind = basin_comparison(60, truth=False)
    assert aligned_to_truth(blind) is None
    assert blind.plot_map().get_xlabel() == "world x (m)"
    with pytest.raises(EvaluationError, match="no run has errors against a truth"):
        blind.plot_map(aligned=True)
    with pytest.raises(EvaluationError, match="The log has no ground truth"):
        blind.plot_errors()


def test_a_folder_that_cannot_be_written_is_named_in_one_line(tmp_path) -> None:
    (tmp_path / "file").touch()
    told = "file/deeper: cannot be written: Not a directory; choose another"
    with pytest.raises(EvaluationError, match=told):
        write_report(basin_comparison(60), str(tmp_path / "file" / "deeper"))
