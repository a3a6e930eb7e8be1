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
    for name, scores in comparison.scores.items():
        assert name in page.text
        for key, score in scores.items():
            assert key in page.text
            assert " ".join(score.protocol.split()) in page.text
    assert len(cells) > 20
    assert all(cell in page.text for cell in cells)
    addresses = {attrs["href"] for attrs in page.named("a")}
    assert {
        "comparison.json",
        "result.mcap",
        "runs/isam2/causal.tum",
        "runs/ekf-slam/trajectory.tum",
    } <= addresses
    assert "runs/dead-reckoning/landmarks.csv" not in addresses


@pytest.mark.usefixtures("unrendered")
def test_unknown_scores_and_doubts_are_shown(
    comparison,
):
    odd = with_score(
        comparison, "isam2", "energy.used_j", Score(12.5, "J", "Read from the meter.")
    )
    odd = with_score(
        odd,
        "isam2",
        "causal.nees_position",
        Score(3.0, "1", "Mean.", (0.9, 1.1), "inside"),
    )
    notes = {
        "log.gaps": "imu: no sample 3.000 to 9.000 s after the start",
        "log.noise": "dvl: 5 of 5 rows",
    }
    html = render_report(replace(odd, sequence=replace(odd.sequence, notes=notes)))
    assert all(
        word in Page(html).text
        for word in ("energy.used_j", "12.5", "Read from the meter.")
    )
    rows = dict(zip(score_keys(odd), score_table(odd).rows, strict=True))
    assert rows["landmarks.nees"][-1].text == "1 is consistent"
    assert (
        rows["causal.nees_position"][2].note == "over-confident; expected 0.900 to 1.10"
    )
    top = html[: html.index("<nav")]
    assert "1 finding, worst: imu: no sample 3.000 to 9.000 s after the start" in top
    assert "5 of 5 rows" not in top
    assert (
        html.index('class="summary"')
        < html.index('class="headline aligned"')
        < html.index('id="figure-map"')
        < html.index('id="table-compact"')
        < html.index('id="warnings"')
    )


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
        lambda c: with_score(
            with_score(c, "isam2", "memory.peak_mb", UNMEASURED),
            "isam2",
            "causal.ate_se2_m",
            ENDLESS,
        ),
        lambda c: replace(c, scores={run.estimator: {} for run in c.runs}, errors={}),
    ],
    ids=["one run", "all failed", "nan and infinite scores", "no scores"],
)
def test_page_is_whole_whatever_is_missing(comparison, change):
    page = Page(render_report(change(comparison)))
    assert "basin-three-laps" in page.text
    assert re.findall(r"\b(nan|NaN|inf|None)\b", page.text) == []


@pytest.mark.usefixtures("unrendered")
def test_without_landmarks_no_figure_of_them_is_announced(comparison):
    alone = only(comparison, "dead-reckoning")
    blind = replace(alone, sequence=replace(alone.sequence, detections=None))
    unmapped = replace(blind, sequence=replace(blind.sequence, true_landmarks=None))
    for shown, is_announced in ((alone, True), (blind, False), (unmapped, False)):
        html = render_report(shown)
        figures = re.findall(r'<figure id="figure-([\w-]+)"', html)
        assert figures == [
            *("map", "map-raw", "errors", "errors-raw", "bounds", "bounds-raw"),
            *("yaw", "nees"),
        ]
        assert (
            html.count("No run reports what became of")
            == html.count('<a href="#detections">')
            == is_announced
        )
        assert ("Ellipses hold" in html) == (shown is not unmapped)
    assert "The log has no landmark detections" in html
    assert {"growth", "innovations"} <= set(
        re.findall(r'<figure id="figure-(\w+)"', render_report(comparison))
    )


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
    same = replace(
        comparison,
        sequence=replace(comparison.sequence, true_landmarks=published_maps()[1]),
    )
    for shown, is_repeated in ((comparison, False), (same, True)):
        text = Page(render_report(shown)).text
        assert ("2014 paper" in text) == is_repeated
        assert ("4.81 (\N{MINUS SIGN}0.19)" in text) == is_repeated
        assert (
            "Positions in the map at the end, metres; in brackets estimate minus truth"
            in text
        )


def test_the_page_lists_what_ekf_slam_used_beside_the_paper(comparison, page):
    """Only where it was compared, and only what the log and the settings give it."""
    said = sentences.beside_the_paper
    known = "Beside the paper's equations ekf-slam used in this log: gravity for roll"
    assert known in page.text
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


@pytest.fixture(scope="module")
def aligned(comparison) -> Comparison:
    moved = aligned_to_truth(comparison)
    assert moved is not None
    return moved


@pytest.mark.parametrize("kind", ["causal", "smoothed"])
def test_aligned_errors_and_maps_are_those_of_the_aligned_scores(
    comparison, aligned, kind
):
    """Figures and tables of one view agree: the series have the rms of the scores."""
    for run in aligned.runs:
        errors = aligned.errors[run.estimator][kind]
        score = comparison.score_of(run.estimator, f"{kind}.ate_se2_m")
        assert rmse(errors.position_m[:, :2]) == pytest.approx(score.value)
        path = getattr(run, kind)
        truth = comparison.sequence.truth.at(errors.stamps_ns).positions
        at = np.searchsorted(path.stamps_ns, errors.stamps_ns)
        np.testing.assert_allclose(
            path.positions[at] - truth, errors.position_m, atol=1e-9
        )
        raw = comparison.errors[run.estimator][kind]
        np.testing.assert_array_equal(errors.nees_position, raw.nees_position)
        if run.landmarks is not None:
            found = landmark_errors(run.landmarks, comparison.sequence.true_landmarks)
            wanted = comparison.score_of(run.estimator, "landmarks.se2_m")
            assert rmse(found.horizontal_m) == pytest.approx(wanted.value)


def test_without_truth_there_is_no_aligned_view():
    blind = basin_comparison(60, truth=False)
    assert aligned_to_truth(blind) is None
    assert blind.plot_map().get_xlabel() == "world x (m)"
    with pytest.raises(EvaluationError, match="no run has errors against a truth"):
        blind.plot_map(aligned=True)
    with pytest.raises(EvaluationError, match="The log has no ground truth"):
        blind.plot_errors()


@pytest.mark.usefixtures("unrendered")
def test_a_filter_as_published_is_named_so_with_its_fair_neighbour(comparison):
    """Beside its name in the table, and in a sentence with what it lacks."""
    plain = {"gate_probability": 1.0, "kernel_width": 0.0}
    ekf = next(run for run in comparison.runs if run.estimator == "ekf-slam")
    published = with_run(comparison, replace(ekf, params=plain))
    text = Page(render_report(published)).text
    assert "ekf-slam as published" in text
    assert "The fair neighbour is invariant-ekf" in text
    assert "The fair neighbour" not in Page(render_report(comparison)).text


@pytest.fixture(scope="module")
def recognised(lane, lane_recognition) -> Comparison:
    """Some runs, with the sequence and the recognition of a lane."""
    sequence = with_detections(lane.sequence, lane_recognition)
    return replace(basin_comparison(), sequence=sequence, recognition=lane_recognition)


def recognition_in(page: str) -> str:
    """The section about sonar images."""
    return page.split('<h2 id="recognition"')[1].split("</section>")[0]


@pytest.mark.usefixtures("unrendered")
def test_the_section_shows_pictures_and_counts(recognised, lane_recognition):
    section = Page(f"<h2{recognition_in(render_report(recognised))}")
    assert f"{lane_recognition.frames} sonar images gave" in section.text
    for outcome, n in lane_recognition.outcomes.items():
        assert f"{outcome} {n}" in section.text
    pictures = section.named("img")
    assert len(pictures) == len(lane_recognition.shown()) == 4
    shown = lane_recognition.shown()[0]
    address = pictures[0]["src"].removeprefix("data:image/jpeg;base64,")
    assert base64.b64decode(address) == shown.jpeg
    seconds = (shown.stamp_ns - recognised.sequence.start_ns) * 1e-9
    caption = " ".join(pictures[0]["alt"].split())
    assert caption.startswith(f"Sonar image. T = {seconds:.1f} s: ")
    for landmark, probability in zip(
        shown.landmark_ids, shown.probabilities, strict=True
    ):
        assert f"ID {landmark} ({probability:.2f})" in caption
    without = render_report(basin_comparison())
    assert 'id="recognition"' not in without, "a comparison without images"


@pytest.mark.usefixtures("unrendered")
def test_the_report_holds_pictures_and_warnings_with_their_time(recognised):
    warnings = [(recognised.sequence.start_ns + 1_250_000_000, "<b> & so on")]
    warned = replace(
        recognised, recognition=replace(recognised.recognition, warnings=warnings)
    )
    page = recognition_in(render_report(warned))
    assert "1.25 <b> & so on" in Page(f"<h2{page}").text
    assert all(shown in page for shown in ("1.25", "&lt;b&gt; &amp; so on"))
    assert "<b> & so on" not in page
    assert page.count("data:image/jpeg;base64,") == 4


def test_a_folder_that_cannot_be_written_is_named_in_one_line(tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(
        EvaluationError,
        match=r"file/deeper: cannot be written: Not a directory; choose another",
    ):
        write_report(basin_comparison(60), str(tmp_path / "file" / "deeper"))
