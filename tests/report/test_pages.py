"""Laws of both pages, of a comparison and of a batch: whole, self-contained, escaped, readable; and the front door."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest

from sonar_graph import table
from sonar_graph.evaluation import (
    Score,
    score_table,
)
from sonar_graph.report.batch_page import render_batch
from sonar_graph.report.comparison_page import render_report
from sonar_graph.report.figure_style import ESTIMATOR_COLOURS
from sonar_graph.states import LandmarkMap
from tests.recorded_batches import LOGS, drawn_batch, failed, with_failures
from tests.synthetic import basin_comparison

VOID = {"meta", "br", "wbr", "link", "img", "input", "hr"}
HOSTILE = '"><script>alert(1)</script>'


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


def test_what_a_log_or_an_estimator_says_is_escaped_everywhere():
    """Every text of a log, a suite or an estimator would run a script."""
    compared = basin_comparison(60)
    all_hostile = {HOSTILE: HOSTILE}
    first, *others = compared.runs
    told = replace(first, estimator=HOSTILE, params=all_hostile)
    hostile = replace(
        compared,
        sequence=replace(compared.sequence, name=HOSTILE, notes=all_hostile),
        runs=[told, *others],
        scores=compared.scores | {HOSTILE: {HOSTILE: Score(1.0, HOSTILE, HOSTILE)}},
        environment={"x": HOSTILE},
    )
    batch = drawn_batch()
    lost = [failed(replace(run, log=HOSTILE), reason=HOSTILE) for run in batch.runs[:3]]
    texts = dict.fromkeys(("name", "description", "suite"), HOSTILE)
    named = replace(batch, runs=[*lost, *batch.runs], **texts)
    for text, scripts in (
        (render_report(hostile), 0),
        (render_batch(named), 1),
        (hostile._repr_html_(), 0),
    ):
        Page(text)
        assert text.count("<script") == scripts
        assert "alert(1)" in text
    with pytest.raises(AssertionError):
        Page("<div><p>text</div>")  # the check of tags can fail


def test_a_notebook_shows_sequences_paths_and_maps():
    """Whole tables, of a part of a large map, and nothing that a name could run."""
    compared = basin_comparison(60)
    sequence = replace(compared.sequence, name=HOSTILE)
    path = compared.runs[0].causal
    length_m = np.linalg.norm(np.diff(path.positions, axis=0), axis=1).sum()
    many = LandmarkMap(np.arange(50), np.zeros((50, 3)), np.tile(np.eye(3), (50, 1, 1)))
    assert "<script" not in sequence._repr_html_()
    rows = "imu 2 0.00", "detections 60", "truth 60", "true landmarks 4"
    scores = [cell.text for row in score_table(compared).rows for cell in row]
    for shown, words in (
        (compared, scores),
        (sequence, (HOSTILE, *rows)),
        (path, (f"length of the path {length_m:.2f} m", "covariances known")),
        (sequence.truth, ("covariances unknown",)),
        (path.rows(slice(0, 0)), ("poses 0",)),
        (sequence.true_landmarks, ("Map of 4 landmarks", "1 5.000 0.900 -1.000")),
        (many, ("20 more are not shown",)),
    ):
        text = Page(shown._repr_html_()).text
        assert all(word in text for word in words)


def drawn(kind: str) -> str:
    if kind == "comparison":
        return render_report(basin_comparison(120))
    return render_batch(with_failures(drawn_batch(), "ekf-slam", LOGS[1], 2))


@pytest.fixture(scope="module", params=["comparison", "batch"])
def kind(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def html(kind) -> str:
    return drawn(kind)


@pytest.fixture(scope="module")
def page(html) -> Page:
    return Page(html)


def test_a_page_fetches_nothing_and_only_that_of_a_batch_has_a_script(page, html, kind):
    keys = "src", "href", "xlink:href"
    addresses = [attrs.get(key) for _, attrs in page.tags for key in keys]
    addresses = list(filter(None, addresses))
    assert len(addresses) > 20
    assert not [one for one in addresses if re.match(r"(?!data:)[a-z]+:|//|/", one)]
    assert "@import" not in html
    assert re.findall(r"url\((?!#)", html) == []
    assert page.named("script") == ([{}] if kind == "batch" else [])
    assert page.named("iframe", "img") == []


def test_links_lead_somewhere_and_ids_are_unique(page, kind, html):
    ids = [attrs["id"] for _, attrs in page.tags if attrs.get("id")]
    assert len(ids) == len(set(ids))
    targets = {attrs["href"] or "" for attrs in page.named("a", "use")}
    assert {one[1:] for one in targets if one.startswith("#")} <= set(ids)
    assert kind == "comparison" or drawn(kind) == html


def test_a_page_can_be_read_without_seeing_it(page, kind):
    assert page.named("html")[0]["lang"] == "en"
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert all(deeper - level <= 1 for level, deeper in pairwise(levels))
    assert all(attrs.get("scope") for attrs in page.named("th"))
    assert all(len(attrs["aria-label"] or "") > 40 for attrs in page.named("svg"))
    assert len(page.named("svg")) == {"comparison": 11, "batch": 3}[kind]
    scrolling = [attrs for attrs in page.named("div") if attrs.get("class") == "scroll"]
    assert all(
        attrs.get("aria-label") and attrs.get("tabindex") == "0" for attrs in scrolling
    )


def contrast(first: str, second: str) -> float:
    """WCAG 2.1 contrast ratio."""

    def luminance(colour):
        parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        linear = np.where(
            parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4
        )
        return float(linear @ [0.2126, 0.7152, 0.0722])

    lighter, darker = sorted([luminance(first), luminance(second)], reverse=True)
    return (lighter + 0.05) / (darker + 0.05)


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_text_and_lines_stand_out_from_the_paper(html, scheme):
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    block = re.findall(r":root \{(.*?)\}", html, flags=re.DOTALL)[scheme]
    colours = dict(re.findall(r"(--[\w-]+): (#[0-9a-f]{6})", block))
    runs = [name for name in colours if name.startswith("--run-")]
    assert len(runs) == len(ESTIMATOR_COLOURS) == table.RUN_COLOURS
    texts = dict.fromkeys(("--muted", "--link", "--warning"), 4.5)
    for name, least in (texts | dict.fromkeys(runs, 3) | {"--ink": 7}).items():
        assert contrast(colours[name], colours["--paper"]) >= least, name
