"""Ranks in the site's search: pages that a user looks for come before pages of docstrings, design and copies of files."""

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

RANKS = {
    "install.md": 4.0,
    "results.md": 4.0,
    "quick_start.md": 2.0,
    "howto/": 3.0,
    "tutorials/": 3.0,
    "reference/": 0.2,
    "design/": 0.3,
    "source/": 0.1,
}
"""Factor of the score of a page, by the beginning of its path; 1 elsewhere."""


def on_page_markdown(
    markdown: str,
    page: Page,
    config: MkDocsConfig,  # noqa: ARG001
    files: Files,  # noqa: ARG001
) -> str:
    """Set the rank of a page."""
    for start, boost in RANKS.items():
        if page.file.src_uri.startswith(start):
            page.meta.setdefault("search", {}).setdefault("boost", boost)
    return markdown
