"""The list of all result tables, on the page of results: title, link and measuring command of each file."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
PAGE = "results.md"
MARKED = re.compile(r"<!-- result tables -->.*<!-- end -->", re.DOTALL)
TITLE = re.compile(r"^# (.*)$", re.MULTILINE)
COMMAND = re.compile(r"^Measured by `([^`]*)`", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace the marked paragraph of the page by a list of the files in ``benchmarks/results``."""
    page = files.get_file_from_path(PAGE)
    if page is None:
        return files
    lines = []
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.md")):
        text = path.read_text("utf-8")
        title = TITLE.search(text)
        command = COMMAND.search(text)
        by = f": `{command[1]}`" if command else ""
        lines.append(
            f"- [{title[1] if title else path.stem}](../benchmarks/results/{path.name}){by}"
        )
    written = page.content_string
    content = MARKED.sub(lambda _: "\n".join(lines), written)
    files.remove(page)
    files.append(File.generated(config, PAGE, content=content))
    return files
