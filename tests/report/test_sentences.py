"""Findings in words and in the terminal follow the numbers: smaller errors, consistency, failures and warnings."""

import io
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sonar_graph.calibration import KnownMap
from sonar_graph.evaluation import MOST_ROWS_NAMED, Comparison, Score
from sonar_graph.evaluation.scores import detection_scores, landmark_scores
from sonar_graph.measurements import Depth, Heading
from sonar_graph.report import sentences, summary
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.landmark_table import landmark_table
from sonar_graph.states import (
    FIRST_ANONYMOUS_ID,
    DetectionLog,
    LandmarkMap,
    Outcome,
    Refusal,
    RefusedRow,
)
from sonar_graph.table import ABSENT
from tests.synthetic import (
    IDS,
    LANDMARKS,
    basin_comparison,
    late,
    only,
    outlier,
    refusing,
    with_failure,
    with_run,
    with_score,
)

BASIN = basin_comparison(60)


def printed(comparison: Comparison, width: int = 80, shown: Any = None) -> str:
    options: dict[str, Any] = {
        "file": io.StringIO(),
        "width": width,
        "color_system": None,
    }
    console = Console(**options)
    console.print(summary(comparison) if shown is None else shown)
    return console.file.getvalue()


def nees(value: float, interval: tuple[float, float] | None = None) -> Score:
    return Score(value, "1", "By hand.", interval, "inside")


def test_the_terminal_shows_the_numbers_of_the_report_in_80_columns():
    comparison = BASIN
    text = printed(comparison)
    lines = text.splitlines()
    keys = "ate_se2_m", "ate_raw_m", "yaw_rmse_rad", "nees_yaw"
    shown = {*(f"causal.{key}" for key in keys), "time.update_max_ms"}
    for name, scores in comparison.scores.items():
        row = next(line for line in lines if name in line)
        assert all(scores[key].text() in row for key in (*shown, "smoothed.ate_se2_m"))
    assert "…" not in text
    assert "corrects the drift." not in text
    assert lines[2].split()[:3] == ["aligned", "aligned", "raw"]
    assert "aligned: Horizontal position error, SE(2) aligned" in text
    assert "raw: Position error, not aligned" in text


def test_a_failure_is_printed_with_its_reason():
    reason = "no [bold] odometry covers the stamps of any of the sonar frames that the log holds"
    text = printed(
        with_failure(basin_comparison(60, truth=False), "isam2", reason), width=100
    )
    assert f"isam2 failed: {reason}" in text
    assert "causal" not in text, "without truth columns of errors are left out"
    assert "med." in text


@pytest.mark.parametrize(
    ("value", "interval", "shown"),
    [
        (0.4, (0.9, 1.1), "0.400 ▼"),
        (1.3, (0.9, 1.1), "1.30 ▲"),
        (1.0, (0.9, 1.1), "1 "),
        (5.1, (0.0, 5.0), "5.10 ▲"),
        (99.0, None, "99 "),
    ],
)
def test_a_nees_outside_its_interval_is_marked(value, interval, shown):
    score = nees(value, interval)
    text = printed(with_score(BASIN, "isam2", "causal.nees_yaw", score))
    assert shown in next(line for line in text.splitlines() if "isam2" in line)
    assert "▲ over-confident, ▼ over-cautious" in text
    assert nees(1.0, (0.9, 1.1)).verdict == "consistent"
    assert nees(4.9, (0.0, 5.0)).verdict == "", "so wide that it says nothing"


def test_odometry_far_from_its_reference_leads_to_inspect():
    comparison = BASIN
    sequence = replace(comparison.sequence, detections=None)
    blind = replace(comparison, sequence=sequence)
    notes = {"truth": "of the same sensors"}
    noted = replace(blind, sequence=replace(sequence, notes=notes))
    hint = "stamps, start or reference may be off; sonar-graph inspect LOG compares"
    said = "stamps, start or reference (the log says: of the same sensors) may be off"
    for case, name, value, told in (
        (comparison, "dead-reckoning", 30.0, hint),
        (comparison, "dead-reckoning", 4.0, ""),
        (comparison, "isam2", 30.0, ""),  # landmarks may be the cause
        (blind, "isam2", 30.0, hint),
        (noted, "isam2", 30.0, said),
    ):
        scored = with_score(case, name, "causal.nees_position", nees(value))
        text = printed(scored, 200)
        assert told in text
        assert ("sonar-graph inspect LOG" in text) == bool(told), (name, value)


SIGMA_M = 0.02
NS = 10**9
WITHHELD = "landmark 3, from keyframe 1 at 1.000 s: 1 range; open: z; an elevation is missing; withheld"


def scored(**values: float) -> Comparison:
    """Runs whose causal errors have these values, without runs that have none."""
    errors_m = {name.replace("_", "-"): value for name, value in values.items()}
    comparison = only(BASIN, *errors_m)
    for name, value in errors_m.items():
        score = Score(value, "m", "By hand.")
        comparison = with_score(comparison, name, "causal.ate_se2_m", score)
    return comparison


def test_without_detections_the_drift_is_explained():
    comparison = BASIN
    assert sentences.remarks(comparison) == []
    part = {"log.part": "the beginning to 10.000 s"}
    heading = Heading(np.zeros(1, int), np.zeros(1), np.ones(1))
    for changes, said in (
        ({"notes": {}}, sentences.NO_DETECTIONS),
        ({"notes": part}, "was chosen (the beginning to 10.000 s) has no landmark det"),
        ({"heading": heading}, "only its headings limit"),
    ):
        sequence = replace(comparison.sequence, detections=None, **changes)
        (line,) = sentences.remarks(replace(comparison, sequence=sequence))
        assert said in line


def test_the_headline_leaves_out_what_has_no_error():
    comparison = BASIN
    failed = with_failure(comparison, "ekf-slam", "no odometry.")
    assert sentences.doubts(failed)[0] == "ekf-slam failed: no odometry."
    assert "ekf-slam" not in sentences.headline(failed)
    alone = with_failure(scored(isam2=0.1), "isam2", "no odometry")
    blind = replace(basin_comparison(60, truth=False), scores={})
    for case, said in (
        (alone, "nothing to compare"),
        (replace(comparison, scores={}), "No position error could be"),
        (blind, "no ground truth"),
        (scored(isam2=0.1), "isam2 is 0.100\N{NO-BREAK SPACE}m off the truth ("),
        (scored(isam2=0.1, ekf_slam=0.2), "nearest"),
    ):
        assert said in sentences.headline(case)


@pytest.mark.parametrize("gated", [19, 21])
def test_an_estimator_that_rejects_a_fifth_is_called_lost(gated):
    log = log_of([Outcome.GATED] * gated + [Outcome.USED] * (100 - gated), [0.1] * 100)
    comparison = BASIN
    run = replace(comparison.runs[1], detections=log, params={})
    lost = with_run(comparison, run)
    told = sentences.lost_runs(lost)
    assert sentences.doubts(lost)[: len(told)] == told
    assert len(told) == (gated > 20)
    start = f"ekf-slam refused {gated} of 100 detections"
    reason = "identities are wrong, or noise is set far too small"
    assert all(one.startswith(start) and reason in one for one in told)
    told_by_map = ["sightings contradict the map, and too few others agree"]
    by_map = with_run(lost, replace(run, withheld=told_by_map))
    assert sentences.lost_runs(by_map) == []
    # few squares are below 1: inside the gate they mean nothing
    near = replace(log, innovation_covs=np.tile(np.eye(2), (100, 1, 1)))
    verdict = detection_scores(near)["detections.nis"].verdict
    assert verdict == ("" if told else "over-cautious")


def with_map(
    ids: np.ndarray = IDS,
    offsets_m: tuple[float, ...] = (0.0,) * 4,
    *,
    has_truth: bool = True,
    **changes: object,
) -> Comparison:
    """One run whose landmarks are so far from the true ones along x, with a sigma of 2 cm."""
    comparison = only(BASIN, "isam2")
    positions = LANDMARKS + np.outer(offsets_m, [1, 0, 0])
    found = LandmarkMap(ids, positions, np.tile(SIGMA_M**2 * np.eye(3), (4, 1, 1)))
    params = {"identity": {"policy": "robust"}}
    run = replace(comparison.runs[0], landmarks=found, params=params, **changes)
    sequence = comparison.sequence
    if not has_truth:
        sequence = replace(sequence, true_landmarks=None)
    return replace(with_run(comparison, run), sequence=sequence)


def log_of(outcomes: list[Outcome], innovations_m: list[float]) -> DetectionLog:
    """Detections of landmark 2."""
    n = len(outcomes)
    innovations = np.column_stack([innovations_m, np.zeros(n)])
    covs = np.tile(SIGMA_M**2 * np.eye(2), (n, 1, 1))
    return DetectionLog(np.arange(n), np.full(n, 2), innovations, covs, outcomes)


def test_a_landmark_that_its_covariance_rules_out_is_named_with_the_policy():
    comparison = with_map(IDS, [0.0, 0.05, 5.0, 0.01])
    line = (
        "Warning: isam2 puts landmark 3 far outside its covariance (NEES up to 31250); "
        'look at identities (identity.policy is "robust"), then at noise and start'
    )
    assert sentences.doubt_of_identities(comparison) == [line]
    assert line in printed(comparison, 200)
    assert line in sentences.doubts(comparison)
    # of two degrees of freedom, in closed form
    limit_m = SIGMA_M * np.sqrt(-2 * np.log(1e-9))
    right, wrong = (with_map(IDS, [by * limit_m] * 4) for by in (0.999, 1.001))
    assert sentences.doubt_of_identities(right) == []
    (line,) = sentences.doubt_of_identities(wrong)
    assert "landmarks 1, 2, 3 and 4 far outside" in line


def test_without_true_landmarks_the_innovations_of_used_detections_tell():
    def doubts(log, *, has_truth=False):
        shown = with_map(has_truth=has_truth, detections=log)
        return sentences.doubt_of_identities(shown)

    start = "Warning: isam2: sightings of landmark 2 contradict its map (mean NIS up to"
    for far, nis in ((2, None), (3, 375), (10, 1250)):  # (3 * 50² + 7 * 0.5²) / 10 / 2
        log = log_of([Outcome.USED] * 10, [1.0] * far + [0.01] * (10 - far))
        lines = [line.partition(");")[0] for line in doubts(log)]
        assert lines == ([f"{start} {nis}"] if nis else [])
        assert not doubts(log, has_truth=True)  # the truth shows no fault
    for outcome in (Outcome.GATED, Outcome.WITHHELD, Outcome.REPEATED):
        assert not doubts(log_of([outcome] * 10, [1.0] * 10))
    n = 2000
    drawn = SIGMA_M * np.random.default_rng(2).standard_normal((n, 2))
    log = log_of([Outcome.USED] * n, [0.0] * n)
    for factor, is_told in ((3, False), (4, True)):  # sigmas so many times too small
        found = doubts(replace(log, innovations=factor * drawn))
        assert bool(found) == is_told


BEFORE = [Outcome.UNSOUND, Outcome.LATE, Outcome.UNLOCATED, Outcome.TRACK_REPEATED]
NAMELESS = [Outcome.NO_IDENTITY, Outcome.WAITING, Outcome.FORGOTTEN, Outcome.UNFIT]
"""Outcomes before an identity mattered, and those of detections without one that can be used."""


@pytest.mark.parametrize(
    ("outcomes", "count"),
    [
        *(([outcome] * 6, 6) for outcome in NAMELESS),
        *(([outcome] * 5 + [Outcome.NEW], 0) for outcome in NAMELESS),
        ([*BEFORE, *NAMELESS[:2], Outcome.WAITING], 3),
        (BEFORE, 0),
    ],
)
def test_a_log_without_any_identity_is_told_with_what_to_do(outcomes, count):
    blind = with_map(detections=log_of(outcomes, [np.nan] * len(outcomes)))
    line = (
        f"Warning: none of {count} detections has an identity that isam2 can use: no landmark is mapped; "
        'isam2 maps them by place with identity.unknown.policy = "associate"'
    )
    assert sentences.doubt_of_identities(blind) == ([line] if count else [])
    assert (line in printed(blind, 200)) == bool(count)


def test_landmarks_without_a_name_are_counted_and_scored_by_place():
    unnamed = np.arange(4) + FIRST_ANONYMOUS_ID
    nameless = with_map(unnamed, [0.01, 0.02, 3.0, 0.01])
    sentence = "isam2 found 4 landmarks without a name (identity.unknown.policy); scored by place, as 1, 2 and 4."
    assert sentences.nameless_landmarks(nameless) == [sentence]
    assert sentence in printed(nameless, 200)
    rows = landmark_table(nameless).rows[:8:2]
    assert [row[2].text != ABSENT for row in rows] == [True, True, False, True]
    raw = raw_score(nameless)
    assert raw.value == pytest.approx(np.sqrt((0.01**2 + 0.02**2 + 0.01**2) / 3))
    assert "3 landmarks matched by identity, 3 of them by place" in raw.protocol
    (line,) = sentences.doubt_of_identities(with_map(unnamed, [0.01, 0.5, 3.0, 0.01]))
    assert "puts landmark 2 far outside its covariance" in line
    unknown = with_map(np.array([1, 2, 3, FIRST_ANONYMOUS_ID]), has_truth=False)
    assert sentences.nameless_landmarks(unknown) == [
        "isam2 found 1 landmark without a name (identity.unknown.policy); u0 stands for identity 3000000000 in the files."
    ]
    # merely wrong, and not named by place
    wrong = with_map(np.array([1, 2, 3, 9]))
    assert sentences.nameless_landmarks(wrong) == []
    assert "3 landmarks matched by identity (4" in raw_score(wrong).protocol


def raw_score(comparison: Comparison) -> Score:
    scores = landmark_scores(comparison.runs[0].landmarks, comparison.sequence)
    return scores["landmarks.raw_m"]


@pytest.mark.parametrize("is_named", [True, False])
def test_beside_a_sensor_that_is_named_no_right_one_is_to_be_left_out(is_named: bool):
    stamps_ns = BASIN.sequence.start_ns + NS * np.arange(1, 11)
    depth = Depth(stamps_ns, np.zeros(10), np.full(10, np.nan))
    rows = [RefusedRow("depth", int(t), Refusal.OUT_OF_REACH, 99.0) for t in stamps_ns]
    refused = refusing(rows, "isam2")
    notes = {"log.doubtful": "DVL axes: wrong axes"} if is_named else {}
    sequence = replace(refused.sequence, depth=depth, notes=notes)
    *first, line = sentences.doubtful_lines(replace(refused, sequence=sequence))
    assert len(first) == is_named
    assert ("use = false" in line) != is_named
    assert ("mend what is named above first" in line) == is_named


@pytest.mark.usefixtures("unrendered")
def test_terminal_and_page_list_refused_and_withheld_rows():
    calm = BASIN
    start_ns = calm.sequence.start_ns
    refused = refusing([outlier(start_ns + NS, 512.6), late(start_ns)], "isam2")
    comparison = with_run(refused, replace(refused.runs[0], withheld=[WITHHELD]))
    rows = [
        f"Warning: dvl, 1.000 s: {Refusal.OUTLIER} (squared distance 513); isam2",
        f"Warning: imu, 0.000 s: {Refusal.LATE}; isam2",
    ]
    line = f"Warning: isam2: {WITHHELD}"
    assert sentences.refusal_lines(comparison) == rows
    assert sentences.withheld_lines(comparison) == [line]
    below = printed(comparison, 200)
    page = render_report(comparison)
    assert all(one in below for one in [*rows, line])
    assert page.index(line) < page.index("<nav") < page.index(rows[0])
    assert 'id="refused"' not in render_report(calm)
    assert "Warning" not in printed(calm, 200)
    messages = [f"{WITHHELD} {k}" for k in range(MOST_ROWS_NAMED + 2)]
    many = with_run(calm, replace(calm.runs[0], withheld=messages))
    lines = sentences.withheld_lines(many)
    assert len(lines) == MOST_ROWS_NAMED + 1
    assert lines[-1] == "Warning: isam2 withheld 2 more: comparison.json has all"
    same = replace(calm, runs=[replace(run, withheld=[WITHHELD]) for run in calm.runs])
    (line,) = sentences.withheld_lines(same)
    assert line == f"Warning: {', '.join(r.estimator for r in calm.runs)}: {WITHHELD}"


@pytest.mark.parametrize(("start_sigma_m", "count"), [(0.04, 1), (0.06, 2)])
def test_landmarks_that_moved_are_doubted_where_the_start_is_less_certain_than_the_map(
    start_sigma_m, count
):
    given = BASIN.sequence.calibration
    known = KnownMap.of([1], [[0.0, 0.0, 0.0]], sigma_m=0.05)
    sigmas_m = (start_sigma_m, 0.01, 1.0)
    start = given.start.model_copy(update={"position_sigma_m": sigmas_m})
    calibration = given.model_copy(update={"start": start, "map": known})
    comparison = with_map(withheld=["moved since the map was made: landmark 1"])
    sequence = replace(comparison.sequence, calibration=calibration)
    lines = sentences.withheld_lines(replace(comparison, sequence=sequence))
    assert len(lines) == count
    assert 'source = "map"' in lines[-1] or count == 1


def test_outliers_among_used_detections_are_named_from_a_twentieth_on():
    def said(far, outcome=Outcome.USED, off_m=1):
        outcomes = [Outcome.USED] * (100 - far) + [outcome] * far
        log = log_of(outcomes, [0.01] * (100 - far) + [off_m] * far)
        return sentences.outliers(with_map(detections=log))

    (line,) = said(6)
    told = "Warning: sonar, detections that were used although as far off as one in a billion should be: "
    assert line.startswith(f"{told}isam2 6 of 100: look at their ranges")
    limit_m = SIGMA_M * np.sqrt(sentences.ABSURD)
    assert not said(5)
    assert not said(6, Outcome.GATED)
    assert not said(6, off_m=0.999 * limit_m)
    assert said(6, off_m=1.001 * limit_m)


def test_errors_that_last_from_sighting_to_sighting_are_named_with_the_sigma_to_write():
    noise = np.random.default_rng(3).standard_normal(400)

    def said(rho=0.8, count=400, size=1, **changes):
        errors = noise[:count].copy()
        for k in range(1, count):
            errors[k] = rho * errors[k - 1] + np.sqrt(1 - rho**2) * noise[k]
        log = log_of([Outcome.USED] * count, (size * SIGMA_M * errors).tolist())
        comparison = with_map(detections=log)
        sequence = replace(comparison.sequence, **changes)
        found = sentences.alike_errors(replace(comparison, sequence=sequence))
        assert len(found) < 2
        return "".join(found)

    def number(pattern, line):
        return float(re.search(pattern.replace("N", "([.0-9]+)"), line)[1])

    line = said()
    assert number("correlation N in 399 pairs", line) == pytest.approx(0.8, abs=0.1)
    assert line.startswith("Warning: isam2: errors of range are alike")
    # by hand: the mean of such errors has (1 + rho) / (1 - rho) times the variance
    sequence = BASIN.sequence
    expected_m = 3.0 * sequence.calibration.sonar.range_sigma_m
    sigma_m = number("`range_sigma_m = N` under", line)
    assert sigma_m == pytest.approx(expected_m, rel=0.3)
    logged = np.tile(np.diag([0.01, 1e-4]), (len(sequence.detections), 1, 1))
    detections = replace(sequence.detections, range_azimuth_cov=logged)
    factor = number("give sigmas N times", said(detections=detections))
    assert factor == pytest.approx(3.0, rel=0.3)
    for unsaid in (
        {"rho": 0.0},
        {"count": 90},
        {"size": 0.3},  # the sigma is large enough already
        {"size": 30.0},  # absurd ones have a line of their own
        {"notes": {"log.doubtful": "depth against dvl: sign"}},
        {"notes": {"log.sensors": "dvl against imu: scale"}},
    ):
        assert said(**unsaid) == "", unsaid
    assert said(notes={"log.sensors": "reference against IMU: late"})


def test_runs_that_agree_with_each_other_and_not_the_truth_share_a_fault():
    def said(*offs_m):
        comparison = basin_comparison(60)
        for name, off_m in zip(("isam2", "ekf-slam"), offs_m, strict=True):
            errors = comparison.errors[name]["causal"]
            moved_m = np.full_like(errors.position_m, off_m)
            score = Score(off_m, "m", "By hand.")
            comparison = with_score(comparison, name, "causal.ate_se2_m", score)
            comparison.errors[name] = {"causal": replace(errors, position_m=moved_m)}
        return sentences.shared_error(comparison)

    (line,) = said(2.0, 2.0)
    assert "agree to 0 m, and are 2 m off the truth" in line
    assert said(0.0, 0.0) == []
    # estimators that differ have faults of their own
    assert said(3.0, 2.0) == []
