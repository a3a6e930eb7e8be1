"""Copies of files of the repository that pages link to, so that no link leads away from the site.

Pages are written to be read in the repository too: ``../../sonar_graph/motion.py`` is a link there. Here it leads to a
page with the text of that file, ``../CHANGELOG.md`` to the changelog as a page, a folder to the list of its files.
"""

import os
import re
from pathlib import Path, PurePosixPath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from tutorial_pages import page_of_script

ROOT = Path(__file__).parents[2]
LINK = re.compile(
    r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]+)(?P<anchor>#[^)\s]*)?\)"
)
LANGUAGES = {".py": "python", ".toml": "toml", ".yml": "yaml", ".cff": "yaml"}
places: dict[str, Path] = {}
"""Of each page, the file in the repository that its links start from."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each file outside the documentation that a page, or such a copy, links to."""
    places.clear()
    waiting = []
    for file in files.documentation_pages():
        places.setdefault(file.src_uri, ROOT / "docs" / file.src_uri)
        waiting.append(file)
    while waiting:
        file = waiting.pop()
        if places[file.src_uri].suffix != ".md" and file.src_uri.startswith("source/"):
            continue
        for link in LINK.finditer(file.content_string):
            path = _outside(places[file.src_uri], link["target"], files)
            if path is None or files.get_file_from_path(uri := _page_of(path)):
                continue
            places[uri] = path
            files.append(File.generated(config, uri, content=_text_of(path)))
            waiting.append(files.get_file_from_path(uri))
    return files


def on_page_markdown(
    markdown: str,
    page: Page,
    config: MkDocsConfig,  # noqa: ARG001
    files: Files,
) -> str:
    """Turn links to the repository into links to the pages that hold its files."""
    here = page.file.src_uri

    def turned(link: re.Match[str]) -> str:
        path = _outside(places[here], link["target"], files)
        if path is None:
            if not here.startswith("source/"):
                return link[0]
            path = (places[here].parent / link["target"]).resolve()
            if not path.is_relative_to(ROOT / "docs"):
                return link[0]
            uri = path.relative_to(ROOT / "docs").as_posix()
        else:
            uri = _page_of(path)
        anchor = link["anchor"] or "" if path.suffix == ".md" else ""
        return f"[{link['text']}]({os.path.relpath(uri, PurePosixPath(here).parent)}{anchor})"

    return LINK.sub(turned, markdown)


def _outside(place: Path, target: str, files: Files) -> Path | None:
    """The file of the repository that a link means, None where it is on the site by itself."""
    if "://" in target or target.startswith("mailto:"):
        return None
    path = (place.parent / target).resolve()
    if not path.exists() or not path.is_relative_to(ROOT):
        return None
    own = (
        path.relative_to(ROOT / "docs").as_posix()
        if path.is_relative_to(ROOT / "docs")
        else None
    )
    page = None if own is None else files.get_file_from_path(own)
    return path if page is None or page.inclusion.is_excluded() else None


def _page_of(path: Path) -> str:
    if (page := page_of_script(path)) is not None:
        return page
    uri = path.relative_to(ROOT).as_posix()
    return f"source/{uri}" if path.suffix == ".md" else f"source/{uri}.md"


def _text_of(path: Path) -> str:
    if path.suffix == ".md":
        return path.read_text("utf-8")
    name = path.relative_to(ROOT).as_posix()
    head = f"---\nsearch:\n  exclude: true\n---\n\n# {name}\n\n"
    if path.is_dir():
        inside = (
            one
            for one in sorted(path.iterdir())
            if not one.name.startswith(("__pycache__", "."))
        )
        return (
            head
            + "\n".join(f"- `{one.name}{'/' * one.is_dir()}`" for one in inside)
            + "\n"
        )
    language = LANGUAGES.get(path.suffix, "text")
    return f'{head}~~~~~~ {{.{language} linenums="1"}}\n{path.read_text("utf-8").rstrip()}\n~~~~~~\n'
