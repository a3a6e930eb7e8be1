"""The built site: no dead link, nothing from elsewhere, and in Chromium no console message, nothing cut off or inaccessible.

``make docs`` writes it to ``build/site``, or ``SONAR_GRAPH_SITE`` names its folder. It is opened as files, as a reader
does who has no network.
"""

import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag

import pytest

ROOT = Path(__file__).parents[2]
SITE = Path(os.environ.get("SONAR_GRAPH_SITE", ROOT / "build" / "site"))
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    None,
)
AXE = Path(os.environ.get("SONAR_GRAPH_AXE", ROOT / "node_modules/axe-core/axe.min.js"))
PHONE = 390
DESKTOP = 1280
LOADED = {
    ("script", "src"),
    ("img", "src"),
    ("iframe", "src"),
    ("link", "href"),
    ("source", "src"),
}
"""What a browser fetches by itself."""
OPENED = [
    "index.html", "install.html", "quick_start.html", "results.html", "reference/index.html",
    "gallery/index.html", "settings.html", "limits.html", "messages.html",
    "tutorials/01_first_comparison.html", "tutorials/07_batches.html", "howto/own_estimator.html",
    "tutorials/12_notebook.html", "theory/isam2.html",
    "theory/metrics.html", "theory/from_the_paper.html", "reference/conventions.html", "reference/sonar_graph.html",
    "reference/sonar_graph.slam.html", "source/CHANGELOG.html", "source/sonar_graph/motion.py.html",
    "CONTRIBUTING.html",
]  # fmt: skip
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SITE.is_dir(), reason="no site: make docs"),
]
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no Chromium: apt install chromium"
)


class Page(HTMLParser):
    """Links, identifiers and loaded files of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.ids: set[str] = set()
        self.feed(path.read_text("utf-8"))

    def handle_starttag(
        self, tag: str, attributes: list[tuple[str, str | None]]
    ) -> None:
        for name, value in attributes:
            if name in ("id", "name") and value:
                self.ids.add(value)
            elif (tag, name) in LOADED and value:
                self.loaded.append(value)
            elif tag == "a" and name == "href" and value:
                self.links.append(value)


@pytest.fixture(scope="module")
def pages() -> dict[Path, Page]:
    """All pages of ours; 404.html has links from the root of a server, and reports are pages of their own."""
    own = [
        path
        for path in sorted(SITE.rglob("*.html"))
        if path.name not in ("404.html", "report.html")
    ]
    return {path: Page(path) for path in own}


def dead(path: Path, link: str, pages: dict[Path, Page]) -> bool:
    """True where a link of a page leads to no file, or to no place on that page."""
    target, anchor = urldefrag(unquote(link))
    if re.match(r"[a-z]+:", target):
        return False
    found = (path.parent / target).resolve() if target else path
    if not found.is_file():
        return True
    return bool(anchor) and found in pages and anchor not in pages[found].ids


def test_no_link_is_dead(pages):
    assert len(pages) > 60
    found = [
        f"{path.relative_to(SITE)}: {link}"
        for path, page in pages.items()
        for link in {*page.links, *page.loaded}
        if dead(path, link, pages)
    ]
    assert found == []
    home = SITE / "index.html"
    assert all(
        dead(home, wrong, pages) for wrong in ("nowhere.html", "settings.html#nowhere")
    ), "the check can fail"


def test_nothing_is_loaded_from_elsewhere(pages):
    styles = [path.read_text("utf-8") for path in SITE.rglob("*.css")]
    assert styles
    assert [
        url
        for page in pages.values()
        for url in page.loaded
        if re.match(r"(https?:)?//", url)
    ] == []
    assert (
        re.findall(
            r"url\([\"']?(?:https?:)?//[^)]*|@import[^;]*//[^;]*", "".join(styles)
        )
        == []
    )


def test_every_name_of_the_reference_has_its_place(pages):
    for package, names in tomllib.loads(
        (ROOT / "docs/reference/names.toml").read_text("utf-8")
    ).items():
        ids = pages[SITE / "reference" / f"{package}.html"].ids
        assert [
            name for name in names if not any(one.endswith(f".{name}") for one in ids)
        ] == []


def test_tutorials_have_the_output_of_their_programs():
    for script in (ROOT / "docs" / "tutorials").glob("[0-9]*.py"):
        assert '<span class="filename">Output</span>' in (
            SITE / "tutorials" / f"{script.stem}.html"
        ).read_text("utf-8")
    assert (SITE / "tutorials/01_first_comparison/comparison/report.html").is_file()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip(
        "playwright.sync_api",
        reason="playwright is not installed: pip install playwright",
    )
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox"]
        )
        yield chromium
        chromium.close()


@contextmanager
def opened(
    browser: Any, name: str, width: int, scheme: str = "light"
) -> Iterator[tuple[Any, list[str]]]:
    """A page of the site, and its console's messages."""
    page = browser.new_page(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    )
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto((SITE / name).as_uri())
    yield page, said
    page.close()


@needs_browser
@pytest.mark.parametrize("name", OPENED)
def test_nothing_is_said_in_the_console_and_nothing_sticks_out(browser, name):
    for width in (PHONE, DESKTOP):
        with opened(browser, name, width) as (page, said):
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert said == []


@needs_browser
def test_a_page_that_is_wrong_is_found(browser, tmp_path):
    broken = tmp_path / "broken.html"
    broken.write_text(
        '<html><body><script>nothing();</script><div style="width: 3000px">wide</div></body></html>'
    )
    with opened(browser, str(broken), PHONE) as (page, said):
        assert page.evaluate("document.documentElement.scrollWidth") > PHONE
        assert any("nothing is not defined" in line for line in said)


@needs_browser
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("install", "install"),
        ("csv units", "tutorials/11_tables"),
        ("convert csv", "tutorials/11_tables"),
        ("inspect --toml", "tutorials/04_your_own_log"),
        ("plot trajectory", "tutorials/03_viewers"),
        ("own estimator", "howto/own_estimator"),
        ("suites", "tutorials/07_batches"),
        ("results", "results"),
        ("preintegration", "preintegration"),
        ("max-mixture", "theory/doubtful_identities"),
    ],
)
def test_search_finds_the_right_page_first_without_a_server(browser, words, expected):
    with opened(browser, "index.html", DESKTOP) as (page, said):
        page.locator("input.md-search__input").click()
        page.keyboard.type(words)
        page.wait_for_selector("a.md-search-result__link", timeout=20_000)
        page.wait_for_timeout(500)  # results of the words before the last
        first = page.locator("a.md-search-result__link").first.get_attribute("href")
        assert expected in first
        assert said == []


@needs_browser
@pytest.mark.skipif(
    not AXE.is_file(),
    reason="no axe-core: npm install axe-core, or set SONAR_GRAPH_AXE",
)
@pytest.mark.parametrize("name", OPENED)
def test_axe_finds_nothing_serious(browser, name):
    for width, scheme in ((PHONE, "light"), (DESKTOP, "dark")):
        with opened(browser, name, width, scheme) as (page, _):
            assert serious(page) == []


@needs_browser
@pytest.mark.skipif(
    not AXE.is_file(),
    reason="no axe-core: npm install axe-core, or set SONAR_GRAPH_AXE",
)
def test_axe_finds_a_picture_without_a_description(browser):
    with opened(browser, "index.html", DESKTOP) as (page, _):
        page.evaluate("document.querySelector('article img').removeAttribute('alt')")
        assert any("image-alt" in one for one in serious(page))


def serious(page: Any) -> list[str]:
    """What axe calls serious or critical, of the page itself; reports in frames have tests of their own."""
    page.evaluate(AXE.read_text("utf-8"))
    violations = page.evaluate(
        "axe.run({iframes: false}).then(outcome => outcome.violations)"
    )
    return [
        f"{one['id']}: {one['nodes'][0]['html'][:200]}"
        for one in violations
        if one["impact"] in ("serious", "critical")
    ]
