"""Notebooks among the tutorials, as pages: run from top to bottom while the site is built, output below each cell.

They are stored without output, so that what a page shows is what this version prints. A cell that fails ends the build.
"""

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from tutorial_pages import TUTORIALS

LONGEST_S = 500
"""Longest time that a cell may take, s."""
SVG = "image/svg+xml"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook among the tutorials, and the figures that it draws."""
    for path in sorted(TUTORIALS.glob("[0-9]*.ipynb")):
        text, figures = page_of_cells(executed(path), path.stem)
        head = f"The notebook is `docs/tutorials/{path.name}`; this page shows it with its output.\n\n"
        title, _, rest = text.partition("\n\n")
        uri = f"tutorials/{path.stem}.md"
        files.append(File.generated(config, uri, content=f"{title}\n\n{head}{rest}"))
        for name, svg in figures.items():
            uri = f"tutorials/{path.stem}/{name}"
            files.append(File.generated(config, uri, content=svg))
    return files


def executed(path: Path) -> Any:
    """The notebook with outputs, run in a folder of its own."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        place = {"metadata": {"path": folder}}
        client = NotebookClient(
            notebook, timeout=LONGEST_S, kernel_name="python3", resources=place
        )
        try:
            client.execute()
        except CellExecutionError as error:
            raise PluginError(f"{path.name}: {error}") from error
    return notebook


def page_of_cells(notebook: Any, name: str) -> tuple[str, dict[str, str]]:
    """Markdown of a notebook with outputs, and its figures by file name."""
    parts: list[str] = []
    figures: dict[str, str] = {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            if output.output_type == "stream" and output.name == "stdout":
                parts.append(as_text(output.text))
            data = output.get("data", {})
            if SVG in data:
                file = f"figure_{len(figures) + 1}.svg"
                figures[file] = data[SVG]
                parts.append(f"![What the cell drew]({name}/{file})")
            elif data:
                parts.append(shown(data))
    return "\n\n".join(parts) + "\n", figures


def shown(data: Mapping[str, str]) -> str:
    """What a cell shows by its last expression: as HTML where it has one."""
    if "text/html" not in data:
        return as_text(data["text/plain"])
    # a blank line would end the block of HTML
    return re.sub(r"\n\s*\n", "\n", data["text/html"]).strip()


def as_text(text: str) -> str:
    """Printed output."""
    return f'```text title="Output"\n{text.strip()}\n```'
