"""The page in Chromium: nothing in the console, nothing cut off, figures drawn, tables sort, axe finds nothing serious.

Chromium comes from the system; axe-core from npm: ``SONAR_GRAPH_AXE`` names its ``axe.min.js``, or it lies in
``node_modules``.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.report import write_batch_report, write_page
from tests.recorded_batches import LOGS, drawn_batch, with_failures
from tests.synthetic import basin_comparison, with_run

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install playwright"
)
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    None,
)
AXE = Path(
    os.environ.get(
        "SONAR_GRAPH_AXE",
        Path(__file__).parents[2] / "node_modules/axe-core/axe.min.js",
    )
)
PHONE = 390
DESKTOP = 1280
SMALLEST_TEXT_PX = """Math.min(...[...document.querySelectorAll("svg text")].filter(one => one.checkVisibility())
  .map(one => parseFloat(getComputedStyle(one).fontSize) * Math.hypot(one.getScreenCTM().a, one.getScreenCTM().b)))"""
VISIBLE_WORDS = "document.body.innerText.split(/\\s+/).filter(Boolean).length"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt install chromium"),
]


@pytest.fixture(scope="module")
def page_file(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("batch")
    return write_batch_report(
        with_failures(drawn_batch(), "ekf-slam", LOGS[1], 2), folder
    )


@pytest.fixture(scope="module")
def page_of_many_logs(tmp_path_factory) -> Path:
    logs = tuple(f"tracks, wrong_id_rate={rate}" for rate in range(9))
    return write_batch_report(
        drawn_batch(6, logs=logs), tmp_path_factory.mktemp("many")
    )


@pytest.fixture(scope="module")
def comparison_file(tmp_path_factory) -> Path:
    comparison = basin_comparison(240)
    first = replace(comparison.runs[0], withheld=["landmark 1: a finding of the run"])
    return write_page(
        with_run(comparison, first), tmp_path_factory.mktemp("comparison")
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox"]
        )
        yield chromium
        chromium.close()


@contextmanager
def opened(
    browser: Any, file: Path, width: int, scheme: str = "light"
) -> Iterator[tuple[Any, list[str]]]:
    """The page, and its console's messages."""
    page = browser.new_page(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    )
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(file.as_uri())
    yield page, said
    page.close()


@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_the_console_is_silent_and_nothing_overflows(
    browser, page_file, page_of_many_logs, tmp_path, width
):
    wide = "document.documentElement.scrollWidth"
    with opened(browser, page_of_many_logs, width) as (page, said):
        assert page.evaluate("document.documentElement.scrollHeight") < 25_000
        assert (
            page.evaluate(
                "document.querySelector('#table-overview').getBoundingClientRect().bottom"
            )
            <= 900
        )
        assert page.evaluate(wide) <= width
        assert said == []
    with opened(browser, page_file, width) as (page, said):
        page.evaluate(
            "document.querySelectorAll('details').forEach(one => one.open = true)"
        )
        assert page.evaluate(wide) <= width
        assert said == []
    broken = tmp_path / "broken.html"
    text = page_file.read_text("utf-8").replace(
        "</main>", '<div style="width: 3000px">wide</div></main>'
    )
    broken.write_text(text.replace("<script>", "<script>nothing();"), "utf-8")
    with opened(browser, broken, width) as (page, said):  # the checks can fail
        assert page.evaluate(wide) > width
        assert any("nothing is not defined" in line for line in said)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_the_first_screen_has_sentence_and_map(browser, comparison_file, width, scheme):
    box = "document.querySelector('{}').getBoundingClientRect()"
    with opened(browser, comparison_file, width, scheme) as (page, said):
        assert page.evaluate(
            "document.querySelector('.headline').textContent"
        ).startswith("isam2 is nearest to the truth")
        shown = f"#figure-map svg:nth-child({1 if width == DESKTOP else 2})"
        order = [".summary", ".headline", shown, "#table-compact"]
        tops = [page.evaluate(box.format(one) + ".top") for one in order]
        assert tops == sorted(tops)
        assert page.evaluate(box.format(shown) + ".bottom") <= 800
        assert page.evaluate(box.format(shown) + ".right") <= width
        assert page.evaluate(box.format("#table-compact") + ".right") <= width
        if width == DESKTOP:
            assert page.evaluate(box.format(shown) + ".width") >= 700
            assert page.evaluate(box.format("#table-compact") + ".bottom") <= 800
            # beside the map, however high that is
            findings = page.evaluate(box.format(".findings summary") + ".bottom")
            assert findings < page.evaluate(box.format(shown) + ".bottom")
        assert page.evaluate(SMALLEST_TEXT_PX) >= 12
        assert page.evaluate(VISIBLE_WORDS) <= 1500
        ink, paper = page.evaluate(
            "[getComputedStyle(document.querySelector('#figure-map svg text')).fill, "
            "getComputedStyle(document.body).backgroundColor]"
        )
        assert (sum(_rgb(ink)) > sum(_rgb(paper))) == (scheme == "dark")
        page.evaluate(
            "document.querySelectorAll('details').forEach(one => one.open = true)"
        )
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert said == []


@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_one_switch_aligns_figures_tables_and_headline(browser, comparison_file, width):
    seen = "[...document.querySelectorAll('{}')].map(one => one.checkVisibility())"
    with opened(browser, comparison_file, width) as (page, said):
        for chosen, other in (("aligned", "raw"), ("raw", "aligned")):
            page.locator(f"label[for=show-{chosen}]").click()
            shown = page.evaluate(seen.format(f".{chosen}"))
            assert len(shown) >= 6
            assert all(shown)
            assert not any(page.evaluate(seen.format(f".{other}")))
        assert said == []


def test_folded_chapters_of_a_comparison_stand_on_paper(browser, comparison_file):
    folded = (
        "[...document.querySelectorAll('details.chapter:not([open]) > :not(summary)')]"
    )
    with opened(browser, comparison_file, DESKTOP) as (page, _):
        assert page.evaluate(f"{folded}.length") > 5
        assert not page.evaluate(f"{folded}.some(one => one.checkVisibility())")
        page.emulate_media(media="print")
        assert page.evaluate(f"{folded}.every(one => one.checkVisibility())")


def test_paper_has_folded_tables_and_light_colours(
    browser, page_file, page_of_many_logs, tmp_path
):
    shown = "document.querySelector('#table-consistency').checkVisibility()"
    with opened(browser, page_of_many_logs, DESKTOP) as (page, _):
        for event, is_shown in (
            ("click", False),
            ("beforeprint", True),
            ("afterprint", False),
        ):
            page.evaluate(f"dispatchEvent(new Event('{event}'))")
            assert page.evaluate(shown) is is_shown
    with opened(browser, page_file, DESKTOP, "dark") as (page, _):
        page.emulate_media(media="print")
        assert (
            sum(_rgb(page.evaluate("getComputedStyle(document.body).backgroundColor")))
            == 3 * 255
        )
        page.pdf(path=str(tmp_path / "page.pdf"), format="A4")
    assert (tmp_path / "page.pdf").stat().st_size > 10_000


def test_tables_sort_by_number_and_back_with_the_keyboard(browser, page_file):
    rows = "document.querySelectorAll('#table-difference-ate-se2-m tbody tr')"
    values = (
        f"[...{rows}].map(row => row.children[3].dataset.sort).filter(text => text)"
    )
    last = f"[...{rows}].at(-1).children[3].dataset.sort"
    with opened(browser, page_file, DESKTOP) as (page, _):
        button = page.locator("#table-difference-ate-se2-m th button").nth(3)
        button.focus()
        page.keyboard.press("Enter")
        upwards = page.evaluate(values)
        assert button.locator("..").get_attribute("aria-sort") == "ascending"
        page.keyboard.press("Enter")
        downwards = page.evaluate(values)
        assert page.evaluate(last) == "", "what has no mean stays at the end"
    assert len(upwards) > 3
    assert list(map(float, upwards)) == sorted(map(float, upwards))
    assert list(map(float, downwards)) == sorted(map(float, downwards), reverse=True)


@pytest.mark.skipif(
    not AXE.is_file(),
    reason="no axe-core: npm install axe-core, or set SONAR_GRAPH_AXE",
)
@pytest.mark.parametrize(("width", "scheme"), [(PHONE, "light"), (DESKTOP, "dark")])
@pytest.mark.parametrize("kind", ["page_file", "comparison_file"])
def test_axe_finds_nothing_serious(browser, request, kind, width, scheme):
    with opened(browser, request.getfixturevalue(kind), width, scheme) as (page, _):
        page.evaluate(
            "document.querySelectorAll('details').forEach(one => one.open = true)"
        )
        page.evaluate(AXE.read_text("utf-8"))
        found = _serious(page)
        page.evaluate(
            "document.querySelectorAll('figure svg').forEach(one => one.removeAttribute('aria-label'))"
        )
        assert found == []
        assert _serious(page), "a figure without a name is found: the check can fail"


def _serious(page: Any) -> list[str]:
    violations = page.evaluate("axe.run().then(outcome => outcome.violations)")
    return [
        f"{one['id']}: {one['nodes'][0]['html'][:200]}"
        for one in violations
        if one["impact"] in ("serious", "critical")
    ]


def _rgb(colour: str) -> list[float]:
    return [float(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]
