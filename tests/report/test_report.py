from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.evaluation.results import Comparison, Score
from sonar_graph.evaluation.score_table import score_keys, score_table
from sonar_graph.evaluation.scored_instants import published_maps
from sonar_graph.report.comparison_page import render_report, write_page
from sonar_graph.states import Outcome
from tests.synthetic import REFUSALS, basin_comparison, only, with_failure, with_run, with_score

VOID = {"meta", "br", "wbr", "link", "img", "input", "hr"}
REASON = "gave up at 12.5 s <script>alert(1)</script> & more"


class Page(HTMLParser):
    """What a page consists of; refuses tags that are not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "text"} & set(self.open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())

    def named(self, *names: str) -> list[dict[str, str | None]]:
        return [attrs for tag, attrs in self.tags if tag in names]


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return basin_comparison(120)


@pytest.fixture(scope="module")
def html(comparison) -> str:
    return render_report(comparison)


@pytest.fixture(scope="module")
def page(html) -> Page:
    return Page(html)


def test_the_check_of_tags_notices_an_unclosed_one():
    with pytest.raises(AssertionError):
        Page("<div><p>text</div>")


def test_page_refers_to_nothing_outside_its_folder(page, html):
    addresses = [attrs[key] or "" for _, attrs in page.tags for key in ("src", "href", "xlink:href") if key in attrs]
    assert addresses
    assert [address for address in addresses if re.match(r"(?!data:)[a-z]+:|//|/", address)] == []
    assert "@import" not in html
    assert re.findall(r"url\((?!#)", html) == []
    assert page.named("script", "iframe", "img") == []


def test_links_within_the_page_lead_somewhere_and_ids_are_unique(page):
    ids = [attrs["id"] for _, attrs in page.tags if attrs.get("id")]
    assert len(ids) == len(set(ids))
    targets = {attrs["href"] for attrs in page.named("a", "use") if (attrs["href"] or "").startswith("#")}
    assert targets <= {f"#{identity}" for identity in ids}


def test_files_beside_the_page_are_linked(page):
    addresses = {attrs["href"] for attrs in page.named("a")}
    assert {"comparison.json", "result.mcap", "runs/isam2/causal.tum", "runs/ekf-slam/result.json"} <= addresses
    assert "runs/dead-reckoning/landmarks.csv" not in addresses


def test_every_run_score_and_protocol_appears(comparison, page):
    cells = {cell.text for row in score_table(comparison).rows for cell in row}
    for name, scores in comparison.scores.items():
        assert name in page.text
        for key, score in scores.items():
            assert key in page.text
            assert " ".join(score.protocol.split()) in page.text
    assert len(cells) > 20
    assert all(cell in page.text for cell in cells)


def test_scores_nobody_foresaw_are_shown_too(comparison):
    odd = with_score(comparison, "isam2", "energy.used_j", Score(12.5, "J", "Read from the meter."))
    text = Page(render_report(odd)).text
    assert "energy.used_j" in text
    assert "12.5" in text
    assert "Read from the meter." in text


def test_a_failed_run_is_named_first_with_its_reason_escaped(comparison):
    html = render_report(with_failure(comparison, "ekf-slam", REASON))
    page = Page(html)
    assert "<script" not in html
    assert page.text.count(REASON) == 2, "in the finding and in the table of failures"
    assert page.text.index("ekf-slam failed") < page.text.index("Causal position error")
    assert {"runs/ekf-slam/result.json"} == {
        attrs["href"] for attrs in page.named("a") if "ekf-slam" in (attrs["href"] or "")
    }


def test_what_puts_a_log_in_doubt_stands_at_the_top(comparison):
    notes = {"log.gaps": "imu: no sample 3.000 to 9.000 s after the start", "log.noise": "dvl: 5 of 5 rows"}
    page = render_report(replace(comparison, sequence=replace(comparison.sequence, notes=notes)))
    top = page[: page.index('class="summary"')]
    assert "Warning: imu: no sample 3.000 to 9.000 s after the start" in top
    assert "5 of 5 rows" not in top
    assert "Warning:" not in render_report(replace(comparison, sequence=replace(comparison.sequence, notes={})))


def test_what_a_log_or_an_estimator_says_is_escaped_everywhere(comparison):
    hostile = '"><script>alert(1)</script>'
    sequence = replace(comparison.sequence, name=hostile, notes={hostile: hostile})
    run = replace(comparison.runs[0], estimator=hostile, params={hostile: hostile})
    scores = {**comparison.scores, hostile: {hostile: Score(1.0, hostile, hostile)}}
    html = render_report(
        replace(
            comparison, sequence=sequence, runs=[run, *comparison.runs[1:]], scores=scores, environment={"x": hostile}
        )
    )
    Page(html)
    assert "<script" not in html


@pytest.mark.parametrize(
    "change",
    [
        lambda c: only(c, "isam2"),
        lambda c: with_failure(only(c, "isam2"), "isam2", "no odometry"),
        lambda c: with_run(c, replace(c.runs[0], update_s=np.empty(0), detections=None, landmarks=None)),
        lambda c: with_score(
            with_score(c, "isam2", "memory.peak_mb", Score(float("nan"), "MB", "Not measured.")),
            "isam2",
            "causal.ate_se2_m",
            Score(float("inf"), "m", "Diverged."),
        ),
        lambda c: replace(c, scores={run.estimator: {} for run in c.runs}, errors={}),
    ],
    ids=["one run", "all failed", "empty blocks", "nan and infinite scores", "no scores"],
)
def test_page_is_whole_whatever_is_missing(comparison, change):
    page = Page(render_report(change(comparison)))
    assert "basin-three-laps" in page.text
    assert re.findall(r"\b(nan|NaN|inf|None)\b", page.text) == []


@pytest.mark.parametrize("planar", [True, False], ids=["planar", "3-D"])
def test_without_truth_the_page_says_so_and_shows_the_rest(planar):
    page = Page(render_report(basin_comparison(60, planar=planar, truth=False)))
    assert "The log has no ground truth" in page.text
    assert "Per update, median" in page.text
    assert "Position error" not in page.text
    assert len(page.named("svg")) == 5


def test_every_reason_of_refusal_is_counted(comparison, page):
    log = comparison.runs[0].detections
    assert log is not None
    for outcome in [Outcome.USED, Outcome.NEW, *REFUSALS]:
        count = log.outcomes.count(outcome)
        assert re.search(rf"{re.escape(outcome.value.capitalize())} {count} \(", page.text)
    assert f"All detections {len(log)}" in page.text


def test_nees_is_shown_with_what_is_expected(comparison):
    far = with_score(comparison, "isam2", "causal.nees_position", Score(3.0, "1", "Mean.", (0.9, 1.1), "inside"))
    rows = dict(zip(score_keys(far), score_table(far).rows, strict=True))
    assert rows["causal.nees_yaw"][-1].text == "1 is consistent"
    assert rows["causal.nees_position"][2].note == "over-confident; expected 0.900 to 1.10"


def test_page_can_be_read_without_seeing_it(page):
    assert page.named("html")[0]["lang"] == "en"
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert all(deeper - level <= 1 for level, deeper in pairwise(levels))
    assert all(attrs.get("scope") for attrs in page.named("th"))
    assert all(len(attrs["aria-label"] or "") > 40 for attrs in page.named("svg"))
    assert len(page.named("svg")) == 7
    scrolling = [attrs for attrs in page.named("div") if attrs.get("class") == "scroll"]
    assert all(attrs.get("aria-label") and attrs.get("tabindex") == "0" for attrs in scrolling)


def contrast(first: str, second: str) -> float:
    """WCAG 2.1 contrast ratio."""

    def luminance(colour: str) -> float:
        parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    lighter, darker = sorted([luminance(first), luminance(second)], reverse=True)
    return (lighter + 0.05) / (darker + 0.05)


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_text_and_lines_stand_out_from_the_paper(html, scheme):
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    block = re.findall(r":root \{(.*?)\}", html, flags=re.DOTALL)[scheme]
    colours = dict(re.findall(r"(--[\w-]+): (#[0-9a-f]{6})", block))
    for name, least in {"--ink": 7, "--muted": 4.5, "--link": 4.5, "--warning": 4.5}.items():
        assert contrast(colours[name], colours["--paper"]) >= least, name
    for index in range(6):
        assert contrast(colours[f"--run-{index}"], colours["--paper"]) >= 3


@pytest.mark.slow
def test_a_long_mission_still_makes_a_small_page(tmp_path: Path):
    write_page(basin_comparison(4078), tmp_path)
    assert (tmp_path / "report.html").stat().st_size < 3_000_000


def test_only_the_repeated_experiment_stands_beside_the_paper(comparison: Comparison) -> None:
    same = replace(comparison, sequence=replace(comparison.sequence, true_landmarks=published_maps()[1]))
    for shown, is_repeated in ((comparison, False), (same, True)):
        text = Page(render_report(shown)).text
        assert ("2014 paper" in text) == is_repeated
        assert ("4.81 (\N{MINUS SIGN}0.19)" in text) == is_repeated
        assert "Positions in the map at the end, metres; in brackets estimate minus truth" in text
